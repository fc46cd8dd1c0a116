"""``oodd-eval show``: tables of earlier results, recomputed from their scores."""

import argparse

from oodd_eval.cli import EXPRESSION, Parser, say, say_notes
from oodd_eval.cli.terminal import TerminalReporter, make_console, summary
from oodd_eval.data.facts import ENVIRONMENTS, in_order
from oodd_eval.data.split import load_split
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.names import check_known, expression, select
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.record import Record
from oodd_eval.results.render import FORMATS
from oodd_eval.results.render.terminal import print_sections
from oodd_eval.results.report import Report


def define(parser: Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.options(
        run,
        "show oodd-results --intervals",
        "show oodd-results --detector rf --metric missed_at_5pct",
        "show oodd-results --env hopper -k 'not drift' --csv",
    )
    add("directory", metavar="DIR", help="results directory")
    add("--split", metavar="NAME", help="where the split is, if not at its usual place")
    add("--stored", action="store_true", help="print stored metrics without recomputing them")
    add("--intervals", action="store_true", help="print 95 %% intervals")
    add("--detector", metavar="NAME", help="print the table by anomaly of one detector")
    add("--metric", default="auc_matched",
        help="metric of that table (default: auc_matched; see oodd-eval list metrics)")
    add("--wide", action="store_true",
        help="print all metrics, nulls and guaranteed alarms at 10, 5 and 1 %% among them")
    for name, layout in FORMATS.items():
        add(f"--{name}", action="store_true", help=f"print {layout.summary}")
    add("--env", default="all", metavar="NAMES", help="only these environments (default: all)")
    add("-k", dest="expression", default="", metavar="EXPR", help=EXPRESSION)
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval show``; 1 when one of the cells failed."""
    check_known("metric", NAMES, options.metric)
    results = ResultsDirectory(options.directory)
    records = results.records()
    known = in_order([*ENVIRONMENTS, *(r.environment for r in records)], ENVIRONMENTS)
    chosen = select("environment", options.env, known)
    passes = expression(options.expression)
    records = [r for r in records if r.environment in chosen and passes(str(r.cell))]
    if not options.stored:
        records = _recomputed(records, results, options.split)
    say_notes(results.notes)
    if not records:
        return say(f"no records in {options.directory} are selected", 5)
    code = int(not all(r.ok for r in records))
    if options.detector:
        check_known("detector of these results", {r.detector for r in records}, options.detector)
    layout = next((FORMATS[name] for name in FORMATS if getattr(options, name)), None)
    report = Report(
        records,
        intervals=options.intervals,
        detail="full" if layout else "wide" if options.wide else "brief",
        detector=options.detector or "",
        metric=options.metric,
    )
    if layout:
        print(layout.render(report), end="")
        return code
    reporter = TerminalReporter(make_console())
    print_sections(report.sections, reporter.console)
    if not options.detector:
        reporter.failures(records)
    reporter.console.print(summary(records))
    return code


def _recomputed(records: list[Record], results: ResultsDirectory, at: str | None) -> list[Record]:
    """Rescore each split's records, and keep the order of all."""
    fresh: dict[object, Record] = {}
    for name, digest in dict.fromkeys((r.split, r.split_digest) for r in records):
        # A split that is not the published one carries its digest behind its name.
        split = load_split(at or name.partition("@")[0])
        of_split = [r for r in records if r.split_digest == digest]
        fresh |= {r.identity: r for r in rescore(of_split, results, split)}
    return [fresh[r.identity] for r in records]
