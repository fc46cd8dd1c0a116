"""Read HDF5 files of strangers: sizes are bounded, and a change while a file is open is noticed.

HDF5 allows links, content in other files, types of any size, and filters that make gigabytes of a
few bytes. Here a file may hold only groups and plain datasets, and their sizes are compared with
`oodd_eval.data.bounded` before anything is read.
"""

import contextlib
import math
import os
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import CHUNK_BYTES, SPLIT, Bounds
from oodd_eval.errors import DigestError, OoddError, SplitError

ROWS: Final = frozenset({"observations", "actions", "rewards"})
"""Datasets of a split with a row for each step: they are read in ranges, all others at once."""

_BROKEN: Final = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    RuntimeError,
    AttributeError,
    OverflowError,
    MemoryError,
)  # what h5py raises for damage
_DEFLATE: Final = 1032  # bytes that the format can make of one
_FILTERS: Final = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}


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
            block: NDArray[Any] = self._dataset[rows]
        self._file.check_unchanged()
        return block


class StoredFile:
    """An open HDF5 file, by default of a split.

    Parameters
    ----------
    path
        The file.
    bounds
        What its arrays may be; its error is raised where the file cannot be read.
    """

    def __init__(self, path: Path, bounds: Bounds = SPLIT) -> None:
        self.name, self.bounds = path.name, bounds
        self._taken = 0  # bytes of what was read at once
        if not path.is_file():
            raise bounds.failure(f"{path} is no plain file")
        try:
            self._file = h5py.File(path, "r", rdcc_nbytes=2**20, locking=False)
        except _BROKEN as error:
            raise bounds.failure(
                f"{self.name} cannot be read, it is truncated or no HDF5 file ({error})"
            ) from error
        self._stamp = self._state()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextlib.contextmanager
    def reading(self, what: str) -> Iterator[None]:
        """Raise the error of the bounds for whatever h5py raises for damaged content."""
        try:
            yield
        except OoddError:
            raise
        except _BROKEN as error:
            self.check_unchanged()
            raise self.bounds.failure(
                f"{self.name}, group {what} cannot be read ({error})"
            ) from error

    def groups(self, parent: str = "/") -> list[str]:
        """Return the names in a group, none where it is absent; each must be a group itself."""
        with self.reading(parent):
            if parent not in self._file:
                return []
            group = self._file if parent == "/" else child(self._file, parent, self.bounds.error)
            for name in group:
                if not isinstance(child(group, name, self.bounds.error), h5py.Group):
                    message = f"{self.name} holds {name!r}, expected groups in {parent}"
                    raise self.bounds.error(message)
            return [*group]

    def part(self, name: str, datasets: Collection[str] | None = None) -> dict[str, Any]:
        """Return datasets of a group by name.

        Parameters
        ----------
        name
            Path of the group.
        datasets
            Those to read at once, as far as the group has them; it stands for a file of its own
            then, which the bounds are for. By default all, those in `ROWS` as `StoredRows`.
        """
        with self.reading(name):
            group = self._group(name)
            if datasets is None:
                return {dataset: self._content(group, dataset, ROWS) for dataset in group}
            self._taken = 0
            return {d: self._content(group, d) for d in datasets if d in group}

    def attributes(self, name: str, keys: Collection[str]) -> dict[str, Any]:
        """Return attributes of a group with one value each, as far as it has them."""
        with self.reading(name):
            attributes = self._group(name).attrs
            present = [key for key in keys if key in attributes]
            for key in present:
                if math.prod(attributes.get_id(key).shape) != 1:
                    raise self.bounds.error(f"{self.name}, group {name}: {key} is no single value")
            return {key: attributes[key] for key in present}

    def members(self, name: str) -> dict[str, StoredRows | None]:
        """Return what a group holds by name: datasets, and None for each group."""
        with self.reading(name):
            group = self._group(name)
            items = {key: child(group, key, self.bounds.error) for key in group}
            return {
                key: StoredRows(self, item) if isinstance(item, h5py.Dataset) else None
                for key, item in items.items()
                if isinstance(item, h5py.Dataset | h5py.Group)
            }

    def single_values(self, name: str) -> dict[str, Any]:
        """Return the attributes of a group that are one number or text."""
        with self.reading(name):
            attributes = self._group(name).attrs
            single = [
                key for key in attributes if math.prod(attributes.get_id(key).shape or ()) == 1
            ]
            values = {key: attributes[key] for key in single}
        return {
            key: value.item() if isinstance(value, np.generic) else value
            for key, value in values.items()
            if isinstance(value, str | np.number | np.bool_)
        }

    def _group(self, path: str) -> h5py.Group:
        group: Any = self._file
        for name in filter(None, path.split("/")):
            if name not in group:
                raise self.bounds.failure(f"{self.name} lacks the group {path}")
            group = child(group, name, self.bounds.error)
        return group

    def _content(self, group: h5py.Group, name: str, lazy: Collection[str] = ()) -> Any:
        dataset = child(group, name, self.bounds.error)
        if not isinstance(dataset, h5py.Dataset):
            message = f"{self.name}, {group.name} holds {name!r}, expected an array"
            raise self.bounds.error(message)
        if name in lazy or (lazy and dataset.dtype.hasobject):
            return StoredRows(self, dataset)
        array_name = f"{self.name}, {dataset.name}"
        self._taken = self.bounds.check(array_name, dataset.dtype, dataset.nbytes, self._taken)
        array: NDArray[Any] = np.asarray(dataset[()])
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
        status = os.fstat(self._file.id.get_vfd_handle())
        return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_nlink


def child(group: h5py.Group, name: str, error: type[OoddError] = SplitError) -> Any:
    """Return what a group holds under a name: a group, or a dataset that is plain.

    Raise `error` for a link that leads elsewhere, for content in another file, and for more content
    than the file can hold.
    """
    if not isinstance(group, h5py.Group):
        raise error(f"{_label(group)} is no group, expected one with {name!r}")
    if group.id.links.get_info(name.encode(errors="surrogateescape")).type != h5py.h5l.TYPE_HARD:
        raise error(f"{_label(group)} holds {name!r}, which points elsewhere: refused")
    item = group[name]
    if isinstance(item, h5py.Dataset):
        check_plain(item, error)
    return item


def _label(item: Any) -> str:
    """Return a group or dataset as messages name it."""
    return f"{Path(item.file.filename).name}, {item.name}"


def check_plain(dataset: h5py.Dataset, error: type[OoddError] = SplitError) -> None:
    """Raise `error` unless a dataset's content is in its file, and no more than fits there."""
    if dataset.shape is None:
        raise error(f"{_label(dataset)} is empty, expected an array")
    # Opening a split comes here for some hundred datasets: what h5py makes anew is asked for once.
    layout, item, size = dataset.id.get_create_plist(), dataset.dtype.itemsize, dataset.nbytes
    if layout.get_layout() == h5py.h5d.VIRTUAL or layout.get_external_count():
        raise error(f"{_label(dataset)} keeps its content in another file: refused")
    filters = [layout.get_filter(i)[0] for i in range(layout.get_nfilters())]
    if {*filters} - _FILTERS or len(filters) > len({*filters}):
        raise error(
            f"{_label(dataset)} is packed by the filters {filters}, expected gzip and "
            "shuffle: repack it, as with h5repack -f SHUF -f GZIP=4"
        )
    file_size = os.fstat(h5py.h5i.get_file_id(dataset.id).get_vfd_handle()).st_size
    pieces, longest, stored, large = 1, size, [dataset.id.get_storage_size()], []
    if chunks := dataset.chunks:
        pairs = zip(dataset.shape, chunks, strict=True)
        pieces, longest = math.prod(-(-n // c) for n, c in pairs), math.prod(chunks) * item
        if longest > CHUNK_BYTES:
            raise error(
                f"{_label(dataset)} has chunks of {longest} bytes, limit {CHUNK_BYTES}: repack it, "
                "as with h5repack"
            )
        stored = []

        def note(chunk: Any) -> None:
            stored.append(chunk.size)
            if chunk.size * _DEFLATE > CHUNK_BYTES and filters:
                large.append(chunk)

        if pieces <= file_size:
            dataset.id.chunk_iter(note)
    most = sum(stored) * (_DEFLATE if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if size > most or len(stored) < pieces or sum(stored) > file_size:
        raise error(
            f"{_label(dataset)} has {size} bytes in {pieces} pieces, of which the file holds "
            f"{len(stored)} in {sum(stored)} bytes: it is damaged, or made to fill the memory"
        )
    for chunk in large:
        _, content = dataset.id.read_direct_chunk(chunk.chunk_offset)
        with contextlib.suppress(zlib.error):  # HDF5 says so, too, when the chunk is read
            if len(zlib.decompressobj().decompress(content, longest + 1)) > longest:
                message = f"{_label(dataset)} has a chunk that unpacks to more than {longest} bytes"
                raise error(message)
