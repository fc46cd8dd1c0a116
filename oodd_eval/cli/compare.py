"""``oodd-eval compare``: two rows of results, results against a reference; writing references."""

import argparse
from pathlib import Path

from oodd_eval.cli import EXPRESSION, Parser, say
from oodd_eval.cli.terminal import make_console
from oodd_eval.errors import OutputError, UnknownNameError, UsageError
from oodd_eval.metrics.catalogue import NAMES, RANKING
from oodd_eval.names import expression, select
from oodd_eval.results import paired, regression
from oodd_eval.results.regression import RecordSet, read_record_set, rendering, write_reference


def define(parser: Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.options(
        run,
        "compare oodd-results pe rf",
        "compare oodd-results --against reference.jsonl --fail auc_matched:-0.01",
        "compare oodd-results --write-reference reference.jsonl -k 'seed=0'",
    )
    add("results", metavar="DIR", help="results directory or file of records")
    add("rows", nargs="*", metavar="ROW",
        help="two rows of these results to compare by the paired bootstrap, such as pe and rf")
    add("--metric", default=RANKING, help=f"metric of that comparison (default: {RANKING})")
    add("--against", metavar="REFERENCE", help="likewise: what the results should come up to")
    add("--fail", action="append", default=[], metavar="METRIC:[+-]NUMBER[%]",
        help="fail when the metric changed by more in the direction of the sign: auc:-0.01, "
             "delay:+10%% (default: when any metric is worse at all)")
    add("--two-sided", action="store_true",
        help="fail for improvements beyond the tolerance, too")
    add("--by", choices=("cell", "group", "mean"), default="cell",
        help="compare cells, means over the anomalies of a group in an environment, or means "
             "over all cells (default: cell)")
    add("-k", dest="expression", default="", metavar="EXPR", help=EXPRESSION)
    add("--junit", metavar="FILE", help="write JUnit XML, a test case per cell and metric")
    add("--markdown", metavar="FILE", help="write Markdown, for a pull request")
    add("--write-reference", metavar="FILE",
        help="write a small file of records to compare with later, compressed if named .xz or .gz")
    add("--keep", metavar="METRICS", default="",
        help="of these metrics alone, but with what their intervals are made of")
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval compare``; 1 when the comparison fails, 5 when nothing is in it."""
    if not options.against and not options.write_reference and not options.rows:
        raise UsageError(
            "nothing to do: expected two rows, --against REFERENCE or --write-reference FILE"
        )
    wanted = expression(options.expression)
    now = read_record_set(options.results).selected(wanted)
    if options.rows:
        return _rows(now, options)
    code = 0
    if options.against:
        code = _compare(now, read_record_set(options.against).selected(wanted), options)
    # Last, so that a file can be compared with and then replaced.
    if options.write_reference:
        if not now.records:
            return say(f"no record of {options.results} is selected: no reference written", 5)
        keep = select("metric", options.keep, NAMES) if options.keep else ()
        write_reference(now.records, options.write_reference, keep=keep)
        if options.verbosity >= 0:
            print(f"{len(now.records)} cells written to {options.write_reference}")
    return code


def _rows(now: RecordSet, options: argparse.Namespace) -> int:
    if len(options.rows) != 2 or options.against or options.write_reference:
        given = " ".join(options.rows)
        raise UsageError(f"rows {given!r}, expected two, without --against or --write-reference")
    if not now.boards:
        return say(f"no record of {options.results} is selected", 5)
    first, second = options.rows
    found = []
    unknown: UnknownNameError | None = None
    for conditions, cells in now.boards.items():
        try:
            compared = paired.compare(list(cells.values()), first, second, options.metric)
            found.append(f"{conditions}\n{compared}")
        except UnknownNameError as error:
            unknown = unknown or error
    if unknown and not found:
        raise unknown
    # A directory may also hold boards, runs with --limit say, without these rows.
    print("\n".join(found))
    return 0


def _compare(now: RecordSet, reference: RecordSet, options: argparse.Namespace) -> int:
    known = dict.fromkeys((*NAMES, *reference.metrics()))
    tolerances = regression.parse_tolerances(options.fail, known)
    judged_by = {"by": options.by, "two_sided": options.two_sided}
    try:
        found = regression.compare(now, reference, tolerances, **judged_by)
    except regression.NothingInCommonError as error:
        return say(str(error), 5)
    for path, render in ((options.junit, rendering.junit), (options.markdown, rendering.markdown)):
        try:
            if path:
                Path(path).write_text(render(found), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{path!r} cannot be written: {error.strerror}") from None
    console = make_console()
    if options.verbosity < 0:
        console.print(rendering.summary(found))
    else:
        rendering.show(found, console, everything=options.verbosity > 0)
    return int(bool(found.failures))
