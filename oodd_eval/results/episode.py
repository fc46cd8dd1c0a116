"""One episode of a cell with its scores, beside its nominal twin."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.results.identity import Cell

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredEpisode:
    """An anomalous episode beside its nominal twin, with the scores of both.

    Attributes
    ----------
    cell, index
        The cell, and the index of the episode among the cell's.
    scores, twin_scores
        One for each observation, NaN where undefined.
    trajectory, twin
        The episodes, of T + 1 observations each.
    sensors
        Names of the sensors, in the order of columns.
    onset, effect
        The row from which the anomaly is in force, and the first that differs from the twin's.
    rule
        The guaranteed alarm at 5 %; None where there are too few calibration episodes for it.
    """

    cell: Cell
    index: int
    scores: Floats
    twin_scores: Floats
    trajectory: Trajectory
    twin: Trajectory
    sensors: tuple[str, ...]
    onset: int
    effect: int
    rule: GuaranteedAlarm | None

    @property
    def alarm(self) -> int | None:
        """The row of the first alarm; None without one."""
        return self.rule.first(self.scores) if self.rule else None

    def delay(self, *, of_twin: bool = False) -> float:
        """Return the number of rows from the effect to the first alarm.

        Parameters
        ----------
        of_twin
            Whether the alarm is one of the twin, which is a false one.

        Returns
        -------
        float
            Infinite without an alarm; NaN where that precedes the effect, or no row follows it.
        """
        scores = self.twin_scores if of_twin else self.scores
        first = self.rule.first(scores) if self.rule else None
        if self.rule is None or len(scores) <= self.effect:
            return math.nan
        if first is None:
            return math.inf
        return first - self.effect if first >= self.effect else math.nan

    def __repr__(self) -> str:
        """Return what happened when: the arrays would fill screens."""
        return (
            f"ScoredEpisode({self.cell}, index={self.index}, rows={len(self.scores)}, "
            f"onset={self.onset}, effect={self.effect}, alarm={self.alarm})"
        )
