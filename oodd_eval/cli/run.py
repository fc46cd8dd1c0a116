"""``oodd-eval run``: plan, run, report."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from oodd_eval.cli.discovery import discovered, report_broken
from oodd_eval.cli.terminal import TerminalReporter, make_console
from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import expression, memory_bytes, seconds, select, whole_numbers
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.tables import markdown
from oodd_eval.scoring.plan import Plan, Unit, make_plan
from oodd_eval.scoring.runner import Run, Settings
from oodd_eval.scoring.runner import run as carry_out

DEVICES: Final = ("auto", "cpu", "cuda")


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval run`` and return its exit code."""
    settings = _settings(options)
    plugins = discovered(options.plugins)
    report_broken(plugins)
    split = load_split(options.split)
    plan = _plan(options, plugins, split)
    if not plan.cells:
        print(f"oodd-eval: no cell matches -k {options.expression!r}", file=sys.stderr)  # noqa: T201
        return 5
    console = make_console()
    if options.collect_only:
        if options.verbosity >= 0:
            console.print("\n".join(plan.cells))
        console.print(f"{len(plan.cells)} cells in {len(plan.units)} fits")
        return 0
    results = ResultsDirectory(options.output)
    reporter = TerminalReporter(console, verbosity=options.verbosity, intervals=options.intervals)
    plugins.observe(reporter, "terminal")
    done = carry_out(plan, split, plugins, settings, results)
    if done.records:
        report = markdown.render(results.records(), intervals=options.intervals)
        path = results.write_report(report)
        if options.verbosity >= 0:
            console.print(f"results in {results.path}, tables in {path}")
    return _exit_code(done, plugins)


def _exit_code(done: Run, plugins: Plugins) -> int:
    if done.interrupted:
        return 2
    return int(bool(plugins.broken) or not all(record.ok for record in done.records))


def _settings(options: argparse.Namespace) -> Settings:
    for name in ("detector", "env"):
        if getattr(options, name) is None:
            raise UsageError(f"--{name} is missing, on the command line and in --config")
    for name in ("jobs", "limit"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise UsageError(f"--{name} is {getattr(options, name)}, expected at least 1")
    return Settings(
        jobs=options.jobs,
        limits=Limits(seconds(options.timeout), memory_bytes(options.memory)),
        fresh=options.fresh,
        stop_on_failure=options.stop,
        executor=options.executor,
    )


def _plan(options: argparse.Namespace, plugins: Plugins, split: Split) -> Plan:
    plan = make_plan(
        plugins,
        split=split.name,
        split_digest=split.digest,
        detectors=plugins.select(options.detector),
        environments=select("environment", options.env, split.environments),
        anomalies=select("anomaly", options.anomaly, ANOMALIES),
        horizons=whole_numbers("--horizon", options.horizon, least=1),
        seeds=whole_numbers("--seed", options.seed, least=0),
        parameters=_parameters(options.param),
        limit=options.limit,
    )
    if options.device is not None:
        plan = _on_device(plan, options.device, plugins)
    return plan.matching(expression(options.expression)) if options.expression else plan


def _on_device(plan: Plan, device: str, plugins: Plugins) -> Plan:
    """Set the parameter ``device`` of those detectors that have it."""
    if device not in DEVICES:
        raise UsageError(f"--device is {device!r}, expected one of {', '.join(DEVICES)}")
    units = [_placed(unit, device, plugins) for unit in plan.units]
    if units and not any("device" in unit.parameters for unit in units):
        names = ", ".join(dict.fromkeys(unit.detector for unit in units))
        raise UsageError(f"--device {device}: none of the detectors has a device ({names})")
    return replace(plan, units=tuple(units))


def _placed(unit: Unit, device: str, plugins: Plugins) -> Unit:
    defaults = plugins.offer(unit.detector).spec.parameters
    if "device" not in defaults:
        return unit
    others = {name: value for name, value in unit.overrides.items() if name != "device"}
    changed = {} if device == defaults["device"] else {"device": device}
    return replace(
        unit, parameters={**unit.parameters, "device": device}, overrides={**others, **changed}
    )


def _parameters(given: Sequence[str]) -> dict[str, Any]:
    parameters = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise UsageError(f"--param {text!r}, expected NAME=VALUE")
        try:
            parameters[name] = json.loads(value)
        except json.JSONDecodeError:
            parameters[name] = value
    return parameters
