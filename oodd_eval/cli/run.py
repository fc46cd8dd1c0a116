"""``oodd-eval run``: fit and score every selected cell, print tables and write them."""

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console

from oodd_eval.cli import (
    COUNT,
    FILE,
    NAMES,
    OUTPUT_DIRECTORY,
    SEEDS,
    Command,
    Name,
    Names,
    Options,
    alarm_options,
    command,
    detector_options,
    expression_option,
    fit_options,
    load,
    row_metrics_option,
    say,
    say_notes,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.cli.reporter import TerminalReporter, print_report
from oodd_eval.data.bounded import read_toml
from oodd_eval.data.files import write_text
from oodd_eval.data.layout import is_paired
from oodd_eval.data.split import Split, load_split, split_places
from oodd_eval.errors import UsageError
from oodd_eval.metrics.promise import PromiseFinding
from oodd_eval.names import counted, expression
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.prose import print_prose
from oodd_eval.results.directory import REPORT, ResultsDirectory
from oodd_eval.results.render import FORMATS
from oodd_eval.results.report import Report
from oodd_eval.scoring.doubts import costly_voices, doubts_after, doubts_before
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, make_plan
from oodd_eval.scoring.runner import RunOutcome
from oodd_eval.scoring.runner import run as run_plan

SANDBOX: Final = "oodd_leaderboard.sandbox.launcher:make_sandbox"
"""Makes the launcher of ``--sandbox``, given paths that workers must not see."""

DESCRIBED: Final = "oodd_leaderboard.sandbox.describe:discover_in_sandbox"
"""Finds plug-ins as `discover` does, without importing any."""


class _Configurable(Command):
    """A command whose options may also stand in a file."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        values, _, _ = self.make_parser(ctx).parse_args(list(args))
        file = None if ctx.resilient_parsing else values.get("config")
        # The command line comes last, so that it wins.
        return super().parse_args(ctx, [*_options_of(file), *args] if file else args)


@command(
    "run --detector rf --env all",
    "run --detector pe,rf --env hopper,ant --anomaly iid,gravity --jobs 2",
    "run --detector riqn --env hopper --param updates=500 --horizon 1,10 --output mine",
    further={
        "What runs": "--horizon --limit --rolling --collect-only -x --config -p",
        "Where, and within which limits": "--device --timeout --memory --executor --sandbox",
        "Tables": "--intervals --level --paper --row-metrics",
    },
    plugins=True,
    kind=_Configurable,
)
@click.option("--detector", required=True, type=Names("detectors"), help=NAMES)
@click.option("--env", required=True, type=Names("envs"), help=NAMES)
@click.option("--anomaly", default="all", type=Names("anomalies"), help=NAMES)
@click.option("--split", default="mini", type=Name("splits"), help="name or path of a split")
@detector_options
@click.option("--seed", default="0", type=SEEDS, help="seeds of the detectors")
@expression_option
@click.option("--collect-only", is_flag=True, help="print the selected cells and do nothing")
@click.option("-x", "stop", is_flag=True, help="stop at the first failure")
@click.option("--limit", type=COUNT, help="use the first N trajectories of each part")
@fit_options("30m")
@click.option("--executor", default="local", help="local, or dask://HOST:PORT, a Dask cluster")
@click.option("--sandbox", is_flag=True, help="detectors see no network, splits, results or home")
@click.option("--fresh", is_flag=True, help="fit again what the results directory has already")
@click.option("--rolling", is_flag=True, help="logs: judged nominal episodes join the calibration")
@click.option("--intervals", is_flag=True, help="print 95 % intervals in the tables")
@alarm_options
@row_metrics_option
@click.option("--config", type=FILE, help="TOML file with these options by their long names")
@click.option("--output", default="oodd-results", type=OUTPUT_DIRECTORY, help="results directory")
def run(options: Options) -> int:
    """Fit and score every selected cell, print the tables and write the results.

    The exit code is 1 when a cell failed, and 2 when the run was interrupted. What was done before
    is kept: the same command goes on.
    """
    if label := re.search(r"([^,\[]+)\[\w+=[^\]]*\]", options.detector):  # as tables have it
        raise UsageError(
            f"--detector has {label[0]!r}, the label of a row: expected the name {label[1]!r}, and "
            "what is in brackets as --param DETECTOR.NAME=VALUE, --horizon or --seed"
        )
    split, launcher = load_split(options.split), None
    if options.sandbox:
        launcher = load(SANDBOX)([*split_places(split), str(options.output)])
        find = partial(load(DESCRIBED), launcher=launcher, memory=options.memory)
        plugins = discovered(options, find)
        if watching := ", ".join(point.name for point in plugins.observer_points):
            say(f"plug-ins that observe runs are left out of a sandboxed one: {watching}")
    else:
        plugins = discovered(options)
    environments, anomalies = split.select(options.env, options.anomaly)
    paired = {is_paired(split.manifest["environments"][name]) for name in environments}
    if options.row_metrics and False not in paired:
        raise UsageError(f"--row-metrics is for splits without twins, unlike split {split.name}")
    if options.paper and True not in paired:
        raise UsageError(f"--paper is for splits with twins, unlike split {split.name}")
    plan = make_plan(
        plugins,
        split=split,
        detectors=plugins.select(options.detector, split.columns),
        environments=environments,
        anomalies=anomalies,
        horizons=options.horizon,
        seeds=options.seed,
        parameters=dict(options.param),
        device=options.device,
        limit=options.limit,
        rolling=options.rolling,
    )
    plan = plan.matching(expression(options.expression))
    if not plan.cells:
        return say(f"no cell matches -k {options.expression!r}", 5)
    console = make_console()
    if options.verbosity >= 0:
        for note in plan.notes:
            print_prose(note, console)
    if options.collect_only:
        if options.verbosity >= 0:
            console.print("\n".join(map(str, plan.cells)))
        cells, fits = counted(len(plan.cells), "cell(s)"), counted(len(plan.units), "fit(s)")
        console.print(f"{cells} in {fits}")
        return 0
    settings = RunSettings(
        jobs=options.jobs,
        limits=Limits(options.timeout, options.memory),
        launcher=launcher,
        fresh=options.fresh,
        stop_on_failure=options.stop,
        executor=options.executor,
        command=options.invocation,
        row_metrics=options.row_metrics,
    )
    results = ResultsDirectory(options.output)
    reporter = TerminalReporter(console, verbosity=options.verbosity, log=results.log_path)
    doubts = _Doubts(make_console(quiet=options.verbosity < 0), split)
    with reporter:
        done = run_plan(plan, split, plugins, settings, results, observers=[reporter, doubts])
    doubts.print(doubts_after(plan, split, results))
    say_notes(results.notes)
    if done.records:
        records, path = results.records(), results.path
        printed = {name: getattr(options, name) for name in ("intervals", "level", "paper")}
        report = Report(
            records, **printed, units=split.units, remarks=[*costly_voices(records, results)]
        )
        write_text(path / REPORT, FORMATS["markdown"].render(report))
        if options.verbosity >= 0 and any(record.ok for record in done.records):
            console.print("")
            print_report(replace(report, records=done.records, detail="brief"), console, path)
    if left := _left(plan, done, fresh=options.fresh):
        console.print(left)
    if done.interrupted:
        return 2
    return int(bool(plugins.broken) or not all(record.ok for record in done.records))


def _left(plan: Plan, done: RunOutcome, *, fresh: bool) -> str:
    """Return how a run goes on that has not done all: which fits are kept, and by which command."""
    kept = len({(r.environment, r.cell.label) for r in done.records if r.ok})
    every = len(plan.units)
    if kept == every:
        return ""
    again = "the same command without --fresh" if fresh and kept else "the same command"
    advice = f"{again} fits the rest"
    if done.left:
        advice = f"{again} continues"
    elif any(record.status == "unavailable" for record in done.records):
        advice = f"install what is named above, then {advice}"
    return f"{kept} of {counted(every, 'fit(s)')} kept; {advice}"


class _Doubts:
    """Print findings about the data alone, except those that the tables repeat."""

    def __init__(self, console: Console, split: Split) -> None:
        self._console, self._split = console, split

    @hookimpl
    def oodd_run_started(self, plan: Plan) -> None:
        """Print what no detector is needed to find out, but for what stands below the tables."""
        for name in dict.fromkeys(unit.environment for unit in plan.units):
            _, *lines = self._split.manifest["environments"][name].get("ledger", [""])
            more = f" and {len(lines) - 1} more (data info {self._split.name})" * (len(lines) > 1)
            for line in lines[:1]:
                self.say(f"{name}, of its logs: {line}{more}")
        doubts = doubts_before(plan, self._split)
        self.print((name, doubt) for name, doubt in doubts if doubt.subject != "episodes")

    def print(self, doubts: Iterable[tuple[str, PromiseFinding]]) -> None:
        """Print a sentence on each environment and finding."""
        for name, finding in doubts:
            self.say(f"{name}: {finding}")

    def say(self, sentence: str) -> None:
        """Print one sentence."""
        print_prose(sentence, self._console, "yellow")


def _options_of(file: str) -> list[str]:
    """Return a TOML file's content, long names of options with their values, as options."""
    content = read_toml(Path(file), UsageError)
    return [option for key, value in content.items() for option in _option(file, key, value)]


def _option(file: str, name: str, value: Any) -> list[str]:
    match value:
        case dict() if name == "param":
            return [f"--param={key}={json.dumps(v)}" for key, v in value.items()]
        case bool():
            return [f"--{name}"] if value else []
        case list() if all(isinstance(v, str | int) for v in value):
            return [f"--{name}={','.join(map(str, value))}"]
        case str() | int():
            return [f"--{name}={value}"]
    raise UsageError(f"configuration file {file!r}: {name} is {value!r}, which no option takes")
