"""Quaternions: q and -q are one rotation, and loggers write either."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import UnknownNameError
from oodd_logs.kinds import Conversion, Kind, Matrix
from oodd_logs.kinds.naming import read_names, wrong_value

_LETTER: Final = re.compile(
    r"(?P<stem>.*?)(?P<part>[wxyz0-3]|q?(?:real|imag?)[wijk123]?)\W*", re.IGNORECASE
)
_NAMED: Final = 0.02
_UNNAMED: Final = 1e-3
"""By how much the mean square norm may differ from 1, with names that say so and without."""


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    by_stem: dict[str, list[str]] = {}
    for name in columns:
        if match := _LETTER.fullmatch(re.sub(r"\[[^\]\d]*\]$", "", name)):
            by_stem.setdefault(match["stem"], []).append(name)
    fours = [(tuple(names), _NAMED) for names in by_stem.values() if len(names) == 4]
    names = [*columns]
    fours += [(tuple(names[i : i + 4]), _UNNAMED) for i in range(len(names) - 3)]
    taken: set[str] = set()
    rotations: dict[str | tuple[str, ...], Any] = {}
    for four, tolerance in fours:
        if not taken & {*four} and _is_rotation([columns[name] for name in four], tolerance):
            rotations[four] = None
            taken |= {*four}
    return rotations


def _is_rotation(facts: Sequence[Any], tolerance: float) -> bool:
    """Tell whether four columns have norm 1 in the mean of their squares."""
    if any(f.text or f.empty or f.numbers.largest > 1 + tolerance for f in facts):
        return False
    if sum(f.constant for f in facts) > 2 or len({f.cells for f in facts}) > 1:
        return False
    squares = sum(f.numbers.mean**2 + f.numbers.spread**2 for f in facts)
    return bool(abs(squares - 1) < tolerance)


def _check(key: str, value: Any) -> tuple[tuple[str, ...], ...]:
    lists = value if isinstance(value, list | tuple) else [value]
    lists = [lists] if lists and all(isinstance(name, str) for name in lists) else lists
    quaternions = tuple(read_names(key, names) for names in lists)
    if any(len(names) != 4 for names in quaternions):
        raise wrong_value(key, value, "lists of four names, such as [['q_w', 'q_x', 'q_y', 'q_z']]")
    return quaternions


class _Signs:
    """Signs of one quaternion: continuous within a recording, and near the first's in others."""

    def __init__(self) -> None:
        self._reference = np.zeros(4)

    def make(self) -> Callable[[Matrix], Matrix]:
        last = np.zeros(4)

        def convert(rows: Matrix) -> Matrix:
            nonlocal last
            present = np.isfinite(rows).all(axis=1)
            known = rows[present]
            if not len(known):
                return rows
            turns = np.sign((known[1:] * known[:-1]).sum(axis=1))
            signs = np.cumprod(np.append(1.0, np.where(turns < 0, -1.0, 1.0)))
            mean = (known * signs[:, None]).sum(axis=0)
            if not self._reference.any():
                self._reference = mean * np.copysign(1.0, mean[np.abs(mean).argmax()])
            before, first = (last, known[0]) if last.any() else (self._reference, mean)
            signs *= np.copysign(1.0, before @ first)
            last = known[-1] * signs[-1]
            out = rows.copy()
            out[present] = known * signs[:, None]
            return out

        return convert


def _convert(
    quaternions: Sequence[Sequence[str]], sensors: Sequence[Quantity]
) -> Iterator[Conversion]:
    names = [sensor.name for sensor in sensors]
    for four in quaternions:
        for name in four:
            if name not in names:
                raise UnknownNameError("sensor of a quaternion", name, names)
        inputs = tuple(names.index(name) for name in four)
        yield Conversion(inputs, tuple(sensors[i] for i in inputs), _Signs().make)


KIND: Final = Kind(
    "quaternion",
    "{names}: four columns of norm 1, of which q and -q are one rotation; write {line}, which "
    "makes the sign continuous",
    "quaternions",
    recognise=_recognise,
    check=_check,
    convert=_convert,
)
