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


def _flatten(name: str, value: Any) -> Iterable[tuple[str, Any]] | None:
    """Return the seconds of a stamp; protobuf writes whole ones as texts."""
    if not isinstance(value, Mapping) or len(value) != 2:
        return None
    keys = _PARTS.get(frozenset(value))
    if keys is None:
        return None
    try:
        whole, rest = (float(value[key]) for key in keys)
    except (TypeError, ValueError):
        return None
    return [(name, whole + rest / _PER_SECOND.get(keys[1], 1e9))]


KIND: Final = Kind("message-stamps", "", flatten=_flatten)
