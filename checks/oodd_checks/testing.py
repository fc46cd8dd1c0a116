"""Check that a detector honours the contract: each check is a test of its own in pytest.

::

    from oodd_checks.testing import *

    @pytest.fixture(scope="module")
    def detector():
        return make_mine

In a script, all at once: ``check_detector(make_mine)``. On the command line, in a process of its
own, so that a crash is reported too: ``oodd-eval check mine``.
"""

from collections.abc import Mapping
from typing import Any

from oodd_checks.conformance import CheckReport, Result
from oodd_eval.errors import ContractError, MissingExtraError
from oodd_eval.names import check_known

try:
    from oodd_checks.conformance.trial import Factory, Trial, shared_trial, trial
except ModuleNotFoundError as missing:
    raise MissingExtraError(
        f"checks of detectors need pytest ({missing}): pip install 'oodd-eval[check]'"
    ) from missing

from oodd_checks.conformance.session import CHECKS, run_tests, supervise

globals().update({check.__name__: check for check in CHECKS.values()})

__all__ = [
    "CHECKS",
    "CheckReport",
    "NonConformingError",
    "Result",
    "Trial",
    "check_detector",
    "run_checks",
    "shared_trial",
    "supervise",
    "trial",
]
__all__ += [check.__name__ for check in CHECKS.values()]


class NonConformingError(ContractError, AssertionError):
    """A detector failed checks; the message has a line for each of them.

    Parameters
    ----------
    report
        The results of all checks.
    """

    def __init__(self, report: CheckReport) -> None:
        lines = [result.line() for result in report.failed]
        super().__init__("\n".join([report.summary(), *lines]))
        self.report = report


def run_checks(
    factory: Factory, *, expected_failures: Mapping[str, str] | None = None, **arguments: Any
) -> CheckReport:
    """Carry out all checks in this process and return what they came to.

    Parameters
    ----------
    factory
        A detector's class or function, an unfitted one, or better its `DetectorSpec`, which tells
        the declared parameters too.
    expected_failures
        Names of checks that are known to fail, with the reason; one that passes is not all right.
    arguments
        ``horizon`` (1), ``seed`` (0) and ``parameters`` that the factory is called with, without
        the first two where it does not take them.

    Returns
    -------
    CheckReport
        The result of every check, in the order in which they run.

    Raises
    ------
    UnknownNameError
        When there is no check of a name among the expected failures.
    """
    failures = dict(expected_failures or {})
    check_known("check", CHECKS, *failures)
    results: list[Result] = []
    run_tests(Trial(factory, **arguments), results.append)
    return CheckReport([result.expected(failures) for result in results])


def check_detector(
    factory: Factory, *, expected_failures: Mapping[str, str] | None = None, **arguments: Any
) -> CheckReport:
    """Do what `run_checks` does, and print it.

    Parameters
    ----------
    factory, expected_failures, arguments
        As in `run_checks`.

    Returns
    -------
    CheckReport
        The result of every check, as in `run_checks`.

    Raises
    ------
    NonConformingError
        When a check fails, or one passes that is expected to fail.

    Examples
    --------
    >>> from oodd_trivial import Clock
    >>> failures = {"gross-anomaly": "knows only the time"}
    >>> check_detector(Clock, expected_failures=failures).ok  # doctest: +ELLIPSIS
    passed   factory...
    True
    """
    report = run_checks(factory, expected_failures=expected_failures, **arguments)
    print(report)  # noqa: T201  what it is for
    if not report.ok:
        raise NonConformingError(report)
    return report
