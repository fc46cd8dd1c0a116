"""Decides whether a detector learns an episode from its first rows.

A payload, a gain or a wind that is drawn for every episode is worth learning. A fault that begins
in the rows that are learnt from is learnt, too, and no longer found. So learning must forecast
nominal episodes better that were left out, and find faults better that were put into them early.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np
from oodd_common.charts import Floats, limited
from oodd_common.windows import StandardEpisode, regressors

from oodd_eval.metrics.auc import auc
from oodd_panel.forecast import ORDER, WILD, EpisodeLearner, LinearForecast

ONSET: Final = 15
"""Row from which a fault is put into a nominal episode."""
FAULTS: Final = (
    ("shift", 1.0),
    ("shift", 3.0),
    ("noise", 1.0),
    ("noise", 3.0),
    ("gain", 0.3),
    ("slow", 0.3),
    ("stuck", 0.0),
)
"""Faults and their sizes: in scales of a forecast error, or shares of what is lost."""
FAULTY_SENSORS: Final = 5
"""Sensors of which one is faulty."""
LEAST_GAIN: Final = 0.01
"""Least gain in the mean logarithm of errors for which an episode may be learnt."""
EPISODES: Final = 40
"""Most episodes into which faults are put."""

Lengths: TypeAlias = Callable[[Floats, StandardEpisode], Floats]
"""From standardized rows and the episode they are of to a statistic of the rows that are judged."""


def gain(episodes: Sequence[StandardEpisode], horizon: int, ridge: float, learnt: int) -> float:
    """Return by how much learning makes the mean logarithm of later errors smaller.

    Either half of the episodes is forecast by a fit to the other half.
    """
    losses = []
    for varies in (False, True):
        squares = []
        for part in (0, 1):
            forecast = LinearForecast.fit(episodes[1 - part :: 2], horizon, ridge, varies=varies)
            for episode in episodes[part::2]:
                learner = EpisodeLearner(forecast, learnt)
                x, y = regressors(episode, horizon, ORDER), episode.rows[horizon:]
                learner(x[:learnt], y[:learnt])
                errors = y[learnt:] - x[learnt:] @ learner.coefficients
                squares.append((limited(errors, WILD) ** 2).mean(axis=0))
        losses.append(float(np.log(np.maximum(np.mean(squares, axis=0), 1e-12)).mean() / 2))
    return losses[0] - losses[1]


def with_fault(
    rows: Floats, scale: Floats, fault: tuple[str, float], generator: np.random.Generator
) -> Floats:
    """Return standardized rows (N, S) with a fault of some sensors from `ONSET` on.

    `slow` stretches the time of all of them. `scale` is that of a forecast error of each, (S,).
    """
    kind, size = fault
    n, sensors = rows.shape
    faulty = generator.choice(sensors, max(1, sensors // FAULTY_SENSORS), replace=False)
    spoilt, after = rows.copy(), slice(ONSET, None)
    if kind == "shift":
        spoilt[after, faulty] += size * scale[faulty] * generator.choice([-1, 1], len(faulty))
    elif kind == "noise":
        drawn = generator.normal(size=(n - ONSET, len(faulty)))
        spoilt[after, faulty] += size * scale[faulty] * drawn
    elif kind == "gain":
        spoilt[after, faulty] *= 1 - size
    elif kind == "stuck":
        spoilt[after, faulty] = rows[ONSET, faulty]
    else:
        times = ONSET + (1 - size) * np.arange(n - ONSET)
        before = times.astype(int)
        weights = (times - before)[:, None]
        spoilt[after] = (1 - weights) * rows[before] + weights * rows[np.minimum(before + 1, n - 1)]
    return spoilt


def separation(
    parts: Sequence[tuple[Sequence[tuple[Floats, StandardEpisode]], Lengths, Floats]], first: int
) -> Floats:
    """Return how well early faults are found in each episode, a mean AUC of its rows.

    Parameters
    ----------
    parts
        Episodes, what judges them without having seen them, and the scale of a forecast error of
        each sensor. The first rows alone, up to the same for all, are to be given.
    first
        Rows at the beginning that are not judged.
    """
    every = []
    for episodes, judged, scale in parts:
        begin = max(ONSET - first, 0)
        nominal = np.concatenate([judged(rows, x)[begin:] for rows, x in episodes])
        generator = np.random.default_rng(0)
        by_fault = [
            [
                auc(judged(with_fault(rows, scale, fault, generator), x)[begin:], nominal)
                for rows, x in episodes
            ]
            for fault in FAULTS
        ]
        every.append(np.mean(by_fault, axis=0))
    return np.concatenate(every)


def shows_no_loss(learning: Floats, without: Floats) -> bool:
    """Tell whether episodes gain from learning by more than the standard error of the mean gain."""
    gains = learning - without
    return bool(gains.mean() >= gains.std() / np.sqrt(len(gains)))
