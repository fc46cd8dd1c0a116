"""Stamps in messages: seconds beside what is left of one, whatever the order of their keys."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from oodd_logs.kinds import Kind

_PARTS: Final = {
    frozenset(keys): keys
    for keys in (
        ("sec", "nanosec"),
        ("sec", "nsec"),
        ("secs", "nsecs"),
        ("sec", "usec"),
        ("seconds", "nanos"),
        ("seconds", "nanoseconds"),
    )
}
_PER_SECOND: Final = {"usec": 1e6}


def stamp_of(value: Mapping[str, Any]) -> float | None:
    """Return the seconds of a stamp, None for another mapping; protobuf has whole ones as texts."""
    keys = _PARTS.get(frozenset(value))
    try:
        whole, rest = (float(value[key]) for key in keys or ("", ""))
    except (KeyError, TypeError, ValueError):
        return None
    return whole + rest / _PER_SECOND.get(keys[1] if keys else "", 1e9)


def _flatten(name: str, value: Any) -> Iterable[tuple[str, Any]] | None:
    if not isinstance(value, Mapping) or len(value) != 2 or (stamp := stamp_of(value)) is None:
        return None
    return [(name, stamp)]


KIND: Final = Kind("message-stamps", "", flatten=_flatten)
