"""``oodd-eval check``: check a detector, or an environment or anomaly of a plug-in."""

from typing import Final

import click

from oodd_checks.conformance import CheckReport
from oodd_eval.cli import (
    Converted,
    Name,
    Options,
    command,
    detector_options,
    limit_options,
    load,
    refuse,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.data.registry import long_name
from oodd_eval.errors import UnknownNameError
from oodd_eval.names import assignment, check_known, expression
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.parameters import parameters_by_detector, resolve_parameters

_EXPECTED: Final = Converted(assignment, "NAME=REASON")
_OF_DETECTORS: Final = ("param", "horizon", "seed", "expect", "timeout", "memory")
STYLES: Final = {
    "passed": "green",
    "failed": "bold red",
    "skipped": "dim",
    "xfailed": "yellow",
    "xpassed": "bold red",
}


@command("check rf", "check mine -k 'prefix or explain' -v", plugins=True)
@click.argument(
    "name",
    type=Name("detectors", "envs", "anomalies"),
    help="a detector, or a plug-in's environment or anomaly, as PLUGIN/NAME where several have it",
)
@click.option(
    "--env", type=Name("envs"), help="where to try an anomaly (default: one that it is for)"
)
@detector_options
@click.option("--seed", type=click.IntRange(min=0), default=0, help="seed of a detector")
@click.option("-k", "expression", metavar="EXPR", help="only checks whose name matches")
@click.option("--expect", multiple=True, type=_EXPECTED, help="a check that must fail, and why")
@limit_options("a check", "10m")
def check(options: Options) -> int:
    """Check that a detector honours the contract, or an environment or anomaly of a plug-in.

    The exit code is 1 when a check failed or a plug-in is broken, and 5 when none ran.
    """
    from oodd_checks.testing import CHECKS, supervise

    limits = Limits(options.timeout, options.memory)
    expecting = dict(options.expect)
    selects = expression(options.expression)
    plugins = discovered(options)
    try:
        offer = plugins.offer(options.name)
    except UnknownNameError as unknown:
        offered = plugins.custom_specs
        if not (meanings := offered.meanings(options.name)):
            names = [name for spec in offered.specs for name in (spec.name, long_name(spec))]
            kinds = "detector, environment or anomaly of a plug-in"
            raise UnknownNameError(kinds, options.name, [*unknown.known, *names]) from None
        refuse(options, _OF_DETECTORS, f"is for detectors, and {options.name} is none")
        check_custom = load("oodd_recording.commands:check_custom")
        return int(check_custom(options, selects, *meanings, offered) or bool(plugins.broken))
    refuse(options, ["env"], f"is for anomalies, and {options.name} is a detector")
    parameters = parameters_by_detector([offer.spec.name], dict(options.param))[offer.spec.name]
    # The episodes of checks have actions.
    offer, parameters = plugins.taking_actions(offer, parameters)
    offer.require()
    spec = offer.spec
    check_known("check", CHECKS, *expecting)
    resolve_parameters(spec.name, spec.parameters, parameters, others=spec.other_parameters)
    names = [name for name in CHECKS if selects(name)]
    if not names:
        return say(f"no check matches -k {options.expression!r}", 5)
    console, good = make_console(), True
    for horizon in options.horizon:
        arguments = {"horizon": horizon, "seed": options.seed, "parameters": parameters}
        if options.verbosity >= 0:
            settings = {"horizon": horizon, "seed": options.seed, **parameters}.items()
            text = ", ".join(f"{name} {value}" for name, value in settings)
            console.print(f"{spec.name} of {offer.origin}, {text}")
        results = []
        for outcome in supervise(offer, arguments, names, limits):
            result = outcome.expected(expecting)
            results.append(result)
            if options.verbosity >= 0 or not result.ok:
                console.print(result.line(max(map(len, names))), style=STYLES[result.status])
            if options.verbosity > 0 and result.detail:
                console.print(result.detail.rstrip())
        report = CheckReport(results)
        console.print(report.summary(), style="green" if report.ok else "bold red")
        good = good and report.ok
    return 0 if good and not plugins.broken else 1
