"""Illustrations computed from stored scores: what a table of metrics cannot show.

For each cell the averaged ROC curve, delay against the false-alarm rate over the whole range of
CUSUM thresholds, and one trajectory beside its nominal twin. They are drawn on the leaderboard's
site and decide nothing; numbers are rounded for drawing, so that the curves of a detector with 56
cells stay below 250 kB.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import EnvironmentData, Split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import AlarmRule, auc_same_times, first_delay
from oodd_eval.metrics.cusum import THRESHOLD, UNIT, Alarms, Standardization, cusum
from oodd_eval.results.curve_file import SCHEMA, read_curves, write_curves
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import stored_scores
from oodd_eval.results.record import Record
from oodd_eval.scoring.unit import CALIBRATION

FPR: Final = tuple((i / 24) ** 2 for i in range(25))
"""False-positive rates at which ROC curves are given, denser towards 0."""

THRESHOLDS: Final = 25
"""Number of CUSUM thresholds at which delay and false-alarm rate are given."""

BEFORE: Final = 40
AFTER: Final = 60
"""Rows of an example before its onset, and from it on."""

LARGEST: Final = 1e12
"""Scores and statistics beyond this many units are drawn as this many."""

Floats = NDArray[np.float64]

__all__ = [
    "Sweep",
    "cell_curves",
    "delay_far",
    "example",
    "make_curves",
    "mean_matched_roc",
    "read_curves",
    "roc",
    "thresholds",
    "write_curves",
]


def roc(positives: Floats, negatives: Floats, fpr: Floats) -> Floats:
    """Return the true-positive rate at given false-positive rates, ties as diagonal lines.

    Parameters
    ----------
    positives, negatives : float64 arrays
        Scores that should be higher, and lower. NaN (undefined) scores are left out.
    fpr : float64 array of shape (n,)
        False-positive rates in [0, 1].

    Returns
    -------
    float64 array of shape (n,): where the curve is vertical, its upper end; NaN when either class
    is empty. The area under the curve is `oodd_eval.metrics.auc.auc`.

    Examples
    --------
    >>> import numpy as np
    >>> roc(np.array([2.0, 3.0]), np.array([1.0, 2.0]), np.array([0.0, 0.25, 0.5, 1.0])).tolist()
    [0.5, 0.75, 1.0, 1.0]
    """
    positives = np.sort(positives[~np.isnan(positives)])
    negatives = np.sort(negatives[~np.isnan(negatives)])
    if not positives.size or not negatives.size:
        return np.full(len(fpr), np.nan)
    # One vertex per distinct score, from the highest down, and the corner (0, 0) before them.
    scores = np.unique(np.concatenate([positives, negatives]))[::-1]
    x = np.concatenate([[0], negatives.size - np.searchsorted(negatives, scores, side="left")])
    y = np.concatenate([[0], positives.size - np.searchsorted(positives, scores, side="left")])
    x, y = x / negatives.size, y / positives.size
    left = np.searchsorted(x, fpr, side="right") - 1
    right = np.minimum(left + 1, len(x) - 1)
    width = x[right] - x[left]
    share = np.where(width > 0, (fpr - x[left]) / np.where(width > 0, width, 1.0), 0.0)
    result: Floats = y[left] + share * (y[right] - y[left])
    return result


def mean_matched_roc(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    fpr: Floats | Sequence[float] = FPR,
) -> Floats:
    """Return the matched ROC curve of a cell: averaged over trajectories at equal rates.

    Positives are a trajectory's scores, negatives its nominal twin's, both at the times from the
    onset to the end of the shorter of the two, as in ``auc_matched``; the area under the average is
    the average of the areas.

    Returns
    -------
    float64 array, one true-positive rate for each of `fpr`; NaN when no trajectory has a curve.
    """
    grid = np.asarray(fpr, dtype=np.float64)
    curves = np.array(
        [
            roc(a[onset : min(len(a), len(b))], b[onset : min(len(a), len(b))], grid)
            for a, b, onset in zip(anomalous, twins, onsets, strict=True)
        ]
    )
    defined = curves[~np.isnan(curves[:, 0])]
    return defined.mean(axis=0) if len(defined) else np.full(len(grid), np.nan)


def thresholds(twins: Sequence[Floats], rule: AlarmRule, n: int = THRESHOLDS) -> Floats:
    """Return CUSUM thresholds over the whole range in which the twins' false-alarm rate changes.

    They are 0, a geometric sequence from a tenth of the paper's threshold to the first at which no
    twin raises an alarm any more (but at least ten times the paper's), and the paper's own.
    """
    highest = max(
        float(cusum(rule.standardization(b), drift=rule.drift, threshold=math.inf)[0].max())
        for b in twins
    )
    top = min(max(highest, 10 * THRESHOLD), LARGEST)
    between = np.geomspace(THRESHOLD / 10, top, n - 2)
    # The end is met exactly, so that the last false-alarm rate is 0.
    between[-1] = top
    return np.unique(np.concatenate([[0.0, THRESHOLD], between]))


@dataclass(frozen=True, slots=True)
class Sweep:
    """One fitted detector's alarms on the nominal twins under several thresholds.

    They are the same for all anomalies, and most of the work.

    Attributes
    ----------
    rules
        Alarm rules that differ in their threshold, ascending.
    twins
        Scores of the twins.
    quiet
        For each rule, the alarms of each twin.
    """

    rules: list[AlarmRule]
    twins: Sequence[Floats]
    quiet: list[list[Alarms]]

    @classmethod
    def over(cls, twins: Sequence[Floats], rule: AlarmRule, at: Floats) -> Sweep:
        """Find the alarms of the twins at every threshold."""
        rules = [replace(rule, threshold=threshold) for threshold in at.tolist()]
        return cls(rules, twins, [[r.alarms(b) for b in twins] for r in rules])


def delay_far(
    sweep: Sweep, anomalous: Sequence[Floats], onsets: Sequence[int]
) -> dict[str, list[float]]:
    """Return delay, misses and false-alarm rate of a cell at the thresholds of a sweep.

    Returns
    -------
    dict with equally long lists
        ``threshold``; ``far``, the false-alarm rate over whole twins (``far_twin`` of the
        metrics); ``delay_censored`` and ``missed``; ``null_censored``, the censored delay of the
        twins at their partners' onsets: what false alarms alone give. All empty when no score of
        the twins is defined.
    """
    names = ("threshold", "far", "delay_censored", "missed", "null_censored")
    found: dict[str, list[float]] = {name: [] for name in names}
    steps = sum(int(np.count_nonzero(~np.isnan(b))) for b in sweep.twins)
    if not steps:
        return found
    for rule, quiet in zip(sweep.rules, sweep.quiet, strict=True):
        loud = [rule.alarms(a) for a in anomalous]
        found["threshold"].append(rule.threshold)
        found["far"].append(sum(int(alarms.sum()) for alarms in quiet) / steps)
        found["delay_censored"].append(_censored(loud, onsets))
        found["null_censored"].append(_censored(quiet, onsets))
        missed = [math.isnan(first_delay(x, t)) for x, t in zip(loud, onsets, strict=True)]
        found["missed"].append(sum(missed) / len(missed))
    return found


def _censored(alarms: Sequence[Alarms], onsets: Sequence[int]) -> float:
    """Mean delay, a miss counting as the whole remainder of the episode."""
    delays = [
        len(x) - t if math.isnan(delay := first_delay(x, t)) else delay
        for x, t in zip(alarms, onsets, strict=True)
    ]
    return sum(delays) / len(delays)


def example(
    anomalous: Sequence[Floats], twins: Sequence[Floats], onsets: Sequence[int], rule: AlarmRule
) -> dict[str, Any]:
    """Return the trajectory with the median matched AUC of a cell, around its onset.

    It is typical of what the detector does in this cell, where the first one or the best one need
    not be. Of an even number it is the lower median, of equals the first.

    Returns
    -------
    dict
        ``index``: which test trajectory. ``auc_matched``: its matched AUC, None where undefined.
        ``onset``, ``length``: in observation rows. ``start``: row of the first value of the lists.
        ``scores``, ``twin``: scores in standard deviations from the calibration mean, None where
        undefined. ``cusum``, ``twin_cusum``: CUSUM statistics before the reset that an alarm
        brings. ``alarms``, ``twin_alarms``: rows with an alarm, within the lists' range.
    """
    areas = [
        auc_same_times(a, b, onset, min(len(a), len(b)))
        for a, b, onset in zip(anomalous, twins, onsets, strict=True)
    ]
    ranked = sorted((area, i) for i, area in enumerate(areas) if not math.isnan(area))
    area, index = ranked[(len(ranked) - 1) // 2] if ranked else (math.nan, 0)
    onset = int(onsets[index])
    start = max(0, onset - BEFORE)
    found: dict[str, Any] = {
        "index": index,
        "auc_matched": None if math.isnan(area) else area,
        "onset": onset,
        "length": len(anomalous[index]),
        "start": start,
    }
    for prefix, scores, name in (
        ("", anomalous[index], "scores"),
        ("twin_", twins[index], "twin"),
    ):
        x = rule.standardization(scores)
        statistic, alarms = cusum(x, drift=rule.drift, threshold=rule.threshold)
        shown = slice(start, onset + AFTER)
        found[name] = [None if math.isnan(v) else v for v in (x[shown] / UNIT).tolist()]
        found[f"{prefix}cusum"] = statistic[shown].tolist()
        found[f"{prefix}alarms"] = (start + np.flatnonzero(alarms[shown])).tolist()
    return found


def cell_curves(
    sweep: Sweep, rule: AlarmRule, anomalous: Sequence[Floats], onsets: Sequence[int]
) -> dict[str, Any]:
    """Return ``roc``, ``delay_far`` and ``example`` of one cell, rounded for drawing.

    Parameters
    ----------
    sweep
        Of the fitted detector.
    rule
        The standard one, for the example.
    """
    tpr = mean_matched_roc(anomalous, sweep.twins, onsets)
    defined = not np.isnan(tpr).any()
    curves = {
        "roc": {"fpr": list(FPR) if defined else [], "tpr": tpr.tolist() if defined else []},
        "delay_far": delay_far(sweep, anomalous, onsets),
        "example": example(anomalous, sweep.twins, onsets, rule),
    }
    rounded: dict[str, Any] = _rounded(curves)
    return rounded


def make_curves(
    records: Iterable[Record], results: ResultsDirectory, split: Split
) -> dict[str, Any]:
    """Compute the curves of all evaluated cells from the stored scores.

    Parameters
    ----------
    records
        Of this split; failed cells have no curves.
    results
        Where the scores of the records are.
    split
        For onsets and lengths.

    Returns
    -------
    The content of ``curves.json``.

    Raises
    ------
    ResultsError
        When the split is not the one that the records are of, or scores are missing.
    """
    units = []
    data: dict[str, EnvironmentData] = {}
    fitted: dict[str, tuple[Sweep, AlarmRule]] = {}
    with ExitStack() as stack:
        for record in records:
            if not record.ok:
                continue
            if record.split_digest != split.digest:
                raise ResultsError(
                    f"{record.cell} is of a split with digest {record.split_digest[:12]}, but "
                    f"split {split.name!r} here has {split.digest[:12]}: curves need the split "
                    "that the scores are of"
                )
            if record.environment not in data:
                data[record.environment] = split.environment(record.environment)
                stack.callback(data[record.environment].close)
            environment = data[record.environment]
            scores = stored_scores(record, results, environment).parts
            key = record.scores
            if key not in fitted:
                rule = AlarmRule(Standardization.fit(scores[CALIBRATION]))
                at = thresholds(scores[TWINS], rule)
                fitted[key] = Sweep.over(scores[TWINS], rule, at), rule
            sweep, rule = fitted[key]
            anomalous = scores[f"test/{record.anomaly}"]
            onsets = environment.anomalous(record.anomaly).onsets[: len(anomalous)].tolist()
            units.append(
                {
                    "cell": str(record.cell),
                    "detector": record.detector,
                    "horizon": record.horizon,
                    "seed": record.seed,
                    "overrides": record.overrides,
                    "environment": record.environment,
                    "anomaly": record.anomaly,
                    **cell_curves(sweep, rule, anomalous, onsets),
                }
            )
    return {"schema": SCHEMA, "units": units}


def _rounded(value: Any) -> Any:
    """Round to three digits and five decimals, whole numbers to ints: finer than can be drawn."""
    if isinstance(value, dict):
        return {name: _rounded(v) for name, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    if not isinstance(value, float):
        return value
    near = round(float(f"{min(max(value, -LARGEST), LARGEST):.3g}"), 5)
    return int(near) if near.is_integer() else near
