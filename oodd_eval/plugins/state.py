"""Fitted state as two plain files, for detectors whose state is arrays: no pickle, nothing unsafe.

For a detector's ``save`` and ``load`` (`oodd_eval.plugins.contract.StorableDetector`)::

    state.json    what the detector is and the settings that its fit depends on
    arrays.npz    its arrays
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data import bounded
from oodd_eval.errors import FittedStateError

STATE: Final = "state.json"
ARRAYS: Final = "arrays.npz"

Arrays: TypeAlias = Mapping[str, NDArray[Any]]


def save_state(directory: Path, *, kind: str, settings: Mapping[str, Any], arrays: Arrays) -> None:
    """Write arrays of numbers and the settings (JSON values) that a detector needs to load them.

    `kind` names the state, with the version of its layout: ``"mewma/1"``.
    """
    np.savez_compressed(directory / ARRAYS, allow_pickle=False, **arrays)
    state = {"kind": kind, "settings": dict(settings)}
    (directory / STATE).write_text(json.dumps(state, indent=1), encoding="utf-8")


def load_state(directory: Path, *, kind: str, settings: Mapping[str, Any]) -> Arrays:
    """Return the arrays of a saved state.

    Raises `FittedStateError` for missing or damaged files, another kind, or other settings.
    """
    # What JSON makes of the settings is what was written: tuples come back as lists.
    expected = {"kind": kind, "settings": json.loads(json.dumps(dict(settings)))}
    try:
        state, arrays = _read(directory)
    except Exception as error:  # noqa: BLE001  zip, NumPy and JSON raise many kinds for damage
        what = f"{str(directory)!r} cannot be read as a saved detector ({STATE}, {ARRAYS})"
        raise FittedStateError(f"{what}: {error}") from None
    if state != expected:
        advice = "make the detector with the parameters that it was saved with"
        raise FittedStateError(f"{str(directory)!r} holds {state}, expected {expected}: {advice}")
    return arrays


def _read(directory: Path) -> tuple[Any, Arrays]:
    state = json.loads(bounded.read_bytes(directory / STATE, bounded.STATE_BYTES, FittedStateError))
    return state, bounded.read_npz(directory / ARRAYS, bounded.STATE)


def take(arrays: Arrays, name: str, shape: tuple[int | None, ...], kind: str = "f") -> NDArray[Any]:
    """Return one array of `load_state`, or raise `FittedStateError` when it is something else.

    `shape` has the expected lengths, None where any will do; `kind` is ``"f"`` for finite floats,
    ``"+"`` for positive ones, such as scales, and ``"i"`` for integers.
    """
    array = arrays.get(name)
    if (
        array is None
        or array.dtype.kind != ("i" if kind == "i" else "f")
        or array.ndim != len(shape)
        or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
        or not np.isfinite(array).all()
        or (kind == "+" and not (array > 0).all())
    ):
        what = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
        numbers = {"f": "finite floats", "+": "positive finite floats", "i": "integers"}[kind]
        expected = f"{numbers} of shape {shape} (None: any)"
        raise FittedStateError(f"saved array {name!r} is {what}, expected {expected}")
    return array
