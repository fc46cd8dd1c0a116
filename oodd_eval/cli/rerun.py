"""``oodd-eval leaderboard rerun``: an entry's detectors once more, on seeds drawn after it.

Entries are data; this is the only action that runs a detector for one.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from oodd_eval.cli import EXPRESSION, NAMES, Parser, add_limits, at_least, say, value
from oodd_eval.cli.data import record_split
from oodd_eval.cli.terminal import TerminalReporter, discovered, make_console
from oodd_eval.data.split import Split, load_split, split_places
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.entry import SubmittedEntry, read_entry
from oodd_eval.leaderboard.verify import verify
from oodd_eval.leaderboard.verify.rerun import (
    LEAST,
    SPLIT_DIRECTORY,
    definition_of,
    draw,
    environments_of,
)
from oodd_eval.names import expression, select, whole_numbers
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.sandbox import require_sandbox
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.keys import source_digest
from oodd_eval.scoring.plan import Plan, make_plan
from oodd_eval.scoring.runner import run as carry_out


def define(parser: Parser) -> None:
    """Add the options of the action."""
    # fmt: off
    add = parser.options(
        run, "leaderboard rerun leaderboard/results/paper-mini --output again", plugins=True
    )
    add("path", metavar="ENTRY", help="directory of the entry")
    add("--output", required=True, metavar="DIR",
        help="directory of the re-run; the same command goes on where it was interrupted")
    add("--env", default="all", metavar="NAMES",
        help=f"{NAMES}, at least {LEAST} for a grant (default: all of the entry)")
    add("--seed", type=value(partial(whole_numbers, least=0)), metavar="N,...",
        help="seeds of the detectors (default: those of the entry)")
    add("-k", dest="expression", default="", metavar="EXPR", help=EXPRESSION)
    add("--no-sandbox", dest="sandbox", action="store_false",
        help="use plain workers also where bubblewrap is installed; the grant says so")
    add("--jobs", type=at_least(1), metavar="N", help="fits at a time (default: one per core)")
    add_limits(add, "a fit with its scores", "3h")
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out the action; 1 when a fit failed, 2 when it was interrupted."""
    path, place = Path(options.path), Path(options.output)
    verdicts = [*verify(path)]
    if len(verdicts) != 1 or not verdicts[0].ok:
        raise UsageError(f"{options.path!r}: expected one valid entry, see leaderboard verify")
    entry, plugins = read_entry(path), discovered(options)
    names = select("environment", options.env, environments_of(entry))
    check_installed(entry, plugins)
    boxed = options.sandbox and _sandboxed()
    drawn = draw(entry, place, names, sandbox=boxed)
    record_split(definition_of(entry, drawn), options, names, place / SPLIT_DIRECTORY)
    split = load_split(place / SPLIT_DIRECTORY)
    plan = plan_of(entry, split, plugins, options.seed).matching(expression(options.expression))
    hidden = (*split_places(split), options.output) if boxed else None
    settings = RunSettings(
        jobs=options.jobs,
        limits=Limits(options.timeout, options.memory, hidden),
        command=options.invocation,
    )
    results, console = ResultsDirectory(place), make_console()
    reporter = TerminalReporter(console, verbosity=options.verbosity, log=results.log_path)
    done = carry_out(plan, split, plugins, settings, results, observers=[reporter])
    if done.interrupted:
        return 2
    console.print(f"next: oodd-eval leaderboard verify {path} --rerun {place}")
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
            own, other = (f"{p} {version}, source {s[:12]}" for p, version, s in (here, there))
            raise UsageError(
                f"{record.detector} is installed as {own}, but {entry.meta.id} has {other}: "
                "install that"
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
        for (own, _, seed), record in fits.items()
        if own == environment and (seeds is None or seed in seeds)
    ]
    units = tuple(unit for plan in plans for unit in plan.units)
    if not units:
        raise UsageError(f"{entry.meta.id} has none of seeds {', '.join(map(str, seeds or ()))}")
    return Plan(split.name, split.digest, units, split.groups)
