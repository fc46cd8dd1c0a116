"""A report: one document of sections with tables and sentences, which renderers write as text."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from oodd_eval.metrics.catalogue import RANKING
from oodd_eval.results.board import Board, boards
from oodd_eval.results.record import Record
from oodd_eval.results.strengths import thresholds
from oodd_eval.results.tables import Table, ladder, layout

Detail = Literal["brief", "wide", "full"]


@dataclass(frozen=True, slots=True)
class Section:
    """Part of a report.

    Attributes
    ----------
    title
        Plain text, as all texts are: a renderer escapes what its format needs.
    facts
        Sentences below the title.
    findings
        Sentences that nobody should miss.
    tables
        Tables in their order.
    folded
        Further tables, which a format that can fold text folds away, under `fold`.
    notes
        Sentences below the tables.
    """

    title: str
    facts: Sequence[str] = ()
    findings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    fold: str = ""
    folded: Sequence[Table] = ()
    notes: Sequence[str] = ()


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
        ``"brief"`` is what a run prints at its end; ``"wide"`` adds all metrics and levels of
        alarms; ``"full"`` also each row's cells and all failures.
    detector
        Name of a detector, for its cells alone.
    metric
        The metric of these cells.
    """

    records: Sequence[Record]
    intervals: bool = False
    detail: Detail = "full"
    detector: str = ""
    metric: str = RANKING
    title: str = field(default="Results", kw_only=True)

    @functools.cached_property
    def sections(self) -> list[Section]:
        """The sections, made when a renderer asks for them."""
        make = self._of_detector if self.detector else self._of_board
        return [make(board) for board in boards(self.records)]

    def _of_board(self, board: Board) -> Section:
        ok = sum(r.ok for r in board.records)
        counts = f"{len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed"
        return Section(
            f"Split {board.split}",
            [f"Cells: {counts}."],
            layout.findings(board),
            [table for table in self._tables(board) if table],
            notes=layout.notes(board),
        )

    def _tables(self, board: Board) -> Iterator[Table | None]:
        intervals, full = self.intervals, self.detail == "full"
        yield layout.separability(board, intervals=intervals)
        yield layout.guaranteed(board, intervals=intervals)
        yield layout.attribution(board, intervals=intervals)
        yield from ladder.tables(board, intervals=intervals, places=full)
        yield from layout.anomaly_groups(board, intervals=intervals)
        if self.detail != "brief":
            yield layout.all_metrics(board, intervals=intervals)
            yield from layout.all_alarms(board, intervals=intervals)
        if full:
            yield from (layout.by_anomaly(board, e, intervals=intervals) for e in board.entries)
            yield layout.failures(board)

    def _of_detector(self, board: Board) -> Section:
        tables = []
        for entry in (e for e in board.entries if e.detector == self.detector):
            tables.append(layout.by_anomaly(board, entry, self.metric, intervals=self.intervals))
            strengths = thresholds([r for r in board.records if r.setting == entry])
            if strengths.get(entry):
                tables.append(ladder.by_place(board, entry, strengths, intervals=self.intervals))
        return Section(f"{self.detector} on split {board.split}", tables=tables)


def flat(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return a flat mapping for each cell: its identity, its metrics, and its cost.

    Every mapping has the metrics of all records, NaN where a cell lacks one.
    """
    names = (
        "split",
        "environment",
        "anomaly",
        "strength",
        "group",
        "detector",
        "horizon",
        "seed",
        "status",
        "reason",
        "brief",
    )
    costs = ("seconds_fit", "seconds_score", "steps_scored", "peak_rss_mb")
    metrics = dict.fromkeys(name for r in records for name in r.metrics)
    return [
        {
            **{n: getattr(r, n) for n in names},
            "row": str(r.setting),
            **{n: r.value(n) for n in metrics},
            **{n: getattr(r, n) for n in costs},
        }
        for r in records
    ]
