"""Angles that jump by a full turn: sine and cosine do not."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import UsageError
from oodd_logs.kinds import Conversion, Kind
from oodd_logs.kinds.naming import matching, read_names
from oodd_logs.kinds.wraps import sine_and_cosine

FULL_TURN: Final = dict.fromkeys(("deg", "°", "degree", "degrees"), 360.0)
"""Full turns in the units of angles other than radians."""

_TURNS: Final = (2 * np.pi, 360.0)


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    return {
        name: f"wraps at {facts.period:.4g}"
        for name, facts in columns.items()
        if facts.period in _TURNS
    }


def _convert(globs: Sequence[str], sensors: Sequence[Quantity]) -> list[Conversion]:
    angles = matching(globs, sensors, "sensor that is an angle")
    for i in angles:
        if sensors[i].unit not in {"1", "rad", *FULL_TURN}:
            raise UsageError(
                f"angles: {sensors[i].name!r} is in {sensors[i].unit}, expected rad or deg, as in "
                f"sensors = ['{sensors[i].name}[rad]']"
            )
    return [
        sine_and_cosine(i, sensors[i], FULL_TURN.get(sensors[i].unit, 2 * np.pi)) for i in angles
    ]


KIND: Final = Kind(
    "angle",
    "{names}: jumps of a full turn; write {line}, which makes sine and cosine of each",
    "angles",
    recognise=_recognise,
    check=read_names,
    convert=_convert,
)
