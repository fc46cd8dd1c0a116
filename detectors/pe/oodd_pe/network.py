"""The ensemble's networks in torch: forecasts of a whole distribution, and their training.

A network describes the change of all sensors, in units of the errors of a linear forecast. It gives
means, scales, a triangular matrix of dependences, and how heavy each tail is, all by the inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_torch.optimizers import Adam, Average, Muon
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import silu, smooth_l1_loss

from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.state import Arrays

LAYERS: Final = 3
CHUNK: Final = 4096
"""Rows that are looked at together outside the training: bounds memory."""
COMPARED: Final = 8192
"""Most held-out rows by which a member is judged between rounds."""
SURVEYED: Final = 65_536
"""Training rows at most from which least scales are taken, evenly spread: bounds memory."""
RATE: Final = 8e-3
"""Learning rate of biases and output layers."""
HIDDEN_RATE: Final = 0.03
"""Learning rate of the weights of hidden layers, by Muon."""
DECAY: Final = 0.998
FIRST: Final = 30
"""Most updates of the first round."""
WARM_UP: Final = 100
"""Updates in which the rates rise from 0."""
MEAN_FIRST: Final = 0.25
"""Share of a round's updates in which squared errors weigh more than the likelihood.

A likelihood alone widens the scales of what it could still learn to forecast.
"""
LOG_SCALE: Final = 12.0
"""Largest size of the logarithm of a scale."""
LEAST_SCALES: Final = 0.01
"""Share of the training rows with smaller scales than the least that a forecast may have.

Far from its training inputs a network says that it knows nothing. It would forecast errors a
hundred times as wide as any in training, and an anomaly would be hidden by the inputs that it
corrupts.
"""
LOG_TAIL: Final = math.log(8.0)
"""Half the logarithm of the largest degrees of freedom, 64; the least are 1."""


class Forecast(NamedTuple):
    """Forecasts of M networks for N rows of D sensors, and how far outcomes are from them.

    Attributes
    ----------
    residual
        Whitened residuals e = s (I + U) (y - mean), (M, N, D).
    log_scale
        Logarithms of s, (M, N, D).
    log_tail
        Logarithms of the degrees of freedom of each residual's t distribution, (M, N, D).
    mean
        Forecasts, (M, N, D).
    """

    residual: Tensor
    log_scale: Tensor
    log_tail: Tensor
    mean: Tensor

    def surprise(self) -> Tensor:
        """Return the negative log likelihoods of the rows, (M, N)."""
        nu = self.log_tail.exp()
        half = (nu + 1) / 2
        log_density = (
            torch.lgamma(half)
            - torch.lgamma(nu / 2)
            - 0.5 * (self.log_tail + math.log(math.pi))
            + self.log_scale
            - half * torch.log1p(self.residual.square() / nu)
        )
        return -log_density.sum(-1)


class DensityNetworks(torch.nn.Module):
    """M independent networks that forecast densities, trained and evaluated together.

    Parameters
    ----------
    members, inputs, sensors, width
        M, I, D and units of each hidden layer.
    seed
        Decides the initial weights.
    """

    def __init__(self, members: int, inputs: int, sensors: int, width: int, seed: int = 0) -> None:
        super().__init__()
        self.members, self.sensors = members, sensors
        random = torch.Generator().manual_seed(seed)

        def drawn(rows: int, columns: int, size: float = 1.0) -> Parameter:
            weights = torch.randn(members, rows, columns, generator=random)
            return Parameter(weights * (size / math.sqrt(rows)))

        sizes = [inputs] + [width] * LAYERS
        outputs = 3 * sensors + sensors * (sensors - 1) // 2
        self.weights = torch.nn.ParameterList(map(drawn, sizes[:-1], sizes[1:]))
        self.biases = torch.nn.ParameterList(
            Parameter(torch.zeros(members, 1, width)) for _ in range(LAYERS)
        )
        self.out = drawn(width, outputs, 0.1)
        self.out_bias = Parameter(torch.zeros(members, 1, outputs))
        row, column = np.tril_indices(sensors, -1)
        self.row: Tensor
        self.column: Tensor
        self.floor: Tensor
        self.register_buffer("floor", torch.full((members, 1, sensors), -math.inf))
        self.register_buffer("row", torch.from_numpy(row), persistent=False)
        self.register_buffer("column", torch.from_numpy(column), persistent=False)

    def forward(self, x: Tensor, y: Tensor) -> Forecast:
        """Judge outcomes y, (M, N, D), by inputs x, (M, N, I)."""
        # Rows last: what is gathered by sensor is then contiguous, and several times as quick.
        layers = zip([*self.weights, self.out], [*self.biases, self.out_bias], strict=True)
        hidden = silu(_layer(x.mT, *next(layers)))
        for _ in range(LAYERS - 1):
            hidden = hidden + silu(_layer(hidden, *next(layers)))
        out = _layer(hidden, *next(layers))
        d = self.sensors
        mean, scale, tail, dependence = torch.split(out, [d, d, d, out.shape[1] - 3 * d], 1)
        log_scale = torch.maximum(LOG_SCALE * torch.tanh(scale / LOG_SCALE), self.floor.mT)
        log_tail = LOG_TAIL * (1 + torch.tanh(tail))
        error = y.mT - mean
        known = dependence * error[:, self.column]
        residual = log_scale.exp() * error.index_add(1, self.row, known)
        return Forecast(residual.mT, log_scale.mT, log_tail.mT, mean.mT)

    @torch.no_grad()
    def likelihood(self, x: Tensor, y: Tensor, rows: Sequence[NDArray[np.int64]]) -> float:
        """Return the mean log density of each member's own rows, by sensor; NaN without any.

        From inputs (N, I), outcomes (M, N, D) and indices of rows of each member, of which as many
        count as the least has.
        """
        count = min(*(len(r) for r in rows), COMPARED)
        if not count:
            return math.nan
        spread = [r[np.arange(count) * len(r) // count] for r in rows]
        members = torch.arange(self.members, device=x.device)[:, None]
        total = 0.0
        every = torch.from_numpy(np.stack(spread)).to(x.device)
        for index in torch.split(every, CHUNK, dim=1):
            total -= float(self(x[index], y[members, index]).surprise().sum())
        return total / (count * self.members * self.sensors)

    @torch.no_grad()
    def least_scales(self, x: Tensor, y: Tensor) -> Tensor:
        """Return each member's and sensor's least log scale for training rows, (M, 1, D).

        From inputs (N, I) and outcomes (M, N, D).
        """
        step = -(-len(x) // SURVEYED)
        parts = zip(
            torch.split(x[::step], CHUNK), torch.split(y[:, ::step], CHUNK, dim=1), strict=True
        )
        log_scales = [self(i.expand(self.members, -1, -1), o).log_scale for i, o in parts]
        scales = torch.cat(log_scales, dim=1).cpu().numpy()
        least = round(LEAST_SCALES * scales.shape[1])
        lowest = np.partition(scales, least, axis=1)[:, least : least + 1]
        return torch.from_numpy(lowest).to(x.device)

    def arrays(self) -> Arrays:
        """Return the weights, and the least scales, by name, in double precision."""
        return {name: p.detach().cpu().double().numpy() for name, p in self.state_dict().items()}


def _layer(x: Tensor, weights: Tensor, bias: Tensor) -> Tensor:
    """Return weights' x + bias', (M, O, N), from (M, I, N), (M, I, O) and (M, 1, O)."""
    return torch.baddbmm(bias.mT, weights.mT, x)


def train(
    network: DensityNetworks,
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    rows: Sequence[NDArray[np.int64]],
    held_out: Sequence[NDArray[np.int64]],
    *,
    updates: int,
    batch: int,
    seed: int,
    device: str,
    progress: Progress = ignore_progress,
) -> None:
    """Maximize the likelihood of outcomes given inputs, in place.

    Every member draws batches of its own. Training goes in rounds, each about as long as all before
    it. In a round the rates fall to nothing, and its last weights are averaged. Kept are those by
    which held-out rows are likeliest, and after `WARM_UP` updates a round without gain is the last:
    a few hundred rows are learnt by heart in a hundred updates. Networks are trained in single
    precision.

    Parameters
    ----------
    network
        M networks.
    x
        Inputs, (N, I).
    y
        Outcomes, (M, N, D).
    rows
        Indices of the rows that each member is trained on.
    held_out
        Indices of rows that it is not trained on; without any for a member, all rounds are kept.
    updates, batch
        Most gradient steps, and rows of one.
    seed
        Decides the batches.
    device
        Where torch computes.
    progress
        Called after each update with the share of the updates that is done.
    """
    random = np.random.default_rng([seed, 1])
    network.to(device)
    inputs, outcomes = (torch.from_numpy(v).to(device) for v in (x, y))
    best, kept, done = network.likelihood(inputs, outcomes, held_out), _copied(network), 0
    for total in rounds(updates):
        _round(
            network,
            inputs,
            outcomes,
            rows,
            range(done, total),
            batch=batch,
            random=random,
            progress=lambda done: progress(done / updates),
        )
        done, likelihood = total, network.likelihood(inputs, outcomes, held_out)
        # No comparison is true of what is not a number, where nothing is held out.
        if not likelihood <= best:
            best, kept = likelihood, _copied(network)
        elif done >= WARM_UP:
            break
    network.load_state_dict(kept)
    network.floor = network.least_scales(inputs, outcomes)


def _copied(network: DensityNetworks) -> dict[str, Tensor]:
    return {name: values.clone() for name, values in network.state_dict().items()}


def rounds(updates: int) -> list[int]:
    """Return the numbers of updates after which rounds of a training end, the last of them all.

    Each is twice the one before, about; the first is at most `FIRST`.
    """
    ends = [updates]
    while ends[0] > FIRST:
        ends.insert(0, ends[0] // 2)
    return ends


def _round(
    network: DensityNetworks,
    x: Tensor,
    y: Tensor,
    rows: Sequence[NDArray[np.int64]],
    updates: range,
    *,
    batch: int,
    random: np.random.Generator,
    progress: Callable[[int], object],
) -> None:
    """Train by some updates, numbered from the beginning, over which the rates fall to nothing."""
    rest = [*network.biases, network.out, network.out_bias]
    hidden, others = Muon(network.weights), Adam(rest)
    average = Average(network.parameters(), DECAY)
    one = torch.ones(network.members, device=x.device)
    members = torch.arange(network.members, device=x.device)[:, None]
    for update in updates:
        drawn = np.stack([r[random.integers(0, len(r), batch)] for r in rows])
        index = torch.from_numpy(drawn).to(x.device)
        target = y[members, index]
        forecast = network(x[index], target)
        loss = forecast.surprise().mean(1).sum() / network.sensors
        passed = (update - updates.start) / len(updates)
        if passed < MEAN_FIRST:
            errors = smooth_l1_loss(forecast.mean, target, beta=0.3, reduction="none")
            loss = 0.3 * loss + 3.0 * errors.mean((1, 2)).sum()
        loss.backward()
        decay = 0.5 * (1 + math.cos(math.pi * passed))
        rate = min(1.0, (update + 1) / WARM_UP) * (decay + 1e-3)
        others.step(RATE * rate * one)
        hidden.step(HIDDEN_RATE * rate * one)
        average.update()
        progress(update + 1)
    average.apply()
