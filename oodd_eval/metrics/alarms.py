"""Alarms with a false-alarm rate chosen in advance, and alarms as they come.

A threshold is found on the calibration trajectories, which are nominal and apart from training and
test, so that delay and misses are compared at the same target instead of at whatever rate a fixed
threshold happens to give a detector. What rate was achieved on the test's nominal twins is reported
beside the target.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import AlarmRule, Contribution, alarm_contributions
from oodd_eval.metrics.cusum import cusum

Floats = NDArray[np.float64]

TARGETS: Final = {"at_1pct": 0.01, "at_01pct": 0.001}
"""Target false-alarm rates by the suffix of their metrics."""

MIN_STEPS: Final = {"at_1pct": 1_000, "at_01pct": 20_000}
"""Defined calibration steps below which a target is not offered: 10 and 20 alarms at the target."""

CALIBRATED: Final = ("far", "far_twin", "delay", "delay_censored", "missed")
"""Metrics that are reported again at each target."""


class Monitor:
    """Alarms of one episode as its scores come in, beside a running robot.

    The statistic and the alarms are those of `cusum.cusum` on the whole episode, bit for bit.

    Parameters
    ----------
    rule
        Standardization, drift and threshold; see `calibrate` for a threshold with a false-alarm
        rate chosen in advance.

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
        self.statistic = 0.0
        if x != x:  # noqa: PLR0124  # NaN: not defined yet
            return False
        self._carried = self.statistic = max(0.0, self._carried + x)
        alarm = self.statistic > self.rule.threshold
        if alarm:
            self._carried = 0.0
        return alarm


def false_alarm_rate(scores: Sequence[Floats], rule: AlarmRule) -> float:
    """Alarms over defined steps, pooled over nominal trajectories; NaN without defined steps."""
    steps = sum(int(np.count_nonzero(~np.isnan(s))) for s in scores)
    return sum(int(rule.alarms(s).sum()) for s in scores) / steps if steps else float("nan")


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
    The exact smallest double; NaN when no score is defined.

    Notes
    -----
    The number of alarms never grows with the threshold, in spite of the resets: let the k-th alarm
    under the higher threshold come no earlier than the k-th under the lower one. From then on the
    sum under the lower threshold is at least as large until it raises its next alarm, so that its
    (k + 1)-th alarm comes no later either. An alarm needs a sum above the threshold, so the
    thresholds that meet the target form a closed half-line, whose end bisection finds exactly.

    Examples
    --------
    >>> import numpy as np
    >>> from oodd_eval.metrics.cusum import Standardization
    >>> rule = AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.0)
    >>> calibrate([np.array([3.0, -9.0, 1.0, -9.0, 2.0, -9.0])], rule, target=1 / 6)
    2.0
    """
    defined = [rule.standardization(s) for s in scores]
    steps = sum(int(np.count_nonzero(~np.isnan(x))) for x in defined)
    if not steps:
        return float("nan")
    allowed = target * steps

    def alarms(threshold: float) -> int:
        return sum(
            int(cusum(x, drift=rule.drift, threshold=threshold)[1].sum()) for x in defined
        )  # fmt: skip

    if alarms(0.0) <= allowed:
        return 0.0
    low, high = 0.0, max(
        float(cusum(x, drift=rule.drift, threshold=float("inf"))[0].max(initial=0.0))
        for x in defined
    )  # fmt: skip
    # Invariant: `low` gives too many alarms, `high` does not; ends at neighbouring doubles.
    while (middle := low + (high - low) / 2) not in (low, high):
        if alarms(middle) <= allowed:
            high = middle
        else:
            low = middle
    return high


def calibrated_contributions(
    calibration: Sequence[Floats],
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    rule: AlarmRule,
) -> tuple[dict[str, float], dict[str, Contribution]]:
    """Return thresholds and metrics of one cell at every target that its split can support.

    Returns
    -------
    thresholds : dict
        ``threshold_at_1pct`` and so on, in the unit of standardized scores.
    contributions : dict
        ``far_at_1pct``, ``far_twin_at_1pct``, ``delay_at_1pct`` and so on.
    """
    steps = sum(int(np.count_nonzero(~np.isnan(s))) for s in calibration)
    thresholds: dict[str, float] = {}
    contributions: dict[str, Contribution] = {}
    for suffix, target in TARGETS.items():
        if steps < MIN_STEPS[suffix]:
            continue
        threshold = calibrate(calibration, rule, target)
        thresholds[f"threshold_{suffix}"] = threshold
        found = alarm_contributions(
            anomalous, twins, onsets, dataclasses.replace(rule, threshold=threshold)
        )
        contributions |= {f"{name}_{suffix}": found[name] for name in CALIBRATED}
    return thresholds, contributions
