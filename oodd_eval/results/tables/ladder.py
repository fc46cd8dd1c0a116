"""Tables of results at several strengths: detection thresholds, and shares found by rung."""

import math
from collections.abc import Mapping
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.metrics.catalogue import RANKING, UNDEFINED
from oodd_eval.metrics.threshold import DetectionThreshold, MeanThreshold, geometric_mean
from oodd_eval.results.board import Board
from oodd_eval.results.identity import Setting
from oodd_eval.results.ladder import FOUND, Place, Thresholds, at_rung, rung_names, thresholds, unit
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
_RUNGS: Final = (
    "At keptN the policy keeps N % of its return; 4th, 16th and 64th are those parts of kept99's "
    "strength. A ladder without a rung counts there with its next weaker one."
)


def tables(board: Board, *, intervals: bool = False, places: bool = False) -> list[Table]:
    """Return all tables of a board's records at strengths; none where it has no such records.

    With `intervals`, means by kind and thresholds of single places have their 95 % intervals. With
    `places`, each row has a table with its threshold in every environment.
    """
    found = thresholds(board.records)
    made = [_separability(board, found)] if found else []
    if not any(found.values()):  # no level of 5 %, with few calibration episodes
        return made
    by_kind = _by_kind(board, found, intervals=intervals)
    rows = [e for e in board.entries if places and found.get(e)]
    own = [by_place(board, e, found, intervals=intervals) for e in rows]
    return [overview(board, found), *made, by_kind, *own]


def by_place(board: Board, entry: Setting, found: Thresholds, *, intervals: bool = False) -> Table:
    """Return one row's thresholds by environment and kind of anomaly, in the anomaly's unit."""
    own = found[entry]
    kinds = [k for k in board.anomalies if any(k == kind for _, kind in own)]
    rows = [
        [ENVIRONMENTS[e].title, *(_single(own.get((e, k)), intervals=intervals) for k in kinds)]
        for e in board.environments
    ]
    title = f"{entry}: detection thresholds by anomaly, each in its own unit"
    note = f"{_RULE} ≤ and > mark thresholds beyond the weakest and the strongest rung."
    return Table(title, ["Environment", *kinds], rows, note=note)


def overview(board: Board, found: Thresholds) -> Table:
    """Return relative thresholds and shares found by rung, the lowest threshold first.

    `found` are the thresholds of the board's records.
    """
    reference = found.get(REFERENCE, {})
    means = {entry: _mean(own, reference) for entry, own in found.items()}
    values = {entry: mean.value if mean else math.inf for entry, mean in means.items()}
    order = sorted(values, key=values.__getitem__)
    most = max((mean.pairs for mean in means.values() if mean), default=0)
    names = rung_names(board.records)
    shares = _by_rung(board, order, names, FOUND)
    rows = []
    for entry in order:
        mean = means[entry]
        figures = [UNDEFINED, "0", "", ""]
        if mean:
            counts = mean.pairs, mean.below, mean.above
            figures = [mean.text() + "*" * (mean.pairs < most), *map(str, counts)]
        rows.append([str(entry), *figures, *shares[entry]])
    over = f"of {REFERENCE}'s" if reference else "of the strength that costs 1 % of the return"
    header = ["detector", "threshold", "pairs", "below", "above", *names]
    note = (
        f"{_RULE} Shown is its geometric mean as a multiple {over}, over pairs of environment and "
        "anomaly, with its 95 % interval. In so many pairs it lies below or above the ladder, and "
        f"counts as the end of the ladder. {_SIDES} {_RUNGS}"
    )
    title = "Detection thresholds, lower is better, and share of episodes found by strength (%)"
    return Table(title, header, rows, note=note)


def _separability(board: Board, found: Thresholds) -> Table:
    """Return matched AUC by rung."""
    names = rung_names(board.records)
    order = [e for e in board.entries if e in found]
    texts = _by_rung(board, order, names, RANKING)
    rows = [[str(e), *texts[e]] for e in order]
    return Table("Matched AUC (%) by strength", ["detector", *names], rows, note=_RUNGS)


def _by_kind(board: Board, found: Thresholds, *, intervals: bool) -> Table:
    """Return thresholds by kind of anomaly, means over environments."""
    kinds = [k for k in board.anomalies if any(k == kind for p in found.values() for _, kind in p)]
    rows = []
    for entry in (e for e in board.entries if e in found):
        own = (_mean({p: t for p, t in found[entry].items() if p[1] == k}, {}) for k in kinds)
        rows.append([str(entry), *(mean.text(interval=intervals) if mean else "" for mean in own)])
    title = "Detection thresholds by anomaly, in units of the strength that costs 1 % of the return"
    note = (
        f"{_RULE} Means are geometric, over environments; a threshold beyond the ladder counts as "
        f"its end. {_SIDES}"
    )
    return Table(title, ["detector", *kinds], rows, note=note)


def _by_rung(
    board: Board, entries: list[Setting], names: list[str], metric: str
) -> dict[Setting, list[str]]:
    """Return a metric's means at each rung as texts."""
    steps = [Board(at_rung(board.records, name)) for name in names]
    return {
        e: [show_value(b.mean(e, b.environments, b.anomalies, metric), metric) for b in steps]
        for e in entries
    }


def _mean(
    own: Mapping[Place, DetectionThreshold], reference: Mapping[Place, DetectionThreshold]
) -> MeanThreshold | None:
    """Return the mean over the places of a reference, or over all, in units, without one."""
    chosen = [p for p in own if p in reference] if reference else [*own]
    units = [reference[p] if reference else unit(p) for p in chosen]
    return geometric_mean([own[p] for p in chosen], units) if chosen else None


def _single(own: DetectionThreshold | None, *, intervals: bool) -> str:
    if own is None:
        return ""
    ends = ", ".join(map(own.text, own.interval))
    return own.text(own.value) + f" [{ends}]" * intervals
