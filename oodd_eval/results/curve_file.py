"""The file ``curves.json``: how it is laid out, written, and read with every field checked.

::

    {"schema": 1, "units": [{
        "cell", "detector", "horizon", "seed", "overrides", "environment", "anomaly",
        "roc": {"fpr", "tpr"},
        "delay_far": {"threshold", "far", "delay_censored", "missed", "null_censored"},
        "example": {"index", "auc_matched", "onset", "length", "start",
                    "scores", "twin", "cusum", "twin_cusum", "alarms", "twin_alarms"}}, ...]}

What the fields mean is said where they are computed, in `oodd_eval.results.curves`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from oodd_eval.data import files as stored_files
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.errors import OutputError, ResultsError

SCHEMA: Final = 1
"""Version of the layout; a reader refuses others."""

LONGEST: Final = 1000
"""Most numbers in any list: a file has to stay small enough to be embedded in a page."""

LARGEST: Final = 1e15
"""No number is larger; NaN is not in any range."""

UNIT: Final[Mapping[str, type]] = {
    **dict.fromkeys(("cell", "detector", "environment", "anomaly"), str),
    **dict.fromkeys(("horizon", "seed"), int),
    **dict.fromkeys(("overrides", "roc", "delay_far", "example"), dict),
}
"""Fields of a cell's curves and their types."""

ROC: Final = ("fpr", "tpr")
DELAY_FAR: Final = ("threshold", "far", "delay_censored", "missed", "null_censored")
NUMBERS: Final = ("index", "onset", "length", "start")
SERIES: Final = ("scores", "twin", "cusum", "twin_cusum")
ALARMS: Final = {"alarms": "cusum", "twin_alarms": "twin_cusum"}


def write_curves(curves: Mapping[str, Any], path: Path) -> None:
    """Write curves as JSON without spaces, one cell a line.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    lines = ",\n".join(
        json.dumps(unit, separators=(",", ":"), allow_nan=False) for unit in curves["units"]
    )
    try:
        path.write_text(f'{{"schema":{SCHEMA},"units":[\n{lines}\n]}}\n', encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from None


def read_curves(path: Path | str) -> dict[str, Any]:
    """Read ``curves.json`` and check every field: types, lengths, ranges, finite numbers.

    Raises
    ------
    ResultsError
        Naming the field that is not as the layout has it.
    """
    path = Path(path)
    try:
        plain = json.loads(stored_files.read_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise ResultsError(f"{str(path)!r} cannot be read: {error}") from None
    return check_curves(plain, path.name)


def check_curves(plain: Any, where: str) -> dict[str, Any]:
    """Return a JSON value if it is the content of ``curves.json``; see `read_curves`."""
    whole = _fields(plain, {"schema": int, "units": list}, where)
    if whole["schema"] != SCHEMA:
        raise ResultsError(
            f"{where}: schema is {whole['schema']}, expected {SCHEMA}: it was written by another "
            "version of oodd-eval"
        )
    seen: set[str] = set()
    for i, item in enumerate(whole["units"]):
        name = f"{where}: units[{i}]"
        unit = _fields(item, UNIT, name)
        for field, known in (("environment", ENVIRONMENTS), ("anomaly", ANOMALIES)):
            if unit[field] not in known:
                raise _wrong(f"{name}.{field}", unit[field], f"one of {', '.join(known)}")
        if unit["cell"] in seen:
            raise _wrong(f"{name}.cell", unit["cell"], "a cell that did not occur before")
        seen.add(unit["cell"])
        _check_lists(unit["roc"], ROC, f"{name}.roc", rates=set(ROC))
        _check_lists(unit["delay_far"], DELAY_FAR, f"{name}.delay_far", rates={"far", "missed"})
        _check_example(unit["example"], f"{name}.example")
    return whole


def _check_lists(value: Any, names: tuple[str, ...], where: str, *, rates: set[str]) -> None:
    """Equally long lists of non-negative numbers, the first of them ascending."""
    lists = _fields(value, dict.fromkeys(names, list), where)
    first = lists[names[0]]
    for name, numbers in lists.items():
        _check_length(numbers, len(first), f"{where}.{name}")
        for i, number in enumerate(numbers):
            _check_number(number, f"{where}.{name}[{i}]", 0.0, 1.0 if name in rates else LARGEST)
    for i in range(1, len(first)):
        if first[i] < first[i - 1]:
            raise _wrong(f"{where}.{names[0]}[{i}]", first[i], f"at least {first[i - 1]}")


def _check_example(value: Any, where: str) -> None:
    kinds: dict[str, type] = {
        **dict.fromkeys(NUMBERS, int),
        "auc_matched": object,
        **dict.fromkeys((*SERIES, *ALARMS), list),
    }
    example = _fields(value, kinds, where)
    for name in NUMBERS:
        _check_number(example[name], f"{where}.{name}", 0.0, 1e9)
    if example["auc_matched"] is not None:
        _check_number(example["auc_matched"], f"{where}.auc_matched", 0.0, 1.0)
    start, onset = example["start"], example["onset"]
    if onset >= example["length"]:
        raise _wrong(f"{where}.onset", onset, f"less than length, {example['length']}")
    if start > onset:
        raise _wrong(f"{where}.start", start, f"at most onset, {onset}")
    for statistic, scores in (("cusum", "scores"), ("twin_cusum", "twin")):
        _check_length(example[scores], len(example[statistic]), f"{where}.{scores}")
        for name, low in ((statistic, 0.0), (scores, -LARGEST)):
            for i, number in enumerate(example[name]):
                # A score may be undefined, a statistic is not.
                if number is not None or name == statistic:
                    _check_number(number, f"{where}.{name}[{i}]", low, LARGEST)
    if len(example["scores"]) > example["length"] - start:
        raise _wrong(
            f"{where}.scores", f"{len(example['scores'])} numbers",
            f"at most length - start, {example['length'] - start}",
        )  # fmt: skip
    for alarms, statistic in ALARMS.items():
        stop = start + len(example[statistic])
        for i, row in enumerate(example[alarms]):
            if type(row) is not int or not start <= row < stop:
                raise _wrong(f"{where}.{alarms}[{i}]", row, f"a row in {start} ... {stop - 1}")


def _fields(value: Any, kinds: Mapping[str, type], where: str) -> dict[str, Any]:
    """Return an object with exactly these fields of these types."""
    if not isinstance(value, dict):
        raise _wrong(where, type(value).__name__, "a JSON object")
    if value.keys() != kinds.keys():
        raise ResultsError(
            f"{where} has other fields than expected: missing {sorted(kinds.keys() - value)}, "
            f"unknown {sorted(value.keys() - kinds)!s:.200}"
        )
    for name, kind in kinds.items():
        # bool is an int to isinstance, and never meant here.
        if not isinstance(value[name], kind) or isinstance(value[name], bool):
            raise _wrong(f"{where}.{name}", value[name], kind.__name__)
    return value


def _check_length(numbers: list[Any], expected: int, where: str) -> None:
    if len(numbers) > LONGEST:
        raise _wrong(where, f"{len(numbers)} numbers", f"at most {LONGEST}")
    if len(numbers) != expected:
        raise _wrong(where, f"{len(numbers)} numbers", f"{expected}")


def _check_number(value: Any, where: str, low: float, high: float) -> None:
    if type(value) not in (int, float) or not low <= value <= high:
        raise _wrong(where, value, f"a number in [{low:g}, {high:g}]")


def _wrong(where: str, found: Any, expected: str) -> ResultsError:
    return ResultsError(f"{where} is {found!r:.80}, expected {expected}")
