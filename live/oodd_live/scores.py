"""Scores that a monitor computes elsewhere: their statistic row by row, and gaps between them."""

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.arrays import as_numbers
from oodd_eval.errors import TrajectoryError
from oodd_eval.metrics.alarms import GuaranteedAlarm, Monitor
from oodd_live.stream import OBSERVATION

Floats = NDArray[np.float64]


class ScoreMonitor(Monitor):
    """Alarms of scores as they come in, of a weighted mean or of several rows where declared.

    `smoothing` is the weight of the newest score in the mean, None for the score itself, and `hold`
    the number of rows in which the statistic has to be above the threshold. Rows without a score
    change nothing.
    """

    def __init__(self, rule: GuaranteedAlarm, smoothing: float | None, hold: int) -> None:
        self._smoothing, self._past = smoothing, deque([-math.inf] * hold, hold)
        super().__init__(rule)

    def reset(self) -> None:
        """Begin a new episode."""
        super().reset()
        self._mean: float | None = None
        self._past.extend([-math.inf] * len(self._past))

    def update(self, score: float) -> bool:
        """Take the next score, NaN where undefined; return whether it raises an alarm."""
        if math.isnan(score):
            return super().update(score)
        if self._smoothing is not None:
            mean = score if self._mean is None else self._mean
            self._mean = score = mean + self._smoothing * (score - mean)
        super().update(score)
        self._past.append(self.statistic)
        self.statistic = min(self._past)
        return self.statistic > self.rule.threshold


class ScoreStream:
    """Gaps between the scores of an episode, in place of the faults of a `Stream`.

    A gap of more than `most` rows is a fault; `longest` is the longest so far.
    """

    shift, suspects = None, ()

    def __init__(self, most: int) -> None:
        self.most = most
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self._gap, self.longest, self.surprise = 0, 0, 0.0

    def take(self, score: ArrayLike | None, *_: object) -> tuple[Floats, None]:
        """Take the next score; NaN and None where there is none."""
        row = np.ravel(as_numbers(math.nan if score is None else score))
        if row.shape != (1,):
            raise TrajectoryError(f"the watchdog got {len(row)} scores of a row, expected one")
        self._gap = self._gap + 1 if math.isnan(row[0]) else 0
        self.longest = max(self.longest, self._gap)
        self.surprise = math.inf if self._gap > self.most else 0.0
        return row, None

    def faults(self, *_: object) -> dict[int | str, str]:
        """Return the fault of a gap."""
        return {OBSERVATION: "missing"}


def longest_gap(scores: Floats) -> int:
    """Return the most rows without a score, one after another.

    >>> longest_gap(np.array([np.nan, 1.0, np.nan, np.nan])), longest_gap(np.array([1.0]))
    (2, 0)
    """
    present = np.flatnonzero(~np.isnan(scores))
    return int(np.diff(present, prepend=-1, append=len(scores)).max()) - 1
