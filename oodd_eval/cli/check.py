"""``oodd-eval check``: check a detector, or an environment or anomaly of a plug-in."""

import time
from typing import Final

import click

from oodd_eval.cli import (
    Converted,
    Name,
    Options,
    command,
    detector_options,
    limit_options,
    load,
    say,
)
from oodd_eval.cli.terminal import discovered, know_own, make_console
from oodd_eval.data.own import AnomalySpec, EnvironmentSpec
from oodd_eval.errors import UnknownNameError
from oodd_eval.names import Predicate, assignment, check_known, expression
from oodd_eval.plugins.conformance import CHECKS, Report, Result, expected
from oodd_eval.plugins.conformance.supervise import supervise
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.parameters import resolve_parameters

_STYLES: Final = {
    "passed": "green",
    "failed": "bold red",
    "skipped": "dim",
    "xfailed": "yellow",
    "xpassed": "bold red",
}


@command("check rf", "check mine -k 'prefix or causality' -v", plugins=True)
@click.argument(
    "detector",
    type=Name("detectors", "envs", "anomalies"),
    help="a detector, or an environment or anomaly of a plug-in",
)
@click.option(
    "--env", type=Name("envs"), help="where to try an anomaly (default: one that it is for)"
)
@detector_options
@click.option("--seed", type=click.IntRange(min=0), default=0, help="seed of a detector")
@click.option(
    "-k",
    "expression",
    metavar="EXPR",
    help="only checks whose name matches, such as 'files or network'",
)
@click.option(
    "--expect",
    multiple=True,
    type=Converted(assignment, "NAME=REASON"),
    help="a check that is known to fail, and why; if it passes, that is a failure",
)
@limit_options("a check", "10m")
def check(options: Options) -> int:
    """Check that a detector honours the contract, or an environment or anomaly of a plug-in.

    The exit code is 1 when a check failed, and 5 when none ran.
    """
    limits = Limits(options.timeout, options.memory)
    expecting, parameters = dict(options.expect), dict(options.param)
    wanted = expression(options.expression) if options.expression else lambda _: True
    plugins = discovered(options)
    try:
        offer = plugins.offer(options.detector)
    except UnknownNameError:
        if options.detector in plugins.own_specs:
            return _own(options, wanted)
        raise
    offer.require()
    spec = offer.spec
    check_known("check", CHECKS, *expecting)
    resolve_parameters(spec.name, spec.parameters, parameters, others=spec.other_parameters)
    names = [name for name in CHECKS if wanted(name)]
    if not names:
        return say(f"no check matches -k {options.expression!r}", 5)
    console, good = make_console(), True
    for horizon in options.horizon:
        arguments = {"horizon": horizon, "seed": options.seed, "parameters": parameters}
        if options.verbosity >= 0:
            told = {"horizon": horizon, "seed": options.seed, **parameters}.items()
            settings = ", ".join(f"{name} {value}" for name, value in told)
            console.print(f"{spec.name} of {offer.origin}, {settings}")
        results = []
        for found in supervise(offer, arguments, names, limits):
            result = expected(found, expecting)
            results.append(result)
            if options.verbosity >= 0 or not result.ok:
                console.print(result.line(max(map(len, names))), style=_STYLES[result.status])
            if options.verbosity > 0 and result.detail:
                console.print(result.detail.rstrip())
        report = Report(results)
        console.print(report.summary(), style="green" if report.ok else "bold red")
        good = good and report.ok
    return 0 if good else 1


def _own(options: Options, wanted: Predicate) -> int:
    """Check an environment or an anomaly of a plug-in; 1 when a check failed."""
    specs = {spec.name: spec for spec in know_own(options)}
    spec, environment = specs[options.detector], options.detector
    if isinstance(spec, AnomalySpec):
        others = (s.name for s in specs.values() if isinstance(s, EnvironmentSpec))
        environment = options.env or next(iter([*spec.environments, *others, "cartpole"]))
    console, results = make_console(), []
    console.print(f"{spec.name} in {environment}" if spec.name != environment else spec.name)
    for name, carry_out in load("oodd_recording.checks:check_own")(spec, environment):
        if wanted(name):
            start = time.perf_counter()
            wrong = carry_out()
            took = time.perf_counter() - start
            results.append(Result(name, "failed" if wrong else "passed", wrong, took))
            if options.verbosity >= 0 or wrong:
                console.print(results[-1].line(13), style=_STYLES[results[-1].status])
    report = Report(results)
    if not results:
        return say(f"no check matches -k {options.expression!r}", 5)
    console.print(report.summary(), style="green" if report.ok else "bold red")
    return 0 if report.ok else 1
