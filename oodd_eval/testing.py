"""Check that a detector honours the contract: each check is a test of its own in pytest.

::

    from oodd_eval.testing import pytest_generate_tests, test_contract

    @pytest.fixture(scope="module")
    def detector():
        return make_mine

In a script, all at once: ``check_detector(make_mine)``. On the command line, in a process of its
own, so that a crash is reported too: ``oodd-eval check mine``.
"""

from collections.abc import Mapping
from typing import Any

from oodd_eval.errors import ContractError
from oodd_eval.names import check_known
from oodd_eval.plugins.conformance import CHECKS, Check, Report, Result, carry_out, expected
from oodd_eval.plugins.conformance.trial import CheckFailedError, CheckSkipped, Factory, Trial

__all__ = [
    "Check",
    "CheckFailedError",
    "CheckSkipped",
    "NonConformingError",
    "Report",
    "Result",
    "Trial",
    "check_detector",
    "detector_checks",
    "pytest_generate_tests",
    "run_checks",
    "test_contract",
]


class NonConformingError(ContractError, AssertionError):
    """A detector failed checks; the message has a line for each of them.

    Parameters
    ----------
    report
        The results of all checks.
    """

    def __init__(self, report: Report) -> None:
        lines = [result.line() for result in report.failed]
        super().__init__("\n".join([report.summary(), *lines]))
        self.report = report


def detector_checks() -> list[Check]:
    """Return all checks, for ``pytest.mark.parametrize``.

    Returns
    -------
    list of Check
        In the order in which they run; each is called with a factory.
    """
    return list(CHECKS.values())


def test_contract(check: Check, detector: Factory | Trial) -> None:
    """Run one check on the factory that the fixture `detector` returns."""
    check(detector)


def pytest_generate_tests(metafunc: Any) -> None:
    """Give `test_contract` every check; pytest calls this in the modules that import it."""
    if metafunc.function is test_contract:
        metafunc.parametrize("check", detector_checks(), ids=str)


def run_checks(
    factory: Factory, *, expected_failures: Mapping[str, str] | None = None, **arguments: Any
) -> Report:
    """Carry out all checks in this process and return what they came to.

    Parameters
    ----------
    factory
        A detector's factory, or better its `DetectorSpec`, which tells the declared parameters too.
    expected_failures
        Names of checks that are known to fail, with the reason; one that passes is not all right.
    arguments
        ``horizon`` (1), ``seed`` (0) and ``parameters`` that the factory is called with.

    Returns
    -------
    Report
        The result of every check, in the order of `detector_checks`.

    Raises
    ------
    UnknownNameError
        When there is no check of a name among the expected failures.
    """
    check_known("check", CHECKS, *(expected_failures or {}))
    results = carry_out(Trial(factory, **arguments), CHECKS)
    return Report([expected(result, expected_failures or {}) for result in results])


def check_detector(
    factory: Factory, *, expected_failures: Mapping[str, str] | None = None, **arguments: Any
) -> Report:
    """Do what `run_checks` does, and print it.

    Parameters
    ----------
    factory, expected_failures, arguments
        As in `run_checks`.

    Returns
    -------
    Report
        The result of every check, as in `run_checks`.

    Raises
    ------
    NonConformingError
        When a check fails, or one passes that is expected to fail.

    Examples
    --------
    >>> from oodd_trivial import Clock
    >>> known = {"gross-anomaly": "knows only the time"}
    >>> check_detector(Clock, expected_failures=known).ok  # doctest: +ELLIPSIS
    passed   factory...
    True
    """
    report = run_checks(factory, expected_failures=expected_failures, **arguments)
    print(report)  # noqa: T201  what it is for
    if not report.ok:
        raise NonConformingError(report)
    return report
