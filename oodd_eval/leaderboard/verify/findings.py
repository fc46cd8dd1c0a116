"""What verification finds, each finding with the entry, the place and the field it is about."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field
from typing import Any, Final

LIMIT: Final = 200
"""Problems that are kept of one entry; more are counted."""

_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxlevel = 2


def shown(value: Any) -> str:
    r"""Return a value of a submission, shortened and safe to print on a terminal.

    Examples
    --------
    >>> print(shown("a\x1b[31m"))
    'a\x1b[31m'
    """
    return _SHORT.repr(value).encode("ascii", "backslashreplace").decode()


@dataclass(frozen=True, slots=True)
class Problem:
    """One reason to refuse an entry.

    Attributes
    ----------
    where
        File, with line and cell where there are any: ``records.jsonl:3 (mini/ant/iid::rf[…])``.
    field
        What is wrong there, such as ``metrics.auc.value``; empty for the file as a whole.
    message
        What was found and what was expected.
    """

    where: str
    field: str
    message: str

    @property
    def text(self) -> str:
        """The problem as one line."""
        return ": ".join(part for part in (self.where, self.field, self.message) if part)


@dataclass(slots=True)
class Findings:
    """Problems and notes of one entry, in the order in which they were found."""

    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    count: int = 0

    def refuse(self, where: str, what: str, message: str) -> None:
        """Add a problem; beyond `LIMIT` it is counted only."""
        self.count += 1
        if len(self.problems) < LIMIT:
            self.problems.append(Problem(where, what, message))

    def note(self, text: str) -> None:
        """Add a remark that refuses nothing."""
        self.notes.append(text)
