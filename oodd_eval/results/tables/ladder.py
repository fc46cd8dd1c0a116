"""Tables of results at several strengths: detection thresholds, and shares found by strength."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from oodd_eval.data.facts import title_of
from oodd_eval.metrics.catalogue import RANKING, UNDEFINED
from oodd_eval.metrics.threshold import DetectionThreshold, MeanThreshold, geometric_mean
from oodd_eval.results.board import Board
from oodd_eval.results.identity import Setting
from oodd_eval.results.strengths import (
    DETECTION,
    Pair,
    Strengths,
    Thresholds,
    at_strength,
    thresholds,
)
from oodd_eval.results.tables import Table, show_value

REFERENCE: Final = Setting("riqn")
"""The row whose thresholds others are divided by, where a board has it."""

_RULE: Final = (
    "The threshold is the weakest strength that a detector finds within 100 rows in half of the "
    "episodes, where at most 5 % of nominal episodes have an alarm."
)
_SIDES: Final = (
    "What that hides is marked: the true mean is at most this (≤), more (>), or either (~)."
)
_COLUMNS: Final = {
    True: "At keptN the policy keeps N % of its return; 4th, 16th and 64th are those parts of "
    "kept99's strength. A ladder without a rung counts there with its next weaker one.",
    False: "Columns are named by strengths; their means are over the environments and anomalies "
    "that have the strength.",
}  # of the benchmark's ladder, and of other strengths
_COSTS: Final = "the strength that costs 1 % of the return"


def tables(board: Board, *, intervals: bool = False, places: bool = False) -> list[Table]:
    """Return all tables of a board's records at strengths; none where it has no such records.

    With `intervals`, means by kind and thresholds of single places have their 95 % intervals. With
    `places`, each row has a table with its threshold in every environment.
    """
    by_row = thresholds(board.records)
    strengths = Strengths.of(board.records)
    separability = [_separability(board, by_row, strengths)] if by_row else []
    if not any(by_row.values()):  # no level of 5 %, with few calibration episodes
        return separability
    by_kind = _by_kind(board, by_row, strengths, intervals=intervals)
    rows = [e for e in board.entries if places and by_row.get(e)]
    single = [by_place(board, e, by_row, intervals=intervals) for e in rows]
    return [overview(board, by_row), *separability, by_kind, *single]


def by_place(board: Board, entry: Setting, by_row: Thresholds, *, intervals: bool = False) -> Table:
    """Return one row's thresholds by environment and kind of anomaly, in the anomaly's unit."""
    by_pair = by_row[entry]
    kinds = [k for k in board.anomalies if any(k == kind for _, kind in by_pair)]
    rows = [
        [title_of(e), *(_single(by_pair.get((e, k)), intervals=intervals) for k in kinds)]
        for e in board.environments
    ]
    title = f"{entry}: detection thresholds by anomaly, each in its own unit"
    note = f"{_RULE} ≤ and > mark thresholds beyond the weakest and the strongest rung."
    return Table(title, ["Environment", *kinds], rows, note=note)


def overview(board: Board, by_row: Thresholds) -> Table:
    """Return relative thresholds and shares found by strength, the lowest threshold first.

    `by_row` are the thresholds of the board's records.
    """
    strengths = Strengths.of(board.records)
    reference = by_row.get(REFERENCE, {})
    means = {entry: _mean(by_pair, reference, strengths) for entry, by_pair in by_row.items()}
    values = {entry: mean.value if mean else math.inf for entry, mean in means.items()}
    order = sorted(values, key=values.__getitem__)
    most = max((mean.pairs for mean in means.values() if mean), default=0)
    shares = _by_strength(board, order, strengths.names, DETECTION)
    rows = []
    for entry in order:
        mean = means[entry]
        figures = [UNDEFINED, "0", "", ""]
        if mean:
            counts = mean.pairs, mean.below, mean.above
            figures = [mean.text() + "*" * (mean.pairs < most), *map(str, counts)]
        rows.append([str(entry), *figures, *shares[entry]])
    multiple = f"{REFERENCE}'s" if reference else _COSTS
    over = f"as a multiple of {multiple}"
    if not reference and not strengths.calibrated:
        over = "in the units of the anomalies"
    header = ["detector", "threshold", "pairs", "below", "above", *strengths.names]
    note = (
        f"{_RULE} Shown is its geometric mean {over}, over pairs of environment and "
        "anomaly, with its 95 % interval. In so many pairs it lies below or above the ladder, and "
        f"counts as the end of the ladder. {_SIDES} {_COLUMNS[strengths.calibrated]}"
    )
    title = "Detection thresholds, lower is better, and share of episodes found by strength (%)"
    return Table(title, header, rows, note=note)


def _separability(board: Board, by_row: Thresholds, strengths: Strengths) -> Table:
    """Return matched AUC by strength."""
    order = [e for e in board.entries if e in by_row]
    texts = _by_strength(board, order, strengths.names, RANKING)
    rows = [[str(e), *texts[e]] for e in order]
    header, note = ["detector", *strengths.names], _COLUMNS[strengths.calibrated]
    return Table("Matched AUC (%) by strength", header, rows, note=note)


def _by_kind(board: Board, by_row: Thresholds, strengths: Strengths, *, intervals: bool) -> Table:
    """Return thresholds by kind of anomaly, means over environments."""
    kinds = [k for k in board.anomalies if any(k == kind for p in by_row.values() for _, kind in p)]
    rows = []
    for entry in (e for e in board.entries if e in by_row):
        of_kind = ({p: t for p, t in by_row[entry].items() if p[1] == k} for k in kinds)
        means = (_mean(by_pair, {}, strengths) for by_pair in of_kind)
        texts = (mean.text(interval=intervals) if mean else "" for mean in means)
        rows.append([str(entry), *texts])
    units = f"in units of {_COSTS}" if strengths.calibrated else "each in its own unit"
    title = f"Detection thresholds by anomaly, {units}"
    note = (
        f"{_RULE} Means are geometric, over environments; a threshold beyond the ladder counts as "
        f"its end. {_SIDES}"
    )
    return Table(title, ["detector", *kinds], rows, note=note)


def _by_strength(
    board: Board, entries: list[Setting], names: Sequence[str], metric: str
) -> dict[Setting, list[str]]:
    """Return a metric's means at each strength as texts."""
    steps = [Board(at_strength(board.records, name)) for name in names]
    return {
        e: [show_value(b.mean(e, b.environments, b.anomalies, metric), metric) for b in steps]
        for e in entries
    }


def _mean(
    by_pair: Mapping[Pair, DetectionThreshold],
    reference: Mapping[Pair, DetectionThreshold],
    strengths: Strengths,
) -> MeanThreshold | None:
    """Return the mean over the pairs of a reference, or over all, in units, without one."""
    chosen = [p for p in by_pair if p in reference] if reference else [*by_pair]
    units = [reference[p] if reference else strengths.unit(p) for p in chosen]
    return geometric_mean([by_pair[p] for p in chosen], units) if chosen else None


def _single(threshold: DetectionThreshold | None, *, intervals: bool) -> str:
    if threshold is None:
        return ""
    ends = ", ".join(map(threshold.text, threshold.interval))
    return threshold.text(threshold.value) + f" [{ends}]" * intervals
