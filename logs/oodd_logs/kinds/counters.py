"""Counters and clocks: no sensors as they are, but their increments may be."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import Quantity
from oodd_logs.kinds import Conversion, Kind, Matrix
from oodd_logs.kinds.naming import matching, read_names


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    return {name: None for name, facts in columns.items() if facts.counter}


def _increments() -> Callable[[Matrix], Matrix]:
    last = np.full((1, 1), np.nan)

    def convert(rows: Matrix) -> Matrix:
        nonlocal last
        before = rows[:1] if np.isnan(last).all() else last
        last = rows[-1:]
        return np.diff(rows, axis=0, prepend=before)

    return convert


def _convert(globs: Sequence[str], sensors: Sequence[Quantity]) -> list[Conversion]:
    return [
        Conversion((i,), (Quantity(f"step of {sensors[i].name}", sensors[i].unit),), _increments)
        for i in matching(globs, sensors, "sensor that is a counter")
    ]


KIND: Final = Kind(
    "counter",
    "{names}: rising without end, a counter or clock, no sensor; as sensors with {line} their "
    "increments are taken",
    "counters",
    sensor=False,
    recognise=_recognise,
    check=read_names,
    convert=_convert,
)
