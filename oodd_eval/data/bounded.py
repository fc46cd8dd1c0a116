"""Bounds of what strangers' files may hold, and readers of text and NumPy files that keep them.

A few bytes can announce or unpack to gigabytes, so sizes are compared with a bound before anything
is read. HDF5 files are read by `oodd_eval.data.stored`, within the same bounds.
"""

import errno
import io
import json
import math
import os
import stat
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from oodd_eval.errors import (
    FittedStateError,
    OoddError,
    PolicyError,
    ResultsError,
    SplitError,
    TrajectoryError,
)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the arrays in one kind of file.

    Parameters
    ----------
    most
        Bytes that all arrays read from one file may take together.
    error
        Raised for content that is damaged or out of bounds.
    advice
        What to do then; it ends the message.
    kinds
        Kinds of NumPy dtypes that arrays may have; empty where the caller checks dtypes.
    entries
        Arrays that one ``.npz`` file may have.
    """

    most: int
    error: type[OoddError]
    advice: str = ""
    kinds: str = "fiub"
    entries: int = 2**20

    def check(self, what: str, dtype: np.dtype[Any], size: int, taken: int = 0) -> int:
        """Return the bytes taken with `size` more; raise `error` beyond the bounds."""
        if self.kinds and dtype.kind not in self.kinds:
            raise self.error(f"{what} has dtype {dtype.str}, expected numbers")
        if taken + size > self.most:
            raise self.failure(f"{what}: arrays take {taken + size} bytes, limit {self.most}")
        return taken + size

    def failure(self, problem: str) -> OoddError:
        """Return the error for a problem, with the advice."""
        return self.error(f"{problem}: {self.advice}" if self.advice else problem)


SPLIT: Final = Bounds(2**27, SplitError, "build or fetch it again", kinds="")
"""Of a file of a split, all but the rows of episodes, which are read in blocks."""
EPISODE: Final = Bounds(2**28, TrajectoryError, "split the episode")
SCORES: Final = Bounds(2 * 10**7 * 8, ResultsError, kinds="f")
STATE: Final = Bounds(520 * 10**6, FittedStateError, "fit again", entries=5000)
POLICY: Final = Bounds(2**28, PolicyError, kinds="fiu")

MANIFEST_BYTES: Final = 10**7
TOML_BYTES: Final = 10**6  # of a recipe or configuration
_DEEPEST: Final = 50  # levels of lists and objects
LINE_CHARACTERS: Final = 2**20  # of a line of a CSV file
CHUNK_BYTES: Final = 2**26  # of a chunk of an HDF5 dataset, packed or not
EPISODES: Final = 200_000  # of a part of imported logs

_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes
_HEADERS: Final = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def open_plain(path: Path) -> io.BufferedReader:
    """Open a plain file for reading; `OSError` for what is none, such as a pipe or a device.

    Opening a pipe waits for somebody to write into it, and a device may have no end.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is no plain file", str(path))
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, most: int, error: type[OoddError]) -> bytes:
    """Return the content of a plain file of at most `most` bytes; raise `error` for others."""
    try:
        with open_plain(path) as file:
            size = os.fstat(file.fileno()).st_size
            # Reading takes memory for as many bytes as are asked for.
            content = b"" if size > most else file.read(size + 1)
    except (OSError, ValueError) as problem:  # a name may hold what no file's name may
        why = getattr(problem, "strerror", None) or problem
        raise error(f"{str(path)!r} cannot be read: {why}") from None
    if max(size, len(content)) > most:
        raise error(f"{str(path)!r} has more than {most} bytes")
    return content


def read_json(path: Path, most: int, error: type[OoddError]) -> Any:
    """Return the value in a file of JSON of at most `most` bytes; raise `error` for others."""
    return _parsed(path, read_bytes(path, most, error), json.loads, error)


def read_toml(path: Path, error: type[OoddError]) -> dict[str, Any]:
    """Return the content of a file in TOML that people write; raise `error` for others."""
    content: dict[str, Any] = _parsed(
        path, read_bytes(path, TOML_BYTES, error), lambda text: tomllib.loads(text.decode()), error
    )
    return content


def _parsed(
    path: Path, content: bytes, parse: Callable[[bytes], Any], error: type[OoddError]
) -> Any:
    try:
        level = [value := parse(content)]
        for _ in range(_DEEPEST):
            level = [inner for outer in level for inner in _inner(outer)]
        if level:
            raise RecursionError("is nested too deep")  # noqa: TRY301
    except (ValueError, RecursionError) as problem:
        raise error(f"{str(path)!r} cannot be read: {problem}") from None
    return value


def _inner(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def read_npz(path: Path, bounds: Bounds) -> dict[str, NDArray[Any]]:
    """Return arrays of an ``.npz`` file by name.

    Parameters
    ----------
    path
        A file as ``numpy.savez`` writes it.
    bounds
        What its arrays may be; headers are compared with them before content is read.

    Raises
    ------
    OoddError
        The error of `bounds`, when the file is damaged or exceeds them. Nothing is unpickled.
    """
    if not path.is_file():
        raise bounds.error(f"{path} is no plain file")
    arrays: dict[str, NDArray[Any]] = {}
    taken = 0
    try:
        with zipfile.ZipFile(path) as archive:
            for item in _few(archive.infolist(), path, bounds):
                name = item.filename.removesuffix(".npy")
                dtype, size = _announced(archive, item)
                taken = bounds.check(f"{path}, {name}", dtype, size, taken)
                with archive.open(item) as member:
                    arrays[name] = npy.read_array(member, allow_pickle=False)
    except bounds.error:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for damage
        problem = f"{path} cannot be read: {type(error).__name__}: {error}"
        raise bounds.failure(problem) from error
    return arrays


def _few(items: list[zipfile.ZipInfo], path: Path, bounds: Bounds) -> list[zipfile.ZipInfo]:
    if len(items) > bounds.entries:
        raise bounds.failure(f"{path} has {len(items)} arrays, limit {bounds.entries}")
    return items


def _announced(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> tuple[np.dtype[Any], int]:
    if item.compress_type not in _METHODS:
        raise zipfile.BadZipFile(f"{item.filename} is neither stored nor deflated")
    with archive.open(item) as member:
        return npy_header(member)


def npy_header(file: IO[bytes]) -> tuple[np.dtype[Any], int]:
    """Return the dtype and the bytes of content that the header of an ``.npy`` file announces."""
    header = _HEADERS[npy.read_magic(file)]
    shape, _, dtype = header(file)
    if min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape}")
    return dtype, math.prod(shape) * dtype.itemsize


def without_nan(value: Any) -> Any:
    """Return a value for JSON: None in place of numbers that it does not know, at any depth."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return value
