"""The metrics, as pure functions of score arrays.

Every metric is a ratio of sums over test trajectories, held as a `Contribution`: a mean over the
trajectories where it is defined has denominators 1 and 0, a pooled rate has counts. From the same
two arrays come the value, its bootstrap interval, group means and paired comparisons.

Time runs over observation rows; ``onset`` is the first row that may differ from the nominal twin's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.cusum import DRIFT, THRESHOLD, Standardization, cusum

Floats = NDArray[np.float64]

METRICS: Final[dict[str, str]] = {
    "auc": "the paper's: scores from the onset on against scores before it, mean over trajectories",
    "auc_null": "the same on the nominal twin: what the phase of the episode alone gives",
    "auc_matched": "ranks: anomalous scores against the twin's at the same times",
    "auc_placebo": "two nominal twins against each other at the same times: 0.5 within noise",
    "delay": "steps from the onset to the first alarm, over trajectories that have one",
    "delay_null": "the same on the nominal twin: what false alarms alone give",
    "delay_censored": "delay with a miss counted as the whole remainder of the episode",
    "missed": "share of trajectories without an alarm from the onset on",
    "far": "false-alarm rate: alarms before the onset over the steps before it",
    "far_twin": "false-alarm rate over whole nominal twins",
}
"""Names and meanings, in the order of records and tables."""

POOLED: Final[dict[str, str]] = {
    "auc_pooled": "AUC of all trajectories' scores in one pool, labelled by the onset",
    "average_precision": "area under the precision-recall curve of that pool",
    "fpr95": "false-positive rate of that pool where 95 % of its anomalous steps are found",
}
"""The words of the neighbouring field: single numbers of pooled steps, not ratios of sums."""

HIGHER_IS_BETTER: Final = frozenset({"auc", "auc_matched", "auc_pooled", "average_precision"})
"""Of the others, null, placebo and threshold have no better side; the rest are better lower."""


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """A ratio of sums: numerators and denominators of n test trajectories, 0 / 0 if undefined.

    Examples
    --------
    >>> import numpy as np
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

    Parameters
    ----------
    positives, negatives : float64 arrays
        Scores that should be higher, and lower. NaN (undefined) scores are left out.

    Returns
    -------
    A number in [0, 1]; NaN when either class is empty.

    Notes
    -----
    Equal to the Mann-Whitney U statistic over the number of pairs; counted exactly, in
    O((m + n) log n).

    Examples
    --------
    >>> import numpy as np
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
        return cusum(
            self.standardization(scores), drift=self.drift, threshold=self.threshold
        )[1]  # fmt: skip


def first_delay(alarms: NDArray[np.bool_], onset: int) -> float:
    """Return steps from the onset to the first alarm at or after it; NaN if there is none."""
    late = np.flatnonzero(alarms[onset:])
    return float(late[0]) if late.size else float("nan")


def auc_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int]
) -> dict[str, Contribution]:
    """Return the four AUCs of one cell.

    Parameters
    ----------
    anomalous, twins : sequences of n arrays
        Scores of the anomalous trajectories and of their nominal twins, in the same order.
    onsets : sequence of n ints

    Notes
    -----
    Matched comparisons use the times from the onset to the end of the shorter of the two. The
    placebo compares twin i with twin i + 1 (the last with the first) at those of these times that
    both have: with more times of one than of the other, their phase would be compared.
    """
    n = len(anomalous)
    spans = [
        (int(onset), min(len(a), len(b)))
        for onset, a, b in zip(onsets, anomalous, twins, strict=True)
    ]
    pairs = list(zip(anomalous, twins, spans, strict=True))
    return {
        "auc": mean_of([auc_onset(a, start) for a, _, (start, _) in pairs]),
        "auc_null": mean_of([auc_onset(b, start) for _, b, (start, _) in pairs]),
        "auc_matched": mean_of([auc_same_times(a, b, *span) for a, b, span in pairs]),
        "auc_placebo": mean_of(
            [
                _placebo(b, twins[(i + 1) % n], *span) if n > 1 else float("nan")
                for i, (_, b, span) in enumerate(pairs)
            ]
        ),
    }


def _placebo(twin: Floats, other: Floats, start: int, stop: int) -> float:
    return auc_same_times(twin, other, start, min(stop, len(other)))


def alarm_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Contribution]:
    """Delays, misses and false-alarm rates of one cell under an alarm rule.

    Parameters
    ----------
    anomalous, twins : sequences of n arrays
    onsets : sequence of n ints
    rule
        Its sum is not reset at the onset.

    Notes
    -----
    A miss enters ``delay_censored`` as T - onset + 1, one more than the largest possible delay.
    """
    loud = [rule.alarms(a) for a in anomalous]
    quiet = [rule.alarms(b) for b in twins]
    delays = np.array([first_delay(x, int(t)) for x, t in zip(loud, onsets, strict=True)])
    remainders = np.array([len(a) - int(t) for a, t in zip(anomalous, onsets, strict=True)])
    missed = np.isnan(delays)
    early = [(x[:t], a[:t]) for x, a, t in zip(loud, anomalous, map(int, onsets), strict=True)]
    return {
        "delay": mean_of(delays),
        "delay_null": mean_of([first_delay(x, int(t)) for x, t in zip(quiet, onsets, strict=True)]),
        "delay_censored": mean_of(np.where(missed, remainders, delays)),
        "missed": mean_of(missed.astype(np.float64)),
        "far": _rate(early),
        "far_twin": _rate(list(zip(quiet, twins, strict=True))),
    }


def cell_contributions(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Contribution]:
    """All metrics of one cell, in the order of `METRICS`."""
    found = auc_contributions(anomalous, twins, onsets)
    found |= alarm_contributions(anomalous, twins, onsets, rule)
    return {name: found[name] for name in METRICS}


def pooled_metrics(anomalous: Sequence[Floats], onsets: Sequence[int]) -> dict[str, float]:
    """Pooled AUC, average precision and FPR95 of one cell, in the order of `POOLED`.

    All defined scores of all anomalous trajectories form one pool, positive where t >= onset, as
    is usual where anomalies are searched in single images or time steps. With TP and FP the
    positives and negatives at or above a threshold, P and N their totals, and the thresholds
    descending over the distinct scores:

    - ``auc_pooled`` is the area under TP / P over FP / N, ties one half;
    - ``average_precision`` is the sum of (increase of TP / P) * TP / (TP + FP), without
      interpolation;
    - ``fpr95`` is FP / N at the highest threshold with TP / P >= 0.95.

    Parameters
    ----------
    anomalous : sequence of n arrays
        Scores; NaN is left out.
    onsets : sequence of n ints

    Returns
    -------
    dict
        NaN where a class is empty.

    Notes
    -----
    A pool compares scores of different episodes and phases, and its average precision moves with
    the share of positives, which the onsets decide: for reading beside other work, not for ranking.

    Examples
    --------
    >>> import numpy as np
    >>> pooled_metrics([np.array([0.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0, 1.0])], [1, 3])
    {'auc_pooled': 0.9583333333333334, 'average_precision': 0.9166666666666666, 'fpr95': 0.25}
    """
    scores = np.concatenate(anomalous)
    times = np.concatenate(
        [np.arange(len(a)) - onset for a, onset in zip(anomalous, onsets, strict=True)]
    )
    defined = ~np.isnan(scores)
    scores, positive = scores[defined], times[defined] >= 0
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
