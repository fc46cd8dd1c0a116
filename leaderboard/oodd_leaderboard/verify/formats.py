"""The formats of ``entry.json`` and of records: types, alphabets, ranges.

Types are those of `EntryInfo` and `Record`. Beyond them names are held to a safe alphabet, since
they become file names, links and table cells, and text is one line that can be printed, without
``<`` and ``>``: whatever shows it, it cannot become markup.
"""

import functools
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from datetime import date
from typing import Any, Final, NamedTuple

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, NAME_PATTERN, PROTOCOL
from oodd_eval.results import record as record_format
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.record import Record
from oodd_leaderboard.reported import ENTRY, SCHEMA, EntryInfo
from oodd_leaderboard.verify.entry_files import (
    MB,
    MOST_FILES,
    Findings,
    find_text,
    parse_json,
    plain,
    short,
)

MOST_RECORDS: Final = 20_000
MOST_LINE: Final = 4 * MB
MOST_TEST: Final = 2_000  # trajectories: with more, recomputing intervals takes too much room
LONGEST_TEXT: Final = 4000
LARGEST: Final = 2**53  # whole numbers beyond are not exact in a double
MOST_FLOAT: Final = sys.float_info.max
MOST_COST: Final = 1e9  # seconds (thirty years) or megabytes: nobody measured more

_DEEPEST: Final = 8  # levels of a JSON value
_BLANK: Final = "\u115f\u1160\u2800\u3164\uffa0"  # letters and signs that show nothing


class Rule(NamedTuple):
    """A predicate of a value, and what is expected in words."""

    holds: Callable[[Any], object]
    expected: str


def complaint(rule: Rule, value: object) -> str:
    """Return what is wrong with a value by a rule; empty if nothing is."""
    return "" if rule.holds(value) else f"is {short(value)}, expected {rule.expected}"


def _matching(pattern: str, expected: str) -> Rule:
    return Rule(re.compile(pattern, re.ASCII).fullmatch, expected)


def _is_text(value: str, longest: int = LONGEST_TEXT, least: int = 0) -> bool:
    marked = any(mark in value for mark in ("<", ">", "]("))
    seen = sum(c not in _BLANK and not c.isspace() for c in value)
    return least <= seen and len(value) <= longest and value.isprintable() and not marked


def _text(longest: int, least: int = 0) -> Rule:
    expected = f"one line of plain text without markup, of {least} to {longest} characters"
    return Rule(lambda value: _is_text(value, longest, least), expected)


def _whole(least: int, largest: int) -> Rule:
    return Rule(lambda value: least <= value <= largest, f"a number from {least} to {largest}")


def _one_of(*values: Any) -> Rule:
    return Rule(values.__contains__, " or ".join(map(repr, values)))


def _are_texts(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(item, str) for item in value.values())


def _is_day(text: str) -> bool:
    try:
        return str(day := date.fromisoformat(text)) == text and 2020 <= day.year < 2100
    except ValueError:
        return False


_NAME: Final = _matching(
    r"(?!.*\.\.)[A-Za-z0-9][A-Za-z0-9._@+!:-]{0,159}",
    "a name of letters, digits, '.', '_', '-', '@', '+', '!', ':', at most 160, no '..'",
)
_LOWER: Final = _matching(
    NAME_PATTERN, "a name of lower-case letters, digits, '-' and '_', at most 64"
)
_DIGEST: Final = _matching(r"[0-9a-f]{64}", "a SHA-256 digest in 64 hexadecimal digits")
ENTRY_ID: Final = _matching(
    r"(?!.*\.\.)[a-z0-9][a-z0-9._-]{0,79}",
    "at most 80 lower-case letters, digits, '.', '_', '-', no '..'",
)
PLUGIN_NAME: Final = _matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}:[A-Za-z0-9][A-Za-z0-9._-]{0,99}",
    "'distribution:plug-in', both of letters, digits, '.', '_', '-'",
)
SCORE_KEY: Final = _matching(r"[a-z0-9][a-z0-9._-]{0,159}", "a score file's name, bare")
_COST: Final = Rule(
    lambda value: value is None or math.isnan(value) or 0 <= value <= MOST_COST,
    f"a number from 0 to {MOST_COST:g}, or null",
)

_ENTRY: Final[Mapping[str, Rule]] = {
    "schema": _one_of(SCHEMA),
    "id": ENTRY_ID,
    "title": _text(120, least=1),
    "submitter": _text(120),
    "citation": _text(2000),
    "caption": _text(500),
    "url": _matching(
        r"(https?://[A-Za-z0-9._~:/?#@!$&*+,;=%-]{1,290})?", "an http or https address, or nothing"
    ),
    "split": _NAME,
    "split_digest": _DIGEST,
    "protocol": _one_of(PROTOCOL),
    "created": Rule(_is_day, "a date such as 2026-11-21, from 2020 to 2099"),
    "environment": Rule(
        lambda value: (
            value.keys() == {"python", "platform", "packages"}
            and _are_texts(value["packages"])
            and _are_texts(value | {"packages": ""})
        ),
        "python, platform and packages with their versions",
    ),
    "files": Rule(
        lambda value: all(facts.keys() == {"sha256", "bytes"} for facts in value.values()),
        "sha256 and bytes of each file",
    ),
}
_RECORD: Final[Mapping[str, Rule]] = {
    "schema": _one_of(record_format.SCHEMA),
    "protocol": _one_of(PROTOCOL),
    "detector": _NAME,
    "detector_version": _NAME,
    "plugin": PLUGIN_NAME,
    "plugin_source": _DIGEST,
    "inputs": _one_of("observations", "observations+actions", ""),
    "strength": _matching(r"[A-Za-z0-9._-]{0,64}", "a strength's name, or nothing"),
    "horizon": _whole(1, 100_000),
    "seed": _whole(0, LARGEST),
    "split": _NAME,
    "split_digest": _DIGEST,
    "limit": _one_of(None),
    "scores": SCORE_KEY,
    "reason": _text(1000),
    "provenance": Rule(
        lambda value: _are_texts(value.get("packages", {})), "packages with their versions"
    ),
    **dict.fromkeys(("seconds_fit", "seconds_score", "steps_scored", "peak_rss_mb"), _COST),
}
_PAIRED: Final[Mapping[str, Rule]] = {
    "environment": _one_of(*ENVIRONMENTS),
    "anomaly": _one_of(*ANOMALIES),
    "counts": Rule(
        lambda value: (
            value.keys() == {"train", "calibration", "test"}
            and all(1 <= n <= LARGEST for n in value.values())
            and value["test"] <= MOST_TEST
        ),
        f"train, calibration and test of 1 or more, at most {MOST_TEST} of test",
    ),
}
_UNPAIRED: Final[Mapping[str, Rule]] = {
    "environment": _LOWER,
    "anomaly": _LOWER,
    "group": _one_of(*GROUPS, ""),
    "counts": Rule(
        lambda value: (
            value.keys() == {"train", "calibration", "nominal", "test"}
            and all(0 <= n <= LARGEST for n in value.values())
            and max(value["nominal"], value["test"]) <= MOST_TEST // 2
        ),
        f"train, calibration, nominal and test, at most {MOST_TEST // 2} of the last two",
    ),
}
_reader = functools.cache(TypeAdapter)


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
        if levels == 0 or len(value) > MOST_FILES:
            yield path, f"is {short(value)}, expected less depth, and at most {MOST_FILES} items"
            return
        for key, item in items:
            text = key if isinstance(key, str) else ""
            below = f"{path}.{plain(text)}".removeprefix(".") if text else f"{path}[{key}]"
            if not _is_text(text):
                yield below, "is no plain name"
            yield from unsafe(item, below, levels - 1)
    elif isinstance(value, str):
        if not _is_text(value):
            yield path, complaint(_text(LONGEST_TEXT), value)
    elif value is not None and not abs(value) <= (
        LARGEST if isinstance(value, int) else MOST_FLOAT
    ):
        yield path, f"is {short(value)}, expected a finite number, whole ones of at most {LARGEST}"


def _read(kind: Any, text: str, location: str, findings: Findings) -> Any:
    """Return a JSON text as a type; None where a field is wrong, and all that are are problems."""
    before = findings.count
    result = None
    with findings.reading(location):
        value = parse_json(text)
        try:
            result = _reader(kind).validate_json(text)
        except ValidationError as problem:
            for error in problem.errors(include_url=False):
                findings.refuse(location, _path(error["loc"]), _message(error))
        if isinstance(value, dict):
            value.pop("per_trajectory", None)  # numbers alone, and many
        for path, wrong in unsafe(value):
            findings.refuse(location, path, wrong)
    return None if findings.count > before else result


def _path(parts: tuple[int | str, ...]) -> str:
    """Return the path of a field, such as ``plugins[0].version``."""
    named = (f"[{part}]" if isinstance(part, int) else f".{plain(part)}" for part in parts)
    return "".join(named).removeprefix(".")


def _message(error: Any) -> str:
    """Return one of pydantic's errors as the value and what is expected."""
    if error["type"] == "missing":
        return "is missing"
    if error["type"] in {"extra_forbidden", "unexpected_keyword_argument"}:
        return "is no field of this format"
    return f"is {short(error['input'])}: {error['msg'].replace('Input should be', 'expected')}"


def _hold_to(rules: Mapping[str, Rule], value: Any, location: str, findings: Findings) -> bool:
    """Tell whether fields keep their rules; each that does not is a problem."""
    wrong = {field: complaint(rule, getattr(value, field)) for field, rule in rules.items()}
    for field, message in wrong.items():
        if message:
            findings.refuse(location, field, message)
    return not any(wrong.values())


def read_info(contents: Mapping[str, bytes], findings: Findings) -> EntryInfo | None:
    """Read ``entry.json``; None when a field is wrong, so that nothing can be compared with it."""
    name, text = find_text(contents, ENTRY, findings)
    entry: EntryInfo | None = _read(EntryInfo, text, name, findings) if name else None
    return entry if entry is not None and _hold_to(_ENTRY, entry, name, findings) else None


def read_records(contents: Mapping[str, bytes], findings: Findings) -> dict[str, Record]:
    """Return the records whose fields are sound, by place: ``records.jsonl:3 (<cell>)``."""
    name, text = find_text(contents, RECORDS, findings)
    if not name:
        return {}
    lines = text.removesuffix("\n").split("\n")
    if not text.endswith("\n"):
        findings.refuse(f"{name}:{len(lines)}", "", "does not end with a new line: it is cut off")
    if not text or len(lines) > MOST_RECORDS:
        findings.refuse(name, "", f"has {len(lines)} lines, expected 1 to {MOST_RECORDS} records")
        return {}
    records = {}
    for number, line in enumerate(lines, start=1):
        location = f"{name}:{number}"
        if len(line) > MOST_LINE or not line.isprintable():
            expected = f"one record in plain JSON of at most {MOST_LINE} characters"
            findings.refuse(location, "", f"is {short(line)}, expected {expected}")
            continue
        record = _read(Record, line, location, findings)
        if record is None:
            continue
        rules = {**_RECORD, **(_PAIRED if record.paired else _UNPAIRED)}
        if _hold_to(rules, record, location, findings):
            record = Record.from_json(line, location)
            records[f"{location} ({record.cell})"] = record
    return records
