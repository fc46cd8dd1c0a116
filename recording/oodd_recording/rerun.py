"""``oodd-eval leaderboard rerun``: run an entry's detectors again, on seeds drawn after it.

Entries are data; this is the only action that runs a detector for one.
"""

import json
import secrets
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

import click

from oodd_eval.cli import (
    DIRECTORY,
    NAMES,
    SEEDS,
    Names,
    Options,
    command,
    expression_option,
    jobs_option,
    limit_options,
    say,
)
from oodd_eval.cli.terminal import TerminalReporter, discovered, make_console
from oodd_eval.data.facts import CUSTOM_SEED_BASES, ENVIRONMENTS, SPLITS, SplitDefinition
from oodd_eval.data.files import write_text
from oodd_eval.data.split import Split, load_split, split_places
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.entry import ENTRY, SubmittedEntry, digest_of, read_entry
from oodd_eval.leaderboard.verify import verify
from oodd_eval.leaderboard.verify.rerun import LEAST, ORDER, SPLIT_DIRECTORY, RerunOrder, read_order
from oodd_eval.names import expression, select
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.sandbox import require_sandbox
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, make_plan, source_digest
from oodd_eval.scoring.runner import run
from oodd_recording.commands import record_split


@command("leaderboard rerun leaderboard/results/paper-mini --output again", plugins=True)
@click.argument("path", type=DIRECTORY, metavar="ENTRY", help="directory of the entry")
@click.option(
    "--output",
    required=True,
    type=DIRECTORY,
    help="directory of the re-run; the same command goes on where it was interrupted",
)
@click.option(
    "--env", default="all", type=Names("envs"), help=f"{NAMES}, at least {LEAST} for a grant"
)
@click.option("--seed", type=SEEDS, help="seeds of the detectors (default: those of the entry)")
@expression_option
@click.option(
    "--no-sandbox",
    is_flag=True,
    help="use plain workers also where bubblewrap is installed; the grant says so",
)
@jobs_option
@limit_options("a fit with its scores", "3h")
def rerun(options: Options) -> int:
    """Run an entry's detectors again on seeds drawn now.

    The exit code is 1 when a fit failed, and 2 when the re-run was interrupted.
    """
    path, directory = options.path, options.output
    verdicts = [*verify(path)]
    if len(verdicts) != 1 or not verdicts[0].ok:
        raise UsageError(f"{str(path)!r}: expected one valid entry, see leaderboard verify")
    entry, plugins = read_entry(path), discovered(options)
    if not all(record.paired for record in entry.records):
        raise UsageError(
            f"{entry.meta.id} is of logs, which cannot be recorded again: without a re-run its "
            "trust is at most re-scored, by leaderboard verify from its scores"
        )
    names = select("environment", options.env, environments_of(entry))
    check_installed(entry, plugins)
    boxed = not options.no_sandbox and _sandboxed()
    drawn = draw(entry, directory, names, sandbox=boxed)
    record_split(definition_of(entry, drawn), options, names, directory / SPLIT_DIRECTORY)
    split = load_split(directory / SPLIT_DIRECTORY)
    plan = plan_of(entry, split, plugins, options.seed).matching(expression(options.expression))
    hidden = (*split_places(split), str(directory)) if boxed else None
    settings = RunSettings(
        jobs=options.jobs,
        limits=Limits(options.timeout, options.memory, hidden),
        command=options.invocation,
    )
    results, console = ResultsDirectory(directory), make_console()
    reporter = TerminalReporter(console, verbosity=options.verbosity, log=results.log_path)
    done = run(plan, split, plugins, settings, results, observers=[reporter])
    if done.interrupted:
        return 2
    console.print(f"next: oodd-eval leaderboard verify {path} --rerun {directory}")
    return int(not all(record.ok for record in done.records))


def _sandboxed() -> bool:
    """Tell whether workers can have a sandbox, and if not, say why."""
    try:
        require_sandbox()
    except UsageError as error:
        say(f"workers are plain ones, and a grant is going to say so: {error}")
        return False
    return True


def check_installed(entry: SubmittedEntry, plugins: Plugins) -> None:
    """Raise `UsageError` unless each detector is installed in the version and source it had."""
    for record in {record.detector: record for record in entry.records}.values():
        offer = plugins.offer(record.detector)
        name = f"{offer.distribution}:{offer.plugin}"
        here = name, offer.version, source_digest(offer.module)
        there = record.plugin, record.detector_version, record.plugin_source
        if here != there:
            installed, submitted = (
                f"{p} {version}, source {s[:12]}" for p, version, s in (here, there)
            )
            raise UsageError(
                f"{record.detector} is installed as {installed}, but {entry.meta.id} has "
                f"{submitted}: install that"
            )


def plan_of(
    entry: SubmittedEntry, split: Split, plugins: Plugins, seeds: Sequence[int] | None = None
) -> Plan:
    """Return the plan of all rows of an entry in a split, with its seeds or with some of them."""
    # One record stands for all of an environment, row and seed.
    fits: dict[tuple[str, Setting, int], Record] = {}
    for record in entry.records:
        fits.setdefault((record.environment, record.setting, record.seed), record)
    plans = [
        make_plan(
            plugins,
            split=split,
            detectors=[record.detector],
            environments=[environment],
            horizons=[record.horizon],
            seeds=[seed],
            parameters=record.parameters,
        )
        for environment in split.environments
        for (submitted, _, seed), record in fits.items()
        if submitted == environment and (seeds is None or seed in seeds)
    ]
    units = tuple(unit for plan in plans for unit in plan.units)
    if not units:
        raise UsageError(f"{entry.meta.id} has none of seeds {', '.join(map(str, seeds or ()))}")
    return Plan(split.name, split.digest, units, split.groups)


def draw(
    entry: SubmittedEntry, directory: Path, environments: Sequence[str], *, sandbox: bool
) -> RerunOrder:
    """Draw seeds for an entry and write the order, or go on with the one that is there.

    `UsageError`: the order there is for another entry, another version of it, or environments.
    """
    digest = digest_of((entry.path / ENTRY).read_bytes())
    order = read_order(directory)
    if order is None:
        taken = {definition.seed_base for definition in SPLITS.values()}
        base = secrets.choice([n for n in CUSTOM_SEED_BASES if n not in taken])
        day = datetime.now(UTC).date().isoformat()
        order = RerunOrder(digest, base, day, list(environments), sandbox)
    if order.entry != digest:
        raise UsageError(
            f"{str(directory)!r} is a re-run of entry.json {order.entry[:12]}, but {entry.meta.id} "
            f"has {digest[:12]}: seeds are drawn for one version of an entry; name another --output"
        )
    if order.environments != list(environments):
        raise UsageError(
            f"{str(directory)!r} is a re-run on {', '.join(order.environments)}, expected "
            f"{', '.join(environments)}: name another --output"
        )
    order = replace(order, sandbox=order.sandbox and sandbox)
    directory.mkdir(parents=True, exist_ok=True)
    write_text(directory / ORDER, json.dumps(asdict(order), indent=1, sort_keys=True) + "\n")
    return order


def definition_of(entry: SubmittedEntry, order: RerunOrder) -> SplitDefinition:
    """Return the entry's split, recorded anew from the order's seeds; `UsageError` for others."""
    definition = SPLITS.get(entry.meta.split)
    if definition is None or definition.base:
        known = ", ".join(name for name, one in SPLITS.items() if not one.base)
        raise UsageError(
            f"{entry.meta.id} is on split {entry.meta.split!r}: expected one that can be recorded "
            f"with other seeds ({known})"
        )
    return replace(definition, name=f"rerun-{order.seed_base}", seed_base=order.seed_base)


def environments_of(entry: SubmittedEntry) -> list[str]:
    """Return the environments that an entry has, in the order of the paper."""
    present = {record.environment for record in entry.records}
    return [name for name in ENVIRONMENTS if name in present]
