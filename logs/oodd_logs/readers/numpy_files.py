"""Episodes as ``.npz`` files of named arrays, or an ``.npy`` file with one array."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from oodd_eval.data.bounded import EPISODE, npy_header, read_npz
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import TRANSPOSE, Options, Reader, is_transposed
from oodd_logs.readers.cells import WIDEST
from oodd_logs.readers.matrices import MatrixRows, episode_of, whole_number
from oodd_logs.recording import Recording

_BOUNDS: Final = dataclasses.replace(EPISODE, kinds="fiubU", entries=WIDEST)


def _open(path: Path, options: Options) -> Iterator[Recording]:
    arrays: dict[str, Any]
    arrays = {"observations": _array(path)} if path.suffix == ".npy" else read_npz(path, _BOUNDS)
    if is_transposed(path, options):
        arrays = {name: a.T if a.ndim == 2 else a for name, a in arrays.items()}
    name = next((n for n in arrays if n.startswith("obs")), "")
    count, rows, *more = arrays[name].shape if name else (0, 0)
    stacked = {n: a for n, a in arrays.items() if a.ndim and len(a) == count}
    if len(more) == 1 and all(a.ndim > 1 and rows - a.shape[1] in {0, 1} for a in stacked.values()):
        # The first axis is one of episodes, the second one of rows.
        for i in range(count):
            episode = {n: a[i] if n in stacked else a for n, a in arrays.items()}
            yield _recording(f"{path.stem}-{i}", f"{path}, episode {i}", episode)
    else:
        yield _recording(path.stem, str(path), arrays)


def _recording(name: str, source: str, arrays: Mapping[str, Any]) -> Recording:
    topic, fields, ledger = episode_of(cast("Mapping[str, MatrixRows]", arrays), source)
    for field in ("onset", "seed"):
        if field in fields:
            fields[field] = whole_number(source, field, fields[field])
    return Recording(name, source, {"": topic}, fields, ledger)


def _array(path: Path) -> Any:
    """Return the array of an ``.npy`` file, whose rows are read when asked for."""
    with path.open("rb") as file:
        dtype, size = npy_header(file)
        EPISODE.check(str(path), dtype, 0)
        if size > path.stat().st_size - file.tell():
            raise TrajectoryError(f"{path} announces {size} bytes of numbers and is shorter")
    return np.load(path, mmap_mode="r" if size else None, allow_pickle=False)


READER: Final = Reader("numpy", "a NumPy file", (".npz", ".npy"), _open, options=TRANSPOSE)
