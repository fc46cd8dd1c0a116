"""Tests that a detector honours the contract, in pytest, and what they came to.

The module `test_detector` holds the tests; `oodd_checks.testing` is their public face.
"""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from oodd_eval.names import counted

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

    Attributes
    ----------
    name
        The check's.
    status
        ``"passed"``, ``"failed"``, ``"skipped"``, ``"xfailed"`` or ``"xpassed"``.
    message
        Why it is so; empty for a check that passed.
    seconds
        What the check took. The first one that needs the shared fit has it in its seconds.
    detail
        Where a failing detector raised, or the end of what it printed before it crashed.
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

    def expected(self, failures: Mapping[str, str]) -> "Result":
        """Return what the result is where failures are expected: their reasons, by name."""
        reason = failures.get(self.name)
        if reason is not None and self.status == "failed":
            return replace(self, status="xfailed", message=f"{reason} [{self.message}]")
        if reason is not None and self.status == "passed":
            message = f"expected to fail ({reason}): remove it from expected_failures"
            return replace(self, status="xpassed", message=message)
        return self

    def line(self, width: int = 0) -> str:
        """Return status, name and message: in one line, or below where there is no room for it."""
        status = self.status if self.ok else self.status.upper()
        start = f"{status:<8} {self.name:<{width}}"
        if len(start) + 2 + len(self.message) <= _COLUMNS:
            return f"{start}  {self.message}".rstrip()
        below = textwrap.wrap(self.message, _COLUMNS - 9, break_on_hyphens=False)
        return "\n".join([start.rstrip(), *(f"{'':9}{line}" for line in below)])


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Results of the checks of one detector; printing it gives a line per check and a summary.

    Parameters
    ----------
    results
        The result of every check, in the order in which they ran.
    """

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
        """Return one line: how many checks there were, and how many came to what.

        Returns
        -------
        str
            Such as ``"28 checks: 25 passed, 3 skipped in 0.4 s"``.
        """
        counts = Counter(result.status for result in self.results)
        parts = [f"{counts[s]} {meaning}" for s, meaning in STATUSES.items() if counts[s]]
        seconds = sum(result.seconds for result in self.results)
        checks = counted(len(self.results), "check(s)")
        return f"{checks}: {', '.join(parts) or 'none ran'} in {seconds:.1f} s"

    def __str__(self) -> str:
        width = max((len(result.name) for result in self.results), default=0)
        return "\n".join([*(result.line(width) for result in self.results), self.summary()])
