"""The formats of ``entry.json`` and of records, held to strictly: types, alphabets, ranges.

Names are held to a safe alphabet, since they become file names, links and table cells. Text is one
line that can be printed, without ``<`` and ``>``: whatever shows it, it cannot become markup.
"""

import functools
import math
import re
from collections.abc import Callable, Mapping
from datetime import date
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, TypeAdapter
from pydantic_core import ValidationError

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, NAME_PATTERN, PROTOCOL
from oodd_eval.leaderboard.entry import ENTRY, SCHEMA, EntryInfo
from oodd_eval.leaderboard.verify.files import MB, Findings, find_text, parse_json, plain, short
from oodd_eval.metrics.alarms import AlarmKind
from oodd_eval.names import PARAMETER_NAME, SPEC_NAME
from oodd_eval.results import record as record_format
from oodd_eval.results.curve_file import strict_model
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record, Status

MOST_RECORDS: Final = 20_000
MOST_LINE: Final = 4 * MB
MOST_TEST: Final = 2_000  # trajectories: with more, recomputing intervals takes too much room

LONGEST_TEXT: Final = 4000  # of a parameter or of what a run says of itself
_BLANK: Final = "\u115f\u1160\u2800\u3164\uffa0"  # letters and signs that show nothing
_YEARS: Final = range(2020, 2100)  # in which an entry can have been made
LARGEST: Final = 2**53  # whole numbers beyond are not exact in a double
MOST_COST: Final = 1e9  # seconds (thirty years) or megabytes: nobody measured more

_DEEPEST: Final = 5
_MOST_ITEMS: Final = 200


def _rule(holds: Callable[[Any], object], expected: str) -> AfterValidator:
    """Return the rule for values of which a predicate holds."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise ValueError(f"expected {expected}")
        return value

    return AfterValidator(check)


def _matching(pattern: str, expected: str) -> AfterValidator:
    return _rule(re.compile(pattern, re.ASCII).fullmatch, expected)


def _is_text(value: str, longest: int, least: int = 0) -> bool:
    marked = any(mark in value for mark in ("<", ">", "]("))
    seen = sum(c not in _BLANK and not c.isspace() for c in value)
    return least <= seen and len(value) <= longest and value.isprintable() and not marked


def _text(longest: int, least: int = 0) -> AfterValidator:
    expected = f"one line of plain text without markup, of {least} to {longest} characters"
    return _rule(lambda value: _is_text(value, longest, least), expected)


def _written_as(parse: Callable[[str], object], value: str) -> bool:
    """Tell whether a text is what parsing it and writing it again gives."""
    try:
        return str(parse(value)) == value
    except ValueError:
        return False


def _is_free(value: Any, levels: int = _DEEPEST) -> bool:
    """Tell a JSON value that is neither deep nor large, and holds no text with markup."""
    if isinstance(value, dict | list):
        items = [*value, *value.values()] if isinstance(value, dict) else value
        small = levels > 0 and len(value) <= _MOST_ITEMS
        return small and all(_is_free(item, levels - 1) for item in items)
    if isinstance(value, str):
        return _is_text(value, LONGEST_TEXT)
    if isinstance(value, int):
        return abs(value) <= LARGEST
    return value is None or math.isfinite(value)


# fmt: off
Row = Annotated[str, _text(300, least=1), _rule(
    functools.partial(_written_as, Setting.parse),
    "detector and settings as on the board, such as 'riqn[h=5]'")]
Day = Annotated[str, _rule(
    functools.partial(_written_as, date.fromisoformat), "a date such as 2026-11-21"),
    _rule(lambda day: int(day[:4]) in _YEARS, "a year from 2020 to 2099")]
EntryId = Annotated[str, _matching(
    r"(?!.*\.\.)[a-z0-9][a-z0-9._-]{0,79}",
    "at most 80 lower-case letters, digits, '.', '_', '-', no '..'")]
DetectorName = Annotated[str, _matching(
    SPEC_NAME,
    "a name of lower-case letters, digits and '-', at most 64, perhaps with a class behind a ':', "
    "such as rf or pyod:IForest")]
DetectorNames = Annotated[list[DetectorName], _rule(
    lambda names: names and names == sorted(set(names)), "names in order, each once")]
Name = Annotated[str, _matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", "a name of letters, digits, '.', '_', '-', at most 100")]
ParameterName = Annotated[str, _matching(PARAMETER_NAME, "a parameter's name, at most 64")]
PluginName = Annotated[str, _matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}:[A-Za-z0-9][A-Za-z0-9._-]{0,99}",
    "'distribution:plug-in', both of letters, digits, '.', '_', '-'")]
Version = Annotated[str, _matching(r"[A-Za-z0-9][A-Za-z0-9.+!_-]{0,63}", "a version such as 1.2")]
SplitName = Annotated[str, _matching(
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}(@[0-9a-f]{8})?",
    "a split's name of letters, digits, '.', '_', '-', with '@' and the start of its digest where "
    "it is not the published one")]
LogName = Annotated[str, _matching(
    NAME_PATTERN, "a name of lower-case letters, digits, '-' and '_', at most 64")]
Strength = Annotated[str, _matching(r"[A-Za-z0-9._-]{0,64}", "a strength's name, or nothing")]
Digest = Annotated[str, _matching(r"[0-9a-f]{64}", "a SHA-256 digest in 64 hexadecimal digits")]
ScoreKey = Annotated[str, _matching(r"[a-z0-9][a-z0-9._-]{0,159}", "a score file's name, bare")]
Url = Annotated[str, _matching(
    r"(https?://[A-Za-z0-9._~:/?#@!$&*+,;=%-]{1,290})?", "an http or https address, or nothing")]
FileName = Annotated[str, _matching(
    r"(?!.*\.\.)(scores/)?[a-z0-9][a-z0-9._-]{0,170}",
    "a plain name of a file, in scores/ or in the entry itself")]
GrantedBy = Annotated[str, _text(200, least=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Whole = Annotated[int, Field(ge=0, le=LARGEST)]
Cost = Annotated[float, Field(ge=0, le=MOST_COST)] | None
FreeValue = Annotated[Any, _rule(
    _is_free, f"a value without markup, at most {_DEEPEST} levels deep, of at most {_MOST_ITEMS} "
    "items each and finite numbers")]
Parameters = dict[ParameterName, FreeValue]
Terms = Annotated[list[Finite], FailFast(), Field(max_length=MOST_TEST)]
Pair = Annotated[tuple[Terms, Terms], _rule(
    lambda pair: len(pair[0]) == len(pair[1]), "as many numerators as denominators")]

# fmt: on


class _Provenance(BaseModel):
    """Types that an entry's own statements are compared with; other values must be plain."""

    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: Parameters

    oodd_eval: Version
    python: Version
    numpy: Version = ""
    packages: dict[Name, Version] = Field(default={}, max_length=_MOST_ITEMS)


def _schema(version: int) -> Any:
    return Annotated[Literal[version], Field(alias="schema")]


_COUNT: Final = Annotated[int, Field(ge=1, le=LARGEST)]
_TESTS: Final = Annotated[int, Field(ge=0, le=MOST_TEST // 2)]
_PROTOCOL: Final = Literal[PROTOCOL]

# fmt: off
_ENTRY: Final = strict_model(
    layout=_schema(SCHEMA), id=EntryId, title=Annotated[str, _text(120, least=1)],
    detectors=DetectorNames, submitter=Annotated[str, _text(120)],
    citation=Annotated[str, _text(2000)], url=Url,
    split=SplitName, split_digest=Digest, protocol=_PROTOCOL,
    plugins=Annotated[list[strict_model(  # type: ignore[misc]
        distribution=Name, plugin=Name, version=Version, source_digest=Digest,
    )], Field(max_length=100)],
    environment=strict_model(
        python=Annotated[str, _text(100, least=1)], platform=Annotated[str, _text(200)],
        packages=dict[Name, Version]),
    created=Day, caption=Annotated[str, _text(500)],
    primary=Annotated[list[Row], Field(max_length=100)],
    files=dict[FileName, strict_model(sha256=Digest, bytes=Whole)],  # type: ignore[misc]
)

_FIELDS: Final = {
    "layout": _schema(record_format.SCHEMA), "protocol": _PROTOCOL,
    "detector": DetectorName, "detector_version": Version, "plugin": PluginName,
    "plugin_source": Digest, "parameters": Parameters, "overrides": Parameters,
    "inputs": Literal["observations", "observations+actions", ""],
    "alarm": Literal[get_args(AlarmKind)],
    "deterministic": bool, "strength": Strength,
    "magnitude": (Annotated[float, Field(ge=0)] | None, None),
    "horizon": Annotated[int, Field(ge=1, le=100_000)],
    "seed": Whole, "split": SplitName, "split_digest": Digest, "limit": None,
    "status": Status, "reason": Annotated[str, _text(1000)],
    "metrics": dict[str, strict_model(  # type: ignore[misc]
        value=Finite | None, low=Finite | None, high=Finite | None,
        n=Annotated[int, Field(ge=0, le=MOST_TEST)])],
    "brief": bool,
    "per_trajectory": dict[str, Pair], "scores": ScoreKey,
    "seconds_fit": Cost, "seconds_score": Cost, "steps_scored": Whole | None, "peak_rss_mb": Cost,
    "provenance": _Provenance,
}

_RECORD: Final = strict_model(
    **_FIELDS, environment=Literal[*ENVIRONMENTS], anomaly=Literal[*ANOMALIES],
    group=Literal[*GROUPS], counts=strict_model(
        train=_COUNT, calibration=_COUNT, test=Annotated[int, Field(ge=1, le=MOST_TEST)]),
)

_UNPAIRED: Final = strict_model(
    **_FIELDS, paired=Literal[False], environment=LogName, anomaly=LogName,
    group=Literal[*GROUPS, ""], note=(Annotated[str, _text(1000)], ""), counts=strict_model(
        train=_COUNT, calibration=_COUNT, nominal=_TESTS, test=_TESTS),
)
# fmt: on

_adapter = functools.cache(TypeAdapter)


def complaint(kind: Any, value: object) -> str:
    """Return what is wrong with a value of one of this module's types; empty if nothing is."""
    try:
        _adapter(kind).validate_python(value, strict=True)
    except ValidationError as error:
        return _message(error.errors(include_url=False)[0])
    return ""


def _message(error: Any) -> str:
    """Return one of pydantic's errors as the value and what is expected."""
    if error["type"] == "missing":
        return "is missing"
    if error["type"] == "extra_forbidden":
        return "is no field of this format"
    text = error["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    return f"is {short(error['input'])}, {text}"


def _path(parts: tuple[int | str, ...]) -> str:
    """Return the path of a field, such as ``plugins[0].version``."""
    text = ""
    for part in parts:
        # Behind the name of a dictionary's key, when the name itself is wrong.
        if part != "[key]":
            text += f"[{part}]" if isinstance(part, int) else f".{plain(part)}"
    return text.removeprefix(".")


def _record_model(plain: Any) -> type[BaseModel]:
    """Return the format of a record: with twins, or without."""
    unpaired = isinstance(plain, dict) and plain.get("paired") is False
    model: type[BaseModel] = _UNPAIRED if unpaired else _RECORD
    return model


def _holds_to(
    model: Callable[[Any], type[BaseModel]], text: str, where: str, findings: Findings
) -> bool:
    """Tell whether a JSON text has its format; every field that has not is a problem."""
    before = findings.count
    try:
        with findings.reading(where):
            model(parse_json(text)).model_validate_json(text)
    except ValidationError as error:
        for one in error.errors(include_url=False):
            findings.refuse(where, _path(one["loc"]), _message(one))
    return findings.count == before


def read_info(contents: Mapping[str, bytes], findings: Findings) -> EntryInfo | None:
    """Read ``entry.json``; None when a field is wrong, so that nothing can be compared with it."""
    name, text = find_text(contents, ENTRY, findings)
    sound = name and _holds_to(lambda _: _ENTRY, text, name, findings)
    return EntryInfo(**parse_json(text)) if sound else None


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
        where = f"{name}:{number}"
        if len(line) > MOST_LINE or not line.isprintable():
            expected = f"one record in plain JSON of at most {MOST_LINE} characters"
            findings.refuse(where, "", f"is {short(line)}, expected {expected}")
        elif _holds_to(_record_model, line, where, findings):
            record = Record.from_json(line, where)
            records[f"{where} ({record.cell})"] = record
    return records
