"""``oodd-eval leaderboard show`` and ``place``: the published board, and a run of one's own on it.

Both read the board that is installed with the package, so that neither needs a network.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final

import click

from oodd_eval.cli import DIRECTORY, NAMES, Name, Names, Options, command, say_notes, together
from oodd_eval.cli.console import make_console
from oodd_eval.errors import UsageError
from oodd_eval.names import check_known, counted, select
from oodd_eval.prose import Section, Table, print_prose, print_sections
from oodd_eval.results import tables
from oodd_eval.results.board import boards, grouped
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.render.tabular import ranking_csv
from oodd_eval.results.render.text import markdown_section
from oodd_eval.results.standings import Standing
from oodd_leaderboard.published import (
    MARK,
    Placement,
    PublishedBoard,
    board_of,
    neighbours,
    neighbours_notes,
    placement,
    printed_name,
    rankings,
    read_published,
)
from oodd_leaderboard.reported import ENTRY, REPORTED, read_entry

NEARBY: Final = 3
"""Rows above and below those of a run that `place` prints."""

_format_options: Final = together(
    click.option("--markdown", is_flag=True, help="print Markdown"),
    click.option("--csv", is_flag=True, help="print a line per row, with all figures"),
)


@command("leaderboard show", "leaderboard show --split mini --csv")
@click.option("--split", type=Name("splits"), help="only the board of this split")
@_format_options
def show(options: Options) -> int:
    """Print the published board, which is installed with the package."""
    published = read_published()
    if options.split:
        names = {board.records[0].split for board in published.boards}
        check_known("split with a published board", sorted(names), options.split)
    boards = [b for b in published.boards if options.split in (None, b.records[0].split)]
    output = _Output(options)
    for board in boards:
        ranks = board.ranks()
        notes = [REPORTED, *tables.ranking_notes(ranks, whole=False), *_of_entries(board)]
        output.print(
            Section(
                f"Leaderboard, {board}", tables=rankings(ranks), notes=[] if output.quiet else notes
            ),
            ranking_csv(ranks) if output.csv else "",
        )
    if options.split or output.csv or output.quiet:
        return 0
    for suite in published.suites:
        title = f"Suite {suite.name}, digest {suite.digest[:12]}"
        output.print(Section(title, tables=[suite.thresholds]))
    return 0


@command("leaderboard place oodd-results", "leaderboard place oodd-results --detector mine")
@click.argument("directory", type=DIRECTORY, help="results directory of oodd-eval run, or an entry")
@click.option("--detector", default="all", type=Names("detectors"), help=NAMES)
@click.option("--all", "everything", is_flag=True, help="print all rows, not those nearby alone")
@_format_options
def place_run(options: Options) -> int:
    """Show where a run would stand on the published board, and the rows nearby.

    The exit code is 4 when nothing of the run can be compared with a board.
    """
    output = _Output(options)
    if options.everything and (output.csv or output.quiet):
        raise UsageError("--all is for the tables, which --csv and -q do not print: leave out one")
    records, primary = _read(options.directory, options.detector)
    published = read_published()
    runs = boards(records)
    compared_with = [board_of(run.records, published.boards) for run in runs]
    for run, board in zip(runs, compared_with, strict=True):
        placed = placement(run.records, board, primary)
        new = placed.rows - placed.published
        of_ranks, notes = [], []
        if not output.quiet:
            of_ranks = rankings(placed.ranks, placed.rows)
            if not options.everything:
                of_ranks = list(map(_nearby, of_ranks))
            names = {line[1] for table in of_ranks for line in table.rows}
            standings = placed.ranks.standings
            printed = [s for s in standings if printed_name(s, placed.rows) in names]
            beside = (neighbours(placed.ranks, row) for row in sorted(new or placed.rows, key=str))
            compared = [table for table in beside if table]
            of_ranks += compared
            notes = neighbours_notes(compared)
            notes += tables.ranking_notes(placed.ranks, whole=False, rows=printed)
        output.print(
            Section(
                f"Your rows on the leaderboard, {board}",
                facts=_sentences(placed, board.entries),
                tables=of_ranks,
                notes=notes,
            ),
            ranking_csv(placed.ranks) if output.csv and not output.quiet else "",
        )
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


def _nearby(table: Table) -> Table:
    """Return a ranking with the rows next to those that are marked alone."""
    marked = [i for i, line in enumerate(table.rows) if line[1].startswith(MARK)]
    near = [any(abs(i - at) <= NEARBY for at in marked) for i in range(len(table.rows))]
    lines: list[list[str]] = []
    for close, run in groupby(zip(near, table.rows, strict=True), key=itemgetter(0)):
        rows = [row for _, row in run]
        left_out = f"({counted(len(rows), 'more row(s)')})"
        lines += rows if close else [["", left_out, *[""] * (len(table.header) - 2)]]
    return replace(table, rows=lines)


def _of_entries(board: PublishedBoard) -> list[str]:
    """Return which rows each entry has."""
    entries = grouped(board.entries, board.entries.__getitem__)
    return [f"Entry {name}: {', '.join(map(str, rows))}." for name, rows in sorted(entries.items())]


def _sentences(placed: Placement, entries: Mapping[Setting, str]) -> list[str]:
    """Return a sentence on the rank of each row, and what is to be known of it."""
    lines = []
    for standing in (s for s in placed.ranks.standings if s.entry in placed.rows):
        row, over = standing.entry, ""
        by_scores, by_alarms = _rank(standing.rank), _rank(standing.alarm_rank)
        if placed.cells != placed.expected:
            over = f", over {len(placed.cells)} of {counted(len(placed.expected), 'cell(s)')}"
            by_scores += _shared(standing, placed.ranks.standings, "rank")
            by_alarms += _shared(standing, placed.ranks.standings, "alarm_rank")
        text = f"{row}{over}: {by_scores} by separability, {by_alarms} by guaranteed alarms."
        if row in placed.published:
            text += f" It has the numbers of that row of entry {entries[row]}, and its place."
        elif row in placed.replaced:
            text += f" It stands instead of that row of entry {entries[row]}, which differs."
        if row in placed.lacking:
            text += f" For a rank on the board it lacks {placed.lacking[row]}."
        lines.append(text)
    if placed.cells != placed.expected:
        lines.append(
            f"These ranks are over the {counted(len(placed.cells), 'cell(s)')} that your rows "
            f"have, of {len(placed.expected)}, and so not the board's. With few episodes hardly "
            "any difference is significant. Run the other cells into the same directory."
        )
    return lines


def _rank(rank: int | None) -> str:
    return "no rank" if rank is None else f"rank {rank}"


def _shared(standing: Standing, standings: Sequence[Standing], kind: str) -> str:
    """Return in brackets how many rows share a rank; among trivial ones that says nothing."""
    # Trivial rows do not count beside a row that is trivial itself.
    rank = getattr(standing, kind)
    same = [s for s in standings if rank and getattr(s, kind) == rank]
    if len(same) < 2:
        return ""
    trivial = sum(s.trivial for s in same) * (not standing.trivial)
    among = f", {trivial} of them trivial: it says nothing" * (trivial > 0)
    return f" (shared by {len(same)} rows{among})"


class _Output:
    """Prints sections as the options ask: for a terminal, as Markdown, or as CSV."""

    def __init__(self, options: Options) -> None:
        if options.markdown and options.csv:
            raise UsageError("--markdown and --csv are two formats: leave out one")
        self.markdown, self.csv, self.quiet = options.markdown, options.csv, options.verbosity < 0
        self._console = make_console()

    def print(self, section: Section, csv: str = "") -> None:
        if self.csv:
            print(csv, end="")
        elif self.markdown:
            print(markdown_section(section))
        else:
            self._console.print(section.title if section.facts else f"{section.title}\n")
            for sentence in section.facts:
                print_prose(sentence, self._console)
            if section.facts and section.tables:
                self._console.print("")
            print_sections([section], self._console)
