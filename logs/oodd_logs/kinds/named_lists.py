"""Lists beside a list of names, and lists of objects with names: items by name, never by place.

Several programs may write to one topic, each with parts of its own, and in any order.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_logs.kinds import Kind

_NAMING: Final = re.compile(r"name|key|label|joint|motor|channel|sensor|field|axis|axes|frame")
_NAMES: Final = ("name", "key", "child_frame_id", "joint_name", "label", "field", "k")
_VALUES: Final = frozenset({"value", "val", "v"})

Pairs = Iterable[tuple[str, Any]]


def _flatten(name: str, value: Any) -> Pairs | None:
    if isinstance(value, Mapping):
        return _beside_names(name, value)
    if _is_list(value) and len(value) and all(isinstance(item, Mapping) for item in value):
        return _with_names(name, value)
    return None


def _beside_names(name: str, value: Mapping[str, Any]) -> Pairs | None:
    """Return what is beside a list of names, with items of lists by these.

    ``{"name": ["hip", "knee"], "position": [1, 2]}`` has ``position.hip`` and ``position.knee``.
    """
    naming = [key for key, inner in value.items() if _are_names(inner)]
    fitting = [key for key in naming if _NAMING.search(key.lower())] or naming
    if not naming or len(fitting) > 1:
        return None
    names = fitting[0]
    items = _labels(value[names])
    others = [v for k, v in value.items() if k not in naming and _is_list(v) and len(v)]
    plain = [v for v in others if not isinstance(v[0], Mapping)]
    if any(len(v) != len(items) for v in plain):  # those of equal length are so by chance
        return None
    items_by_key = [(key, _named(inner, items)) for key, inner in value.items() if key != names]
    if not any(inner is not value[key] for key, inner in items_by_key):
        return None
    return [(f"{name}.{key}" if name else key, inner) for key, inner in items_by_key]


def _named(value: Any, names: Sequence[str]) -> Any:
    """Return lists with an item a name as mappings; those in a mapping, if all of its lists are."""
    if _is_list(value) and len(value) and isinstance(value[0], Mapping):
        inner = [_named(item, names) for item in value]
        if any(new is not old for new, old in zip(inner, value, strict=True)):
            return inner
    if _is_list(value) and len(value) == len(names) and not _are_names(value):
        return dict(zip(names, value, strict=True))
    if isinstance(value, Mapping):
        lists = [inner for inner in value.values() if _is_list(inner) and len(inner)]
        if lists and {*map(len, lists)} == {len(names)}:
            return {key: _named(inner, names) for key, inner in value.items()}
    return value


def _with_names(name: str, value: Sequence[Any]) -> Pairs | None:
    """Return objects by their names, and values of pairs of a key and a value by the key."""
    for key in _NAMES:
        names = [item.get(key) for item in value]
        if _are_names(names):
            rest = [{k: v for k, v in item.items() if k != key} for item in value]
            inner = [r.popitem()[1] if len(r) == 1 and {*r} <= _VALUES else r for r in rest]
            return [(f"{name}.{n}", i) for n, i in zip(_labels(names), inner, strict=True)]
    return None


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def _are_names(value: Any) -> bool:
    """Tell whether a value is a list of different texts."""
    if not isinstance(value, list | tuple) or not value or not isinstance(value[0], str):
        return False
    return all(isinstance(text, str) and text for text in value) and len({*value}) == len(value)


def _labels(names: Sequence[str]) -> list[str]:
    """Return names as parts of those of columns, in which brackets are around units, at the end."""
    parts = [re.split(r"(\[[^\[\]]+\])\Z", text) for text in names]
    brackets = str.maketrans("[]", "()")
    return [head.translate(brackets).strip() + "".join(unit) for head, *unit in parts]


KIND: Final = Kind("named-lists", "", flatten=_flatten)
