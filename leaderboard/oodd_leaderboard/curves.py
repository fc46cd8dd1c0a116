"""Illustrations computed from scores: ROC curves, delay against false alarms, one example.

They are drawn on the leaderboard's site and decide nothing; numbers are rounded for drawing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.metrics.auc import AlarmRule, Floats, auc_same_times, first_delay
from oodd_eval.metrics.cusum import THRESHOLD, UNIT, Alarms, cusum
from oodd_eval.metrics.recalibration import PairedScores
from oodd_eval.metrics.unpaired import LEAST_NOMINAL, UnpairedScores, anomalous_rows

FPR: Final = tuple((i / 24) ** 2 for i in range(25))
"""False-positive rates at which ROC curves are given, denser towards 0."""

THRESHOLDS: Final = 25  # number of CUSUM thresholds at which delay and false-alarm rate are given

BEFORE: Final = 40  # rows of an example before its onset
AFTER: Final = 60  # and from it on
LARGEST: Final = 1e12  # scores and statistics beyond this many units are drawn as this many


def roc(positives: Floats, negatives: Floats, fpr: Floats) -> Floats:
    """Return the true-positive rate at given false-positive rates, ties as diagonal lines.

    Where the curve is vertical, it is its upper end; NaN when either class has no defined score.
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
    effects: Sequence[int],
    fpr: Floats | Sequence[float] = FPR,
) -> Floats:
    """Return the matched ROC curve of a cell: averaged over trajectories at equal rates.

    Scores are compared at the times of ``auc_matched``. NaN when no trajectory has a curve.
    """
    grid = np.asarray(fpr, dtype=np.float64)
    triples = zip(effects, anomalous, twins, strict=True)
    spans = [slice(t, min(map(len, two))) for t, *two in triples]
    pairs = zip(anomalous, twins, spans, strict=True)
    curves = np.array([roc(a[span], b[span], grid) for a, b, span in pairs])
    defined = curves[~np.isnan(curves[:, 0])]
    return defined.mean(axis=0) if len(defined) else np.full(len(grid), np.nan)


def thresholds(twins: Sequence[Floats], rule: AlarmRule, n: int = THRESHOLDS) -> Floats:
    """Return CUSUM thresholds over the whole range in which the twins' false-alarm rate changes.

    They are 0, the paper's, and a geometric sequence from a tenth of it to the first at which no
    twin raises an alarm any more, but at least to ten times the paper's.
    """
    unbounded = GuaranteedAlarm(rule.standardization, math.inf)
    top = min(max(10 * THRESHOLD, *map(unbounded.largest, twins)), LARGEST)
    between = np.geomspace(THRESHOLD / 10, top, n - 2)
    # The end is met exactly, so that the last false-alarm rate is 0.
    between[-1] = top
    return np.unique(np.concatenate([[0.0, THRESHOLD], between]))


@dataclass(frozen=True, slots=True)
class Sweep:
    """One fitted detector's alarms on the nominal twins under several thresholds, ascending.

    They are the same for all anomalies, and most of the work; `quiet` has them by rule and twin.
    Without twins they are those on nominal test episodes.
    """

    rules: list[AlarmRule]
    twins: Sequence[Floats]
    quiet: list[list[Alarms]]

    @classmethod
    def over(cls, twins: Sequence[Floats], rule: AlarmRule, at: Floats) -> "Sweep":
        """Find the alarms of the twins at every threshold."""
        rules = [replace(rule, threshold=threshold) for threshold in at.tolist()]
        return cls(rules, twins, [[r.alarms(b) for b in twins] for r in rules])


def delay_far(
    sweep: Sweep, anomalous: Sequence[Floats], onsets: Sequence[int], *, paired: bool = True
) -> dict[str, list[float]]:
    """Return delay, misses and false-alarm rate of a cell at the thresholds of a sweep.

    ``far`` is that over whole twins, and ``null_censored``, if `paired`, the censored delay of the
    twins at their partners' onsets: what false alarms alone give. All are empty when the twins have
    no score, or nothing is anomalous.
    """
    names = ("threshold", "far", "delay_censored", "missed", *["null_censored"] * paired)
    rows = []
    steps = sum(int(np.count_nonzero(~np.isnan(b))) for b in sweep.twins)
    defined = steps and len(anomalous)
    for rule, quiet in zip(sweep.rules, sweep.quiet, strict=True) if defined else ():
        loud = [rule.alarms(a) for a in anomalous]
        missed = [math.isnan(first_delay(x, t)) for x, t in zip(loud, onsets, strict=True)]
        far = sum(int(alarms.sum()) for alarms in quiet) / steps
        row = [rule.threshold, far, _censored(loud, onsets), sum(missed) / len(missed)]
        rows.append([*row, _censored(quiet, onsets)] if paired else row)
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def _censored(alarms: Sequence[Alarms], onsets: Sequence[int]) -> float:
    """Return the mean delay, a miss counting as the whole remainder of the episode."""
    pairs = [(first_delay(x, t), len(x) - t) for x, t in zip(alarms, onsets, strict=True)]
    return sum(rest if math.isnan(delay) else delay for delay, rest in pairs) / len(pairs)


def example(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    onsets: Sequence[int],
    effects: Sequence[int],
    rule: AlarmRule,
) -> dict[str, Any]:
    """Return the trajectory with the median matched AUC of a cell, around its onset.

    Of an even number it is the lower median, of equals the first. All lists begin at the row
    ``start``: scores in standard deviations from the calibration mean (None where undefined), CUSUM
    statistics before the reset that an alarm brings, and rows with an alarm.
    """
    areas = [
        auc_same_times(a, b, effect, min(len(a), len(b)))
        for a, b, effect in zip(anomalous, twins, effects, strict=True)
    ]
    area, index = _median(areas)
    onset = int(onsets[index])
    start = max(0, onset - BEFORE)
    rows = slice(start, onset + AFTER)
    return {
        "index": index,
        "auc_matched": area,
        "onset": onset,
        "length": len(anomalous[index]),
        "start": start,
        **_drawn(anomalous[index], rule, rows, ("scores", "cusum", "alarms")),
        **_drawn(twins[index], rule, rows, ("twin", "twin_cusum", "twin_alarms")),
    }


def _median(areas: Sequence[float]) -> tuple[float | None, int]:
    """Return the lower median of the areas that are defined, and the first index that has it."""
    ranked = sorted((area, i) for i, area in enumerate(areas) if not math.isnan(area))
    return ranked[(len(ranked) - 1) // 2] if ranked else (None, 0)


def _drawn(
    scores: Floats, rule: AlarmRule, rows: slice, names: tuple[str, str, str]
) -> dict[str, Any]:
    """Return scores, statistics and rows with an alarm of a part of an episode."""
    x = rule.standardization(scores)
    statistic, alarms = cusum(x, drift=rule.drift, threshold=rule.threshold)
    standardized = [None if math.isnan(v) else v for v in (x[rows] / UNIT).tolist()]
    at = (rows.start + np.flatnonzero(alarms[rows])).tolist()
    return dict(zip(names, (standardized, statistic[rows].tolist(), at), strict=True))


LONGEST: Final = 600  # most rows of an example without twins


def cell_curves(
    cell: PairedScores | UnpairedScores, sweep: Sweep, rule: AlarmRule
) -> dict[str, Any]:
    """Return the three curves of a cell, rounded for drawing.

    Parameters
    ----------
    cell
        The scores, of at least one anomalous episode.
    sweep
        Alarms on the twins, or on the nominal test episodes.
    rule
        That of the example.

    Returns
    -------
    dict
        ``roc``, ``delay_far`` and ``example``. Without twins ``roc`` is the curve of ``auc_pool``,
        ``delay_far`` that of delays from the first interval on, and ``example`` the episode with
        the median pooled AUC.
    """
    if isinstance(cell, PairedScores):
        tpr = mean_matched_roc(cell.anomalous, cell.twins, cell.effects)
        delays = delay_far(sweep, cell.anomalous, cell.onsets)
        drawn = example(*cell, rule)
    else:
        areas, tpr = pooled_roc(cell)
        starts = {i: cell.intervals[i][0][0] for i in cell.labelled}
        onsets = {i: start for i, start in starts.items() if 0 <= start < len(cell.anomalous[i])}
        episodes = [cell.anomalous[i] for i in onsets]
        delays = delay_far(sweep, episodes, [*onsets.values()], paired=False)
        drawn = _unpaired_example(cell, areas, rule)
    defined = not np.isnan(tpr).any()
    roc_curve = {"fpr": list(FPR) if defined else [], "tpr": tpr.tolist() if defined else []}
    curves: dict[str, Any]
    curves = rounded({"roc": roc_curve, "delay_far": delays, "example": drawn})
    return curves


def pooled_roc(
    cell: UnpairedScores, fpr: Floats | Sequence[float] = FPR
) -> tuple[list[float], Floats]:
    """Return the pooled AUC of each anomalous episode, and the mean of their ROC curves.

    A row is found at the false-positive rates from the share of nominal scores above it on: those
    of the same row in the task's nominal test episodes, or without a clock all of them. Ties are
    diagonal lines. NaN where no row can be compared.
    """
    grid = np.asarray(fpr, dtype=np.float64)
    areas = [math.nan] * len(cell.anomalous)
    curves = []
    for nominal, anomalous in cell.by_task():
        references = [cell.nominal[j] for j in nominal]
        for i in anomalous:
            scores = cell.anomalous[i]
            rows = anomalous_rows(cell.intervals[i], len(scores)) & ~np.isnan(scores)
            above, ties = _shares_above(scores, rows, references, clock=cell.clock)
            if above.size:
                areas[i] = float(np.mean(1 - above - ties / 2))
                width = np.where(ties > 0, ties, 1.0)[:, None]
                ramp = np.clip((grid - above[:, None]) / width, 0.0, 1.0)
                step = grid >= above[:, None]
                curves.append(np.where(ties[:, None] > 0, ramp, step).mean(axis=0))
    return areas, np.mean(curves, axis=0) if curves else np.full(len(grid), np.nan)


def _shares_above(
    scores: Floats, rows: NDArray[np.bool_], references: Sequence[Floats], *, clock: bool
) -> tuple[Floats, Floats]:
    """Return for rows of an episode the shares of nominal scores above them, and equal to them."""
    if not clock:
        ordered = np.sort(np.concatenate([r[~np.isnan(r)] for r in references]))
        n = max(len(ordered), 1)
        values = scores[rows] if len(ordered) else np.zeros(0)
        low, high = (np.searchsorted(ordered, values, side=s) for s in ("left", "right"))
        return 1 - high / n, (high - low) / n
    table = np.full((len(references), len(scores)), np.nan)
    for line, reference in zip(table, references, strict=True):
        line[: len(reference)] = reference[: len(scores)]
    counts = (~np.isnan(table)).sum(axis=0)
    comparable = rows & (counts >= LEAST_NOMINAL)
    table, counts = table[:, comparable], counts[comparable]
    return (
        (table > scores[comparable]).sum(axis=0) / counts,
        (table == scores[comparable]).sum(axis=0) / counts,
    )


def _unpaired_example(
    cell: UnpairedScores, areas: Sequence[float], rule: AlarmRule
) -> dict[str, Any]:
    """Return the episode with the median pooled AUC of a cell, around its first interval."""
    area, index = _median(areas)
    scores, intervals = cell.anomalous[index], cell.intervals[index]
    first, stop = intervals[0] if intervals else (0, len(scores))
    start = max(0, first - BEFORE)
    rows = slice(start, min(max(stop + BEFORE, first + AFTER), start + LONGEST))
    return {
        "index": index,
        "auc_pool": area,
        "intervals": [list(interval) for interval in intervals],
        "length": len(scores),
        "start": start,
        **_drawn(scores, rule, rows, ("scores", "cusum", "alarms")),
    }


def rounded(value: Any) -> Any:
    """Round to three digits and five decimals, whole numbers to ints: finer than can be drawn."""
    if isinstance(value, dict):
        return {name: rounded(v) for name, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    if not isinstance(value, float):
        return value
    near = round(float(f"{min(max(value, -LARGEST), LARGEST):.3g}"), 5)
    return int(near) if near.is_integer() else near
