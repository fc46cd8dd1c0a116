"""What strangers' texts and records may hold.

Names become file names, links and table cells, so they are held to a safe alphabet. A text is one
line that can be printed, without ``<`` and ``>``: whatever shows it, it cannot become markup.
"""

import math
import re
import reprlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from oodd_eval.data.facts import GROUPS, NAME_PATTERN
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import NAMES, metric_info
from oodd_eval.results.record import Record

MOST_TEST: Final = 2_000  # trajectories: with more, intervals take too much room
LONGEST_TEXT: Final = 4000
LARGEST: Final = 2**53  # whole numbers beyond are not exact in a double
MOST_COST: Final = 1e9  # seconds (thirty years) or megabytes: nobody measured more

_DEEPEST: Final = 8  # levels of a JSON value
_MOST_ITEMS: Final = 2000  # of one of its lists and objects

_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxlevel = 2


def short(value: Any) -> str:
    """Return a stranger's value, shortened and safe to print on a terminal."""
    return _SHORT.repr(value).encode("ascii", "backslashreplace").decode()


def explained(error: ValidationError) -> str:
    """Return the first field of a file that is wrong, and what is wrong with it."""
    first = error.errors(include_url=False)[0]
    at = ".".join(short(str(part))[1:-1] for part in first["loc"])
    return f"{at}: {first['msg']}, got {short(first['input'])}"


class Rule(NamedTuple):
    """A predicate of a value, and what is expected in words."""

    holds: Callable[[Any], object]
    expected: str

    def complaint(self, value: object) -> str:
        """Return what is wrong with a value; empty if nothing is."""
        return "" if self.holds(value) else f"is {short(value)}, expected {self.expected}"


def _matching(pattern: str, expected: str) -> Rule:
    return Rule(re.compile(pattern, re.ASCII).fullmatch, expected)


def _is_text(value: str, longest: int = LONGEST_TEXT) -> bool:
    marked = any(mark in value for mark in ("<", ">", "]("))
    return len(value) <= longest and value.isprintable() and not marked


def text(longest: int) -> Rule:
    """Return the rule of one line of plain text."""
    expected = f"one line of plain text without markup, of at most {longest} characters"
    return Rule(lambda value: _is_text(value, longest), expected)


def _whole(least: int, largest: int) -> Rule:
    return Rule(lambda value: least <= value <= largest, f"a number from {least} to {largest}")


NAME: Final = _matching(
    r"(?!.*\.\.)[A-Za-z0-9][A-Za-z0-9._@+!:-]{0,159}",
    "a name of letters, digits, '.', '_', '-', '@', '+', '!', ':', at most 160, no '..'",
)
ENTRY_NAME: Final = _matching(
    r"(?!.*\.\.)[a-z0-9][a-z0-9._-]{0,79}",
    "at most 80 lower-case letters, digits, '.', '_', '-', no '..'",
)
DIGEST: Final = _matching(r"[0-9a-f]{64}", "a SHA-256 digest in 64 hexadecimal digits")
WHEEL: Final = _matching(
    r"[A-Za-z0-9][A-Za-z0-9._+!-]{0,199}\.whl", "the bare name of a file that ends with .whl"
)
URL: Final = _matching(
    r"(https?://[A-Za-z0-9._~:/?#@!$&*+,;=%-]{1,290})?", "an http or https address, or nothing"
)
_LOWER: Final = _matching(
    NAME_PATTERN, "a name of lower-case letters, digits, '-' and '_', at most 64"
)
_COST: Final = Rule(
    lambda value: value is None or math.isnan(value) or 0 <= value <= MOST_COST,
    f"a number from 0 to {MOST_COST:g}, or null",
)
_RECORD: Final[Mapping[str, Rule]] = {
    "detector": NAME,
    "detector_version": NAME,
    "plugin": _matching(
        r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}:[A-Za-z0-9][A-Za-z0-9._-]{0,99}",
        "'distribution:plug-in', both of letters, digits, '.', '_', '-'",
    ),
    "environment": _LOWER,
    "anomaly": _LOWER,
    "strength": _matching(r"[A-Za-z0-9._-]{0,64}", "a strength's name, or nothing"),
    "group": Rule((*GROUPS, "").__contains__, f"one of {', '.join(GROUPS)}, or nothing"),
    "inputs": Rule(("observations", "observations+actions", "").__contains__, "known inputs"),
    "horizon": _whole(1, 100_000),
    "seed": _whole(0, LARGEST),
    "split": NAME,
    "split_digest": DIGEST,
    "reason": text(1000),
    "note": text(LONGEST_TEXT),
    "counts": Rule(
        lambda value: all(0 <= n <= MOST_TEST * 50 for n in value.values()), "few trajectories"
    ),
    "recordings": Rule(
        lambda value: all(0 <= n <= MOST_TEST * 50 for numbers in value.values() for n in numbers),
        "numbers of recordings",
    ),
    **dict.fromkeys(("seconds_fit", "seconds_score", "steps_scored", "peak_rss_mb"), _COST),
}


def check_record(record: Record, location: str) -> None:
    """Raise `ResultsError` for the first field of a record that a board cannot show.

    Parameters
    ----------
    record
        As it was read.
    location
        File and line, for the message.
    """
    for field, problem in _problems(record):
        raise ResultsError(f"{location}: {field}: {problem}")


def _problems(record: Record) -> Iterator[tuple[str, str]]:
    for field, rule in _RECORD.items():
        if problem := rule.complaint(getattr(record, field)):
            yield field, problem
    for field in ("parameters", "overrides", "provenance"):
        yield from unsafe(getattr(record, field), field)
    for name, metric in record.metrics.items():
        if name not in NAMES:
            yield f"metrics.{short(name)}", "is no metric"
        if not (math.isnan(metric.value) or math.isfinite(metric.value)):
            yield f"metrics.{name}", f"is {metric.value}, expected a finite number"
    trajectories = record.counts.get("test", 0) + record.counts.get("nominal", 0)
    for name, terms in record.per_trajectory.items():
        if name not in record.metrics or not metric_info(name).interval:
            yield f"per_trajectory.{short(name)}", "is there without its metric"
        if not len(terms[0]) == trajectories <= MOST_TEST:
            yield f"per_trajectory.{short(name)}", f"has {len(terms[0])} terms, not {trajectories}"
    n = len(record.recordings_of_terms)
    if record.recordings and not record.paired and n != trajectories:
        yield "recordings", f"are of {n} episodes, not {trajectories}"
    every = np.array([*record.per_trajectory.values()]).reshape(-1, 2, trajectories)
    top, bottom = every[:, 0], every[:, 1]
    if not np.isfinite(every).all() or (bottom < 0).any() or top[bottom == 0].any():
        yield "per_trajectory", "holds what is no ratio, expected finite ones, or 0 / 0"


def unsafe(value: Any, path: str = "", levels: int = _DEEPEST) -> Iterator[tuple[str, str]]:
    """Yield places of a JSON value that hold markup, much text, or what no reader takes.

    Parameters
    ----------
    value
        As `json` reads it.
    path
        Of the value, for messages.
    levels
        Levels of lists and objects that it may have.

    Yields
    ------
    tuple
        Path, and what is wrong there.
    """
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        if levels == 0 or len(value) > _MOST_ITEMS:
            yield path, f"is {short(value)}, expected less depth, and at most {_MOST_ITEMS} items"
            return
        for key, item in items:
            below = f"{path}.{short(key)[1:-1]}" if isinstance(key, str) else f"{path}[{key}]"
            if isinstance(key, str) and not _is_text(key):
                yield below, "is no plain name"
            yield from unsafe(item, below, levels - 1)
    elif isinstance(value, str):
        if problem := text(LONGEST_TEXT).complaint(value):
            yield path, problem
    elif value is not None and not abs(value) <= (
        LARGEST if isinstance(value, int) else sys.float_info.max
    ):
        yield path, f"is {short(value)}, expected a finite number, whole ones of at most {LARGEST}"
