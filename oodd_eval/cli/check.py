"""``oodd-eval check``: the conformance checks of one detector, each reported when it is done."""

from __future__ import annotations

import argparse
import sys
from typing import Final

from rich.console import Console

from oodd_eval.cli.discovery import discovered, report_broken
from oodd_eval.cli.terminal import make_console
from oodd_eval.errors import UsageError
from oodd_eval.names import (
    assignments,
    expression,
    memory_bytes,
    parameters,
    seconds,
    whole_numbers,
)
from oodd_eval.plugins.conformance.checks import CHECKS
from oodd_eval.plugins.conformance.report import Report, Result, check_names, expected
from oodd_eval.plugins.conformance.supervise import CheckLimits, CheckRequest, supervise
from oodd_eval.plugins.discovery import Offer, resolve_parameters

_STYLES: Final = {"passed": "green", "failed": "bold red", "skipped": "dim",
                  "xfailed": "yellow", "xpassed": "bold red"}  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval check``: 0 when all is right, 1 when a check failed, 5 when none ran.

    Raises
    ------
    UsageError
        For an unknown detector, parameter or check, or a value that cannot be read.
    MissingExtraError
        When the detector needs something that is not installed.
    """
    if options.seed < 0:
        raise UsageError(f"--seed is {options.seed}, expected at least 0")
    horizons = whole_numbers("--horizon", options.horizon, least=1)
    limits = CheckLimits(seconds(options.timeout), memory_bytes(options.memory))
    expecting = assignments("--expect", options.expect)
    check_names(expecting, CHECKS)
    plugins = discovered(options.plugins)
    report_broken(plugins)
    offer = plugins.offer(options.detector)
    offer.require()
    given = parameters(options.param)
    resolve_parameters(offer.spec, given)

    wanted = expression(options.expression) if options.expression else lambda _: True
    names = [name for name in CHECKS if wanted(name)]
    if not names:
        print(f"oodd-eval: no check matches -k {options.expression!r}", file=sys.stderr)  # noqa: T201
        return 5
    console, good = make_console(), True
    for horizon in horizons:
        request = CheckRequest(offer.plugin, offer.spec.name, given, horizon, options.seed, names)
        if options.verbosity >= 0:
            console.print(_header(offer, request))
        results = []
        for found in supervise(request, limits):
            results.append(expected(found, expecting))
            _print(console, results[-1], options.verbosity, max(map(len, names)))
        report = Report(results)
        console.print(report.summary(), style="green" if report.ok else "bold red")
        good = good and report.ok
    return 0 if good else 1


def _header(offer: Offer, request: CheckRequest) -> str:
    settings = {"horizon": request.horizon, "seed": request.seed, **request.parameters}
    told = ", ".join(f"{name} {value}" for name, value in settings.items())
    return f"{request.detector} of {offer.origin}, {told}"


def _print(console: Console, result: Result, verbosity: int, width: int) -> None:
    """Print a result: failures only when quiet, with what lies behind them when verbose."""
    if verbosity < 0 and result.ok:
        return
    console.print(result.line(width), style=_STYLES[result.status])
    if verbosity > 0 and result.detail:
        console.print(result.detail.rstrip())
