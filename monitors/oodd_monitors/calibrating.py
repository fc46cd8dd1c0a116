"""Calibration of a recorded score: its threshold, and what speaks for and against it."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.metrics.alarms import GuaranteedAlarm

Floats = NDArray[np.float64]
ScoreAlarm = Literal["threshold", "cusum", "ewma", "score"]
"""Statistic of a score's alarm; ``"score"`` is the harness's word for ``"threshold"``."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoreCalibration:
    """A threshold of a recorded score, made by `calibrate`.

    Attributes
    ----------
    rule
        The alarm: of the score itself, or of its CUSUM.
    alarm
        Its statistic.
    hold
        Rows in a row in which the statistic has to be above the threshold.
    level
        Largest share of healthy episodes with an alarm.
    """

    rule: GuaranteedAlarm
    alarm: ScoreAlarm
    hold: int
    level: float


def calibrate(
    scores: Sequence[ArrayLike],
    level: float = 0.05,
    *,
    alarm: ScoreAlarm = "threshold",
    hold: int = 1,
    recordings: Sequence[Hashable] | None = None,
) -> ScoreCalibration:
    """Find the threshold of a score on healthy episodes.

    Parameters
    ----------
    scores
        One array of shape (T + 1,) for each healthy episode, in the order in which they were
        recorded; NaN where the score is undefined.
    level
        Largest share of healthy episodes with an alarm.
    alarm
        Statistic of the alarm.
    hold
        Rows in a row in which the statistic has to be above the threshold.
    recordings
        For each episode the recording that it is a window of; None where each is one.

    Returns
    -------
    ScoreCalibration

    Raises
    ------
    UsageError
        When the episodes are too few for the level, or an argument is wrong.
    """
    raise NotImplementedError
