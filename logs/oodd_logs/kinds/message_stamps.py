"""Stamps in messages: seconds beside what is left of one, whatever the order of their keys."""

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any, Final

from oodd_logs.kinds import Kind
from oodd_logs.kinds.times import unit_of

_PER_SECOND: Final = {"ns": 1e9, "us": 1e6}


def stamp_of(value: Mapping[str, Any]) -> float | None:
    """Return the seconds of a stamp, None for another mapping; protobuf has whole ones as texts."""
    parts = {unit_of(key): part for key, part in value.items()} if len(value) == 2 else {}
    for unit, per_second in _PER_SECOND.items():
        if {*parts} == {"s", unit}:
            with contextlib.suppress(TypeError, ValueError):
                return float(parts["s"]) + float(parts[unit]) / per_second
    return None


def _flatten(name: str, value: Any) -> Iterable[tuple[str, Any]] | None:
    stamp = stamp_of(value) if isinstance(value, Mapping) else None
    return None if stamp is None else [(name, stamp)]


KIND: Final = Kind("message-stamps", "", flatten=_flatten)
