"""Base of detectors that judge a row by the window that ends in it, without a forecast."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import StorableWindowDetector, windows

from oodd_eval import Trajectory

Floats = NDArray[np.float64]

CHUNK: Final = 4096
"""Windows that are cut at once: those of a long episode of many sensors need gigabytes."""

FOLDS: Final = 5
"""Parts of the nominal windows, each judged by what was learnt from the others."""


class RecentRowsDetector(StorableWindowDetector):
    """A detector whose score of ``o_t`` depends on the standardized ``o_t .. o_{t-W+1}`` alone.

    Before the beginning of an episode, its first observation is repeated. All scores are defined.
    The horizon is without effect: nothing is forecast.

    Parameters
    ----------
    name, seed, horizon, window
        See `WindowDetector`.
    """

    def __init__(self, name: str, *, seed: int, horizon: int, window: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=window, lag=0)

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation."""
        self._must_fit(trajectory)
        rows = self._scale()(trajectory)
        times = np.arange(len(rows))
        parts = [
            self._scores(windows(rows, times[first : first + CHUNK], self.window))
            for first in range(0, len(rows), CHUNK)
        ]
        return np.concatenate(parts)

    def _judge(self, window: NDArray[Any], now: NDArray[Any], t: int) -> float:  # noqa: ARG002
        return float(self._scores(window[None])[0])

    @abstractmethod
    def _scores(self, latest: NDArray[np.float32]) -> Floats:
        """Return the scores of N windows (N, W, D), newest row first.

        The bits of a score must not depend on how many windows there are.
        """


def folds_of(parts: Sequence[Floats]) -> list[Floats]:
    """Return rows in up to five folds: whole episodes in turn, or stretches of a single one.

    From one array (N, K) per episode to at least two arrays of rows, where there are two rows.
    """
    parts = stretches(parts)
    count = min(FOLDS, len(parts))
    return [np.concatenate(parts[i::count]) for i in range(count)]


def stretches(episodes: Sequence[Floats]) -> list[Floats]:
    """Return the episodes, or up to five stretches of a single one, so that there are others."""
    if len(episodes) > 1:
        return list(episodes)
    return np.array_split(episodes[0], min(FOLDS, len(episodes[0])))


def evenly(rows: Floats, most: int) -> Floats:
    """Return at most so many of the rows, at equal distances; all where there are no more.

    Examples
    --------
    >>> evenly(np.arange(5.0)[:, None], 3).ravel().tolist()
    [0.0, 2.0, 4.0]
    """
    return rows[spread(len(rows), most)]


def spread(count: int, most: int) -> NDArray[np.int64]:
    """Return at most so many of the numbers 0 to `count` - 1, the first and the last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)
