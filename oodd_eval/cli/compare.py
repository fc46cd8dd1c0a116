"""``oodd-eval compare``: two rows of results, results against a reference; writing references."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Final

import click

from oodd_eval.cli import (
    FILE,
    OUTPUT_FILE,
    Name,
    Names,
    Options,
    command,
    expression_option,
    refuse,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import write_text
from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.names import counted, expression, select
from oodd_eval.prose import print_prose, print_table
from oodd_eval.results import comparison as regression
from oodd_eval.results.board import ranked_by
from oodd_eval.results.comparison import RecordSet, read_record_set, write_reference
from oodd_eval.results.record import Record
from oodd_eval.results.render.tabular import junit
from oodd_eval.results.render.text import markdown_section
from oodd_eval.results.report import comparison_section
from oodd_eval.results.standings import PairedComparison, compare_rows

_AGAINST: Final = ("fail", "two_sided", "by", "junit", "markdown")  # with --against alone

LOG_WIDTH: Final = 160
"""Columns that a log has at least."""


@command(
    "compare oodd-results pe rf",
    "compare oodd-results --against reference.jsonl --fail auc_matched:-0.01",
    "compare oodd-results --write-reference reference.jsonl -k 'seed=0'",
)
@click.argument("results", type=FILE, help="results directory or file of records")
@click.argument("rows", nargs=-1, metavar="[ROW ROW]", help="compare these, such as pe and rf")
@click.option("--metric", type=Name("metrics"), help="metric of that comparison")
@click.option("--against", type=FILE, help="likewise: what the results should come up to")
@click.option(
    "--fail",
    multiple=True,
    metavar="METRIC:[+-]NUMBER[%]",
    help="fail when a metric changed by more: auc:-0.01, delay:+10% (default: when one is worse)",
)
@click.option("--two-sided", is_flag=True, help="fail for improvements beyond the tolerance, too")
@click.option(
    "--by",
    type=click.Choice(["cell", "group", "mean"]),
    default="cell",
    help="compare cells, means over a group of anomalies in an environment, or means of all cells",
)
@expression_option
@click.option("--junit", type=OUTPUT_FILE, help="write JUnit XML, a test case per cell and metric")
@click.option("--markdown", type=OUTPUT_FILE, help="write Markdown, for a pull request")
@click.option("--write-reference", type=OUTPUT_FILE, help="write such a reference (also .xz, .gz)")
@click.option("--keep", type=Names("metrics"), help="keep only these metrics, with their intervals")
def compare(options: Options) -> int:
    """Compare two rows of some results, or results with a reference.

    The exit code is 1 when the comparison fails, and 5 when nothing is in it.
    """
    if not options.against and not options.write_reference and not options.rows:
        raise UsageError(
            "nothing to do: expected two rows, --against REFERENCE or --write-reference FILE"
        )
    if options.rows:
        refuse(options, _AGAINST, "is for a comparison with --against, not for two rows")
    else:
        refuse(options, ["metric"], "is for the comparison of two rows: name them")
    if not options.against:
        refuse(options, _AGAINST, "is for a comparison: say with what by --against REFERENCE")
    if not options.write_reference:
        refuse(options, ["keep"], "is for a reference: say where it goes by --write-reference FILE")
    passes = expression(options.expression)
    now = read_record_set(options.results).selected(passes)
    if options.rows:
        return _rows(now, options)
    code = 0
    if options.against:
        code = _compare(now, read_record_set(options.against).selected(passes), options)
    if options.write_reference:
        if not now.records:
            return say(f"no record of {options.results} is selected: no reference written", 5)
        present = dict.fromkeys(name for record in now.records for name in record.metrics)
        keep = select("metric of these results", options.keep, present) if options.keep else ()
        write_reference(now.records, options.write_reference, keep=keep)
        if options.verbosity >= 0:
            print(f"{counted(len(now.records), 'cell(s)')} written to {options.write_reference}")
    return code


def _rows(now: RecordSet, options: Options) -> int:
    if len(options.rows) != 2 or options.against or options.write_reference:
        rows = " ".join(options.rows)
        raise UsageError(f"rows {rows!r}, expected two, without --against or --write-reference")
    if not now.boards:
        return say(f"no record of {options.results} is selected", 5)
    first, second = options.rows
    lines: list[object] = []
    unknown: UnknownNameError | None = None
    for conditions, cells in now.boards.items():
        try:
            lines += [*compared(list(cells.values()), first, second, options.metric), conditions]
        except UnknownNameError as error:
            unknown = unknown or error
    if unknown and not lines:
        raise unknown
    # A directory may also hold boards, runs with --limit say, without these rows.
    print("\n".join(map(str, lines)))
    return 0


def compared(
    records: Sequence[Record], first: str, second: str, metric: str | None
) -> Iterator[PairedComparison]:
    """Compare two rows by a metric, by default by separability and then by guaranteed alarms."""
    if metric:
        yield compare_rows(records, first, second, metric)
        return
    by_scores, by_alarms = ranked_by(records)
    yield compare_rows(records, first, second, by_scores)
    with contextlib.suppress(ResultsError):  # alarms that not both rows have
        yield compare_rows(records, first, second, by_alarms)


def _compare(now: RecordSet, reference: RecordSet, options: Options) -> int:
    metric_names = dict.fromkeys((*NAMES, *reference.metrics()))
    tolerances = regression.parse_tolerances(options.fail, metric_names)
    rules = {"by": options.by, "two_sided": options.two_sided}
    try:
        comparison = regression.compare(now, reference, tolerances, **rules)
    except regression.NothingInCommonError as error:
        return say(str(error), 5)
    if options.junit:
        write_text(options.junit, junit(comparison))
    if options.markdown:
        write_text(options.markdown, markdown_section(comparison_section(comparison)))
    console = make_console()
    section = comparison_section(comparison, everything=options.verbosity > 0)
    if options.verbosity >= 0:
        # Nobody knows how wide a log is; a row that is broken is hard to read anywhere.
        width = console.width if console.is_terminal else max(console.width, LOG_WIDTH)
        for table in section.tables:
            print_table(table, console, width)
        for note in comparison.notes:
            print_prose(note, console, "yellow")
    console.print(section.facts[0])
    if comparison.failures and options.verbosity >= 0:
        print_prose(section.title, console, "bold red")
    return int(bool(comparison.failures))
