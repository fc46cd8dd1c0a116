"""Names and globs as recipes have them, and the errors for wrong values."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import UnknownNameError, UsageError


def wrong_value(key: str, value: Any, expected: str) -> UsageError:
    """Return the error for a value of a recipe: what it is, and what was expected."""
    return UsageError(f"{key} is {value!r:.100}, expected {expected}")


def read_text(key: str, value: Any) -> str:
    """Return a text in one line; `UsageError` for others."""
    if not isinstance(value, str) or not value.isprintable():
        raise wrong_value(key, value, "a text in one line")
    return value


def read_names(key: str, value: Any) -> tuple[str, ...]:
    """Return names or globs, of which a recipe has one or a list; `UsageError` for others."""
    values = value if isinstance(value, list | tuple) else [value]
    texts = tuple(read_text(key, text) for text in values)
    if "" in texts:
        raise wrong_value(key, value, "texts that are not empty")
    return texts


def matching(globs: Iterable[str], sensors: Sequence[Quantity], noun: str) -> list[int]:
    """Return the positions of the sensors that globs match.

    Raises
    ------
    UnknownNameError
        When a glob matches none; `noun` says what it should be.
    """
    names, positions = [sensor.name for sensor in sensors], set()
    for glob in globs:
        matches = map(pattern_of(glob.strip()).fullmatch, names)
        matched = {i for i, match in enumerate(matches) if match}
        if not matched:
            raise UnknownNameError(noun, glob, names)
        positions |= matched
    return sorted(positions)


def pattern_of(pattern: str) -> re.Pattern[str]:
    """Return the expression of a glob of names, in which brackets stand for themselves."""
    return re.compile(re.escape(pattern).replace(r"\*", ".*").replace(r"\?", "."))
