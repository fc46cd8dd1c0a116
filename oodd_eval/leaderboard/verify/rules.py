"""Rules for single values of a submission: each returns a complaint, or nothing.

Names are held to a safe alphabet, since they become file names, links and table cells. Text is one
line that can be printed, without ``<`` and ``>``: whatever shows it, it cannot become markup.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Collection, Mapping
from datetime import date
from typing import Any, Final

from oodd_eval.leaderboard.verify.findings import Findings, shown

Rule = Callable[[Any], str]
"""Takes a JSON value; returns what is wrong with it, empty if nothing is."""

LARGEST: Final = 2**53
"""Whole numbers beyond are not exact in a double."""

MOST_COST: Final = 1e9
"""Seconds (thirty years) or megabytes (a thousand terabytes): what is more was not measured."""

_DEEPEST: Final = 5
_ITEMS: Final = 200


def matching(pattern: str, description: str) -> Rule:
    """Return the rule for strings that match a pattern as a whole."""
    compiled = re.compile(pattern)

    def rule(value: Any) -> str:
        if isinstance(value, str) and compiled.fullmatch(value):
            return ""
        return f"is {shown(value)}, expected {description}"

    return rule


entry_id = matching(
    r"(?!.*\.\.)[a-z0-9][a-z0-9._-]{0,79}",
    "at most 80 lower-case letters, digits, '.', '_', '-', no '..'",
)
detector_name = matching(
    r"[a-z0-9][a-z0-9-]{0,63}(:[A-Za-z_][A-Za-z0-9_]{0,63}(\.[A-Za-z_][A-Za-z0-9_]{0,63}){0,7})?",
    "a name of lower-case letters, digits and '-', at most 64, perhaps with a class behind a ':', "
    "such as rf or pyod:IForest",
)
name = matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", "a name of letters, digits, '.', '_', '-', at most 100"
)
parameter_name = matching(r"[A-Za-z_][A-Za-z0-9_]{0,63}", "the name of a parameter, at most 64")
plugin_name = matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}:[A-Za-z0-9][A-Za-z0-9._-]{0,99}",
    "'distribution:plug-in', both of letters, digits, '.', '_', '-'",
)
version = matching(r"[A-Za-z0-9][A-Za-z0-9.+!_-]{0,63}", "a version such as 1.2.0")
split_name = matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}(@[0-9a-f]{8})?",
    "a split's name of letters, digits, '.', '_', '-', with '@' and the start of its digest "
    "where it is not the published one",
)
digest = matching(r"[0-9a-f]{64}", "a SHA-256 digest in 64 hexadecimal digits")
score_key = matching(r"[a-z0-9][a-z0-9._-]{0,159}", "the name of a score file without its ending")
url = matching(
    r"(https?://[A-Za-z0-9._~:/?#@!$&*+,;=%-]{1,290})?", "an http or https address, or nothing"
)


def text(longest: int, *, least: int = 0) -> Rule:
    """Return the rule for plain text of one line."""

    def rule(value: Any) -> str:
        if not isinstance(value, str):
            return f"is {shown(value)}, expected text"
        if not least <= len(value) <= longest:
            return f"has {len(value)} characters, expected {least} to {longest}"
        if not value.isprintable():
            bad = next(c for c in value if not c.isprintable())
            return f"contains the control character {bad!a}, expected one line of plain text"
        if bad_mark := next((mark for mark in ("<", ">", "](") if mark in value), ""):
            return f"contains {bad_mark!r}, expected plain text without markup: {shown(value)}"
        return ""

    return rule


_line = text(4000)


def command(value: Any) -> str:
    """Complain of what is not commands of oodd-eval joined by ``&&``, or nothing.

    Whoever re-runs an entry may paste its command into a shell, so that nothing else may be in it:
    no other program, and no character that a shell would act on.
    """
    if complaint := _line(value):
        return complaint
    for part in value.split(" && ") if value else ():
        try:
            words = shlex.split(part)
        except ValueError:
            words = []
        if words[:2] not in (["oodd-eval", "run"], ["oodd-eval", "reproduce"]):
            return f"is {shown(part)}, expected oodd-eval run or oodd-eval reproduce"
        if shlex.join(words) != part:
            return f"is {shown(part)}, expected plain words, quoted as {shown(shlex.join(words))}"
    return ""


def one_of(known: Collection[Any]) -> Rule:
    """Return the rule for members of a collection."""

    def rule(value: Any) -> str:
        # True == 1 in Python, never here.
        if isinstance(value, str | int) and not isinstance(value, bool) and value in known:
            return ""
        return f"is {shown(value)}, expected {' or '.join(map(str, known))}"

    return rule


def whole(least: int, most: int = LARGEST) -> Rule:
    """Return the rule for whole numbers, no truth values, in a range."""

    def rule(value: Any) -> str:
        if isinstance(value, int) and not isinstance(value, bool) and least <= value <= most:
            return ""
        upper = "" if most == LARGEST else f" and at most {most}"
        return f"is {shown(value)}, expected a whole number of at least {least}{upper}"

    return rule


def number(value: Any) -> str:
    """Complain of what is no finite number; null is none either."""
    if isinstance(value, float) and math.isfinite(value):
        return ""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST:
        return ""
    return f"is {shown(value)}, expected a finite number"


def number_or_null(value: Any) -> str:
    """Complain of what is neither a finite number nor null, which stands for undefined."""
    return f"{complaint} or null" if value is not None and (complaint := number(value)) else ""


def cost(value: Any) -> str:
    """Complain of a cost that is neither unknown (null) nor a number of at least 0."""
    if complaint := number_or_null(value):
        return complaint
    if value is None or 0 <= value <= MOST_COST:
        return ""
    return f"is {value}, expected at least 0 and at most {MOST_COST:g}"


def day(value: Any) -> str:
    """Complain of what is no date such as ``2026-11-21``."""
    try:
        if isinstance(value, str) and date.fromisoformat(value).isoformat() == value:
            return ""
    except ValueError:
        pass
    return f"is {shown(value)}, expected a date such as 2026-11-21"


def nullable(rule: Rule) -> Rule:
    """Return a rule that lets null pass too."""
    return lambda value: "" if value is None else rule(value)


def boolean(value: Any) -> str:
    """Complain of what is neither true nor false."""
    return "" if isinstance(value, bool) else f"is {shown(value)}, expected true or false"


def mapping(value: Any) -> str:
    """Complain of what is no JSON object."""
    return "" if isinstance(value, dict) else f"is {shown(value)}, expected a JSON object"


def plain(value: Any) -> str:
    """Complain of a free JSON value that is deep, large, or holds text with markup."""
    return _plain(value, _DEEPEST)


_text = text(300)


def _plain(value: Any, levels: int) -> str:
    if value is None or isinstance(value, bool):
        return ""
    if isinstance(value, str):
        return _text(value)
    if not isinstance(value, dict | list):
        return number(value)
    if not levels:
        return f"is nested more than {_DEEPEST} levels deep"
    if len(value) > _ITEMS:
        return f"holds {len(value)} items, expected at most {_ITEMS}"
    if isinstance(value, list):
        found = [_plain(item, levels - 1) for item in value]
    else:
        found = [_text(key) or _plain(item, levels - 1) for key, item in value.items()]
    return next(filter(None, found), "")


def check_fields(
    value: Any, rules: Mapping[str, Rule], findings: Findings, where: str, prefix: str = ""
) -> bool:
    """Check that a JSON object has exactly the fields named, each as its rule demands.

    Returns
    -------
    Whether nothing was found.
    """
    before = findings.count
    if complaint := mapping(value):
        findings.refuse(where, prefix.rstrip("."), complaint)
        return False
    for field in sorted(value.keys() - rules.keys()):
        findings.refuse(where, f"{prefix}{shown(field)[1:-1]}", "is no field of this format")
    for field, rule in rules.items():
        if field not in value:
            findings.refuse(where, f"{prefix}{field}", "is missing")
        elif complaint := rule(value[field]):
            findings.refuse(where, f"{prefix}{field}", complaint)
    return findings.count == before
