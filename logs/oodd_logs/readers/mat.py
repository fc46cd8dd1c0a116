"""Recordings as MATLAB files: matrices and vectors of numbers, of version 5 and of 7.3, HDF5."""

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

Arrays = Mapping[str, NDArray[Any]]


def _open(path: Path, options: Options) -> Iterator[Recording]:
    with path.open("rb") as file:
        head = file.read(128)
    is_hdf5 = b"MATLAB 7.3" in head or head.startswith(b"\x89HDF")
    arrays = _version_7(path, options) if is_hdf5 else _version_5(path, options)
    transposed = is_transposed(path, options)
    plain = {}
    for name, array in arrays.items():
        plain[name] = array.T if transposed else array
        if 1 in array.shape:
            plain[name] = array.ravel() if array.size > 1 else array.reshape(())
    topic, fields, ledger = episode_of(plain, str(path))
    yield Recording(path.stem, str(path), {"": topic}, fields, ledger)


def _version_5(path: Path, options: Options) -> Arrays:
    scipy = library("scipy.io")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that occur twice
        present = {name: (shape, kind) for name, shape, kind in scipy.whosmat(path)}
        names = _variables(path, {n: kind for n, (_, kind) in present.items()}, options)
        size = sum(8 * int(np.prod(present[name][0], dtype=object)) for name in names)
        EPISODE.check(str(path), np.dtype(float), size)
        content = scipy.loadmat(path, variable_names=names)
    arrays = {name: np.asarray(content[name]) for name in names if name in content}
    return {name: a for name, a in arrays.items() if a.dtype.kind in EPISODE.kinds and a.ndim == 2}


def _version_7(path: Path, options: Options) -> Arrays:
    """Return the variables of an HDF5 file, in which rows and columns are in MATLAB's order."""
    file = StoredFile(path, EPISODE)
    present = {name: rows for name, rows in file.members("/").items() if rows is not None}
    kinds = {name: "double" if r.dtype.kind in "fiub" else "other" for name, r in present.items()}
    names = _variables(path, kinds, options)
    taken = 0
    for name in names:
        taken = EPISODE.check(f"{path}, {name}", present[name].dtype, present[name].nbytes, taken)
    arrays = {n: present[n][:].T for n in names if len(present[n].shape) == 2}
    file.close()
    return arrays


def _variables(path: Path, kinds: Mapping[str, str], options: Options) -> list[str]:
    """Return the variables to read: those of the option ``variable``, or all that are numbers."""
    numeric = [name for name, kind in kinds.items() if kind in _CLASSES]
    if not numeric:
        raise TrajectoryError(
            f"{path} has {', '.join(f'{n} ({k})' for n, k in kinds.items()) or 'no variables'}"
            ", expected matrices or vectors of numbers: save the fields of structures as variables"
        )
    return chosen(numeric, options, "variable")


READER: Final = Reader(
    "mat",
    "a MATLAB file",
    (".mat",),
    _open,
    extra="logs",
    options={"variable": "name of the variable to read, or a list of names or globs", **TRANSPOSE},
)
