"""Alarms with a false-alarm rate chosen in advance, and alarms as they come.

A threshold is found on the calibration trajectories, nominal and apart from training and test, so
that delay and misses are compared at the same target; the rate that was achieved on the test's
nominal twins is reported beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import AlarmRule
from oodd_eval.metrics.cusum import cusum

Floats = NDArray[np.float64]

MIN_STEPS: Final = {"at_1pct": 1_000, "at_01pct": 20_000}
"""Defined calibration steps below which a target is not offered: 10 and 20 alarms at the target."""


class Monitor:
    """Alarms of one episode as its scores come in, beside a running robot.

    The statistic and the alarms are those of `cusum.cusum` on the whole episode, bit for bit.

    Attributes
    ----------
    statistic : float
        ``S_t`` after the last score, before the reset that an alarm brings; 0 at the beginning.

    Examples
    --------
    >>> from oodd_eval.metrics.cusum import Standardization
    >>> monitor = Monitor(AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.25, threshold=1))
    >>> [(monitor.update(score), monitor.statistic) for score in (0.5, 0.5, 2.0, 0.0)]
    [(False, 0.25), (False, 0.5), (True, 2.25), (False, 0.0)]
    """

    def __init__(self, rule: AlarmRule) -> None:
        self.rule = rule
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self.statistic = self._carried = 0.0

    def update(self, score: float) -> bool:
        """Take the next score, NaN where undefined; return whether it raises an alarm."""
        x = float(self.rule.standardization(np.array([score]))[0]) - self.rule.drift
        if math.isnan(x):
            self.statistic = 0.0
            return False
        self._carried = self.statistic = max(0.0, self._carried + x)
        alarm = self.statistic > self.rule.threshold
        if alarm:
            self._carried = 0.0
        return alarm


def false_alarm_rate(scores: Sequence[Floats], rule: AlarmRule) -> float:
    """Alarms over defined steps, pooled over nominal trajectories; NaN without defined steps."""
    steps = defined_steps(scores)
    return sum(int(rule.alarms(s).sum()) for s in scores) / steps if steps else math.nan


def defined_steps(scores: Sequence[Floats]) -> int:
    """Return the number of scores of several trajectories that are not NaN."""
    return sum(int(np.count_nonzero(~np.isnan(s))) for s in scores)


def highest_statistic(scores: Sequence[Floats], rule: AlarmRule) -> float:
    """Return the smallest threshold that none of several trajectories exceeds."""
    unbounded = (
        cusum(rule.standardization(s), drift=rule.drift, threshold=math.inf) for s in scores
    )
    return max(float(statistic.max(initial=0.0)) for statistic, _ in unbounded)


def calibrate(scores: Sequence[Floats], rule: AlarmRule, target: float) -> float:
    """Return the smallest threshold whose pooled false-alarm rate is at most the target.

    Parameters
    ----------
    scores : sequence of float64 arrays
        Scores of the calibration trajectories.
    rule
        Standardization and drift; its threshold is not used.
    target
        False-alarm rate per step, in (0, 1).

    Returns
    -------
    float
        In the unit of standardized scores; NaN without a defined score.

    Notes
    -----
    The number of alarms never grows with the threshold, in spite of the resets: where the k-th
    alarm under the higher threshold comes no earlier than the k-th under the lower one, the sum
    under the lower one is from then on at least as large until its next alarm, which comes no later
    either. So the thresholds that meet the target form a closed half-line; bisection finds its end.

    Examples
    --------
    >>> from oodd_eval.metrics.cusum import Standardization
    >>> rule = AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.0)
    >>> calibrate([np.array([3.0, -9.0, 1.0, -9.0, 2.0, -9.0])], rule, target=1 / 6)
    2.0
    """
    defined = [rule.standardization(s) for s in scores]
    steps = defined_steps(defined)
    if not steps:
        return math.nan

    def enough(threshold: float) -> bool:
        alarms = (cusum(x, drift=rule.drift, threshold=threshold)[1] for x in defined)
        return sum(int(a.sum()) for a in alarms) <= target * steps

    if enough(0.0):
        return 0.0
    low, high = 0.0, highest_statistic(scores, rule)
    # Invariant: `low` gives too many alarms, `high` does not; ends at neighbouring doubles.
    while (middle := low + (high - low) / 2) not in (low, high):
        if enough(middle):
            high = middle
        else:
            low = middle
    return high
