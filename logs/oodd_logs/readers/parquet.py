"""Recordings as Parquet files, of which some thousand rows are in memory at a time."""

import fnmatch
import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.kinds import images, number_lists
from oodd_logs.kinds.message_stamps import stamp_of
from oodd_logs.ledger import Ledger
from oodd_logs.readers import Options, Reader, library
from oodd_logs.readers.cells import check_width, column_names, texts
from oodd_logs.readers.gathered import LISTS, Gathered
from oodd_logs.recording import Column, Recording, Topic

_BATCH: Final = 2**15  # rows
_STREAMS: Final = 4  # choices of columns that are read in turns
_PER_SECOND: Final = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@dataclass(frozen=True, slots=True)
class _Leaf:
    """One column of numbers or texts: where it is in a column of the file."""

    # `path` has the fields of structures and positions in lists, as names and numbers; `figure` is
    # that of a list which they lead to.

    column: str
    path: tuple[str | int, ...]
    figure: str = ""

    @property
    def label(self) -> str:
        steps = (self.column, *self.path, self.figure)
        return ".".join(str(step) for step in steps if step != "")


class ParquetRows:
    """Rows of a Parquet file, read on in batches as long as ranges follow one another.

    Parameters
    ----------
    path
        The file.
    lists
        Globs of long lists that are columns by place.
    """

    def __init__(self, path: Path, lists: Sequence[str] = ()) -> None:
        self.path, self.ledger, self._lists = path, Ledger(), lists
        self._objects: dict[str, Column] = {}
        with self._opened() as file:
            metadata, schema = file.metadata, file.schema_arrow
            self.rows: int = metadata.num_rows
            self._groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
            objects = _objects(schema)
            listed = [f.name for f in schema if "list<" in str(f.type) and f.name not in objects]
            first: Any = (
                next(file.iter_batches(batch_size=64, columns=listed), {}) if listed else {}
            )
            if objects:
                gathered = Gathered(str(path), lists)
                for batch in file.iter_batches(batch_size=_BATCH // 32, columns=objects):
                    for row in batch.to_pylist():
                        gathered.add(row)
                topic = gathered.topic()
                self.ledger.merge(gathered.ledger)
                self._objects = topic.read(topic.names, 0, topic.rows)
        self._starts = np.cumsum([0, *(group.num_rows for group in self._groups)])
        leaves: list[_Leaf] = []
        for f in (f for f in schema if f.name not in objects):
            cells = first[f.name] if f.name in listed and first else ()
            value = next((cell.as_py() for cell in cells if cell.is_valid), None)
            leaves += self._inner(f.name, f.type, value, ())
        check_width(path, len(leaves))
        self._leaves = dict(zip(column_names(leaf.label for leaf in leaves), leaves, strict=True))
        self.names = (*self._leaves, *(name for name in self._objects if name not in self._leaves))
        stamps = [f.name for f in schema if library("pyarrow").types.is_timestamp(f.type)]
        self.time = stamps[0] if len(stamps) == 1 else ""
        self._streams: dict[tuple[str, ...], _Stream] = {}

    def _inner(
        self, column: str, kind: Any, value: Any, steps: tuple[str | int, ...]
    ) -> Iterator[_Leaf]:
        """Yield the columns in one of the file: fields of structures, items of lists."""
        types = library("pyarrow").types
        name = ".".join(map(str, (column, *steps)))
        if types.is_struct(kind):
            for f in kind:
                yield from self._inner(column, f.type, (value or {}).get(f.name), (*steps, f.name))
        elif _is_list(kind):
            fixed = types.is_fixed_size_list(kind)
            size = kind.list_size if fixed else len(value or ())
            total = np.size(value) if value else size
            wide = any(fnmatch.fnmatch(name, glob) for glob in self._lists)
            if (number_lists.is_folded(name, total) and not wide) or not (
                fixed or self._is_constant(name, total)
            ):
                self.ledger.add("column", "changed", number_lists.KIND.words, name=name)
                yield from (_Leaf(column, steps, figure) for figure in number_lists.FIGURES)
                return
            for i, item in enumerate(value or [None] * size):
                yield from self._inner(column, kind.value_type, item, (*steps, i))
        elif types.is_binary(kind) or types.is_large_binary(kind):
            self.ledger.add("column", "dropped", images.KIND.words, name=name)
        else:
            yield _Leaf(column, steps)

    def _is_constant(self, name: str, size: int) -> bool:
        """Tell by the numbers that the file counts whether all lists are as long as the first."""
        pattern = re.compile(re.escape(re.sub(r"\.\d+\b", "", name)) + r"\.list\..*")
        every = [group.column(i) for group in self._groups for i in range(group.num_columns)]
        chunks = [chunk for chunk in every if pattern.fullmatch(chunk.path_in_schema)]
        values = sum(chunk.num_values for chunk in chunks)
        counted = [chunk.statistics for chunk in chunks if chunk.statistics]
        nulls = sum(statistics.null_count or 0 for statistics in counted)
        rows = self.rows
        return size > 0 and 0 in {values - size * rows, values - nulls - size * (rows - nulls)}

    def topic(self) -> Topic:
        """Return all rows as a topic."""
        return Topic(self.names, self.rows, self.read, self.time)

    def read(self, names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        """Return columns of a range of rows."""
        key = tuple(name for name in names if name in self._leaves)
        table = {name: column[start:stop] for name, column in self._objects.items()}
        if key:
            stream = self._streams.pop(key, None)
            group = max(0, int(np.searchsorted(self._starts, start, side="right")) - 1)
            first = int(self._starts[group])
            if stream is None or start < stream.first or stream.end < first:
                stream = _Stream(self.path, self._batches(key, group), first)
            table |= stream.take(key, start, stop)
            if (rows := len(table[key[0]])) != stop - start:
                raise TrajectoryError(f"{self.path} has {rows} of the rows {start} to {stop - 1}")
            self._streams[key] = stream  # the last one used stands last
            while len(self._streams) > _STREAMS:
                self._streams.pop(next(iter(self._streams))).batches.close()
        return {name: table[name] for name in names}

    def _batches(self, names: Sequence[str], group: int) -> Generator[dict[str, Column]]:
        leaves = {name: self._leaves[name] for name in names}
        columns = [*dict.fromkeys(leaf.column for leaf in leaves.values())]
        with self._opened() as file:
            groups = range(group, len(self._groups))
            for batch in file.iter_batches(batch_size=_BATCH, row_groups=groups, columns=columns):
                cells = {name: batch.column(leaf.column) for name, leaf in leaves.items()}
                yield {name: _values(cells[name], leaf, self.path) for name, leaf in leaves.items()}

    def _opened(self) -> Any:
        # By default the library keeps all that it has read of the file.
        return library("pyarrow.parquet").ParquetFile(
            self.path, pre_buffer=False, buffer_size=2**20
        )


@dataclass(slots=True)
class _Stream:
    """Batches in a row, of which the rows from `first` on are kept that the next range may need."""

    path: Path
    batches: Generator[dict[str, Column]]
    first: int
    kept: dict[str, Column] = field(default_factory=dict)

    def take(self, names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        """Return the rows of a range; what lies before it is forgotten where more is read."""
        if stop > (end := self.end):
            parts = [{name: column[start - self.first :] for name, column in self.kept.items()}]
            while end < stop and (batch := next(self.batches, None)) is not None:
                low, end = end, end + _count(batch)
                if end > start:
                    parts.append({n: column[max(0, start - low) :] for n, column in batch.items()})
            self.first = start
            self.kept = {}
            for name in names:
                cells = [part[name] for part in parts if _count(part)] or [np.empty(0)]
                size = sum(part.size for part in cells) * max(part.itemsize for part in cells)
                if cells[0].dtype.kind == "U" and size > EPISODE.most:
                    raise TrajectoryError(f"{self.path}, column {name!r}: texts take {size} bytes")
                self.kept[name] = np.concatenate(cells) if len(cells) > 1 else cells[0]
        rows = slice(start - self.first, stop - self.first)
        return {name: self.kept.get(name, np.empty(0))[rows] for name in names}

    @property
    def end(self) -> int:
        """Row after the last one that is in memory."""
        return self.first + _count(self.kept)


def _count(batch: Mapping[str, Column]) -> int:
    return len(next(iter(batch.values()), ()))


def _objects(schema: Any) -> list[str]:
    """Return the columns whose rows are objects: with names or stamps among their values."""
    types = library("pyarrow").types

    def is_object(kind: Any) -> bool:
        if types.is_struct(kind):
            stamped = stamp_of({f.name: 0 for f in kind}) is not None
            return stamped or any(is_object(f.type) for f in kind)
        inner = kind
        while _is_list(inner):
            inner = inner.value_type
        is_plain = types.is_primitive(inner) or types.is_binary(inner)
        return bool(types.is_map(kind) or (inner is not kind and not is_plain))

    objects = [f.name for f in schema if is_object(f.type)]
    named = any(_is_list(f.type) and types.is_string(f.type.value_type) for f in schema)
    return [f.name for f in schema if f.name in objects or (named and _is_list(f.type))]


def _is_list(kind: Any) -> bool:
    types = library("pyarrow").types
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _values(array: Any, leaf: _Leaf, path: Path) -> Column:
    """Return the numbers or texts of a column in a batch."""
    pa, compute = library("pyarrow"), library("pyarrow.compute")
    types = pa.types
    for step in leaf.path:
        inner = compute.struct_field if isinstance(step, str) else compute.list_element
        array = inner(array, step)
    if leaf.figure:
        rows, owners = len(array), np.arange(len(array))
        while hasattr(array.type, "value_type"):
            parents = compute.list_parent_indices(array).to_numpy(zero_copy_only=False)
            owners, array = owners[parents], compute.list_flatten(array)
        numbers = array.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        return number_lists.ragged_figures(numbers, owners, rows)[leaf.figure]
    if types.is_dictionary(array.type):
        array = array.dictionary_decode()
    kind = array.type
    worded = (types.is_string, types.is_large_string, types.is_date, types.is_time)
    if kind == pa.string_view() or any(is_kind(kind) for is_kind in worded):
        cells = ["" if cell is None else str(cell) for cell in array.to_pylist()]
        return texts(cells, f"{path}, column {leaf.label!r}")
    per_second = 1.0
    if types.is_timestamp(kind) or types.is_duration(kind):
        array, per_second = array.cast(pa.int64()), _PER_SECOND[kind.unit]
    numbers = array.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(numbers) / per_second


def _open(path: Path, options: Options) -> Iterator[Recording]:
    rows = ParquetRows(path, options.get("lists", ()))
    yield Recording(path.stem, str(path), {"": rows.topic()}, ledger=rows.ledger)


READER: Final = Reader(
    "parquet", "a Parquet file", (".parquet", ".pq"), _open, extra="logs", options=LISTS
)
