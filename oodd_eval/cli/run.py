"""``oodd-eval run``: fit and score every selected cell, print tables and write them."""

import argparse
import json
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

from oodd_eval import cli
from oodd_eval.cli import Parser
from oodd_eval.cli.terminal import TerminalReporter, discovered, make_console
from oodd_eval.data.files import write_text
from oodd_eval.data.split import load_split, split_places
from oodd_eval.errors import UsageError
from oodd_eval.names import expression, whole_numbers
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.sandbox import require_sandbox
from oodd_eval.results.directory import REPORT, ResultsDirectory
from oodd_eval.results.render import FORMATS
from oodd_eval.results.report import Report
from oodd_eval.scoring.executors import LOCAL, RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run as carry_out


def define(parser: Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.options(
        run,
        "run --detector rf --env all",
        "run --detector pe,rf --env hopper,ant --anomaly iid,gravity --jobs 2",
        "run --detector riqn --env hopper --param updates=500 --horizon 1,10 --output mine",
        plugins=True,
    )
    parser.set_defaults(options_of=options_of)
    add("--detector", metavar="NAMES", help=f"{cli.NAMES} (required)")
    add("--env", metavar="NAMES", help=f"{cli.NAMES} (required)")
    add("--anomaly", default="all", metavar="NAMES", help=f"{cli.NAMES} (default: all)")
    add("--split", default="mini", help="name or path of a split (default: mini)")
    cli.add_detector(add)
    add("--seed", default="0", metavar="N,...", type=cli.value(partial(whole_numbers, least=0)),
        help="seeds of the detectors (default: 0)")
    add("-k", dest="expression", default="", metavar="EXPR", help=cli.EXPRESSION)
    add("--collect-only", action="store_true", help="print the selected cells and do nothing")
    add("-x", dest="stop", action="store_true", help="stop at the first failure")
    add("--limit", type=cli.at_least(1), metavar="N",
        help="use the first N trajectories of each part")
    cli.add_resources(add, timeout="30m")
    add("--executor", default="local", metavar="local|dask://HOST:PORT",
        help="where fits are carried out: here, or on a Dask cluster (default: local)")
    add("--sandbox", action="store_true",
        help="run detectors in bubblewrap: no network, no view of splits, results or the home")
    add("--fresh", action="store_true", help="fit again what the results directory has already")
    add("--intervals", action="store_true", help="print 95 %% intervals in the tables")
    add("--config", metavar="FILE", help="TOML file with these options by their long names")
    add("--output", default="oodd-results", metavar="DIR",
        help="results directory (default: oodd-results)")
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval run`` and return its exit code."""
    for name in ("detector", "env"):
        if getattr(options, name) is None:
            raise UsageError(f"--{name} is missing, on the command line and in --config")
    plugins = discovered(options)
    split = load_split(options.split)
    environments, anomalies = split.select(options.env, options.anomaly)
    plan = make_plan(
        plugins,
        split=split,
        detectors=plugins.select(options.detector),
        environments=environments,
        anomalies=anomalies,
        horizons=options.horizon,
        seeds=options.seed,
        parameters=dict(options.param),
        device=options.device,
        limit=options.limit,
    )
    plan = plan.matching(expression(options.expression))
    if not plan.cells:
        return cli.say(f"no cell matches -k {options.expression!r}", 5)
    console = make_console()
    if options.collect_only:
        if options.verbosity >= 0:
            console.print("\n".join(map(str, plan.cells)))
        console.print(f"{len(plan.cells)} cells in {len(plan.units)} fits")
        return 0
    hidden = None
    if options.sandbox:
        if options.executor != LOCAL:
            raise UsageError("--sandbox is for workers of this machine, without --executor")
        require_sandbox()
        hidden = (*split_places(split), options.output)
    limits = Limits(options.timeout, options.memory, hidden)
    settings = RunSettings(
        jobs=options.jobs,
        limits=limits,
        fresh=options.fresh,
        stop_on_failure=options.stop,
        executor=options.executor,
        command=options.invocation,
    )
    results = ResultsDirectory(options.output)
    reporter = TerminalReporter(
        console, verbosity=options.verbosity, intervals=options.intervals, log=results.log_path
    )
    done = carry_out(plan, split, plugins, settings, results, observers=[reporter])
    cli.say_notes(results.notes)
    if done.records:
        report = Report(results.records(), intervals=options.intervals)
        path = results.path / REPORT
        write_text(path, FORMATS["markdown"].render(report))
        if options.verbosity >= 0:
            console.print(f"results in {results.path}, tables in {path}")
    if done.interrupted:
        return 2
    return int(bool(plugins.broken) or not all(record.ok for record in done.records))


def options_of(file: str) -> list[str]:
    """Return a TOML file's content, long names of options with their values, as options."""
    try:
        content = tomllib.loads(Path(file).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"configuration file {file!r} cannot be read: {error}") from None
    return [option for key, given in content.items() for option in _options(file, key, given)]


def _options(file: str, name: str, given: Any) -> list[str]:
    match given:
        case dict() if name == "param":
            return [f"--param={key}={json.dumps(v)}" for key, v in given.items()]
        case bool():
            return [f"--{name}"] if given else []
        case list() if all(isinstance(v, str | int) for v in given):
            return [f"--{name}={','.join(map(str, given))}"]
        case str() | int():
            return [f"--{name}={given}"]
    raise UsageError(f"configuration file {file!r}: {name} is {given!r}, which no option takes")
