"""``oodd-eval check``: checks of a detector, an environment or an anomaly, told one by one."""

import argparse
import time
from typing import Final

from oodd_eval.cli import Parser, add_detector, add_limits, at_least, say, value
from oodd_eval.cli.terminal import discovered, know_own, make_console
from oodd_eval.data.own import AnomalySpec, EnvironmentSpec
from oodd_eval.errors import UnknownNameError
from oodd_eval.names import Predicate, assignment, check_known, expression
from oodd_eval.plugins.conformance import Report, Result
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.parameters import resolve_parameters

_STYLES: Final = {
    "passed": "green",
    "failed": "bold red",
    "skipped": "dim",
    "xfailed": "yellow",
    "xpassed": "bold red",
}


def define(parser: Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.options(
        run, "check rf", "check mine -k 'prefix or causality' -v", plugins=True
    )
    add("detector", metavar="NAME", help="a detector, or an environment or anomaly of a plug-in")
    add("--env", metavar="NAME", help="where to try an anomaly (default: one that it is for)")
    add_detector(add)
    add("--seed", type=at_least(0), default=0, metavar="N", help="seed of a detector (default: 0)")
    add("-k", dest="expression", metavar="EXPR",
        help="only checks whose name matches, such as 'files or network'")
    add("--expect", action="append", default=[], metavar="NAME=REASON", type=value(assignment),
        help="a check that is known to fail, and why; if it passes, that is a failure")
    add_limits(add, "a check", "10m")
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval check``: 1 when a check failed, 5 when none ran, else 0."""
    from oodd_eval.testing import CHECKS, supervise

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
            values = {"horizon": horizon, "seed": options.seed, **parameters}.items()
            settings = ", ".join(f"{name} {value}" for name, value in values)
            console.print(f"{spec.name} of {offer.origin}, {settings}")
        results = []
        for outcome in supervise(offer, arguments, names, limits):
            result = outcome.expected(expecting)
            results.append(result)
            if options.verbosity >= 0 or not result.ok:
                console.print(result.line(max(map(len, names))), style=_STYLES[result.status])
            if options.verbosity > 0 and result.detail:
                console.print(result.detail.rstrip())
        report = Report(results)
        console.print(report.summary(), style="green" if report.ok else "bold red")
        good = good and report.ok
    return 0 if good else 1


def _own(options: argparse.Namespace, wanted: Predicate) -> int:
    """Check an environment or an anomaly of a plug-in; 1 when a check failed."""
    from oodd_recording.checks import check_own

    specs = {spec.name: spec for spec in know_own(options)}
    spec, environment = specs[options.detector], options.detector
    if isinstance(spec, AnomalySpec):
        others = (s.name for s in specs.values() if isinstance(s, EnvironmentSpec))
        environment = options.env or next(iter([*spec.environments, *others, "cartpole"]))
    console, results = make_console(), []
    console.print(f"{spec.name} in {environment}" if spec.name != environment else spec.name)
    for name, carry_out in check_own(spec, environment):
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
