"""``oodd-eval leaderboard rerun``: run entries' detectors again, on seeds drawn after them.

Entries are data; this is the only action that runs a detector for one.
"""

import json
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import click
from oodd_leaderboard.commands.entries import report, write_grant
from oodd_leaderboard.sandbox.describe import discover_in_sandbox
from oodd_leaderboard.sandbox.launcher import make_sandbox
from oodd_leaderboard.verify import EntryVerdict, verify
from oodd_leaderboard.verify.rerun import (
    ORDER,
    SPLIT_DIRECTORY,
    Rerun,
    RerunDifference,
    RerunOrder,
    cell_of,
    compare_rerun,
    read_order,
)

from oodd_eval.cli import (
    DIRECTORY,
    NAMES,
    SEEDS,
    Names,
    Options,
    command,
    jobs_option,
    limit_options,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.cli.terminal import TerminalReporter
from oodd_eval.data.facts import ENVIRONMENTS, SPLITS, SplitDefinition, in_order
from oodd_eval.data.files import find_file, write_text
from oodd_eval.data.split import Split, load_split, split_places
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.metrics.catalogue import UNDEFINED, metric_info
from oodd_eval.names import select
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.prose import Table, print_table
from oodd_eval.results.board import grouped, ranked_by
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, make_plan, source_digest
from oodd_eval.scoring.runner import run
from oodd_recording.build import digest_of_bits
from oodd_recording.commands import record_split


@command(
    "leaderboard rerun leaderboard/results/paper-mini --detector rf --env cartpole,acrobot,hopper",
    "leaderboard rerun leaderboard/results/mine-standard --grant Hopper",
    plugins=True,
)
@click.argument(
    "paths",
    nargs=-1,
    type=DIRECTORY,
    metavar="ENTRY...",
    required=True,
    help="entries of one split; several are run on the same fresh seeds",
)
@click.option("--detector", default="all", type=Names("detectors"), help=NAMES)
@click.option(
    "--env", type=Names("envs"), help=f"{NAMES} (default: those of the re-run so far, at first all)"
)
@click.option("--seed", type=SEEDS, help="seeds of the detectors (default: those of the entry)")
@click.option(
    "--output",
    type=DIRECTORY,
    help="directory of the re-run (default: rerun-ENTRY, of one entry); the same command goes on "
    "where it was interrupted, and other detectors and environments are added",
)
@click.option("--grant", help="once all rows agree, grant one entry the level re-run in this name")
@jobs_option
@limit_options("a fit with its scores", "3h")
def rerun(options: Options) -> int:
    """Run entries' detectors again on seeds drawn now, in a sandbox and row by row, and compare.

    The exit code is 1 when an entry is better than chance explains or a fit failed, and 2 when the
    re-run was interrupted.
    """
    if len(options.paths) > 1 and (options.grant or not options.output):
        raise UsageError(
            "several entries need --output and no --grant: run them together first, then name each "
            "one with the same --output and --grant"
        )
    verdicts, console = sound(options.paths), make_console()
    results = ResultsDirectory(options.output or Path(f"rerun-{verdicts[0].name}"))
    records = chosen(verdicts, options, read_order(results.path))
    environments = in_order((record.environment for record in records), ENVIRONMENTS)
    if missing := unfinished(records, results):
        launcher = make_sandbox([results.path.absolute()])
        find = partial(discover_in_sandbox, launcher=launcher, memory=options.memory)
        plugins = discovered(options, find)
        check_installed(missing, plugins)
    order = draw(verdicts, results.path, environments)
    if missing:
        definition = definition_of(verdicts[0], int(order.bits, 16))
        if not _run(definition, missing, order, plugins, results, options):
            return 2
    fresh = earlier(results)
    for i, verdict in enumerate(verdicts):
        again = compare_rerun(verdict.records, fresh, order, verdict.findings)
        verdicts[i] = replace(verdict, rerun=again)
        for table in figures(again, ranked_by(records)):
            print_table(table, console)
        report(console, verdicts[i], options.verbosity)
    if options.grant:
        return write_grant(console, options.paths[0], verdicts[0], options.grant)
    return int(not all(verdict.ok for verdict in verdicts))


def sound(paths: Sequence[Path]) -> list[EntryVerdict]:
    """Return verdicts on entries that can be run again together; `UsageError` for others."""
    verdicts = []
    for path in paths:
        of_path = [*verify(path)]
        if len(of_path) != 1 or not of_path[0].ok:
            raise UsageError(f"{str(path)!r}: expected one valid entry, see leaderboard verify")
        verdicts += of_path
    for verdict in verdicts:
        if not all(record.paired for record in verdict.records.values()):
            raise UsageError(
                f"{verdict.name} is of logs, which cannot be recorded again: without a re-run its "
                "trust is at most re-scored, by leaderboard verify from its scores"
            )
    first, *others = (definition_of(verdict) for verdict in verdicts)
    if any(other != first for other in others):
        names = ", ".join(verdict.name for verdict in verdicts)
        raise UsageError(f"{names} are on several splits: expected entries of one")
    return verdicts


def definition_of(verdict: EntryVerdict, bits: int = 0) -> SplitDefinition:
    """Return the entry's split with seeds from other bits; `UsageError` where it has none."""
    split = verdict.entry.split if verdict.entry else ""
    definition = SPLITS.get(split)
    if definition is None or definition.base:
        known = ", ".join(name for name, one in SPLITS.items() if not one.base)
        raise UsageError(
            f"{verdict.name} is on split {split!r}: expected one that can be recorded with other "
            f"seeds ({known})"
        )
    drawn = digest_of_bits(bits)
    return replace(definition, name=f"rerun-{drawn[:12]}", seed_base=0, drawn=drawn)


def chosen(
    verdicts: Sequence[EntryVerdict], options: Options, order: RerunOrder | None
) -> list[Record]:
    """Return the records of entries that the options choose, an order's environments by default."""
    records = [record for verdict in verdicts for record in verdict.records.values()]
    environments = in_order((record.environment for record in records), ENVIRONMENTS)
    earlier_ones = ",".join(order.environments) if order else "all"
    environments = select("environment", options.env or earlier_ones, environments)
    detectors = select("detector", options.detector, {record.detector for record in records})
    known = sorted({record.seed for record in records})
    if not set(options.seed or known) <= set(known):
        names = ", ".join(verdict.name for verdict in verdicts)
        raise UsageError(f"--seed: {names} has seeds {', '.join(map(str, known))}")
    return [
        record
        for record in records
        if record.environment in environments
        and record.detector in detectors
        and record.seed in (options.seed or known)
    ]


def earlier(results: ResultsDirectory) -> list[Record]:
    """Return the records of a re-run's directory so far."""
    return results.records() if find_file(results.path / RECORDS) else []


def unfinished(records: Sequence[Record], results: ResultsDirectory) -> list[Record]:
    """Return those of entries' records that were not run again with the same outcome."""
    again = {cell_of(record): record.status for record in earlier(results)}
    return [record for record in records if again.get(cell_of(record)) != record.status]


def check_installed(records: Sequence[Record], plugins: Plugins) -> None:
    """Raise `UsageError` unless each detector is installed in the version and source it had."""
    for record in {record.detector: record for record in records}.values():
        there = record.plugin, record.detector_version, record.plugin_source
        try:
            offer = plugins.offer(record.detector)
        except UnknownNameError as error:
            installed = f"cannot be had ({error})"
        else:
            offer.require()
            name = f"{offer.distribution}:{offer.plugin}"
            here = name, offer.version, source_digest(offer.module)
            if here == there:
                continue
            installed = _version(*here)
        raise UsageError(
            f"{record.detector} is installed as {installed}, but the entry has {_version(*there)}: "
            "install that"
        )


def _version(plugin: str, version: str, source: str) -> str:
    return f"{plugin} {version}, source {source[:12]}"


def draw(
    verdicts: Sequence[EntryVerdict], directory: Path, environments: Sequence[str]
) -> RerunOrder:
    """Draw bits for entries and write the order, or go on with one that is there for them.

    Environments that it lacks are added: entries are fixed by digest, and seeds by the bits, so
    that it does not matter when an environment is named.
    `UsageError`: the order there is for other entries, or other versions of them.
    """
    order = read_order(directory)
    if order is None:
        day = datetime.now(UTC).date().isoformat()
        digests = [verdict.digest for verdict in verdicts]
        order = RerunOrder(digests, secrets.token_hex(16), day, [])
    for verdict in verdicts:
        if verdict.digest not in order.entries:
            drawn_for = ", ".join(digest[:12] for digest in order.entries)
            raise UsageError(
                f"{str(directory)!r} is a re-run of entry.json {drawn_for}, but {verdict.name} "
                f"has {verdict.digest[:12]}: seeds are drawn for one version of an entry; name "
                "another --output"
            )
    if not set(environments) <= set(order.environments):
        every = in_order([*order.environments, *environments], ENVIRONMENTS)
        order = replace(order, environments=every)
        directory.mkdir(parents=True, exist_ok=True)
        write_text(directory / ORDER, json.dumps(asdict(order), indent=1, sort_keys=True) + "\n")
    return order


def _run(
    definition: SplitDefinition,
    records: Sequence[Record],
    order: RerunOrder,
    plugins: Plugins,
    results: ResultsDirectory,
    options: Options,
) -> bool:
    """Record the split as far as it is not there, and run what is missing; False if interrupted."""
    bits, directory = int(order.bits, 16), results.path / SPLIT_DIRECTORY
    record_split(definition, options, order.environments, directory, bits=bits)
    split = load_split(directory)
    settings = RunSettings(
        jobs=options.jobs,
        limits=Limits(options.timeout, options.memory),
        launcher=make_sandbox((*split_places(split), results.path.absolute())),
        command=options.invocation,
        streamed=True,
    )
    plan, console = plan_of(records, split, plugins), make_console()
    with TerminalReporter(console, verbosity=options.verbosity, log=results.log_path) as reporter:
        done = run(plan, split, plugins, settings, results, observers=[reporter])
    return not done.interrupted


def plan_of(records: Sequence[Record], split: Split, plugins: Plugins) -> Plan:
    """Return the plan of all fits that records of entries are of, in another split."""
    # One record stands for all of an environment, row and seed.
    fits = {(r.environment, r.setting, r.seed): r for r in records}
    plans = [
        make_plan(
            plugins,
            split=split,
            detectors=[record.detector],
            environments=[record.environment],
            horizons=[record.horizon],
            seeds=[record.seed],
            parameters=record.parameters,
        )
        for record in fits.values()
    ]
    units = tuple(unit for plan in plans for unit in plan.units)
    return Plan(split.name, split.digest, units, split.groups)


def figures(again: Rerun, ranking: Sequence[str]) -> Iterator[Table]:
    """Yield a table a row: by environment what ranks, and what is better by most errors."""
    for row, compared in again.differences.items():
        lines = []
        for name, parts in grouped(compared, lambda d: d.environment or "mean").items():
            by_metric = {d.metric: d for d in parts}
            most = max(parts, key=lambda d: d.z)
            values = [_values(by_metric.get(metric)) for metric in ranking]
            lines.append([name, *values, metric_info(most.metric).title, f"{most.z:.1f}"])
        # The mean over environments comes last.
        lines.sort(key=lambda line: line[0] == "mean")
        titles = [metric_info(name).title for name in ranking]
        header = ["Environment", *titles, "Most better in", "z"]
        note = (
            "a / b: of the entry and of its re-run. z: by how many standard errors the entry is "
            "better in the metric in which it is most so."
        )
        yield Table(f"{row}, entry / re-run", header, lines, labels=1, note=note, wrap=True)


def _values(difference: RerunDifference | None) -> str:
    if difference is None:
        return UNDEFINED
    text = metric_info(difference.metric).text
    return f"{text(difference.entry)} / {text(difference.rerun)}"
