"""Checks that a detector honours the contract. `oodd_eval.testing` is their public face."""

import textwrap
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from oodd_eval.plugins.conformance import checks_consistency, checks_contract, checks_process
from oodd_eval.plugins.conformance.trial import CheckFailedError, CheckSkipped, Factory, Trial
from oodd_eval.plugins.discovery import printable

STATUSES: Final = {
    "passed": "passed",
    "failed": "failed",
    "skipped": "skipped",
    "xfailed": "failed as expected",
    "xpassed": "passed unexpectedly",
}
"""Statuses and what the summary calls them; failed and xpassed are not all right."""

_COLUMNS: Final = 80


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one check.

    The status is ``"passed"``, ``"failed"``, ``"skipped"``, ``"xfailed"`` or ``"xpassed"``; the
    message says why; the detail is where a failing detector raised, or the end of what it printed
    before it crashed. The first check that needs the shared fit has it in its seconds.
    """

    name: str
    status: str
    message: str = ""
    seconds: float = 0.0
    detail: str = ""

    @property
    def ok(self) -> bool:
        """True if it is as expected."""
        return self.status not in {"failed", "xpassed"}

    def line(self, width: int = 0) -> str:
        """Return status, name and message: in one line, or below where there is no room for it."""
        shown = self.status if self.ok else self.status.upper()
        start = f"{shown:<8} {self.name:<{width}}"
        if len(start) + 2 + len(self.message) <= _COLUMNS:
            return f"{start}  {self.message}".rstrip()
        below = textwrap.wrap(self.message, _COLUMNS - 9, break_on_hyphens=False)
        return "\n".join([start.rstrip(), *(f"{'':9}{line}" for line in below)])


@dataclass(frozen=True, slots=True)
class Report:
    """Results of the checks of one detector; printing it gives a line per check and a summary."""

    results: Sequence[Result] = ()

    @property
    def ok(self) -> bool:
        """True if no check failed, and none passed that was expected to fail."""
        return not self.failed

    @property
    def failed(self) -> list[Result]:
        """The results that are not as they should be."""
        return [result for result in self.results if not result.ok]

    def summary(self) -> str:
        """Return one line: how many checks there were, and how many came to what."""
        counts = Counter(result.status for result in self.results)
        parts = [f"{counts[s]} {meaning}" for s, meaning in STATUSES.items() if counts[s]]
        seconds = sum(result.seconds for result in self.results)
        checks = "check" if len(self.results) == 1 else "checks"
        return f"{len(self.results)} {checks}: {', '.join(parts) or 'none ran'} in {seconds:.1f} s"

    def __str__(self) -> str:
        width = max((len(result.name) for result in self.results), default=0)
        return "\n".join([*(result.line(width) for result in self.results), self.summary()])


@dataclass(frozen=True, slots=True)
class Check:
    """One named check; the summary says what holds when it passes."""

    name: str
    summary: str
    function: Callable[[Trial], None]

    def __call__(self, detector: Factory | Trial, **arguments: Any) -> None:
        """Return if the detector passes; raise `CheckFailedError` or `CheckSkipped` if not.

        It is given as what `Trial` takes, or as a `Trial`. The next check of the same shares the
        fit.
        """
        if isinstance(detector, Trial):
            return detector.carry_out(self.function)
        if not _latest or _latest[0] != (detector, arguments):
            _latest[:] = [(detector, arguments), Trial(detector, **arguments)]
        return self(_latest[1])

    def __str__(self) -> str:
        """Return the name: the ids of parametrized tests."""
        return self.name


_latest: list[Any] = []  # arguments and trial of the last check of a factory

CHECKS: Final = {
    (name := function.__name__.removeprefix("check_").replace("_", "-")): Check(
        name, (function.__doc__ or "").removesuffix("."), function
    )
    for module in (checks_contract, checks_consistency, checks_process)
    for function in vars(module).values()
    if getattr(function, "__name__", "").startswith("check_")
}
"""The checks by name, in the order in which they are carried out; a docstring says what holds."""


def carry_out(trial: Trial, checks: Iterable[str]) -> Iterator[Result]:
    """Carry out the named checks of one detector, each when its result is asked for."""
    for name in checks:
        start = time.perf_counter()
        status, message, detail = "passed", "", ""
        try:
            CHECKS[name](trial)
        except CheckFailedError as error:
            status, message = "failed", printable(str(error))
            if error.__cause__:
                lines = "".join(traceback.format_exception(error.__cause__)).splitlines()
                detail = "\n".join(printable(line) for line in lines)
        except CheckSkipped as skip:
            status, message = "skipped", str(skip)
        yield Result(name, status, message, time.perf_counter() - start, detail)


def expected(result: Result, expected_failures: Mapping[str, str]) -> Result:
    """Return the result in the light of the failures that are expected, by name, with reasons."""
    reason = expected_failures.get(result.name)
    if reason is not None and result.status == "failed":
        return replace(result, status="xfailed", message=f"{reason} [{result.message}]")
    if reason is not None and result.status == "passed":
        message = f"expected to fail ({reason}): take it from the expected failures"
        return replace(result, status="xpassed", message=message)
    return result
