"""``oodd-eval show``: tables of earlier results, recomputed from their scores."""

from __future__ import annotations

import argparse
import sys

from oodd_eval.cli.terminal import TerminalReporter, make_console, summary
from oodd_eval.data.split import load_split
from oodd_eval.errors import UnknownNameError
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.record import Record
from oodd_eval.results.regression.tolerance import KNOWN
from oodd_eval.results.tables import markdown, tables
from oodd_eval.results.tables.board import boards


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval show``; 1 when one of the cells failed."""
    if options.metric not in KNOWN:
        raise UnknownNameError("metric", options.metric, KNOWN)
    results = ResultsDirectory(options.directory)
    records = results.records()
    if not options.stored:
        records = _recomputed(records, results, options.split)
    if not records:
        print(f"oodd-eval: no records in {options.directory}", file=sys.stderr)  # noqa: T201
        return 5
    if options.markdown:
        print(markdown.render(records, intervals=options.intervals), end="")  # noqa: T201
        return int(not all(r.ok for r in records))
    reporter = TerminalReporter(make_console(), intervals=options.intervals)
    if options.detector:
        _by_anomaly(options, records, reporter)
    else:
        reporter.tables(records)
        if options.wide:
            _wide(options, records, reporter)
        reporter.failures(records)
    reporter.console.print(summary(records))
    return int(not all(r.ok for r in records))


def _recomputed(records: list[Record], results: ResultsDirectory, place: str) -> list[Record]:
    """Rescore each split's records, and keep the order of all."""
    fresh: dict[tuple[str, ...], Record] = {}
    for name, digest in dict.fromkeys((r.split, r.split_digest) for r in records):
        # A split that is not the published one carries its digest behind its name.
        split = load_split(place or name.partition("@")[0])
        own = [r for r in records if r.split_digest == digest]
        fresh |= {r.identity: r for r in rescore(own, results, split)}
    return [fresh[r.identity] for r in records]


def _wide(options: argparse.Namespace, records: list[Record], reporter: TerminalReporter) -> None:
    for board in boards(records):
        reporter.table(tables.all_metrics(board, intervals=options.intervals))
        if alarms := tables.calibrated(board, intervals=options.intervals):
            reporter.table(alarms)
        reporter.table(tables.pooled(board))


def _by_anomaly(
    options: argparse.Namespace, records: list[Record], reporter: TerminalReporter
) -> None:
    known = {r.detector for r in records}
    if options.detector not in known:
        raise UnknownNameError("detector of these results", options.detector, known)
    for board in boards(records):
        for entry in board.entries:
            if entry.detector == options.detector:
                reporter.table(
                    tables.by_anomaly(board, entry, options.metric, intervals=options.intervals)
                )
