"""A report: one document of sections with tables and sentences, which renderers write as text."""

import functools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from oodd_eval.metrics.catalogue import HEADLINE, LEVELS, METRICS, NAMES, UNDEFINED, metric_info
from oodd_eval.names import counted
from oodd_eval.prose import Section, Table, terminal_text
from oodd_eval.results import tables
from oodd_eval.results.board import Board, boards, grouped, supervised
from oodd_eval.results.comparison import MEANINGS, By, Comparison, Difference
from oodd_eval.results.record import Record
from oodd_eval.results.standings import verdict_of
from oodd_eval.results.strengths import StrengthTables, thresholds
from oodd_eval.results.tables import Tables

Detail = Literal["brief", "full"]

_OF_PAPER: Final = [name for name, info in METRICS.items() if info.paper]
_WITHOUT_ALARM: Final = [n for n, info in METRICS.items() if not (info.request or info.paper)]


@dataclass(frozen=True)
class Report:
    """A report on records: a section for each board among them.

    Parameters
    ----------
    records
        In any order.
    intervals
        Whether means have their 95 % intervals.
    detail
        ``"brief"`` is what a run prints at its end: the headline with a few notes, beside what is
        asked for by `intervals`, `level`, `paper` and rows' metrics. ``"full"`` is everything.
    detector
        Name of a detector, for its cells alone.
    metric
        The metric of these cells; by default the one that their board ranks by.
    units
        Units of strengths by kind of anomaly, where the split names them.
    level
        Suffix of the level of guaranteed alarms in tables, such as ``"at_10pct"``; by default 5 %,
        or the strictest weaker one that the records have.
    paper
        Whether what the paper's alarm does is in it, too; in a ``"full"`` report it always is.
    remarks
        Sentences on the fits behind the records, below the last table; a ``"brief"`` one has none.
    """

    records: Sequence[Record]
    intervals: bool = False
    detail: Detail = "full"
    detector: str = ""
    metric: str = ""
    units: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    title: str = field(default="Results", kw_only=True)
    level: str = field(default="", kw_only=True)
    paper: bool = field(default=False, kw_only=True)
    remarks: Sequence[str] = field(default=(), kw_only=True)

    def __str__(self) -> str:
        """Return the report as plain text, its verdicts first."""
        return terminal_text(self.sections).rstrip("\n")

    @functools.cached_property
    def sections(self) -> list[Section]:
        """The sections, made when a renderer asks for them."""
        make = self._of_detector if self.detector else self._of_board
        parts = [make(board) for board in boards(self.records)]
        if parts and self.detail != "brief":
            parts[-1] = replace(parts[-1], notes=[*parts[-1].notes, *self.remarks])
        return parts

    def _of_board(self, board: Board) -> Section:
        verdict, board = verdict_of(board, self.level), _in_order(board)
        ok = sum(r.ok for r in board.records)
        counts = f"{len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed"
        distinct: list[Table] = []
        # Where records keep few metrics, the overview and a level's table are the same.
        for table in filter(None, self._tables(board)):
            if all((table.header, table.rows) != (t.header, t.rows) for t in distinct):
                distinct.append(table)
        if self.detail == "brief":
            return Section(f"S{str(board.conditions)[1:]}", tables=distinct, verdict=verdict)
        return Section(
            f"Split {board.split}",
            [f"Cells: {counts}."],
            findings_of(board, self.level),
            distinct,
            notes=tables.notes(board),
            verdict=verdict,
        )

    def _tables(self, board: Board) -> Iterator[Table | None]:
        means = Tables(board, self.intervals, level=self.level)
        brief = self.detail == "brief"
        ranked = not board.leaves_out([board.ranking])
        headline = means.headline()
        strengths = StrengthTables(board, self.intervals, self.units).overview(places=not brief)
        if brief:
            yield headline or next(map(_narrowing, strengths), None)
            yield means.published()
        else:
            yield headline
            yield from [] if board.paired else means.of_logs()
            yield from strengths
            yield means.separability() if ranked else None
            yield means.seeds()
            yield means.attribution()
            yield None if board.leaves_out(_WITHOUT_ALARM) else means.all_metrics()
            yield from means.all_alarms()
        if board.paired and (self.paper or not brief):
            yield None if board.leaves_out(_OF_PAPER) else means.papers()
            yield from means.anomaly_groups()
        if not brief:
            # One figure stands above.
            if ranked and len(board.environments) * len(board.anomalies) > 1:
                yield from map(means.by_anomaly, board.entries)
            yield tables.failures(board)

    def _of_detector(self, board: Board) -> Section:
        title = f"{self.detector} on split {board.split}"
        rows = [r for r in board.records if r.detector == self.detector]
        # The board may have a weaker level than the row alone, for its other rows.
        verdict = verdict_of(Board(rows), self.level or board.level) if rows else ""
        return Section(title, tables=list(self._tables_of_detector(board)), verdict=verdict)

    def _tables_of_detector(self, board: Board) -> Iterator[Table]:
        for entry in (e for e in board.entries if e.detector == self.detector):
            yield Tables(board, self.intervals).by_anomaly(entry, self.metric)
            by_row = thresholds([r for r in board.records if r.setting == entry])
            if by_row.get(entry):
                of_board = StrengthTables(board, self.intervals, self.units)
                yield of_board.by_place(entry, by_row[entry])


def _in_order(board: Board) -> Board:
    """Return a board whose rows have the order of all its tables, the best mean first."""
    by_row = grouped(board.records, lambda r: r.setting)
    return Board([r for row in tables.best_first(board) for r in by_row[row]])


def _narrowing(table: Table) -> Table:
    """Return a table of strengths; one of relative thresholds loses columns before it is parted."""
    kept = [i for i, name in enumerate(table.header) if name not in ("pairs", "below", "above")]
    few = range(2, len(kept) + 1) if len(kept) < len(table.header) else ()
    shorter = [table.columns([*kept[:2], *kept[i:]]) for i in few]
    note = f"{'. '.join(table.note.split('. ')[:2]).removesuffix('.')}."
    return replace(table, undivided=bool(few), narrower=shorter, note=note)


def findings_of(board: Board, level: str = "") -> list[str]:
    """Return the sentences on a board that nobody should miss.

    Parameters
    ----------
    board
        The rows.
    level
        Suffix of the level of guaranteed alarms that is asked for, if one is.
    """
    alarms = board.present(f"false_episodes_{s}" for s in ([level] if level else LEVELS))
    # Other boards without alarms have a table of scores, and the reason below it.
    bare = not alarms and (board.paired or not board.present([board.ranking]))
    return [
        *tables.withheld(board),
        *tables.findings(board),
        *tables.phase_findings(board),
        *tables.outcome_findings(board),
        *(tables.missing_level(board, level or HEADLINE) if bare else ()),
    ]


def flat(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return a flat mapping for each cell: its identity, its metrics, and its cost.

    Every mapping has the metrics of all records, NaN where a cell lacks one. What rows learn from
    is in it where some learn from failures.
    """
    names = (
        *(["training"] if supervised(records) else []),
        "split",
        "environment",
        "anomaly",
        "strength",
        "magnitude",
        "group",
        "paired",
        "detector",
        "horizon",
        "seed",
        "status",
        "reason",
        "note",
        "brief",
    )
    costs = ("seconds_fit", "seconds_score", "steps_scored", "peak_rss_mb")
    metrics = dict.fromkeys(name for r in records for name in r.metrics)
    return [
        {
            **{n: getattr(r, n) for n in names},
            "promise": "; ".join(
                filter(None, dict.fromkeys(tables.unpromised(r, s) for s in LEVELS))
            ),
            "row": str(r.setting),
            **{n: r.value(n) for n in metrics},
            **{n: getattr(r, n) for n in costs},
        }
        for r in records
    ]


_COLOURS: Final = {"better": "green", "recovered": "green", "within": "yellow"}

_WHOLE: Final = ("failed", "missing", "recovered", "new")  # of cells, for every metric


def comparison_section(comparison: Comparison, *, everything: bool = False) -> Section:
    """Return a comparison as part of a report: its verdict is the title, its counts are the fact.

    Its tables have the differences beyond the tolerance, or `everything`. Cells that are missing
    with their whole environment or detector are in the notes.
    """
    compared = [d for d in comparison.differences if d.verdict != "new"]
    listed = comparison.differences
    if not everything:
        listed = [d for d in compared if d.verdict not in ("same", "within") and not d.outside]
    within = [d for d in compared if d.verdict == "within"]
    title = "Regression check passed"
    if failures := len(comparison.failures):
        title = f"Regression check failed: {failures} of {counted(len(compared), 'figure(s)')}"
    units = {"cell": "cell(s)", "group": "group mean(s)", "mean": "mean(s)"}[comparison.by]
    scopes = counted(len({*map(str, compared)}), units)
    metrics = list(dict.fromkeys(d.tolerance.metric for d in compared))
    counts = Counter(d.verdict for d in compared)
    verdicts = ", ".join(f"{counts[v]} {v}" for v in MEANINGS if counts[v])
    new = len({str(d) for d in comparison.differences if d.verdict == "new"})
    are = "is" if new == 1 else "are"
    more = f"; {counted(new, 'new cell(s)')} {are} not in the reference" if new else ""
    name = metrics[0] if len(metrics) == 1 else f"{len(metrics)} metrics"
    return Section(
        title,
        [f"{scopes} compared in {name}: {verdicts}{more}."],
        tables=_comparison_tables(listed, comparison.by),
        fold="Differences within the tolerance",
        folded=_comparison_tables(within, comparison.by),
        notes=[*map(str, comparison.conditions), *comparison.notes],
    )


def _comparison_tables(differences: Iterable[Difference], by: By) -> list[Table]:
    """Return a table for each split and detector; a whole cell takes one row."""
    header = [by, "metric", "reference", "now", "difference", "tolerance", "verdict"]
    tables = []
    for (split, detector), group in by_suite(differences).items():
        several = Counter((d.scope, d.verdict) for d in group)
        rows: dict[tuple[str, str], list[str]] = {}
        colours = []
        for d in group:
            metric = d.tolerance.metric
            row = [metric, _figure(d.reference, metric), _figure(d.now, metric)]
            row += [change(d), d.tolerance.text]
            if d.verdict in _WHOLE and several[d.scope, d.verdict] > 1:
                row = ["all", "", "", change(d), ""]
            if (d.scope, row[0]) not in rows:
                colours.append("red" if d.fails else _COLOURS.get(d.verdict, ""))
                rows[d.scope, row[0]] = [d.scope, *row, d.verdict]
        title = f"{detector} on {split}"
        tables.append(Table(title, header, list(rows.values()), labels=2, colours=colours))
    return tables


def by_suite(differences: Iterable[Difference]) -> dict[tuple[str, str], list[Difference]]:
    """Return differences by split and detector."""
    return grouped(differences, lambda d: (d.split, d.detector))


def change(d: Difference) -> str:
    """Return the change as printed: an arrow, its size, and percent where those are tolerated."""
    if d.verdict in ("failed", "missing", "undefined"):
        return d.reason
    by = d.now - d.reference
    if math.isnan(by):
        return d.reason or UNDEFINED
    if d.verdict == "same":
        return "="
    relative = f" ({by / abs(d.reference):+.1%})" if d.tolerance.percent and d.reference else ""
    return f"{'↑' if by > 0 else '↓'} {abs(by):.3g}{relative}"


def message(d: Difference) -> str:
    """Return one line about a difference: figures, change, tolerance and verdict."""
    ends = d.reference, d.now
    reference, now = ("undefined" if math.isnan(v) else f"{v:.6g}" for v in ends)
    figures = f"{d.tolerance.metric} {d.verdict}: reference {reference}, now {now}, {change(d)}"
    return f"{figures}, tolerance {d.tolerance.text}"


def _figure(value: float, metric: str) -> str:
    """Return a figure with as many digits as a tolerance may need."""
    if math.isnan(value):
        return UNDEFINED
    steps = metric in NAMES and metric_info(metric).unit == "steps"
    return f"{value:.2f}" if steps else f"{value:.4f}"
