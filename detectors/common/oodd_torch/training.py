"""Training of an ensemble: truncated gradients through time, early stopping per network.

Episodes are passed in chunks of consecutive steps; the memory is carried from chunk to chunk, its
gradient is not. Members are independent networks: each has its own order of episodes, learning
rate and stopping point, and they are trained side by side only because one batched matrix product
is quicker than five small ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.windows import windows
from torch import Tensor

from oodd_torch.network import Ensemble
from oodd_torch.optimizers import Adam

SAMPLED: Final = 256
"""Quantile levels that the samples of one update are drawn from, one of each equal part of (0, 1).

Embedding the levels of every step and sensor would take longer than the rest.
"""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Length and settings of a training.

    Attributes
    ----------
    updates
        Gradient steps of every member, at most.
    batch
        Episodes in a batch.
    chunk
        Steps through which gradients flow.
    levels
        Quantile levels of an update.
    rates
        Largest learning rate of each member; warmed up and decayed to a hundredth by a cosine.
    widths
        Width of the quadratic part of each member's quantile loss, kappa, in standard deviations
        of a sensor's change.
    scheduled_sampling
        Probability, at the end of training, that an input is the network's own sample; rises
        linearly from 0.
    evaluations
        How often the loss on held-out episodes is looked at.
    patience
        Evaluations without a better held-out loss, after which training stops.
    """

    updates: int
    batch: int
    chunk: int
    levels: int
    rates: tuple[float, ...]
    widths: tuple[float, ...]
    scheduled_sampling: float = 0.0
    evaluations: int = 20
    patience: int = 6


def quantile_huber(error: Tensor, tau: Tensor, kappa: Tensor | float = 1.0) -> Tensor:
    """Quantile Huber loss of Dabney et al. (2018), elementwise.

    ``rho = |tau - [u < 0]| L(u) / kappa``, ``L(u) = u^2 / 2`` for ``|u| <= kappa``, else
    ``kappa (|u| - kappa / 2)``, with the error ``u = target - prediction``, the level tau that was
    sampled, and kappa, the width of the quadratic part; all are broadcast.
    """
    size = error.abs()
    huber = torch.where(size <= kappa, 0.5 * error * error, kappa * (size - 0.5 * kappa))
    return torch.abs(tau - (error < 0).to(error.dtype)) * huber / kappa


def batches(
    episodes: Sequence[NDArray[np.float32]],
    rngs: Sequence[np.random.Generator],
    window: int,
    schedule: Schedule,
) -> Iterator[tuple[Tensor, Tensor, Tensor, bool]]:
    """Yield chunks of episodes without end: inputs, targets and mask of `arrange`, whether new.

    Every member has a generator of its own for its order of episodes. Chunks of the same episodes
    follow each other, so that the memory can be carried along; the first one is new.
    """
    usable = [e for e in episodes if len(e) > 1]
    size = min(schedule.batch, len(usable))
    while True:
        orders = np.stack([rng.permutation(len(usable)) for rng in rngs])
        for first in range(0, len(usable) - size + 1, size):
            chosen = orders[:, first : first + size]
            x, y, mask = arrange([[usable[i] for i in row] for row in chosen], window)
            for start in range(0, x.shape[1], schedule.chunk):
                part = slice(start, start + schedule.chunk)
                if mask[:, part].any():
                    yield x[:, part], y[:, part], mask[:, part], start == 0


def arrange(
    picked: Sequence[Sequence[NDArray[np.float32]]], window: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Lay out episodes of every member, time before batch.

    Returns inputs (E, T, B, W * D), newest observation first, targets (E, T, B, D) and mask
    (E, T, B).
    """
    members, size = len(picked), len(picked[0])
    longest = max(len(e) for row in picked for e in row) - 1
    d = picked[0][0].shape[1]
    x = np.zeros((members, longest, size, window * d), np.float32)
    y = np.zeros((members, longest, size, d), np.float32)
    mask = np.zeros((members, longest, size), dtype=bool)
    for e, row in enumerate(picked):
        for b, episode in enumerate(row):
            steps = len(episode) - 1
            x[e, :steps, b] = windows(episode, np.arange(steps), window).reshape(steps, -1)
            y[e, :steps, b] = episode[1:]
            mask[e, :steps, b] = True
    return torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(mask)


def predict(
    network: Ensemble, x: Tensor, memory: Tensor, heads: Tensor | None
) -> tuple[Tensor, Tensor]:
    """One pass over a chunk: changes (E, T, B, N, D) to the next rows, and the last memory.

    Parameters
    ----------
    x : (E, T, B, W * D)
    memory : (K, B, H)
    heads : (K, G, H, N * P)
        Output layers at N levels, see `Ensemble.heads_at`: G = T for levels of every step, G = 1
        for levels that all steps share. None without quantiles.

    Returns
    -------
    Changes in the network's units: the prediction is ``o + unit * change``.
    """
    e, t, b, _ = x.shape
    a = network.architecture
    f = network.inputs(x.reshape(e, t * b, -1))
    k, _, h = f.shape
    g = f
    if a.recurrent:
        g, memory = network.run(f.reshape(k, t, b, h), memory)
        g = g.reshape(k, t * b, h)
    z = network.trunk(f, g)  # (K, T * B, H)
    if heads is None:
        change = torch.bmm(z, network.out)
    else:
        change = torch.matmul(z.reshape(k, heads.shape[1], -1, h), heads)
    change = change.reshape(k, t, b, -1, a.outputs) + network.out_bias[:, None, None]
    return network.gather(change), memory


def quantile_huber_slope(error: Tensor, tau: Tensor, kappa: Tensor | float = 1.0) -> Tensor:
    """Return ``|tau - [u < 0]| clip(u / kappa, -1, 1)``, the derivative of `quantile_huber`."""
    return torch.where(error < 0, 1 - tau, tau) * (error / kappa).clamp_(-1, 1)


def _error(network: Ensemble, x: Tensor, y: Tensor, change: Tensor) -> Tensor:
    """Return target minus prediction in the network's units: (E, T, B, N, D)."""
    target = (y - x[..., : network.architecture.features]) / network.unit
    return target[..., None, :] - change


def descend(
    network: Ensemble,
    x: Tensor,
    y: Tensor,
    mask: Tensor,
    memory: Tensor,
    tau: Tensor | None,
    kappa: Tensor,
) -> Tensor:
    """Add the gradients of every network's mean loss; return the last memory.

    The loss is the mean over masked steps, levels and the network's sensors. ``kappa`` has shape
    (E,); ``tau`` (E, N) holds the levels of this update, shared by all steps, episodes and sensors,
    so that their embeddings cost next to nothing. The slope of the loss is handed to the backward
    pass directly: the loss itself, a dozen passes over the largest array of a training step, is
    only needed when it is looked at.
    """
    heads = None if tau is None else network.heads_at(tau)
    change, memory = predict(network, x, memory, heads)
    with torch.no_grad():
        error = _error(network, x, y, change)
        if tau is not None:
            error = quantile_huber_slope(error, tau[:, None, None, :, None], _wide(kappa))
        terms = error.shape[3] * network.architecture.outputs
        steps = mask.sum((1, 2)).clamp(min=1) * terms  # (E,)
        share = mask / steps[:, None, None]
        slope = error.mul_(-share[..., None, None])
    change.backward(slope)  # type: ignore[no-untyped-call]
    return memory


def _wide(per_member: Tensor) -> Tensor:
    """Lay a value of every member, (E,), against (E, T, B, N, D)."""
    return per_member[:, None, None, None, None]


@torch.no_grad()
def evaluate(
    network: Ensemble,
    episodes: Sequence[NDArray[np.float32]],
    levels: int,
    kappa: Tensor,
    share: float = 0.0,
) -> Tensor:
    """Return the held-out loss of every network, (K,), at evenly spaced levels.

    With scheduled sampling a `share` of the inputs are samples here, too, by the same draws every
    time: on true inputs alone the best look would be the one before sampling sets in.
    """
    a = network.architecture
    x, y, mask = (v.to(network.device) for v in arrange([list(episodes)], a.window))
    x, y = (v.expand(network.members, -1, -1, -1) for v in (x, y))
    mask = mask.expand(network.members, -1, -1)
    if share > 0:
        rngs = [np.random.default_rng(e) for e in range(network.members)]
        x = feed_back(network, x, network.start(x.shape[2]), share, rngs)
    even = (torch.arange(levels, device=network.device) + 0.5) / levels
    tau = even.expand(network.members, -1)
    heads = network.heads_at(tau) if a.quantiles else None
    change, _ = predict(network, x, network.start(x.shape[2]), heads)
    error = _error(network, x, y, change)
    if a.quantiles:
        each = quantile_huber(error, tau[:, None, None, :, None], _wide(kappa))
    else:
        each = 0.5 * error.square()
    steps = mask.sum((1, 2))[:, None]
    loss = (each.mean(3) * mask[..., None]).sum((1, 2)) / steps  # (E, D)
    return loss.flatten() if a.per_feature else loss.mean(1)


def train(
    network: Ensemble,
    episodes: Sequence[NDArray[np.float32]],
    held_out: Sequence[NDArray[np.float32]],
    schedule: Schedule,
    rngs: Sequence[np.random.Generator],
) -> list[list[float]]:
    """Train all members in place; each ends at its own best held-out loss.

    Returns held-out losses, one list of K values per evaluation.
    """
    a, device = network.architecture, network.device
    optimiser = Adam(list(network.parameters()))
    rates = network.spread(torch.tensor(schedule.rates, device=device))
    kappa = torch.tensor(schedule.widths, device=device)
    every = max(1, schedule.updates // schedule.evaluations)
    best = torch.full((len(network.first),), torch.inf, device=device)
    kept = [p.detach().clone() for p in network.parameters()]
    history: list[list[float]] = []
    stale, memory = 0, torch.zeros(0)
    chunks = batches(episodes, rngs, a.window, schedule)
    for update in range(1, schedule.updates + 1):
        x, y, mask, new = next(chunks)
        x, y, mask = x.to(device), y.to(device), mask.to(device)
        memory = network.start(x.shape[2]) if new else memory.detach()
        tau = _stratified(rngs, schedule.levels).to(device) if a.quantiles else None
        done = update / schedule.updates
        share = schedule.scheduled_sampling * done
        if share > 0:
            x = feed_back(network, x, memory, share, rngs)
        memory = descend(network, x, y, mask, memory, tau, kappa)
        warm = min(1.0, update / 20)
        decay = 0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * done))
        optimiser.step(rates * warm * float(decay))
        if update % every == 0 or update == schedule.updates:
            found = evaluate(network, held_out, schedule.levels, kappa, schedule.scheduled_sampling)
            history.append(found.tolist())
            better = found < best
            best = torch.where(better, found, best)
            for keep, p in zip(kept, network.parameters(), strict=True):
                keep[better] = p.detach()[better]
            stale = 0 if bool(better.any()) else stale + 1
            if stale >= schedule.patience:
                break
    with torch.no_grad():
        for keep, p in zip(kept, network.parameters(), strict=True):
            p.copy_(keep)
    return history


def _stratified(rngs: Sequence[np.random.Generator], levels: int) -> Tensor:
    """Draw one level uniformly from each of N equal parts of (0, 1): (E, N)."""
    drawn = np.stack([(np.arange(levels) + rng.random(levels)) / levels for rng in rngs])
    return torch.from_numpy(drawn.astype(np.float32))


@torch.no_grad()
def feed_back(
    network: Ensemble,
    x: Tensor,
    memory: Tensor,
    share: float,
    rngs: Sequence[np.random.Generator],
) -> Tensor:
    """Replace inputs by the network's own samples: scheduled sampling (Bengio et al. 2015).

    Each observation after the first of the chunk is replaced with probability `share`, by a sample
    that was made from the inputs before it as they are by then. Samples of samples are therefore
    among them, as in a rollout. Windows hold what was fed in. Levels are drawn per step and sensor.

    Parameters
    ----------
    x : (E, T, B, W * D)
        True inputs, newest observation first.
    memory : (K, B, H)
        Memory before the chunk.
    share
        Probability of a sample.
    rngs
        A generator of each member.

    Returns
    -------
    Inputs of the same shape.
    """
    a, steps = network.architecture, x.shape[1]
    d = a.features
    replaced = np.stack([rng.random(x.shape[1:3]) < share for rng in rngs])
    chosen = torch.from_numpy(replaced).to(x.device)[..., None]
    heads = None
    if a.quantiles:
        levels = _stratified(rngs, SAMPLED).to(x.device)
        drawn = np.stack([rng.integers(SAMPLED, size=(steps, 1, d)) for rng in rngs])
        table = network.embedding(network.spread(levels))
        heads = network.heads_from(torch.from_numpy(drawn).to(x.device), table)
    cell = network.cell() if a.recurrent else None
    out = (network.out,) * steps if heads is None else heads.unbind(1)
    true = x[..., :d].unbind(1)
    fed = [x[:, 0]]
    for head, own, following in zip(out, chosen.unbind(1)[1:], true[1:], strict=False):
        f = network.inputs(fed[-1])
        memory = f if cell is None else cell(f, memory)
        change = network.gather(
            torch.baddbmm(network.out_bias, network.trunk(f, memory), head)
        )  # (E, B, D)
        sample = torch.addcmul(fed[-1][..., :d], network.unit, change)
        newest = torch.where(own, sample, following)
        fed.append(torch.cat([newest, fed[-1][..., :-d]], dim=2))
    return torch.stack(fed, dim=1)
