"""Metrics without a false-alarm guarantee: the AUCs, and alarms at the paper's threshold.

Every metric is a ratio of sums over test trajectories, held as a `Contribution`: a mean over the
trajectories where it is defined has denominators 1 and 0, a pooled rate has counts. From it come
the value, its bootstrap interval, group means and paired comparisons.

Time runs over observation rows. The ``onset`` is the row from which on an anomaly is in force; the
``effect`` is the first row that differs from the nominal twin's, at the onset or after it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.catalogue import METRICS
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD, Standardization, cusum

Floats = NDArray[np.float64]

SMOOTHING: Final = 0.03  # weight of the newest score in the moving average of ``auc_smoothed``
FAR_START: Final = 20  # first row that ``far`` counts: horizons and warm-ups end here at the latest


@dataclass(frozen=True, eq=False)
class Contribution:
    """A ratio of sums over n test trajectories, or a median of theirs.

    Parameters
    ----------
    numerator, denominator
        Float64 arrays of shape (n,), both 0 for a trajectory in which the metric is undefined.
    median
        Whether the value is the median of the numerators; then denominators are 1 or 0.
    nominal
        Of test data without twins, how many of the first terms are of nominal test episodes; the
        others are of anomalous ones. None where terms are of anomalous episodes and their twins.
    deviations
        Of the value in each resample of the calibration episodes from its mean over these: shape
        (draws,). Empty where none changes it, or it is not known.
    recordings
        Without twins, number of the recording that each episode is a window of; empty where each is
        one.

    Examples
    --------
    >>> rate = Contribution(np.array([1.0, 2.0, 0.0]), np.array([10.0, 30.0, 0.0]))
    >>> rate.value, rate.n
    (0.075, 2)
    """

    numerator: Floats
    denominator: Floats
    median: bool = False
    nominal: int | None = None
    deviations: Floats = field(default_factory=lambda: np.zeros(0))
    recordings: tuple[int, ...] = ()

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
    averages = np.full(len(x), np.nan)
    level = 0.0
    for t, value in enumerate(x.tolist()):
        if value == value:  # noqa: PLR0124  # not NaN
            level = (1 - weight) * level + weight * value
            averages[t] = level
    return averages


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """The rule that turns scores into the paper's alarms.

    Parameters
    ----------
    standardization
        Mean and standard deviation of calibration scores.
    drift, threshold
        Those of `oodd_eval.metrics.cusum.cusum`, in the unit of standardized scores.
    """

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


@dataclass(frozen=True, slots=True, eq=False)
class EpisodePair:
    """Scores of an anomalous episode, of its nominal twin and of the next seed's twin.

    Attributes
    ----------
    anomalous, twin, next_twin
        One float64 score a row; `next_twin` is empty where there is one twin alone.
    onset, effect
        The row from which the anomaly is in force, and the first that differs from the twin's.
    standardization
        That of the calibration scores.
    """

    anomalous: Floats
    twin: Floats
    next_twin: Floats
    onset: int
    effect: int
    standardization: Standardization

    @property
    def stop(self) -> int:
        """Number of rows that both episodes have."""
        return min(len(self.anomalous), len(self.twin))

    @property
    def common_stop(self) -> int:
        """Number of rows that all three episodes have."""
        return min(self.stop, len(self.next_twin))


def _auc_smoothed(pair: EpisodePair) -> float:
    anomalous, twin = (
        smoothed(pair.standardization(scores[: pair.stop]))
        for scores in (pair.anomalous, pair.twin)
    )
    return auc_same_times(anomalous, twin, pair.effect, pair.stop)


AUCS: Final[Mapping[str, Callable[[EpisodePair], float]]] = {
    "auc": lambda p: auc_onset(p.anomalous, p.onset),
    "auc_null": lambda p: auc_onset(p.twin, p.onset),
    "auc_matched": lambda p: auc_same_times(p.anomalous, p.twin, p.effect, p.stop),
    "auc_placebo": lambda p: auc_same_times(p.twin, p.next_twin, p.effect, p.common_stop),
    "auc_unpaired": lambda p: auc_same_times(p.anomalous, p.next_twin, p.effect, p.common_stop),
    "auc_smoothed": _auc_smoothed,
}
"""Functions of one episode, by the name that the catalogue has for their mean over episodes."""


def auc_contributions(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    effects: Sequence[int],
    standardization: Standardization,
) -> dict[str, Contribution]:
    """Return the AUCs of one cell.

    ``auc`` and ``auc_null`` compare rows from the onset on with rows before it. The others compare
    two trajectories at the same times, from the effect to the end of the shortest of those that
    are involved: with more times of one than of the other, their phase would be compared.
    ``auc_placebo`` compares twin i with twin i + 1 (the last with the first), ``auc_unpaired`` the
    anomalous trajectory i with twin i + 1.

    Parameters
    ----------
    anomalous, twins
        Scores of the n anomalous trajectories and of their nominal twins.
    onsets, effects
        For each, the first row in which the anomaly is in force, and the first that differs from
        the twin's.
    standardization
        That of the calibration scores, for ``auc_smoothed``.

    Returns
    -------
    dict
        The metrics of `AUCS` by name.
    """
    next_twins = [*twins[1:], twins[0]] if len(twins) > 1 else [np.zeros(0)] * len(twins)
    pairs = [
        EpisodePair(a, b, c, int(onset), int(effect), standardization)
        for a, b, c, onset, effect in zip(
            anomalous, twins, next_twins, onsets, effects, strict=True
        )
    ]
    return {name: mean_of([function(p) for p in pairs]) for name, function in AUCS.items()}


def auc_before(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int]
) -> Contribution:
    """Return the AUC of rows before the onset against the twin's, one half where twins are such.

    Parameters
    ----------
    anomalous, twins
        Scores of the n anomalous trajectories and of their nominal twins.
    onsets
        For each, the first row in which the anomaly is in force.

    Returns
    -------
    Contribution
        Undefined where the anomaly is in force from the first row on.
    """
    return mean_of(
        [
            auc_same_times(a, b, 0, int(onset))
            for a, b, onset in zip(anomalous, twins, onsets, strict=True)
        ]
    )


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
    """Return all metrics of one cell that need no level, in the order of the catalogue.

    Parameters
    ----------
    anomalous, twins, onsets, effects
        As those of `auc_contributions`.
    rule
        The paper's alarms.
    """
    contributions = auc_contributions(anomalous, twins, onsets, effects, rule.standardization)
    contributions |= alarm_contributions(anomalous, twins, onsets, rule)
    return {name: contributions[name] for name in METRICS if name in contributions}


def _rate(pairs: Sequence[tuple[NDArray[np.bool_], Floats]]) -> Contribution:
    """Alarms over defined steps, per trajectory."""
    return Contribution(
        np.array([float(np.count_nonzero(alarms)) for alarms, _ in pairs]),
        np.array([float(np.count_nonzero(~np.isnan(scores))) for _, scores in pairs]),
    )
