"""Results as Markdown: one section per board, the paper's layout among its tables."""

from __future__ import annotations

from collections.abc import Sequence

from tabulate import tabulate

from oodd_eval.results.record import Record
from oodd_eval.results.tables import tables
from oodd_eval.results.tables.board import Board, boards
from oodd_eval.results.tables.tables import Table


def render(records: Sequence[Record], *, intervals: bool = False) -> str:
    """Return a report on records as Markdown.

    Parameters
    ----------
    records
        In any number of splits; each digest gets a section of its own.
    intervals
        Whether to print 95 % intervals behind the values.
    """
    sections = [_board(board, intervals=intervals) for board in boards(records)]
    return "\n".join(["# Results", "", *sections]) if sections else "# Results\n\nNo records.\n"


def table(one: Table) -> str:
    """Return a table as Markdown under its title."""
    escaped = [[escape(cell) for cell in row] for row in one.rows]
    text = tabulate(
        escaped,
        headers=[escape(h) for h in one.header],
        tablefmt="pipe",
        colalign=one.alignment if escaped else None,
        disable_numparse=True,
    )
    return f"### {one.title}\n\n{text}\n"


def _board(board: Board, *, intervals: bool) -> str:
    ok = sum(r.ok for r in board.records)
    parts = [
        f"## Split {escape(board.split)}",
        "",
        f"Cells: {len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed.",
        "",
        *(f"**{escape(sentence)}**\n" for sentence in tables.findings(board)),
        table(tables.ranking(board, intervals=intervals)),
        *(table(tables.anomaly_groups(board, h, intervals=intervals)) for h in board.horizons),
    ]
    parts.append(table(tables.all_metrics(board, intervals=intervals)))
    if alarms := tables.calibrated(board, intervals=intervals):
        parts.append(table(alarms))
    parts += [table(tables.by_anomaly(board, e, intervals=intervals)) for e in board.entries]
    if failures := board.failures():
        rows = [[r.environment, r.label, r.status, r.reason] for r in failures]
        header = ["environment", "detector", "state", "reason"]
        parts.append(table(Table("Failures", header, rows, labels=4)))
    parts += [f"- {escape(line)}" for line in tables.notes(board)]
    return "\n".join(parts) + "\n"


def escape(text: str) -> str:
    """Keep text from being read as table or HTML: names and reasons are other people's."""
    flat = " ".join(text.split())
    for character in "\\|<>*_`[":
        flat = flat.replace(character, f"\\{character}")
    return flat
