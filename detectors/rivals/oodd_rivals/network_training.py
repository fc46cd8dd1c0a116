"""Training of the rivals' networks: initial weights, gradient steps, when to stop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_torch.optimizers import Adam, Average, Muon
from oodd_torch.training import Schedule, batches
from torch import Tensor

from oodd_eval.plugins.forecasting import CONSTANT
from oodd_rivals.networks import Shapes, Weights

RATE: Final = 4e-3
"""Learning rate of biases and of input and output layers, by Adam."""

HIDDEN_RATE: Final = 0.02
"""Learning rate of weights between hidden layers, by Muon."""

WARM_UP: Final = 100
"""Updates in which the rates rise from 0."""

DECAY: Final = 0.998
"""Weight of the past in the mean of the weights with which a training ends."""

RIDGE: Final = 1e-6
"""Penalty of a linear forecast, relative to the mean square of standardized inputs."""

LOOKS: Final = 25
"""Number of times that a training computes the held-out loss."""


def draw(shapes: Shapes, seed: int) -> dict[str, Tensor]:
    """Return initial weights as (1, rows, columns): the stack of one network.

    Those whose name ends with "bias" are 0, those whose name begins with "out" a tenth of what the
    others are: normal, with variance 1 / rows.
    """
    random = torch.Generator().manual_seed(seed)
    weights = {}
    for name, (rows, columns) in shapes.items():
        size = 0.0 if name.endswith("bias") else 0.1 if name.startswith("out") else 1.0
        normal = torch.randn(1, rows, columns, generator=random)
        weights[name] = (normal * (size / math.sqrt(max(1, rows)))).requires_grad_()
    return weights


def minimize(
    weights: Mapping[str, Tensor],
    loss: Callable[[int], Tensor],
    held_out: Callable[[], Tensor],
    updates: int,
    hidden: Sequence[str],
    shrink: float = 0.0,
) -> None:
    """Take gradient steps in place.

    The weights end where their running mean had the least held-out loss of `LOOKS` looks: with few
    and noisy episodes a network begins to know them by heart.

    Parameters
    ----------
    weights
        What `draw` returned.
    loss
        From the number of the update to what is to be small.
    held_out
        The same on episodes that are not learned from.
    updates
        Gradient steps.
    hidden
        Names of weights between hidden layers, which are for Muon; the others are for Adam.
    shrink
        Part of the former that a step of rate 1 takes away.
    """
    tensors = list(weights.values())
    muon = Muon([weights[name] for name in hidden], shrink)
    adam = Adam([w for name, w in weights.items() if name not in hidden])
    average = Average(tensors, DECAY)
    one, least, best = torch.ones(1), math.inf, _copies(tensors)
    looks = {round(updates * look / LOOKS) for look in range(1, LOOKS + 1)}
    for update in range(updates):
        loss(update).backward()  # type: ignore[no-untyped-call]
        decay = 0.5 * (1 + math.cos(math.pi * update / updates))
        rate = min(1.0, (update + 1) / WARM_UP) * (decay + 1e-3)
        adam.step(RATE * rate * one)
        muon.step(HIDDEN_RATE * rate * one)
        average.update()
        if update + 1 in looks:
            current = _copies(tensors)
            average.apply()
            with torch.no_grad():
                value = float(held_out())
            if value < least:
                least, best = value, _copies(tensors)
            _set(tensors, current)
    _set(tensors, best)


def _copies(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [t.detach().clone() for t in tensors]


@torch.no_grad()
def _set(tensors: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    for t, value in zip(tensors, values, strict=True):
        t.copy_(value)


def pieces_of(
    episodes: Sequence[NDArray[np.float32]], parameters: Any, seed: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield batches of pieces of episodes for ever, as `oodd_torch.training.batches` does."""
    p, rng = parameters, np.random.default_rng([seed, 1])
    return batches(episodes, [rng], 1, Schedule(p.updates, p.batch, p.chunk, 1, widths=(1.0,)))


def left_to_forecast(
    pairs: tuple[Floats, Floats], base: Floats, unit: Floats
) -> NDArray[np.float32]:
    """Return inputs and, one row later, what a linear forecast leaves in its units: (N + 1, I + D).

    From inputs (N, I), what is forecast (N, D) and what `ridge` returned.
    """
    x, changes = pairs
    y = (changes - x @ base[:-1] - base[-1]) / unit
    columns = np.pad(x, ((0, 1), (0, 0))), np.pad(y, ((1, 0), (0, 0)))
    return np.concatenate(columns, axis=1).astype(np.float32)


def side_by_side(episodes: Sequence[NDArray[np.float32]]) -> tuple[Tensor, Tensor]:
    """Lay out episodes, time first: rows (T, B, C), zeros after an end, and which count (T, B)."""
    rows = np.zeros((max(map(len, episodes)), len(episodes), episodes[0].shape[1]), np.float32)
    counts = np.zeros(rows.shape[:2], np.float32)
    for b, episode in enumerate(episodes):
        rows[: len(episode), b] = episode
        counts[: len(episode), b] = 1.0
    return torch.from_numpy(rows), torch.from_numpy(counts)


def arrays_of(weights: Mapping[str, Tensor]) -> Weights:
    """Return weights of one network in double precision, (rows, columns) each."""
    return {name: w.detach()[0].double().numpy() for name, w in weights.items()}


def ridge(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Fit y by a linear forecast from x.

    From (N, I) and (N, D) to coefficients (I + 1, D), the constant last, and the root mean square
    of what they leave of each column, (1, D), at least `CONSTANT`.
    """
    ones = np.pad(x, ((0, 0), (0, 1)), constant_values=1.0)
    gram = ones.T @ ones
    penalty = RIDGE * len(x) * np.eye(len(gram))
    coefficients: Floats = np.asarray(np.linalg.solve(gram + penalty, ones.T @ y), np.float64)
    left = np.sqrt(((y - ones @ coefficients) ** 2).mean(axis=0, keepdims=True))
    # A column that only varies in episodes that are not learned from has no unit.
    unit: Floats = np.where(y.std(axis=0) > 0, np.maximum(left, CONSTANT), 1.0)
    return coefficients, unit
