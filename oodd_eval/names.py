"""How users name things: comma lists, globs, ``all``, and boolean expressions over cell ids."""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from oodd_eval.errors import UnknownNameError, UsageError

Predicate = Callable[[str], bool]


def select(kind: str, patterns: str, known: Iterable[str]) -> list[str]:
    """Return the known names that a comma list of names and globs selects.

    Parameters
    ----------
    kind
        What is named, in the singular, for messages.
    patterns
        Such as ``"hopper,walker2d"``, ``"*iqn*"`` or ``"all"``.
    known
        The names that exist, in their order.

    Returns
    -------
    list of str
        In the order of the patterns, then of `known`; each name once.

    Raises
    ------
    UnknownNameError
        When a name does not exist or a glob matches nothing.

    Examples
    --------
    >>> select("environment", "hopper,a*", ["acrobot", "ant", "hopper"])
    ['hopper', 'acrobot', 'ant']
    """
    names = list(known)
    chosen: dict[str, None] = {}
    for pattern in (p.strip() for p in patterns.split(",")):
        if not pattern:
            continue
        found = names if pattern == "all" else fnmatch.filter(names, pattern)
        if not found:
            raise UnknownNameError(kind, pattern, names)
        chosen.update(dict.fromkeys(found))
    if not chosen:
        raise UsageError(f"no {kind} was named: expected names separated by commas, or 'all'")
    return list(chosen)


def whole_numbers(option: str, text: str, *, least: int) -> list[int]:
    """Return the numbers of a comma list, each once.

    Raises
    ------
    UsageError
        When one is not a whole number of at least `least`.
    """
    numbers: dict[int, None] = {}
    for part in text.split(","):
        try:
            number = int(part)
        except ValueError:
            number = least - 1
        if number < least:
            raise UsageError(
                f"{option} is {text!r}, expected whole numbers of at least {least}, "
                "separated by commas"
            )
        numbers[number] = None
    return list(numbers)


def seconds(text: str) -> float:
    """Return a time such as ``"90"``, ``"90s"``, ``"30m"`` or ``"2h"`` in seconds."""
    return _quantity(text, {"": 1, "s": 1, "m": 60, "h": 3600}, "a time such as 90s, 30m or 2h")


def memory_bytes(text: str) -> int:
    """Return an amount of memory such as ``"500MB"``, ``"8GB"`` or ``"8GiB"`` in bytes."""
    units = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9,
             "kib": 2**10, "mib": 2**20, "gib": 2**30}  # fmt: skip
    return int(_quantity(text, units, "an amount of memory such as 500MB or 8GB"))


def _quantity(text: str, units: dict[str, int], expected: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    if not match or match[2].lower() not in units or float(match[1]) == 0:
        raise UsageError(f"{text!r} is not {expected}")
    return float(match[1]) * units[match[2].lower()]


def assignments(option: str, given: Iterable[str]) -> dict[str, str]:
    """Return texts of the form ``NAME=VALUE`` as names and values.

    Raises
    ------
    UsageError
        When one has another form.
    """
    found = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise UsageError(f"{option} {text!r}, expected NAME=VALUE")
        found[name] = value
    return found


def parameters(given: Iterable[str]) -> dict[str, Any]:
    """Return what ``--param NAME=VALUE`` gives, values in JSON or else plain text."""
    return {name: _plain(value) for name, value in assignments("--param", given).items()}


def _plain(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def expression(text: str) -> Predicate:
    """Return the test of cell ids that an expression of ``-k`` describes.

    Words are substrings, regardless of case; ``and``, ``or``, ``not`` and round brackets join them.

    Raises
    ------
    UsageError
        When the expression cannot be read.

    Examples
    --------
    >>> wanted = expression("hopper and not (iid or drift)")
    >>> wanted("mini/hopper/gravity::rf[h=1,seed=0]"), wanted("mini/hopper/iid::rf[h=1,seed=0]")
    (True, False)
    """
    tokens = re.findall(r"[()]|[^\s()]+", text)
    test, rest = _either(tokens, text)
    if rest:
        raise UsageError(f"-k {text!r} cannot be read from {rest[0]!r} on")
    return test


def _either(tokens: Sequence[str], text: str) -> tuple[Predicate, Sequence[str]]:
    left, rest = _both(tokens, text)
    while rest and rest[0] == "or":
        right, rest = _both(rest[1:], text)
        left = _join(any, left, right)
    return left, rest


def _both(tokens: Sequence[str], text: str) -> tuple[Predicate, Sequence[str]]:
    left, rest = _one(tokens, text)
    while rest and rest[0] == "and":
        right, rest = _one(rest[1:], text)
        left = _join(all, left, right)
    return left, rest


def _one(tokens: Sequence[str], text: str) -> tuple[Predicate, Sequence[str]]:
    if not tokens or tokens[0] in ("and", "or", ")"):
        found = repr(tokens[0]) if tokens else "the end"
        raise UsageError(f"-k {text!r} cannot be read: expected a word, found {found}")
    word, rest = tokens[0], tokens[1:]
    if word == "not":
        inner, rest = _one(rest, text)
        return lambda cell: not inner(cell), rest
    if word == "(":
        inner, rest = _either(rest, text)
        if not rest or rest[0] != ")":
            raise UsageError(f"-k {text!r} cannot be read: a bracket is not closed")
        return inner, rest[1:]
    return lambda cell: word.lower() in cell.lower(), rest


def _join(how: Callable[[Iterable[bool]], bool], left: Predicate, right: Predicate) -> Predicate:
    return lambda cell: how(test(cell) for test in (left, right))
