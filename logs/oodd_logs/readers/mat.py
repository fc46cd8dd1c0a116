"""Recordings as MATLAB files: matrices and vectors of numbers, of version 5 and of 7.3, HDF5."""

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import TRANSPOSE, Options, Reader, chosen, is_transposed, library
from oodd_logs.readers.matrices import episode_of
from oodd_logs.recording import Recording

_CLASSES: Final = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
"""Classes of variables that are numbers; structures, cells and objects are left alone."""


def _open(path: Path, options: Options) -> Iterator[Recording]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that occur twice
        arrays = _arrays(path, options)
    plain = {}
    for name, array in arrays.items():
        plain[name] = array.T if is_transposed(path, options) else array
        if 1 in array.shape:
            plain[name] = array.ravel() if array.size > 1 else array.reshape(())
    topic, fields, ledger = episode_of(plain, str(path))
    yield Recording(path.stem, str(path), {"": topic}, fields, ledger)


def _arrays(path: Path, options: Options) -> Mapping[str, NDArray[Any]]:
    """Return the variables of the option ``variable``, or all that are matrices of numbers."""
    with path.open("rb") as opened:
        head = opened.read(128)
    file = None
    if b"MATLAB 7.3" in head or head.startswith(b"\x89HDF"):
        file = StoredFile(path, EPISODE)
        present = {name: rows for name, rows in file.members("/").items() if rows is not None}
        kinds = {n: "double" if r.dtype.kind in "fiub" else "other" for n, r in present.items()}
        sizes = {name: rows.nbytes for name, rows in present.items()}
    else:
        listed = library("scipy.io").whosmat(path)
        kinds = {name: kind for name, _, kind in listed}
        sizes = {name: 8 * math.prod(shape) for name, shape, _ in listed}
    numeric = [name for name, kind in kinds.items() if kind in _CLASSES]
    if not numeric:
        raise TrajectoryError(
            f"{path} has {', '.join(f'{n} ({k})' for n, k in kinds.items()) or 'no variables'}"
            ", expected matrices or vectors of numbers: save the fields of structures as variables"
        )
    names = chosen(numeric, options, "variable")
    EPISODE.check(str(path), np.dtype(float), sum(sizes[name] for name in names))
    if file:
        arrays = {name: present[name][:].T for name in names if len(present[name].shape) == 2}
        file.close()
        return arrays  # rows and columns are in MATLAB's order
    content = library("scipy.io").loadmat(path, variable_names=names)
    arrays = {name: np.asarray(content[name]) for name in names if name in content}
    return {name: a for name, a in arrays.items() if a.dtype.kind in EPISODE.kinds and a.ndim == 2}


READER: Final = Reader(
    "mat",
    "a MATLAB file",
    (".mat",),
    _open,
    extra="logs",
    options={"variable": "name of the variable to read, or a list of names or globs", **TRANSPOSE},
)
