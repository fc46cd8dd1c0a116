"""Fitted state as two plain files, for detectors whose state is arrays: no pickle, nothing unsafe.

For a detector's ``save`` and ``load`` (`oodd_eval.plugins.contract.StorableDetector`)::

    state.json    what the detector is and the settings that its fit depends on
    arrays.npz    its arrays
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import FittedStateError

STATE: Final = "state.json"
ARRAYS: Final = "arrays.npz"


def save_state(
    directory: Path, *, kind: str, settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a fitted state into a directory.

    Parameters
    ----------
    directory
        An existing directory.
    kind
        What is saved, with the version of its layout: ``"mewma/1"``.
    settings
        What a detector must have been made with to load it; JSON values.
    arrays
        Numbers, by name; arrays of objects are refused.
    """
    np.savez_compressed(directory / ARRAYS, allow_pickle=False, **arrays)
    state = {"kind": kind, "settings": dict(settings)}
    (directory / STATE).write_text(json.dumps(state, indent=1), encoding="utf-8")


def load_state(
    directory: Path, *, kind: str, settings: Mapping[str, Any]
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a saved state.

    Raises
    ------
    FittedStateError
        When files are missing or damaged, or of another kind or other settings.
    """
    try:
        state = json.loads((directory / STATE).read_text(encoding="utf-8"))
        # What JSON makes of the settings is what was written: tuples come back as lists.
        wanted = {"kind": kind, "settings": json.loads(json.dumps(dict(settings)))}
        if state != wanted:
            raise FittedStateError(
                f"{str(directory)!r} holds {state}, expected {wanted}: make the detector with the "
                "parameters that it was saved with"
            )
        with np.load(directory / ARRAYS, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, FittedStateError):
            raise
        raise FittedStateError(
            f"{str(directory)!r} cannot be read as a saved detector ({STATE}, {ARRAYS}): {error}"
        ) from None


def take(
    arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], kind: str = "f"
) -> NDArray[Any]:
    """Return one array of a loaded state after a look at its shape and kind of numbers.

    Parameters
    ----------
    arrays
        From `load_state`.
    name
        Which.
    shape
        Expected lengths; None where any will do.
    kind
        ``"f"`` for finite floats, ``"i"`` for integers.

    Raises
    ------
    FittedStateError
        When it is absent, or something else.
    """
    found = arrays.get(name)
    if (
        found is None
        or found.dtype.kind != kind
        or found.ndim != len(shape)
        or any(n is not None and n != m for n, m in zip(shape, found.shape, strict=True))
        or (kind == "f" and not np.isfinite(found).all())
    ):
        what = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
        raise FittedStateError(
            f"saved array {name!r} is {what}, expected finite numbers of kind {kind!r} and shape "
            f"{shape} (None: any)"
        )
    return found
