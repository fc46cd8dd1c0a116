"""A detector's fitted state as data: named arrays and JSON values, never code.

What `oodd_eval.plugins.contract.StorableDetector.state` returns is packed into a `PackedState`:
checked and bounded, as it may be anybody's. So it goes over a pipe, and into one file: an ``.npz``
whose entry ``_json`` is the JSON text.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeAlias
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from oodd_eval.data import bounded
from oodd_eval.data.files import replacing
from oodd_eval.errors import ContractError, FittedStateError, OutputError

State: TypeAlias = Mapping[str, Any]
"""Fitted state by name: NumPy arrays of numbers, and values that JSON knows."""

Arrays: TypeAlias = Mapping[str, NDArray[Any]]

MOST_BYTES: Final = 512 * 10**6  # of all arrays of a state
MOST_ARRAYS: Final = 4096
MOST_TEXT: Final = 2**20  # characters of the JSON values

LARGEST_ITEM: Final = 8  # bytes of a number
LONGEST_NAME: Final = 200  # characters of the name of an array

VALUES: Final = "_json"
"""Entry of a file that holds the JSON text; no array has this name."""


@dataclass(frozen=True, slots=True)
class PackedState:
    """A checked state, apart: arrays of numbers, and the JSON text of all other values."""

    arrays: dict[str, NDArray[Any]]
    text: str

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in self.arrays.values())

    def values(self) -> dict[str, Any]:
        """Return what is no array; tuples have become lists."""
        values: dict[str, Any] = json.loads(self.text)
        return values

    def state(self) -> dict[str, Any]:
        """Return the state that was packed; tuples have become lists."""
        return {**self.values(), **self.arrays}


def pack(state: object, detector: str = "detector") -> PackedState:
    """Return a state in packed form, a copy; raise `ContractError` for what is none, or too large.

    Arrays keep their order in memory, on which the last bit of a sum may depend.
    """
    arrays: dict[str, NDArray[Any]] = {}
    values: dict[str, Any] = {}
    try:
        for name, value in _items(state):
            if type(value) is np.ndarray or isinstance(value, np.generic):
                arrays[name] = np.asarray(value)
            else:
                values[name] = _plain(value)
        problem, text = "", json.dumps(values, allow_nan=False)
    except Exception as error:  # noqa: BLE001  classes of others may raise anything
        # Nor can every one of them say what it is.
        reason = [text for text in error.args if type(text) is str]
        problem, text = ": ".join([type(error).__name__, *reason]), ""
    packed = PackedState(arrays, text)
    if problem := problem or excess(packed):
        raise ContractError(
            f"state() of {detector}: {problem}; expected a mapping from names to NumPy arrays of "
            "numbers and finite JSON values"
        )
    return PackedState({n: np.array(a, order="A") for n, a in arrays.items()}, text)


def _items(state: object) -> list[tuple[str, object]]:
    if not isinstance(state, Mapping):
        raise TypeError(f"it is {type(state).__name__}")
    items = list(islice(state.items(), MOST_ARRAYS + 1))  # a class of its own may have no end
    if len(items) > MOST_ARRAYS:
        raise ValueError(f"more than {MOST_ARRAYS} names")
    if wrong := [type(name).__name__ for name, _ in items if type(name) is not str]:
        raise TypeError(f"a name is {wrong[0]}")
    return items


def _plain(value: object) -> object:
    """Return a JSON value of plain lists and dictionaries, whatever classes these had."""
    if isinstance(value, dict):
        if wrong := [type(name).__name__ for name in dict.keys(value) if type(name) is not str]:
            raise TypeError(f"a name is {wrong[0]}")
        return {name: _plain(part) for name, part in dict.items(value)}
    if isinstance(value, list | tuple):
        parts = list.__iter__(value) if isinstance(value, list) else tuple.__iter__(value)
        return [_plain(part) for part in parts]
    return value


def excess(packed: PackedState) -> str:
    """Return by what a state is too large or what is wrong with an array; empty if nothing is."""
    if len(packed.arrays) > MOST_ARRAYS:
        return f"{len(packed.arrays)} arrays, expected at most {MOST_ARRAYS}"
    for name, array in packed.arrays.items():
        # Names that an entry of a file can have, and that come back from it.
        named = len(name) <= LONGEST_NAME and name.isprintable() and not name.endswith(".npy")
        if not named or name in {"", VALUES}:
            return (
                f"an array is called {name!r:.{LONGEST_NAME}}, expected up to {LONGEST_NAME} "
                f"printable characters, not {VALUES!r} and without '.npy' at the end"
            )
        dtype = array.dtype
        if dtype.kind not in "fiub" or dtype.itemsize > LARGEST_ITEM or not dtype.isnative:
            expected = f"integers, floats or truth values of at most {LARGEST_ITEM} bytes"
            return f"array {name!r} is of {dtype.str}, expected {expected}"
    if packed.nbytes > MOST_BYTES:
        return f"arrays take {packed.nbytes} bytes, expected at most {MOST_BYTES}"
    if len(packed.text) > MOST_TEXT:
        return f"JSON values take {len(packed.text)} characters, expected at most {MOST_TEXT}"
    return ""


def write_state(path: Path, packed: PackedState) -> None:
    """Write a state as one file, which is whole or absent; `OutputError` where it cannot be."""
    if path.is_dir():
        raise OutputError(
            f"{str(path)!r} is a directory, as earlier versions saved fits; a fit is one file now: "
            "remove the directory, or choose another name such as NAME.npz"
        )
    text = np.frombuffer(packed.text.encode(), np.uint8)
    with replacing(path) as temporary, ZipFile(temporary, "w") as archive:
        # The text last: damage that hides entries of the list of contents hides those behind it.
        for name, array in {**packed.arrays, VALUES: text}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                npy.write_array(entry, array, allow_pickle=False)


def read_state(path: Path) -> PackedState:
    """Read what `write_state` wrote; raise `FittedStateError` for anything else."""
    if path.is_dir():
        raise FittedStateError(
            f"{str(path)!r} is a directory, as earlier versions saved fits; expected one file: "
            "fit again and save"
        )
    if not path.exists():
        raise FittedStateError(f"there is no saved fit {str(path)!r}: fit and save first")
    arrays = bounded.read_npz(path, bounded.STATE)
    values = arrays.pop(VALUES, None)
    try:
        text = "" if values is None else values.tobytes().decode()
        # No integer is called NaN or Infinity, which are no JSON.
        named = isinstance(json.loads(text, parse_constant=int), dict)
    except (ValueError, RecursionError):
        named = False
    if not named:
        raise FittedStateError(
            f"{str(path)!r} is no saved fit: its entry {VALUES!r} is no JSON object"
        )
    packed = PackedState(arrays, text)
    if problem := excess(packed):
        raise FittedStateError(f"{str(path)!r} is no saved fit: {problem}")
    return packed


def labelled(kind: str, settings: Mapping[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return a state that says what it is of, for `unlabelled`.

    Parameters
    ----------
    kind
        Its name, with the version of its layout, such as ``"mewma/1"``.
    settings
        JSON values that a detector must share to take it over.
    arrays
        The fit by name.

    Returns
    -------
    dict
        The arrays, with kind and settings beside them.
    """
    return {"kind": kind, "settings": dict(settings), **arrays}


def unlabelled(state: State, kind: str, settings: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a state that `labelled` made.

    Parameters
    ----------
    state
        A state of anybody's.
    kind, settings
        The expected ones.

    Returns
    -------
    dict
        The arrays by name.

    Raises
    ------
    FittedStateError
        For another kind or other settings.
    """
    # What JSON makes of the settings is what was kept: tuples come back as lists.
    expected = {"kind": kind, "settings": json.loads(json.dumps(dict(settings)))}
    values = {name: state.get(name) for name in expected}
    if any(isinstance(v, np.ndarray) for v in values.values()) or values != expected:
        advice = "make the detector with the parameters that it was fitted with"
        raise FittedStateError(f"the state is of {values!s:.500}, expected {expected}: {advice}")
    return {name: value for name, value in state.items() if isinstance(value, np.ndarray)}


def take(
    arrays: Mapping[str, Any], name: str, shape: tuple[int | None, ...], kind: str = "f"
) -> NDArray[Any]:
    """Return one array of a state.

    Parameters
    ----------
    arrays
        A state of anybody's.
    name
        Of the array.
    shape
        Its expected lengths, None where any will do.
    kind
        ``"f"`` for finite floats, ``"+"`` for positive ones, such as scales, ``"i"`` for integers.

    Returns
    -------
    array
        As it is in the state.

    Raises
    ------
    FittedStateError
        When there is none, or it is something else.
    """
    array = arrays.get(name)
    if (
        not isinstance(array, np.ndarray)
        or array.dtype.kind != ("i" if kind == "i" else "f")
        or array.ndim != len(shape)
        or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
        or not np.isfinite(array).all()
        or (kind == "+" and not (array > 0).all())
    ):
        actual = "nothing" if array is None else f"{type(array).__name__} {np.shape(array)}"
        numbers = {"f": "finite floats", "+": "positive finite floats", "i": "integers"}[kind]
        raise FittedStateError(
            f"array {name!r} of the state is {actual}, expected {numbers} of shape {shape} "
            "(None: any)"
        )
    return array
