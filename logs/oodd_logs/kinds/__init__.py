"""Kinds of columns: what the cells of logs may mean, and what is made of them.

Every module of this package that has a `Kind` named ``KIND`` adds one; plug-ins add others by the
hook ``oodd_kinds``. A kind tells by which columns it is recognised, in which words ``data inspect``
says so, which line of a recipe it writes, and how it converts what it is about.
"""

import dataclasses
import functools
import importlib
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import NAME_PATTERN, Quantity
from oodd_eval.errors import PluginError

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Conversion:
    """How some sensors become others.

    Parameters
    ----------
    inputs
        Positions of the sensors among all, in the order in which `make` takes them.
    outputs
        Names and units of what stands in their place, where the first of them stood.
    make
        Called at the beginning of each recording; returns a function that takes rows of shape
        (R, inputs), block after block of the recording, and returns rows of shape (R, outputs).
    """

    inputs: tuple[int, ...]
    outputs: tuple[Quantity, ...]
    make: Callable[[], Callable[[Matrix], Matrix]]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of columns.

    A kind needs `name` and `words`, and those functions that its stage takes: `flatten` for values
    in messages, `read` for texts in cells, `recognise` and `convert` for columns of numbers.

    Parameters
    ----------
    name
        Lower-case letters, digits and hyphens.
    words
        Says of columns that are of the kind what they are and what to write: ``{names}`` stands for
        their names, ``{line}`` for the line of the recipe. Of values in messages it is the reason
        for which the ledger has them; nothing is said for empty ones.
    key
        Key of recipes that lists columns of the kind; empty where a recipe says nothing of them.
    sensor
        Whether columns of the kind are sensors of a first recipe.
    recognise
        Called with facts of columns by name (`oodd_logs.inspection.columns.ColumnFacts`); returns
        by name, or a tuple of the names that belong together, a number, which the key has for it
        in a table, or None, and the key is a list; a text is said, but is not in the recipe.
    check
        Called with what messages call the key and its value in a recipe; returns the value, or
        raises `UsageError` with what is expected.
    convert
        Called with the value of the key and the sensors; returns its conversions, none of whose
        inputs those of another are.
    read
        Called with texts of a column that are no numbers; returns the numbers of those that the
        kind knows, by their text, NaN for what is missing.
    flatten
        Called with the name of a value in a message, or row of objects, and the value; returns
        pairs of names and values in its place, which are looked at again, none for a value that is
        left out, or None for a value of another kind.
    """

    name: str
    words: str
    key: str = ""
    sensor: bool = True
    recognise: Callable[[Mapping[str, Any]], Mapping[str | tuple[str, ...], Any]] | None = None
    check: Callable[[str, Any], Any] | None = None
    convert: Callable[[Any, Sequence[Quantity]], Iterable[Conversion]] | None = None
    read: Callable[[Sequence[str]], Mapping[str, float]] | None = None
    flatten: Callable[[str, Any], Iterable[tuple[str, Any]] | None] | None = None


def kinds() -> Mapping[str, Kind]:
    """Return the kinds by name: the project's, and those of plug-ins that were registered."""
    return MappingProxyType({**shipped_kinds(), **_registered})


def kinds_by_key() -> Mapping[str, Kind]:
    """Return the kinds that recipes list columns of, by the key of recipes."""
    return MappingProxyType({kind.key: kind for kind in kinds().values() if kind.key})


def register_kinds(offered: Iterable[Kind]) -> None:
    """Make kinds of plug-ins known in this process; `check_kind` says which may be.

    Where several share a name, or it is one of the project's, it is ``PLUGIN/NAME``.
    """
    for kind in offered:
        check_kind(dataclasses.replace(kind, name=str(kind.name).rpartition("/")[2]))
        _registered[kind.name] = kind
        _of_messages.cache_clear()


def check_kind(kind: Kind) -> None:
    """Raise `PluginError` for a kind with a wrong name or key."""
    if not re.fullmatch(NAME_PATTERN, str(kind.name)):
        raise PluginError(
            f"{kind.name!r} cannot be the name of a kind of columns, expected lower-case letters, "
            "digits and hyphens"
        )
    if kind.key and (kind.check is None or kind.convert is None):
        raise PluginError(f"kind {kind.name!r} has the key {kind.key!r}, but no check and convert")


def flattened(name: str, value: Any) -> tuple[Kind, list[tuple[str, Any]]] | None:
    """Return the kind that knows a value in a message, and what it makes of it; None without."""
    for kind, flatten in _of_messages():
        if (pairs := flatten(name, value)) is not None:
            return kind, [*pairs]
    return None


def read_texts(texts: Sequence[str]) -> dict[str, float]:
    """Return the numbers of texts that a kind knows, by text."""
    numbers: dict[str, float] = {}
    for kind in kinds().values():
        if kind.read is not None and (left := [text for text in texts if text not in numbers]):
            numbers |= kind.read(left)
    return numbers


@functools.cache
def shipped_kinds() -> dict[str, Kind]:
    """Return the kinds of the project by name."""
    names = (module.name for module in pkgutil.iter_modules(__path__, f"{__name__}."))
    modules = map(importlib.import_module, names)
    return {module.KIND.name: module.KIND for module in modules if hasattr(module, "KIND")}


@functools.cache
def _of_messages() -> list[tuple[Kind, Callable[[str, Any], Iterable[tuple[str, Any]] | None]]]:
    return [(kind, kind.flatten) for kind in kinds().values() if kind.flatten is not None]


_registered: Final[dict[str, Kind]] = {}
