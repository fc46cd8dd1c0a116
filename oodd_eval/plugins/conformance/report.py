"""What checks came to, and how it is printed."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from oodd_eval.errors import UnknownNameError

STATUSES: Final = {
    "passed": "passed",
    "failed": "failed",
    "skipped": "skipped",
    "xfailed": "failed as expected",
    "xpassed": "passed unexpectedly",
}
"""Statuses and what the summary calls them; failed and xpassed are not all right."""

_COLUMNS: Final = 80

_SHOWN: Final = {"passed": "passed", "failed": "FAILED", "skipped": "skipped",
                 "xfailed": "xfailed", "xpassed": "XPASSED"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Result:
    """What one check came to.

    Attributes
    ----------
    name
        Of the check.
    status
        One of `STATUSES`.
    message
        Why it failed or was skipped; empty when it passed.
    seconds
        Wall-clock time; the first check that needs it has the shared fit in its time.
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
        """Whether it is as it should be."""
        return self.status not in {"failed", "xpassed"}

    def line(self, width: int = 0) -> str:
        """Return status, name and message: in one line, or below where there is no room for it."""
        start = f"{_SHOWN[self.status]:<8} {self.name:<{width}}"
        if not self.message:
            return start.rstrip()
        if len(start) + 2 + len(self.message) <= _COLUMNS:
            return f"{start}  {self.message}"
        margin = " " * 9
        below = textwrap.fill(
            self.message,
            _COLUMNS,
            initial_indent=margin,
            subsequent_indent=margin,
            break_on_hyphens=False,
        )
        return f"{start.rstrip()}\n{below}"


@dataclass(frozen=True, slots=True)
class Report:
    """What the checks of one detector came to; printing it gives a line per check and a summary.

    Attributes
    ----------
    results
        In the order of the checks.
    """

    results: Sequence[Result] = field(default_factory=tuple)

    @property
    def ok(self) -> bool:
        """Whether no check failed, and none passed that was expected to fail."""
        return all(result.ok for result in self.results)

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
        """Return a line per check and the summary."""
        width = max((len(result.name) for result in self.results), default=0)
        return "\n".join([*(result.line(width) for result in self.results), self.summary()])


def expected(result: Result, expected_failures: Mapping[str, str]) -> Result:
    """Return the result in the light of the failures that are expected, by name, with reasons."""
    reason = expected_failures.get(result.name)
    if reason is None:
        return result
    if result.status == "failed":
        return replace(result, status="xfailed", message=f"{reason} [{result.message}]")
    if result.status == "passed":
        message = f"expected to fail ({reason}): take it from the expected failures"
        return replace(result, status="xpassed", message=message)
    return result


def check_names(given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names of checks that do not exist.

    Raises
    ------
    UnknownNameError
        Naming the first one, and the nearest that exists.
    """
    names = list(known)
    for name in given:
        if name not in names:
            raise UnknownNameError("check", name, names)
