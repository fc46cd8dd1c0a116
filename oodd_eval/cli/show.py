"""``oodd-eval show``: tables of earlier results, recomputed from their scores."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import click

from oodd_eval.cli import (
    DIRECTORY,
    Name,
    Names,
    Options,
    alarm_options,
    command,
    expression_option,
    refuse,
    row_metrics_option,
    say,
    say_notes,
    together,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.reporter import TerminalReporter, print_report
from oodd_eval.data.facts import ENVIRONMENTS, in_order
from oodd_eval.data.split import Split, load_split, split_directories
from oodd_eval.errors import UsageError
from oodd_eval.metrics.alarms import RECORDED, STATISTICS
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.names import check_known, expression, select
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.record import Record, summary
from oodd_eval.results.render import FORMATS, Format
from oodd_eval.results.report import Report
from oodd_eval.results.tables import ROWS
from oodd_eval.scoring.doubts import costly_voices

_format_options: Final = together(
    *(
        click.option(f"--{name}", is_flag=True, help=f"print {layout.summary}")
        for name, layout in FORMATS.items()
    )
)


@command(
    "show oodd-results --intervals",
    "show oodd-results --detector rf --metric missed_at_5pct",
    "show oodd-results --env hopper -k 'not drift' --csv",
    "show oodd-results --alarm score",
    further={
        "Which results": "--split --stored",
        "Tables and formats": "--row-metrics --paper --alarm --json --latex",
    },
)
@click.argument("directory", type=DIRECTORY, help="results directory")
@click.option("--split", type=Name("splits"), help="where the split is, if not at its usual place")
@click.option("--stored", is_flag=True, help="print stored metrics without recomputing them")
@click.option("--intervals", is_flag=True, help="print 95 % intervals")
@row_metrics_option
@click.option(
    "--detector", type=Name("detectors"), help="print the table by anomaly of one detector"
)
@click.option("--metric", type=Name("metrics"), help="metric of that table")
@click.option("--wide", is_flag=True, help="print everything that there is")
@alarm_options
@click.option(
    "--alarm",
    type=click.Choice(STATISTICS),
    help="watch this statistic of the scores instead of what each detector declares; recorded "
    "columns and flags stay as they are",
)
@_format_options
@click.option("--env", default="all", type=Names("envs"), help="only these environments")
@expression_option
def show(options: Options) -> int:
    """Print tables of earlier results, recomputed from their scores.

    The exit code is 1 when one of the cells failed.
    """
    layout = _format(options)
    _check(options, layout)
    results = ResultsDirectory(options.directory)
    records = results.records()
    environments = in_order([*ENVIRONMENTS, *(r.environment for r in records)], ENVIRONMENTS)
    long = _long_names(records, results, options.split) if "/" in options.env else {}
    selected = {*select("environment", options.env, [*environments, *long.values()])}
    passes = expression(options.expression)
    records = [r for r in records if {r.environment, long.get(r.identity)} & selected]
    records = [r for r in records if passes(str(r.cell))]
    units: dict[str, str] = {}
    splits: dict[str, Split] = {}
    if not options.stored:
        if options.alarm:
            records = [
                r if r.alarm in RECORDED else replace(r, alarm=options.alarm) for r in records
            ]
        splits = _splits(records, results, options.split)
        records = _recomputed(records, results, splits, rows=options.row_metrics)
        units = {kind: unit for split in splits.values() for kind, unit in split.units.items()}
    say_notes(results.notes)
    if options.row_metrics and records and all(r.paired for r in records):
        raise UsageError("--row-metrics is for splits without twins, and these results have twins")
    if options.paper and records and not any(r.paired for r in records):
        raise UsageError("--paper is for splits with twins, and these results have none")
    if options.row_metrics and not any(name in r.metrics for r in records for name in ROWS):
        say("--row-metrics adds nothing: no episode of these results has known anomalous rows")
    if not records:
        return say(f"no records in {options.directory} are selected", 5)
    code = int(not all(r.ok for r in records))
    if options.detector:
        check_known("detector of these results", {r.detector for r in records}, options.detector)
        if layout and not layout.tables:
            records = [r for r in records if r.detector == options.detector]
    report = Report(
        records,
        intervals=options.intervals,
        detail="full" if layout or options.wide else "brief",
        detector=options.detector or "",
        metric=options.metric or "",
        units=units,
        level=options.level,
        paper=options.paper,
        remarks=[*costly_voices(records, results)] if layout or options.wide else (),
    )
    if layout:
        print(layout.render(report), end="")
        return code
    reporter = TerminalReporter(make_console())
    for split in splits.values() if options.verbosity >= 0 else ():
        if split.path not in split_directories().values():
            reporter.console.print(
                f"split {split.name}, digest {split.digest[:12]}, in {split.path}\n"
            )
    if not options.detector:
        reporter.failures(records)
        if code:
            reporter.console.print(f"{summary(records)}\n")
    print_report(report, reporter.console, options.directory)
    return code


def _check(options: Options, layout: Format | None) -> None:
    """Refuse options that would do nothing beside others."""
    if options.alarm and options.stored:
        raise UsageError(
            f"--alarm {options.alarm} computes figures that --stored would not show: leave out one"
        )
    if options.metric:
        check_known("metric", NAMES, options.metric)
    if options.stored:
        refuse(options, ["split", "row_metrics"], "is for computing, and --stored computes nothing")
    if not options.detector:
        refuse(options, ["metric"], "is of the table of one detector: name it with --detector")
    if layout:
        refuse(options, ["wide"], "is for the terminal: a format has all metrics")
        refuse(options, ["paper"], "is for the terminal: a format has the paper's alarm anyway")
    if options.detector:
        every = "prints tables of all detectors: leave out --detector"
        refuse(options, ["wide", "paper"], every)
    if layout and not layout.tables:
        refuse(options, ["metric"], "is of a table, and that format has all metrics of a cell")
        refuse(options, ["level"], "is of tables, and that format has all levels of a cell")


def _format(options: Options) -> Format | None:
    """Return the format that is asked for, if one is."""
    names = [name for name in FORMATS if getattr(options, name)]
    if len(names) > 1:
        raise UsageError(f"--{names[0]} and --{names[1]} are two formats: leave out one")
    return FORMATS[names[0]] if names else None


def _splits(records: list[Record], results: ResultsDirectory, at: str | None) -> dict[str, Split]:
    """Open the splits of records, by their digests."""
    of_digest = {r.split_digest: r for r in records}
    return {d: load_split(at) if at else results.split_of(r) for d, r in of_digest.items()}


def _long_names(
    records: list[Record], results: ResultsDirectory, at: str | None
) -> dict[object, str]:
    """Return the long names of environments, as the splits have them, by records."""
    splits = _splits(records, results, at)
    return {r.identity: splits[r.split_digest].long_name(r.environment) for r in records}


def _recomputed(
    records: list[Record], results: ResultsDirectory, splits: Mapping[str, Split], *, rows: bool
) -> list[Record]:
    """Rescore each split's records, and keep the order of all."""
    fresh: dict[object, Record] = {}
    for digest, split in splits.items():
        of_split = [r for r in records if r.split_digest == digest]
        again = rescore(of_split, results, split, row_metrics=rows)
        fresh |= {r.identity: r for r in again}
    return [fresh[r.identity] for r in records]
