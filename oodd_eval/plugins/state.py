"""Fitted state as two plain files, for detectors whose state is arrays: no pickle, nothing unsafe.

For a detector's ``save`` and ``load`` (`oodd_eval.plugins.contract.StorableDetector`)::

    state.json    what the detector is and the settings that its fit depends on
    arrays.npz    its arrays
"""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

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


MOST_JSON: Final = 2**24  # bytes
MOST_ARRAYS: Final = 2**32  # bytes of all, unpacked


def load_state(directory: Path, *, kind: str, settings: Mapping[str, Any]) -> Arrays:
    """Return the arrays of a saved state.

    Raises `FittedStateError` for missing or damaged files, another kind, or other settings.
    """
    # What JSON makes of the settings is what was written: tuples come back as lists.
    wanted = {"kind": kind, "settings": json.loads(json.dumps(dict(settings)))}
    try:
        state, arrays = _read(directory)
    except Exception as error:  # noqa: BLE001  zip, NumPy and JSON raise many kinds for damage
        what = f"{str(directory)!r} cannot be read as a saved detector ({STATE}, {ARRAYS})"
        raise FittedStateError(f"{what}: {error}") from None
    if state != wanted:
        advice = "make the detector with the parameters that it was saved with"
        raise FittedStateError(f"{str(directory)!r} holds {state}, expected {wanted}: {advice}")
    return arrays


def _read(directory: Path) -> tuple[Any, Arrays]:
    if (size := (directory / STATE).stat().st_size) > MOST_JSON:
        raise ValueError(f"{STATE} has {size} bytes, expected at most {MOST_JSON}")
    state = json.loads((directory / STATE).read_text(encoding="utf-8"))
    with zipfile.ZipFile(directory / ARRAYS) as packed:
        size = sum(item.file_size for item in packed.infolist())
    if size > MOST_ARRAYS:
        raise ValueError(f"{ARRAYS} unpacks to {size} bytes, expected at most {MOST_ARRAYS}")
    with np.load(directory / ARRAYS, allow_pickle=False) as stored:
        return state, {name: stored[name] for name in stored.files}


def take(arrays: Arrays, name: str, shape: tuple[int | None, ...], kind: str = "f") -> NDArray[Any]:
    """Return one array of `load_state`, or raise `FittedStateError` when it is something else.

    `shape` has the expected lengths, None where any will do; `kind` is ``"f"`` for finite floats,
    ``"+"`` for positive ones, such as scales, and ``"i"`` for integers.
    """
    found = arrays.get(name)
    if (
        found is None
        or found.dtype.kind != ("i" if kind == "i" else "f")
        or found.ndim != len(shape)
        or any(n is not None and n != m for n, m in zip(shape, found.shape, strict=True))
        or not np.isfinite(found).all()
        or (kind == "+" and not (found > 0).all())
    ):
        what = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
        numbers = {"f": "finite floats", "+": "positive finite floats", "i": "integers"}[kind]
        expected = f"{numbers} of shape {shape} (None: any)"
        raise FittedStateError(f"saved array {name!r} is {what}, expected {expected}")
    return found
