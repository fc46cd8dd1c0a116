"""The metrics, as pure functions of score arrays.

Every metric is a ratio of sums over test trajectories, held as a `Contribution`: a mean over the
trajectories where it is defined has denominators 1 and 0, a pooled rate has counts. From it come
the value, its bootstrap interval, group means and paired comparisons.

Time runs over observation rows; ``onset`` is the first row that may differ from the nominal twin's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.catalogue import POOLED, RATIOS
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD, Standardization, cusum

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """A ratio of sums: numerators and denominators of n test trajectories, 0 / 0 if undefined.

    Examples
    --------
    >>> rate = Contribution(np.array([1.0, 2.0, 0.0]), np.array([10.0, 30.0, 0.0]))
    >>> rate.value, rate.n
    (0.075, 2)
    """

    numerator: Floats
    denominator: Floats

    @property
    def value(self) -> float:
        """Sum of numerators over sum of denominators; NaN when the latter is 0."""
        total = float(self.denominator.sum())
        return float(self.numerator.sum()) / total if total else float("nan")

    @property
    def n(self) -> int:
        """Number of trajectories that contribute."""
        return int(np.count_nonzero(self.denominator))


def mean_of(values: Sequence[float] | Floats) -> Contribution:
    """Contributions of a mean over the values that are not NaN."""
    array = np.asarray(values, dtype=np.float64)
    defined = ~np.isnan(array)
    return Contribution(np.where(defined, array, 0.0), defined.astype(np.float64))


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


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """Standardization, drift and threshold that turn scores into alarms."""

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
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int]
) -> dict[str, Contribution]:
    """Return the four AUCs of one cell, from its n anomalous trajectories, their twins and onsets.

    Matched comparisons use the times from the onset to the end of the shorter of the two. The
    placebo compares twin i with twin i + 1 (the last with the first) at those of these times that
    both have: with more times of one than of the other, their phase would be compared.
    """
    found: dict[str, list[float]] = {name: [] for name in RATIOS if name.startswith("auc")}
    for i, (a, b, t) in enumerate(zip(anomalous, twins, map(int, onsets), strict=True)):
        stop = min(len(a), len(b))
        found["auc"].append(auc_onset(a, t))
        found["auc_null"].append(auc_onset(b, t))
        found["auc_matched"].append(auc_same_times(a, b, t, stop))
        other = twins[(i + 1) % len(twins)] if len(twins) > 1 else np.zeros(0)
        found["auc_placebo"].append(auc_same_times(b, other, t, min(stop, len(other))))
    return {name: mean_of(values) for name, values in found.items()}


def alarm_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Contribution]:
    """Delays, misses and false-alarm rates of one cell, sums running on over the onset.

    A miss enters ``delay_censored`` as T - onset + 1, one more than the largest possible delay.
    """
    times = [int(t) for t in onsets]
    loud, quiet = ([rule.alarms(s) for s in part] for part in (anomalous, twins))
    delays = np.array([first_delay(x, t) for x, t in zip(loud, times, strict=True)])
    remainders = np.array([len(a) - t for a, t in zip(anomalous, times, strict=True)])
    missed = np.isnan(delays)
    early = [(x[:t], a[:t]) for x, a, t in zip(loud, anomalous, times, strict=True)]
    return {
        "delay": mean_of(delays),
        "delay_null": mean_of([first_delay(x, t) for x, t in zip(quiet, times, strict=True)]),
        "delay_censored": mean_of(np.where(missed, remainders, delays)),
        "missed": mean_of(missed.astype(np.float64)),
        "far": _rate(early),
        "far_twin": _rate(list(zip(quiet, twins, strict=True))),
    }


def cell_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Contribution]:
    """All metrics of one cell, in the order of `RATIOS`."""
    found = auc_contributions(anomalous, twins, onsets)
    found |= alarm_contributions(anomalous, twins, onsets, rule)
    return {name: found[name] for name in RATIOS}


def pooled_metrics(anomalous: Sequence[Floats], onsets: Sequence[int]) -> dict[str, float]:
    """Pooled AUC, average precision and FPR95 of one cell, in the order of `POOLED`.

    All defined scores of all anomalous trajectories form one pool, positive where t >= onset. With
    TP and FP the positives and negatives at or above a threshold, P and N their totals, and the
    thresholds descending over the distinct scores:

    - ``auc_pooled`` is the area under TP / P over FP / N, ties one half;
    - ``average_precision`` is the sum of (increase of TP / P) * TP / (TP + FP), without
      interpolation;
    - ``fpr95`` is FP / N at the highest threshold with TP / P >= 0.95.

    All are NaN where a class is empty. A pool compares scores of different episodes and phases, and
    its average precision moves with the share of positives, which the onsets decide: for reading
    beside other work, not for ranking.

    Examples
    --------
    >>> pooled_metrics([np.array([0.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0, 1.0])], [1, 3])
    {'auc_pooled': 0.9583333333333334, 'average_precision': 0.9166666666666666, 'fpr95': 0.25}
    """
    scores = np.concatenate(anomalous)
    late = [np.arange(len(a)) >= onset for a, onset in zip(anomalous, onsets, strict=True)]
    defined = ~np.isnan(scores)
    scores, positive = scores[defined], np.concatenate(late)[defined]
    if not positive.any() or positive.all():
        return dict.fromkeys(POOLED, float("nan"))
    order = np.argsort(-scores, kind="stable")
    scores, positive = scores[order], positive[order]
    # Equal scores pass a threshold together: only the last of each run of them counts.
    last = np.append(scores[1:] != scores[:-1], True)
    tp, fp = np.cumsum(positive)[last], np.cumsum(~positive)[last]
    # Twenty times the counts, so that 95 % is exact.
    found = int(np.argmax(20 * tp >= 19 * tp[-1]))
    return {
        "auc_pooled": auc(scores[positive], scores[~positive]),
        "average_precision": float(np.sum(np.diff(tp, prepend=0) * (tp / (tp + fp))) / tp[-1]),
        "fpr95": float(fp[found] / fp[-1]),
    }


def _rate(pairs: Sequence[tuple[NDArray[np.bool_], Floats]]) -> Contribution:
    """Alarms over defined steps, per trajectory."""
    return Contribution(
        np.array([float(np.count_nonzero(alarms)) for alarms, _ in pairs]),
        np.array([float(np.count_nonzero(~np.isnan(scores))) for _, scores in pairs]),
    )
