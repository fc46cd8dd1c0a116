"""``oodd-eval leaderboard show`` and ``place``: the published board, and a run of one's own on it.

Both read the boards that are installed with the package, so that neither needs a network.
"""

from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final

import click

from oodd_eval.cli import DIRECTORY, NAMES, Name, Names, Options, command, say_notes, together
from oodd_eval.cli.console import make_console
from oodd_eval.errors import UsageError
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.names import check_known, counted, select
from oodd_eval.prose import Section, Table, print_prose, print_sections
from oodd_eval.results.board import boards
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.results.render.text import markdown_section
from oodd_leaderboard.board_csv import standings_csv
from oodd_leaderboard.pages import first_rows, unranked
from oodd_leaderboard.published import (
    MARK,
    Placement,
    board_of,
    board_table,
    difference_text,
    placement,
    read_published,
)
from oodd_leaderboard.reported import REPORTED
from oodd_leaderboard.standings import OrderedBoard

NEARBY: Final = 3
"""Rows above and below those of a run that `place` prints."""

EQUAL_NOTE: Final = (
    "=: not told from the row above. Rows with rank 1 are not told from the first. The detector "
    "seeds are fixed."
)

_format_options: Final = together(
    click.option("--markdown", is_flag=True, help="print Markdown"),
    click.option("--csv", is_flag=True, help="print a line per row, with all figures"),
)


@command("leaderboard show", "leaderboard show --split mini --csv")
@click.option("--split", type=Name("splits"), help="the rows reported on this split")
@_format_options
def show(options: Options) -> int:
    """Print the last season's board, or the reported rows while there is none.

    They are installed with the package.
    """
    _refuse_both(options)
    published = read_published()
    if options.split:
        names = {board.records[0].split for board in published}
        check_known("split with published rows", sorted(names), options.split)
        published = [b for b in published if b.records[0].split == options.split]
    elif published and published[0].season:
        published = published[:1]
    for board in published:
        ranks = board.ranks()
        notes = [EQUAL_NOTE if board.season else REPORTED, *unranked(ranks)]
        section = Section(
            board.title,
            facts=first_rows(ranks),
            tables=[table for table in [board_table(ranks)] if table],
            notes=[] if options.verbosity < 0 else notes,
        )
        _print(section, ranks, options)
    return 0


@command("leaderboard place oodd-results", "leaderboard place oodd-results --detector mine")
@click.argument("directory", type=DIRECTORY, help="results directory of oodd-eval run")
@click.option("--detector", default="all", type=Names("detectors"), help=NAMES)
@click.option("--all", "everything", is_flag=True, help="print all rows, not those nearby alone")
@_format_options
def place_run(options: Options) -> int:
    """Show where a run would stand beside the last season's rows, or beside reported ones.

    The exit code is 4 when nothing of the run can be compared with a board.
    """
    _refuse_both(options)
    quiet = options.verbosity < 0
    if options.everything and (options.csv or quiet):
        raise UsageError("--all is for the tables, which --csv and -q do not print: leave out one")
    published = read_published()
    runs = boards(_read(options.directory, options.detector))
    compared_with = [board_of(run.records, published) for run in runs]
    for run, board in zip(runs, compared_with, strict=True):
        placed = placement(run.records, board)
        table = None if quiet else board_table(placed.ranks, placed.rows)
        section = Section(
            f"Your rows beside: {board.title}",
            facts=_sentences(placed),
            tables=[table if options.everything else _nearby(table)] if table else [],
            notes=[] if quiet else [EQUAL_NOTE if board.season else REPORTED],
        )
        if not (options.csv and quiet):
            _print(section, placed.ranks, options)
    return 0


def _read(directory: Path, detectors: str) -> list[Record]:
    """Return the chosen records of a run."""
    results = ResultsDirectory(directory)
    records = results.records()
    say_notes(results.notes)
    if not records:
        raise UsageError(f"no records in {str(directory)!r}: expected results of a run")
    names = select("detector of these results", detectors, sorted({r.detector for r in records}))
    return [r for r in records if r.detector in names]


def _nearby(table: Table) -> Table:
    """Return a board with the rows next to those that are marked alone."""
    column = table.header.index("row")
    marked = [i for i, line in enumerate(table.rows) if line[column].startswith(MARK)]
    near = [any(abs(i - at) <= NEARBY for at in marked) for i in range(len(table.rows))]
    lines: list[list[str]] = []
    for close, run in groupby(zip(near, table.rows, strict=True), key=itemgetter(0)):
        rows = [row for _, row in run]
        left_out = [""] * len(table.header)
        left_out[column] = f"({counted(len(rows), 'more row(s)')})"
        lines += rows if close else [left_out]
    return replace(table, rows=lines, narrower=[*map(_nearby, table.narrower)])


def _sentences(placed: Placement) -> list[str]:
    """Return a sentence on the place of each row, and what is to be known of it."""
    lines, standings = [], placed.ranks.standings
    metric = metric_info(placed.ranks.board.ranking)
    for i, standing in enumerate(standings, start=1):
        row = standing.entry
        if row not in placed.rows:
            continue
        text = f"{row} stands at place {i} of {len(standings)} by mean {metric.noun}"
        text += f", rank {standing.rank}." if standing.rank else "."
        if test := placed.ranks.above.get(row):
            verdict = "told" if test.told_apart else "not told"
            text += f" It is {verdict} from {test.first}, the row above it: "
            text += f"{difference_text(test)} below it."
        if row in placed.published:
            text += " The board has that row with the same numbers."
        elif row in placed.replaced:
            text += " It stands instead of the board's row of that name, which differs."
        if standing.state:
            text += f" It has no rank: {standing.state}."
        lines.append(text)
    if placed.cells != placed.expected:
        lines.append(
            f"Means are over the {counted(len(placed.cells), 'cell(s)')} that your rows have, of "
            f"{len(placed.expected)}, and so not the board's. Run the other cells into the same "
            "directory."
        )
    return lines


def _refuse_both(options: Options) -> None:
    if options.markdown and options.csv:
        raise UsageError("--markdown and --csv are two formats: leave out one")


def _print(section: Section, ranks: OrderedBoard, options: Options) -> None:
    """Print a board as the options ask: for a terminal, as Markdown, or as CSV."""
    if options.csv:
        print(standings_csv(ranks), end="")
        return
    if options.markdown:
        print(markdown_section(section))
        return
    console = make_console()
    console.print(section.title if section.facts else f"{section.title}\n")
    for sentence in section.facts:
        print_prose(sentence, console)
    if section.facts and section.tables:
        console.print("")
    print_sections([section], console)
