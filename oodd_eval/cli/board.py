"""``oodd-eval leaderboard show`` and ``place``: the published board, and a run of one's own on it.

Both read the board that is installed with the package, so that neither needs a network.
"""

import argparse
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from oodd_eval.cli import NAMES, Add, Parser, say_notes
from oodd_eval.cli.terminal import TerminalReporter, make_console
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.entry import ENTRY, read_entry
from oodd_eval.leaderboard.placing import Placement, neighbours, place, rankings
from oodd_eval.leaderboard.published import PublishedBoard, board_of, read_published
from oodd_eval.names import check_known, select
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.ladder import thresholds
from oodd_eval.results.record import Record
from oodd_eval.results.tables import ladder, layout, rendering
from oodd_eval.results.tables.board import RankedBoard, boards, grouped
from oodd_eval.results.tables.layout import Table


def define(action: Callable[[str, str], Parser]) -> None:
    """Add both actions with their options."""
    add = action("show", "print the published board").options(
        show, "leaderboard show", "leaderboard show --split mini --csv"
    )
    add("--split", default="", metavar="NAME", help="only the board of this split (default: all)")
    _formats(add)
    add = action("place", "show where a run would stand on the published board").options(
        place_run,
        "leaderboard place oodd-results",
        "leaderboard place oodd-results --detector mine",
    )
    add("directory", metavar="DIR", help="results directory of oodd-eval run, or an entry")
    add("--detector", default="all", metavar="NAMES", help=f"{NAMES} (default: all)")
    _formats(add)


def _formats(add: Add) -> None:
    add("--markdown", action="store_true", help="print Markdown")
    add("--csv", action="store_true", help="print a line per row, with all figures")


def show(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard show``."""
    published = read_published()
    if options.split:
        names = {board.records[0].split for board in published.boards}
        check_known("split with a published board", sorted(names), options.split)
    chosen = [b for b in published.boards if options.split in ("", b.records[0].split)]
    output = _Output(options)
    for board in chosen:
        ranks = board.ranks()
        output.heading(f"Leaderboard, {board}")
        output.ranking(ranks, board.trust)
        if not output.quiet:
            output.notes([*layout.ranking_notes(ranks), *_of_entries(board)])
    if options.split or output.csv or output.quiet:
        return 0
    for name, suite in published.suites.items():
        output.heading(f"Suite {name}, digest {suite.digest[:12]}")
        output.table(ladder.overview(suite, thresholds(suite.records)))
    return 0


def place_run(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard place``; 4 where nothing of a run can be compared with a board."""
    records, primary = _read(Path(options.directory), options.detector)
    published = read_published()
    output = _Output(options)
    runs = boards(records)
    found = [board_of(run.records, published.boards) for run in runs]
    for run, board in zip(runs, found, strict=True):
        placed = place(run.records, board, primary)
        new = placed.own - placed.published
        trust = board.trust | dict.fromkeys(new, "yours")
        output.heading(f"Your rows on the leaderboard, {board}")
        if not output.quiet:
            output.ranking(placed.ranks, trust, placed.own)
            output.notes(layout.ranking_notes(placed.ranks))
            for row in sorted(new or placed.own, key=str):
                if table := neighbours(placed.ranks, row):
                    output.table(table)
        output.notes(_told(placed, board.entries))
    return 0


def _read(directory: Path, detectors: str) -> tuple[list[Record], Sequence[str]]:
    """Return the chosen records of a run or an entry, and the primary rows that it declares."""
    results = ResultsDirectory(directory)
    records = results.records()
    say_notes(results.notes)
    if not records:
        raise UsageError(
            f"no records in {str(directory)!r}: expected results of a run, or an entry"
        )
    primary = read_entry(directory).meta.primary if (directory / ENTRY).is_file() else ()
    names = select("detector of these results", detectors, sorted({r.detector for r in records}))
    return [r for r in records if r.detector in names], primary


def _of_entries(board: PublishedBoard) -> list[str]:
    """Return which rows each entry has."""
    rows = grouped(board.entries, board.entries.__getitem__)
    return [f"Entry {name}: {', '.join(map(str, own))}." for name, own in sorted(rows.items())]


def _told(placed: Placement, entries: Mapping[Setting, str]) -> list[str]:
    """Return a sentence on the place of each row, and what is to be known of it."""
    lines = []
    for one in (s for s in placed.ranks.standings if s.entry in placed.own):
        row, (first, second) = one.entry, map(_rank, (one.rank, one.alarm_rank))
        text = f"{row}: {first} by separability, {second} by guaranteed alarms."
        if row in placed.published:
            text += f" It has the numbers of that row of entry {entries[row]}, and its place."
        elif row in placed.replaced:
            text += f" It stands instead of that row of entry {entries[row]}, which differs."
        if row in placed.lacking:
            text += f" For a rank on the board it lacks {placed.lacking[row]}."
        lines.append(text)
    if placed.cells != placed.expected:
        lines.append(
            f"These ranks are over the {len(placed.cells)} cells that your rows have, of "
            f"{len(placed.expected)}, and so not the board's. With few episodes hardly any "
            "difference is significant. Run the other cells into the same directory."
        )
    if placed.own - placed.published:
        lines.append(
            "New rows are ranked as if a maintainer had run them again. Until then an entry stands "
            "below the rows that were."
        )
    return lines


def _rank(rank: int | None) -> str:
    return "no rank" if rank is None else f"rank {rank}"


class _Output:
    """Prints tables and notes as the options ask: for a terminal, as Markdown, or as CSV."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.markdown, self.csv, self.quiet = options.markdown, options.csv, options.verbosity < 0
        self.console = make_console()
        self.reporter = TerminalReporter(self.console)

    def heading(self, text: str) -> None:
        if not self.csv:
            self.console.print(f"## {rendering.escape(text)}\n" if self.markdown else f"{text}\n")

    def ranking(
        self, ranks: RankedBoard, trust: Mapping[Setting, str], own: Collection[Setting] = ()
    ) -> None:
        if self.csv:
            print(rendering.ranking_csv(ranks, trust), end="")
            return
        for table in rankings(ranks, trust, own):
            self.table(table)

    def table(self, table: Table) -> None:
        if self.markdown:
            print(rendering.markdown(table))
        elif not self.csv:
            self.reporter.table(table)

    def notes(self, lines: Sequence[str]) -> None:
        if self.csv:
            return
        for line in lines:
            if self.markdown:
                print(f"- {rendering.escape(line)}")
            else:
                print(textwrap.fill(line, self.console.width))
        print()
