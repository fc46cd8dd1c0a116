"""Check that a detector honours the contract: in Python, in pytest, on the command line.

In a test of a plug-in, each check is a test of its own::

    import pytest
    from oodd_eval.plugins.conformance import detector_checks
    from oodd_mine import make_mine

    @pytest.mark.parametrize("check", detector_checks(), ids=str)
    def test_contract(check):
        check(make_mine)

In a script, all at once: ``check_detector(make_mine)``. On the command line, in a process of its
own, so that a crash is reported too: ``oodd-eval check mine``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from oodd_eval.errors import ContractError
from oodd_eval.plugins.conformance.bench import (
    Bench,
    CheckFailedError,
    CheckSkipped,
    Factory,
    Subject,
)
from oodd_eval.plugins.conformance.checks import CHECKS, carry_out
from oodd_eval.plugins.conformance.kit import Check
from oodd_eval.plugins.conformance.report import Report, Result, check_names, expected

__all__ = [
    "Check",
    "CheckFailedError",
    "CheckSkipped",
    "NonConformingError",
    "Report",
    "Result",
    "check_detector",
    "detector_checks",
    "run_checks",
]


class NonConformingError(ContractError, AssertionError):
    """A detector failed checks; the message has a line for each, `report` has all results."""

    def __init__(self, report: Report) -> None:
        lines = [result.line() for result in report.failed]
        super().__init__("\n".join([report.summary(), *lines]))
        self.report = report


def detector_checks() -> list[Check]:
    """Return all checks, for ``pytest.mark.parametrize``; each is called with a factory."""
    return list(CHECKS.values())


def run_checks(
    factory: Factory,
    *,
    horizon: int = 1,
    seed: int = 0,
    parameters: Mapping[str, Any] | None = None,
    expected_failures: Mapping[str, str] | None = None,
) -> Report:
    """Carry out all checks in this process and return what they came to.

    Parameters
    ----------
    factory
        Called as ``factory(seed=..., horizon=..., **parameters)``; a `DetectorSpec` tells its
        declared parameters too.
    horizon, seed, parameters
        What the factory is called with.
    expected_failures
        Names of checks that are known to fail, with the reason. One that passes nevertheless is
        not all right: the list has to be kept true.

    Raises
    ------
    UnknownNameError
        When an expected failure names no check.
    """
    expecting = dict(expected_failures or {})
    check_names(expecting, CHECKS)
    bench = Bench(Subject.of(factory, horizon=horizon, seed=seed, parameters=parameters))
    return Report([expected(result, expecting) for result in carry_out(bench, CHECKS.values())])


def check_detector(
    factory: Factory,
    *,
    horizon: int = 1,
    seed: int = 0,
    parameters: Mapping[str, Any] | None = None,
    expected_failures: Mapping[str, str] | None = None,
) -> Report:
    """Check that a detector honours the contract, and print what each check came to.

    Parameters
    ----------
    factory, horizon, seed, parameters, expected_failures
        As for `run_checks`.

    Returns
    -------
    Report
        How many checks passed, were skipped or failed as expected, with messages.

    Raises
    ------
    NonConformingError
        When a check failed, or passed although it was expected to fail.

    Examples
    --------
    >>> from oodd_eval.plugins.baselines import Clock
    >>> report = check_detector(
    ...     Clock, expected_failures={"gross-anomaly": "knows only the time"}
    ... )  # doctest: +ELLIPSIS
    passed   factory...
    >>> report.ok
    True
    """
    report = run_checks(
        factory,
        horizon=horizon,
        seed=seed,
        parameters=parameters,
        expected_failures=expected_failures,
    )
    print(report)  # noqa: T201  what it is for
    if not report.ok:
        raise NonConformingError(report)
    return report
