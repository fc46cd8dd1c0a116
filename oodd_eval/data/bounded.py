"""Bounds of what strangers' files may hold, and readers of text and NumPy files that keep them.

A few bytes can announce or unpack to gigabytes, so sizes are compared with a bound before anything
is read. HDF5 files are read by `oodd_eval.data.stored`, within the same bounds.
"""

import math
import zipfile
from collections.abc import Collection
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
    """

    most: int
    error: type[OoddError]
    advice: str = ""
    kinds: str = "fiub"

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
STATE: Final = Bounds(2**32, FittedStateError)
POLICY: Final = Bounds(2**28, PolicyError, kinds="fiu")

MANIFEST_BYTES: Final = 10**7
STATE_BYTES: Final = 2**24  # of the JSON file of a saved detector
LINE_CHARACTERS: Final = 2**20  # of a line of a CSV file
CHUNK_BYTES: Final = 2**26  # of a chunk of an HDF5 dataset, packed or not
EPISODES: Final = 200_000  # of a part of imported logs

_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes
_HEADERS: Final = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_bytes(path: Path, most: int, error: type[OoddError]) -> bytes:
    """Return the content of a plain file of at most `most` bytes; raise `error` for others.

    `OSError` when it cannot be opened.
    """
    if path.exists() and not path.is_file():
        raise error(f"{path} is no plain file")
    with path.open("rb") as file:
        content = file.read(min(path.stat().st_size, most) + 1)
    if len(content) > most:
        raise error(f"{path} has more than {most} bytes")
    return content


def read_npz(
    path: Path, bounds: Bounds, names: Collection[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Return arrays of an ``.npz`` file by name.

    Parameters
    ----------
    path
        A file as ``numpy.savez`` writes it.
    bounds
        What its arrays may be; headers are compared with them before content is read.
    names
        Arrays to read where the file has them; None for all.

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
            for item in archive.infolist():
                name = item.filename.removesuffix(".npy")
                if names is None or name in names:
                    dtype, size = _announced(archive, item)
                    taken = bounds.check(f"{path}, {name}", dtype, size, taken)
                    with archive.open(item) as member:
                        arrays[name] = npy.read_array(member, allow_pickle=False)
    except bounds.error:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for damage
        raise bounds.error(f"{path} cannot be read: {type(error).__name__}: {error}") from error
    return arrays


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
