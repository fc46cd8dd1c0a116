"""Read HDF5 files of strangers: sizes are bounded, and a change while a file is open is noticed.

HDF5 allows links, content in other files, types of any size, and filters that make gigabytes of a
few bytes. Here a file may hold only groups and plain datasets, and their sizes are checked before
anything is read.
"""

import contextlib
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import DigestError, SplitError, SplitNotFoundError

ROWS: Final = frozenset({"observations", "actions", "rewards"})
"""Datasets with a row for each step. All others are small, and are in memory once they are read."""

BROKEN: Final = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    RuntimeError,
    AttributeError,
    OverflowError,
    MemoryError,
)
"""Errors that h5py raises for a damaged file."""

_MOST_LABELS: Final = 2**27  # bytes of all small datasets of a file
_MOST_CHUNK: Final = 2**26  # bytes that a chunk may have, packed or not
_DEFLATE: Final = 1032  # bytes that the format can make of one
_FILTERS: Final = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_AGAIN: Final = "build or fetch it again"


class StoredRows:
    """A dataset of a `StoredFile`: its rows are read when asked for, and are those verified."""

    def __init__(self, file: "StoredFile", dataset: h5py.Dataset) -> None:
        self._file, self._dataset = file, dataset
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype[Any] = dataset.dtype
        self.chunks: tuple[int, ...] | None = dataset.chunks
        self.nbytes: int = dataset.nbytes

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Return a range of rows; `DigestError` when the file has changed since it was opened."""
        with self._file.reading(self._dataset.name):
            found: NDArray[Any] = self._dataset[rows]
        self._file.check_unchanged()
        return found


class StoredFile:
    """An open file of a split; `name` is the file's, without its directory.

    Raises `SplitNotFoundError` where there is no file, and `SplitError` where it is no HDF5 file.
    """

    def __init__(self, path: Path) -> None:
        self.name, self._labels = path.name, 0
        if not path.is_file():
            raise SplitNotFoundError(
                f"{path} is missing, or is no plain file: build or fetch the split again"
            )
        try:
            self._file = h5py.File(path, "r", rdcc_nbytes=2**20)
        except BROKEN as error:
            raise SplitError(
                f"{path.name} cannot be read, it is truncated or no HDF5 file ({error}): {_AGAIN}"
            ) from error
        self._stamp = self._state()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextlib.contextmanager
    def reading(self, what: str) -> Iterator[None]:
        """Turn what h5py raises for damaged content into a `SplitError`."""
        try:
            yield
        except SplitError:
            raise
        except BROKEN as error:
            self.check_unchanged()
            raise SplitError(
                f"{self.name}, group {what} cannot be read ({error}): {_AGAIN}"
            ) from error

    def groups(self, parent: str = "/") -> list[str]:
        """Return the names in a group, none where it is absent; each must be a group itself."""
        with self.reading(parent):
            if parent not in self._file:
                return []
            group = self._file if parent == "/" else child(self._file, parent)
            for name in group:
                if not isinstance(child(group, name), h5py.Group):
                    raise SplitError(f"{self.name} holds {name!r}, expected groups in {parent}")
            return [*group]

    def part(self, name: str) -> dict[str, Any]:
        """Return the datasets of a group by name: arrays, and `StoredRows` of those in `ROWS`."""
        with self.reading(name):
            group: Any = self._file
            for step in name.split("/"):
                if step not in group:
                    raise SplitError(f"{self.name} lacks the group {name}: {_AGAIN}")
                group = child(group, step)
            return {dataset: self._content(group, dataset) for dataset in group}

    def _content(self, group: h5py.Group, name: str) -> Any:
        found = child(group, name)
        if not isinstance(found, h5py.Dataset) or not found.shape:
            raise SplitError(f"{self.name}, {group.name} holds {name!r}, expected an array")
        if name in ROWS or found.dtype.hasobject:
            return StoredRows(self, found)
        self._labels += found.nbytes
        if self._labels > _MOST_LABELS:
            raise SplitError(
                f"{self.name}: with {found.name} all that is no row of an episode has "
                f"{self._labels} bytes, expected at most {_MOST_LABELS}: {_AGAIN}"
            )
        array: NDArray[Any] = found[:]
        array.flags.writeable = False
        return array

    def check_unchanged(self) -> None:
        """Raise `DigestError` when somebody wrote to the file since it was opened."""
        now, then = self._state(), self._stamp
        # A further name of the file, or one less, changes its third time, too.
        if now[:2] != then[:2] or (now[2] != then[2] and now[3] == then[3]):
            raise DigestError(
                f"{self.name} was changed while it was in use, expected what was verified: verify "
                "it, then run again while nothing writes to it"
            )

    def _state(self) -> tuple[int, int, int, int]:
        found = os.fstat(self._file.id.get_vfd_handle())
        return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_nlink


def child(group: h5py.Group, name: str) -> Any:
    """Return what a group holds under a name: a group, or a dataset that is plain.

    `SplitError` for a link that leads elsewhere, for content in another file, and for more content
    than the file can hold.
    """
    if not isinstance(group, h5py.Group):
        raise SplitError(f"{_place(group)} is no group, expected one with {name!r}")
    if group.id.links.get_info(name.encode(errors="surrogateescape")).type != h5py.h5l.TYPE_HARD:
        raise SplitError(f"{_place(group)} holds {name!r}, which points elsewhere: refused")
    if isinstance(found := group[name], h5py.Dataset) and found.shape:
        check_plain(found)
    return found


def _place(found: Any) -> str:
    """Return a group or dataset as messages name it."""
    return f"{Path(found.file.filename).name}, {found.name}"


def check_plain(dataset: h5py.Dataset) -> None:
    """Raise `SplitError` unless a dataset's content is in its file, and no more than fits there."""
    # Opening a split comes here for some hundred datasets: what h5py makes anew is asked for once.
    layout, item, held = dataset.id.get_create_plist(), dataset.dtype.itemsize, dataset.nbytes
    if layout.get_layout() == h5py.h5d.VIRTUAL or layout.get_external_count():
        raise SplitError(f"{_place(dataset)} keeps its content in another file: refused")
    filters = [layout.get_filter(i)[0] for i in range(layout.get_nfilters())]
    if {*filters} - _FILTERS or len(filters) > len({*filters}):
        raise SplitError(
            f"{_place(dataset)} is packed by the filters {filters}, expected gzip and "
            "shuffle: repack it, as with h5repack -f SHUF -f GZIP=4"
        )
    size = os.fstat(h5py.h5i.get_file_id(dataset.id).get_vfd_handle()).st_size
    pieces, longest, found, large = 1, held, [dataset.id.get_storage_size()], []
    if chunks := dataset.chunks:
        pairs = zip(dataset.shape, chunks, strict=True)
        pieces, longest = math.prod(-(-n // c) for n, c in pairs), math.prod(chunks) * item
        if longest > _MOST_CHUNK:
            raise SplitError(
                f"{_place(dataset)} has chunks of {longest} bytes, expected at most "
                f"{_MOST_CHUNK}: repack it, as with h5repack"
            )
        found = []

        def note(chunk: Any) -> None:
            found.append(chunk.size)
            if chunk.size * _DEFLATE > _MOST_CHUNK and filters:
                large.append(chunk)

        if pieces <= size:
            dataset.id.chunk_iter(note)
    most = sum(found) * (_DEFLATE if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if held > most or len(found) < pieces or sum(found) > size:
        raise SplitError(
            f"{_place(dataset)} has {held} bytes in {pieces} pieces, of which the file holds "
            f"{len(found)} in {sum(found)} bytes: it is damaged, or made to fill the memory"
        )
    for chunk in large:
        _, content = dataset.id.read_direct_chunk(chunk.chunk_offset)
        with contextlib.suppress(zlib.error):  # HDF5 says so, too, when the chunk is read
            if len(zlib.decompressobj().decompress(content, longest + 1)) > longest:
                where = _place(dataset)
                raise SplitError(f"{where} has a chunk that unpacks to more than {longest} bytes")
