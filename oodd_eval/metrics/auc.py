"""Metrics without a false-alarm guarantee: the AUCs, and alarms at the paper's threshold.

Every metric is a ratio of sums over test trajectories, held as a `Contribution`: a mean over the
trajectories where it is defined has denominators 1 and 0, a pooled rate has counts. From it come
the value, its bootstrap interval, group means and paired comparisons.

Time runs over observation rows. The ``onset`` is the row from which on an anomaly is in force; the
``effect`` is the first row that differs from the nominal twin's, at the onset or after it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.cusum import DRIFT, THRESHOLD, Standardization, cusum

Floats = NDArray[np.float64]

SMOOTHING: Final = 0.03  # weight of the newest score in the moving average of ``auc_smoothed``
FAR_START: Final = 20  # first row that ``far`` counts: horizons and warm-ups end here at the latest


@dataclass(frozen=True, eq=False)
class Contribution:
    """A ratio of sums: numerators and denominators of n test trajectories, 0 / 0 if undefined.

    Where it is a `median`, denominators are 1, and the value is the median of the numerators.

    Examples
    --------
    >>> rate = Contribution(np.array([1.0, 2.0, 0.0]), np.array([10.0, 30.0, 0.0]))
    >>> rate.value, rate.n
    (0.075, 2)
    """

    numerator: Floats
    denominator: Floats
    median: bool = False

    @cached_property
    def value(self) -> float:
        """Sum of numerators over sum of denominators, or median; NaN when the latter is 0."""
        if self.median and self.n:
            return float(np.median(self.numerator[self.denominator > 0]))
        total = float(self.denominator.sum())
        return float(self.numerator.sum()) / total if total else float("nan")

    @cached_property
    def n(self) -> int:
        """Number of trajectories that contribute."""
        return int(np.count_nonzero(self.denominator))


def mean_of(values: Sequence[float] | Floats, *, median: bool = False) -> Contribution:
    """Contributions of a mean, or median, over the values that are not NaN."""
    array = np.asarray(values, dtype=np.float64)
    defined = ~np.isnan(array)
    return Contribution(np.where(defined, array, 0.0), defined.astype(np.float64), median)


def auc(positives: Floats, negatives: Floats) -> float:
    """Area under the ROC curve: P(positive > negative) + P(tie) / 2 over all pairs.

    The Mann-Whitney U statistic over the number of pairs, counted exactly.

    Parameters
    ----------
    positives, negatives
        Scores of the two classes, float64 arrays of one dimension; NaN (undefined) is left out.

    Returns
    -------
    float
        In [0, 1]; NaN when either class is empty.

    Examples
    --------
    >>> auc(np.array([2.0, 3.0]), np.array([1.0, 2.0]))
    0.875
    """
    positives = positives[~np.isnan(positives)]
    negatives = np.sort(negatives[~np.isnan(negatives)])
    pairs = positives.size * negatives.size
    if not pairs:
        return float("nan")
    below = int(np.searchsorted(negatives, positives, side="left").sum())
    not_above = int(np.searchsorted(negatives, positives, side="right").sum())
    return (below + not_above) / (2 * pairs)


def auc_onset(scores: Floats, onset: int) -> float:
    """Paper's AUC of one trajectory: scores at t >= onset against scores at t < onset."""
    return auc(scores[onset:], scores[:onset])


def auc_same_times(anomalous: Floats, nominal: Floats, start: int, stop: int) -> float:
    """Return one trajectory's AUC against another's scores at start <= t < stop."""
    return auc(anomalous[start:stop], nominal[start:stop])


def smoothed(x: Floats, weight: float = SMOOTHING) -> Floats:
    """Return the exponentially weighted moving average of standardized scores, from 0 on.

    NaN stays NaN and changes nothing. Once a score was infinite, so are all that follow.

    >>> smoothed(np.array([np.nan, 1.0, 1.0]), weight=0.5).tolist()
    [nan, 0.5, 0.75]
    """
    found = np.full(len(x), np.nan)
    level = 0.0
    for t, value in enumerate(x.tolist()):
        if value == value:  # noqa: PLR0124  # not NaN
            level = (1 - weight) * level + weight * value
            found[t] = level
    return found


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """Standardization, drift and threshold that turn scores into the paper's alarms."""

    standardization: Standardization
    drift: float = DRIFT
    threshold: float = THRESHOLD

    def alarms(self, scores: Floats) -> NDArray[np.bool_]:
        """Alarms of one trajectory, of the shape of its scores."""
        x = self.standardization(scores)
        return cusum(x, drift=self.drift, threshold=self.threshold)[1]


def first_delay(alarms: NDArray[np.bool_], onset: int) -> float:
    """Return steps from the onset to the first alarm at or after it; NaN if there is none."""
    late = np.flatnonzero(alarms[onset:])
    return float(late[0]) if late.size else float("nan")


def auc_contributions(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    effects: Sequence[int],
    standardization: Standardization,
) -> dict[str, Contribution]:
    """Return the AUCs of one cell, from scores of the anomalous trajectories and of their twins.

    The standardization, of the calibration scores, is for ``auc_smoothed``.

    ``auc`` and ``auc_null`` compare rows from the onset on with rows before it. The others compare
    two trajectories at the same times, from the effect to the end of the shortest of those that
    are involved: with more times of one than of the other, their phase would be compared.
    ``auc_placebo`` compares twin i with twin i + 1 (the last with the first), ``auc_unpaired`` the
    anomalous trajectory i with twin i + 1.
    """
    found: dict[str, list[float]] = {
        name: []
        for name in (
            "auc",
            "auc_null",
            "auc_matched",
            "auc_placebo",
            "auc_unpaired",
            "auc_smoothed",
        )
    }
    for i, (a, b, onset, effect) in enumerate(
        zip(anomalous, twins, map(int, onsets), map(int, effects), strict=True)
    ):
        stop = min(len(a), len(b))
        other = twins[(i + 1) % len(twins)] if len(twins) > 1 else np.zeros(0)
        both = min(stop, len(other))
        mean_a, mean_b = (smoothed(standardization(s[:stop])) for s in (a, b))
        found["auc"].append(auc_onset(a, onset))
        found["auc_null"].append(auc_onset(b, onset))
        found["auc_matched"].append(auc_same_times(a, b, effect, stop))
        found["auc_placebo"].append(auc_same_times(b, other, effect, both))
        found["auc_unpaired"].append(auc_same_times(a, other, effect, both))
        found["auc_smoothed"].append(auc_same_times(mean_a, mean_b, effect, stop))
    return {name: mean_of(values) for name, values in found.items()}


def alarm_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Contribution]:
    """Delays, misses and false-alarm rates of one cell at the paper's fixed threshold.

    Sums run on over the onset. A miss enters ``delay_censored`` as T - onset + 1, one more than the
    largest possible delay. ``far`` counts alarms and defined steps from row 20 to the onset.
    """
    times = [int(t) for t in onsets]
    loud, quiet = ([rule.alarms(s) for s in part] for part in (anomalous, twins))
    delays = np.array([first_delay(x, t) for x, t in zip(loud, times, strict=True)])
    remainders = np.array([len(a) - t for a, t in zip(anomalous, times, strict=True)])
    missed = np.isnan(delays)
    before = [slice(FAR_START, t) for t in times]
    early = [(x[rows], a[rows]) for x, a, rows in zip(loud, anomalous, before, strict=True)]
    return {
        "delay": mean_of(delays),
        "delay_null": mean_of([first_delay(x, t) for x, t in zip(quiet, times, strict=True)]),
        "delay_censored": mean_of(np.where(missed, remainders, delays)),
        "missed": mean_of(missed.astype(np.float64)),
        "far": _rate(early),
        "far_twin": _rate(list(zip(quiet, twins, strict=True))),
    }


def cell_contributions(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    effects: Sequence[int],
    rule: AlarmRule,
) -> dict[str, Contribution]:
    """Return all metrics of one cell that need no level, in the order of the catalogue."""
    found = auc_contributions(anomalous, twins, onsets, effects, rule.standardization)
    return found | alarm_contributions(anomalous, twins, onsets, rule)


def _rate(pairs: Sequence[tuple[NDArray[np.bool_], Floats]]) -> Contribution:
    """Alarms over defined steps, per trajectory."""
    return Contribution(
        np.array([float(np.count_nonzero(alarms)) for alarms, _ in pairs]),
        np.array([float(np.count_nonzero(~np.isnan(scores))) for _, scores in pairs]),
    )
