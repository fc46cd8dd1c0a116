"""Columns that begin anew at the end of any period, such as encoders of 4096 ticks."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import Quantity
from oodd_logs.kinds import Conversion, Kind, Matrix
from oodd_logs.kinds.naming import matching, wrong_value


def sine_and_cosine(position: int, sensor: Quantity, period: float) -> Conversion:
    """Return what makes sine and cosine of a sensor that begins anew after a period."""
    is_angle = sensor.role == "angle"
    outputs = (
        Quantity(f"sin {sensor.name}", "1", "sine" if is_angle else sensor.role),
        Quantity(f"cos {sensor.name}", "1", "cosine" if is_angle else sensor.role),
    )

    def convert(rows: Matrix) -> Matrix:
        turns = rows[:, 0] * (2 * np.pi / period)
        return np.stack([np.sin(turns), np.cos(turns)], axis=1)

    return Conversion((position,), outputs, lambda: convert)


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    known = {0.0, 2 * np.pi, 360.0}  # those of angles
    periods = {name: facts.period for name, facts in columns.items() if not facts.counter}
    return {name: period for name, period in periods.items() if period not in known}


def _check(key: str, value: Any) -> dict[str, float]:
    periods = value if isinstance(value, Mapping) else {"": value}
    for glob, period in periods.items():
        if not glob or isinstance(period, bool) or not isinstance(period, int | float):
            raise wrong_value(key, value, "a table of periods, such as {encoder = 4096}")
        if not 0 < period < 1e12:
            raise wrong_value(f"{key}.{glob}", period, "a period above 0")
    return {glob: float(period) for glob, period in periods.items()}


def _convert(periods: Mapping[str, float], sensors: Sequence[Quantity]) -> list[Conversion]:
    conversions: dict[int, Conversion] = {}
    for glob, period in periods.items():
        for i in matching([glob], sensors, "sensor that wraps"):
            conversions.setdefault(i, sine_and_cosine(i, sensors[i], period))
    return [*conversions.values()]


KIND: Final = Kind(
    "wrap",
    "{names}: begins anew at the end of a period; write {line}, which makes sine and cosine of "
    "each",
    "wraps",
    recognise=_recognise,
    check=_check,
    convert=_convert,
)
