"""Training of an ensemble: truncated gradients through time, and the mean of the last weights.

Every member strings all episodes together, in an order of its own. As many readers as a batch has
rows go along that ring, evenly spaced, a chunk of steps in each update. A reader carries its memory
from chunk to chunk, its gradient it does not, and forgets it where an episode begins. An update
therefore sees many short pieces from everywhere, none of it padding, with the memory that scoring
would have there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.windows import windows
from torch import Tensor

from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_torch.network import Ensemble
from oodd_torch.optimizers import Adam, Average, Muon

ADAM_RATE: Final = 8e-3
"""Largest learning rate of biases, of the first and of the last layer."""

MUON_RATE: Final = 2e-2
"""Largest learning rate of the weights between hidden layers."""

SHRINK: Final = 0.5
"""Decay of the weights between hidden layers, per update and learning rate."""

WARM_UP: Final = 20
"""Updates over which the learning rates rise."""

DECAY: Final = 0.998
"""Decay per update of the mean of the weights."""

SAMPLED: Final = 256
"""Quantile levels that the samples of one update are drawn from, one of each equal part of (0, 1).

Embedding the levels of every step and sensor would take longer than the rest.
"""

RIDGE: Final = 1e-6
"""Penalty of the linear forecast's coefficients, per transition and squared coefficient."""

LEAST: Final = 1e-6
"""Smallest unit of a sensor: single precision holds no finer forecasts."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Length and settings of a training.

    Attributes
    ----------
    updates
        Gradient steps of every member.
    batch
        Pieces of episodes in a batch.
    chunk
        Steps of a piece, through which gradients flow.
    levels
        Quantile levels of an update.
    widths
        Width of the quadratic part of each member's quantile loss, kappa, in the network's units.
    scheduled_sampling
        Probability, at the end of training, that an input is the network's own sample; rises
        linearly from 0.
    """

    updates: int
    batch: int
    chunk: int
    levels: int
    widths: tuple[float, ...]
    scheduled_sampling: float = 0.0


def pairs(
    episodes: Sequence[NDArray[np.float32]], window: int
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Yield inputs (T, W * D), newest observation first, and targets (T, D) of every episode."""
    for e in episodes:
        if (steps := len(e) - 1) > 0:
            yield windows(e, np.arange(steps), window).reshape(steps, -1), e[1:]


def linear_forecast(
    episodes: Sequence[NDArray[np.float32]], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fit the linear forecast of the next observation from a window, by ridge regression.

    Returns coefficients (W * D + 1, D), the intercept last, and the root mean square of what they
    leave of each sensor, (D,).
    """

    def moments() -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        for x, y in pairs(episodes, window):
            # What is fitted is the change, so that little data means no change and not the mean.
            x64, change = x.astype(np.float64), y.astype(np.float64) - x[:, : y.shape[1]]
            yield np.insert(x64, x.shape[1], 1.0, axis=1), change

    gram, cross = (sum(v) for v in zip(*((x.T @ x, x.T @ y) for x, y in moments()), strict=True))
    base = np.linalg.solve(gram + RIDGE * gram[-1, -1] * np.eye(len(gram)), cross)
    left = np.sqrt(sum(np.square(y - x @ base).sum(0) for x, y in moments()) / gram[-1, -1])
    base[: base.shape[1]] += np.eye(base.shape[1])
    return base.astype(np.float32), np.maximum(left, LEAST).astype(np.float32)


def transitions(
    episodes: Sequence[NDArray[np.float32]], window: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return all transitions in a row: inputs (N, W * D), targets (N, D), starts or not (N,)."""
    inputs, targets = zip(*pairs(episodes, window), strict=True)
    starts = np.concatenate([np.arange(len(x)) == 0 for x in inputs])
    return (
        torch.from_numpy(np.concatenate(inputs)),
        torch.from_numpy(np.concatenate(targets)),
        torch.from_numpy(starts),
    )


def batches(
    episodes: Sequence[NDArray[np.float32]],
    rngs: Sequence[np.random.Generator],
    window: int,
    schedule: Schedule,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield inputs (E, T, B, W * D), targets (E, T, B, D) and starts (E, T, B) without end.

    Every member has a generator of its own for its order of episodes and its readers' places.
    """
    x, y, starts = transitions(episodes, window)
    n, size = len(x), schedule.batch
    pieces = np.split(np.arange(n), np.flatnonzero(starts.numpy())[1:])
    rings = np.stack(
        [np.concatenate([pieces[i] for i in rng.permutation(len(pieces))]) for rng in rngs]
    )
    places = np.stack([(np.arange(size) + rng.random(size)) * n / size for rng in rngs])
    steps = np.arange(schedule.chunk)[:, None]
    for update in itertools.count():
        now = (places[:, None].astype(np.int64) + update * schedule.chunk + steps) % n  # (E, T, B)
        rows = np.take_along_axis(rings, now.reshape(len(rings), -1), axis=1).reshape(now.shape)
        yield x[rows], y[rows], starts[rows]


def quantile_huber(error: Tensor, tau: Tensor, kappa: Tensor | float = 1.0) -> Tensor:
    """Quantile Huber loss of Dabney et al. (2018), elementwise.

    ``rho = |tau - [u < 0]| L(u) / kappa``, ``L(u) = u^2 / 2`` for ``|u| <= kappa``, else
    ``kappa (|u| - kappa / 2)``, with the error ``u = target - prediction``, the level tau that was
    sampled, and kappa, the width of the quadratic part; all are broadcast.
    """
    size = error.abs()
    huber = torch.where(size <= kappa, 0.5 * error * error, kappa * (size - 0.5 * kappa))
    return torch.abs(tau - (error < 0).to(error.dtype)) * huber / kappa


def hidden(
    network: Ensemble, x: Tensor, memory: Tensor, kept: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """One pass over a chunk: last hidden layer (K, T, B, H), and the last memory.

    Parameters
    ----------
    x : (E, T, B, W * D)
    memory : (K, B, H)
    kept : (E, T, B)
        0 where an episode begins and the memory is to be forgotten, else 1.
    """
    e, t, b, _ = x.shape
    f = network.inputs(x.reshape(e, t * b, -1))
    k, _, h = f.shape
    g = f
    if network.architecture.recurrent:
        forget = None if kept is None else network.spread(kept)[..., None]
        g, memory = network.run(f.reshape(k, t, b, h), memory, forget)
        g = g.reshape(k, t * b, h)
    return network.trunk(f, g).reshape(k, t, b, h), memory


def corrections(network: Ensemble, z: Tensor, heads: Tensor | None) -> Tensor:
    """Corrections (E, T, B, N, D) by the last hidden layer, (K, T, B, H), in the network's units.

    The prediction is ``linear(x) + unit * correction``. `heads`, (K, G, H, N * P), are output
    layers at N levels, see `Ensemble.heads_at`: G = T for levels of every step, G = 1 for levels
    that all steps share. None without quantiles.
    """
    k, t, b, h = z.shape
    if heads is None:
        change = torch.bmm(z.reshape(k, t * b, h), network.out)
    else:
        change = torch.matmul(z.reshape(k, heads.shape[1], -1, h), heads)
    p = network.architecture.outputs
    return network.gather(change.reshape(k, t, b, -1, p) + network.out_bias[:, None, None])


def quantile_huber_slope(error: Tensor, tau: Tensor, kappa: Tensor | float = 1.0) -> Tensor:
    """Return ``|tau - [u < 0]| clip(u / kappa, -1, 1)``, the derivative of `quantile_huber`."""
    return torch.where(error < 0, 1 - tau, tau) * (error / kappa).clamp_(-1, 1)


def _error(network: Ensemble, x: Tensor, y: Tensor, change: Tensor) -> Tensor:
    """Return target minus prediction in the network's units: (E, T, B, N, D)."""
    target = (y - network.linear(x)) / network.unit
    return target[..., None, :] - change


def descend(
    network: Ensemble,
    x: Tensor,
    y: Tensor,
    kept: Tensor,
    memory: Tensor,
    tau: Tensor | None,
    kappa: Tensor,
) -> Tensor:
    """Add the gradients of every network's mean loss; return the last memory.

    The loss is the mean over steps, pieces, levels and the network's sensors. ``kappa`` has shape
    (E,); ``tau`` (E, N) holds the levels of this update, shared by all steps, pieces and sensors,
    so that their embeddings cost next to nothing. The slope of the loss is what the backward pass
    begins with: the loss itself, a dozen passes over the largest array of a training step, is only
    needed when it is looked at.
    """
    heads = None if tau is None else network.heads_at(tau)
    z, memory = hidden(network, x, memory, kept)
    change = corrections(network, z, heads)
    with torch.no_grad():
        slope = _error(network, x, y, change)
        if tau is not None:
            slope = quantile_huber_slope(slope, tau[:, None, None, :, None], _wide(kappa))
        _, t, b, n, _ = slope.shape
        slope *= -1 / (t * b * n * network.architecture.outputs)
    # `change.backward(slope)` does the same, but imports SymPy, which takes half a second.
    change.register_hook(lambda _: slope)  # type: ignore[no-untyped-call]
    change.sum().backward()  # type: ignore[no-untyped-call]
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
    a, members = network.architecture, network.members
    # One reader goes through all episodes.
    x, y, starts = (
        v.to(network.device).expand(members, 1, *v.shape).transpose(1, 2)
        for v in transitions(episodes, a.window)
    )
    memory = network.start(1)
    if share > 0:
        rngs = [np.random.default_rng(e) for e in range(members)]
        x = feed_back(network, x, starts, memory, share, rngs)
    tau = ((torch.arange(levels, device=network.device) + 0.5) / levels).expand(members, -1)
    heads = network.heads_at(tau) if a.quantiles else None
    z, _ = hidden(network, x, memory, (~starts).to(x.dtype))
    change = corrections(network, z, heads)
    error = _error(network, x, y, change)
    if a.quantiles:
        each = quantile_huber(error, tau[:, None, None, :, None], _wide(kappa))
    else:
        each = 0.5 * error.square()
    loss = each.mean((1, 2, 3))  # (E, D)
    return loss.flatten() if a.per_feature else loss.mean(1)


def train(
    network: Ensemble,
    episodes: Sequence[NDArray[np.float32]],
    held_out: Sequence[NDArray[np.float32]],
    schedule: Schedule,
    rngs: Sequence[np.random.Generator],
    progress: Progress = ignore_progress,
) -> list[list[float]]:
    """Train all members in place; each ends at the mean of its last weights.

    `progress` is called with the share of the updates that is done. Returns held-out losses, K
    values before the training and K after it.
    """
    a, device, share = network.architecture, network.device, schedule.scheduled_sampling
    kappa = torch.tensor(schedule.widths, device=device)
    hidden = network.hidden()
    others = [p for p in network.parameters() if all(p is not h for h in hidden)]
    adam, muon = Adam(others), Muon(hidden, SHRINK)
    average = Average(network.parameters(), DECAY)
    history = [evaluate(network, held_out, schedule.levels, kappa, share).tolist()]
    memory = network.start(schedule.batch)
    every = torch.ones(len(memory), device=device)
    chunks = batches(episodes, rngs, a.window, schedule)
    for update in range(1, schedule.updates + 1):
        x, y, starts = (v.to(device) for v in next(chunks))
        tau = _stratified(rngs, schedule.levels).to(device) if a.quantiles else None
        done = update / schedule.updates
        if share > 0:
            x = feed_back(network, x, starts, memory, share * done, rngs)
        memory = descend(network, x, y, (~starts).to(x.dtype), memory, tau, kappa)
        rate = min(1.0, update / WARM_UP) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
        adam.step(every * ADAM_RATE * rate)
        muon.step(every * MUON_RATE * rate)
        average.update()
        progress(done)
    average.apply()
    return [*history, evaluate(network, held_out, schedule.levels, kappa, share).tolist()]


def _stratified(rngs: Sequence[np.random.Generator], levels: int) -> Tensor:
    """Draw one level uniformly from each of N equal parts of (0, 1): (E, N)."""
    drawn = np.stack([(np.arange(levels) + rng.random(levels)) / levels for rng in rngs])
    return torch.from_numpy(drawn.astype(np.float32))


@torch.no_grad()
def feed_back(
    network: Ensemble,
    x: Tensor,
    starts: Tensor,
    memory: Tensor,
    share: float,
    rngs: Sequence[np.random.Generator],
) -> Tensor:
    """Replace inputs by the network's own samples: scheduled sampling (Bengio et al. 2015).

    Each observation that is the first neither of its episode nor of the chunk is replaced with
    probability `share`, by a sample that was made from the inputs before it as they are by then.
    Samples of samples are therefore among them, as in a rollout. Windows hold what was fed in.
    Levels are drawn per step and sensor.

    Parameters
    ----------
    x : (E, T, B, W * D)
        True inputs, newest observation first.
    starts : (E, T, B)
        Whether an episode begins.
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
    first = starts[..., None]
    heads = None
    if a.quantiles:
        levels = _stratified(rngs, SAMPLED).to(x.device)
        drawn = np.stack([rng.integers(SAMPLED, size=(steps, 1, d)) for rng in rngs])
        table = network.embedding(network.spread(levels))
        heads = network.heads_from(torch.from_numpy(drawn).to(x.device), table)
    cell = network.cell() if a.recurrent else None
    fed = [x[:, 0]]
    for t in range(1, steps):
        f = network.inputs(fed[-1])
        if cell is not None:
            forget = network.spread(first[:, t - 1])
            memory = cell(f, memory.masked_fill(forget, 0))
        state = f if cell is None else memory
        head = network.out if heads is None else heads[:, t - 1]
        change = torch.baddbmm(network.out_bias, network.trunk(f, state), head)
        sample = network.linear(fed[-1]) + network.unit * network.gather(change)  # (E, B, D)
        newest = torch.where(chosen[:, t], sample, x[:, t, :, :d])
        grown = torch.cat([newest, fed[-1][..., :-d]], dim=2)
        fed.append(torch.where(first[:, t], x[:, t], grown))
    return torch.stack(fed, dim=1)
