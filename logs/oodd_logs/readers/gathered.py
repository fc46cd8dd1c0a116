"""Columns that grow row by row, for formats whose rows are messages or objects."""

import dataclasses
import fnmatch
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.kinds import flattened, number_lists
from oodd_logs.kinds.images import LONGEST_TEXT
from oodd_logs.ledger import Ledger
from oodd_logs.readers.cells import check_width, column_names, numbers, texts
from oodd_logs.recording import Column, Recording, Topic

LISTS: Final = {"lists": "globs of long lists in messages whose items are columns by their place"}

TIME: Final = "log_time"
"""Column with the seconds since 1970 at which a message was logged."""

RECOVERED: Final = "it was never closed: recovered up to where it breaks off"
"""What became of a recording whose recorder was killed."""

_DEEPEST: Final = 16
_MARK: Final = ".\0"  # in the name of a list, where the number of an item goes
_PENDING: Final = 2**17  # cells that are not yet in arrays
_PLAIN: Final = frozenset({int, float, bool, type(None)})

_Part = tuple[NDArray[np.intp], Any]  # rows of a column, and its numbers or texts there


class Gathered:
    """Rows of named values, gathered one after the other.

    What is in nested mappings and lists gets names such as ``pose.position.x``; kinds of columns
    say what else becomes of values. Lists with as many numbers in every row are columns by place.

    Parameters
    ----------
    source
        What messages call it.
    lists
        Globs of lists that are columns by place, however long.
    """

    def __init__(self, source: str, lists: Sequence[str] = ()) -> None:
        self.source, self.rows, self.ledger = source, 0, Ledger()
        self._lists = lists
        self._parts: dict[str, list[_Part]] = {}
        self._pending: dict[tuple[str, ...], tuple[list[int], list[tuple[Any, ...]]]] = {}
        self._fates: dict[tuple[str, str], bool] = {}
        self._left, self._size = _PENDING, 0

    def add(self, value: Any, stamp: float | None = None) -> None:
        """Add a row: a mapping or message, and its seconds for the column `TIME`, if it has any.

        Names that it lacks are missing there.
        """
        row: dict[str, Any] = {} if stamp is None else {TIME: stamp}
        self._put("", value, row, 0)
        names = tuple(row)
        if names not in self._pending:
            self._parts |= {name: [] for name in names if name not in self._parts}
            check_width(self.source, len(self._parts))
            self._pending[names] = [], []
        rows, values = self._pending[names]
        rows.append(self.rows)
        values.append(tuple(row.values()))
        self.rows += 1
        self._left -= len(row)
        if self._left < 0:
            self._flush()

    def topic(self, time: str = "") -> Topic:
        """Return the rows as a topic."""
        self._flush()
        columns: dict[str, Column] = {}
        for name, parts in self._parts.items():
            columns |= self._list(name, parts) if _MARK in name else {name: self._column(parts)}
        for (name, reason), dropped in self._fates.items():
            self.ledger.add("column", "dropped" if dropped else "changed", reason, name=name)
        return Topic.of(dict(zip(column_names(columns), columns.values(), strict=True)), time)

    def _put(self, name: str, value: Any, row: dict[str, Any], depth: int) -> None:
        """Put a value into a row, under its name or what is made of it under longer ones."""
        kind = type(value)
        if kind in _PLAIN or (kind is str and len(value) <= LONGEST_TEXT):
            row[name] = value
            return
        if depth > _DEEPEST:
            raise TrajectoryError(f"{name!r:.80} has more than {_DEEPEST} levels of structure")
        if kind is not dict:
            value = _unpacked(value)
        wide = bool(self._lists) and any(fnmatch.fnmatch(name, glob) for glob in self._lists)
        if not wide and (known := flattened(name, value)) is not None:
            kind_of_column, pairs = known
            if kind_of_column.words:
                self._fates[name.replace(_MARK, ""), kind_of_column.words] = not pairs
            for label, inner in pairs:
                self._put(label, inner, row, depth + 1)
        elif isinstance(value, Mapping):
            prefix = f"{name}." if name else ""
            for key, inner in value.items():
                if type(inner) in _PLAIN:  # most are
                    row[f"{prefix}{key}"] = inner
                else:
                    self._put(f"{prefix}{key}", inner, row, depth + 1)
        elif isinstance(value, list | tuple | np.ndarray):
            self._put_list(name, value, row, depth)
        else:
            row[name] = value if isinstance(value, int | float | str) else str(value)

    def _put_list(self, name: str, value: Any, row: dict[str, Any], depth: int) -> None:
        """Put a list into a row: of numbers as it is, of objects by their fields."""
        marked = name if _MARK in name else f"{name}{_MARK}"
        if not len(value):
            row[marked] = value
        elif isinstance(value[0], Mapping) and all(isinstance(item, Mapping) for item in value):
            for key in dict.fromkeys(key for item in value for key in item):
                self._put(f"{marked}.{key}", [item.get(key) for item in value], row, depth + 1)
        elif (array := number_lists.as_numbers(value)) is not None:
            row[marked] = array
        else:
            for i, inner in enumerate(value[: number_lists.LONGEST]):
                self._put(marked.replace("\0", str(i)), inner, row, depth + 1)

    def _flush(self) -> None:
        """Bring pending rows into arrays."""
        for names, (rows, values) in self._pending.items():
            places = np.array(rows, np.intp)
            for name, cells in zip(names, zip(*values, strict=True), strict=True):
                if _MARK in name:
                    self._keep_lists(name, places, cells)
                elif str in {*map(type, cells)}:
                    words = [*map(_text, cells)]
                    self._keep(name, places, words, sum(map(len, words)))
                else:
                    self._keep(name, places, np.array(cells, np.float64), 8 * len(cells))
        self._pending, self._left = {}, _PENDING

    def _keep_lists(self, name: str, places: NDArray[np.intp], cells: Sequence[Any]) -> None:
        shapes = [np.shape(cell) for cell in cells]
        for shape in {*shapes}:
            positions = [i for i, other in enumerate(shapes) if other == shape]
            block = np.array([cells[i] for i in positions], np.float64)
            self._keep(name, places[positions], block, block.nbytes)

    def _keep(self, name: str, places: NDArray[np.intp], values: Any, size: int) -> None:
        self._parts[name].append((places, values))
        self._size += size
        if self._size > EPISODE.most or len(self._parts) * self.rows * 8 > 4 * EPISODE.most:
            raise EPISODE.failure(
                f"{self.source} takes more than {EPISODE.most} bytes, choose topics or"
            )

    def _list(self, name: str, parts: Sequence[_Part]) -> dict[str, Column]:
        """Return the columns of a list: one an item, or figures where its length changes."""
        plain = name.replace(_MARK, "")
        shapes = {block.shape[1:] for _, block in parts} - {(0,)}
        if len(shapes) > 1:
            self._fates[plain, number_lists.KIND.words] = False
            rows = [number_lists.figures(plain, block) for _, block in parts]
            return {
                label: self._column([(p, m[label]) for (p, _), m in zip(parts, rows, strict=True)])
                for label in rows[0]
            }
        columns = {}
        for first, *more in np.ndindex(*next(iter(shapes), (0,))):
            label = ".".join((name.replace("\0", str(first)), *map(str, more)))
            cells = [(places, b[:, first, *more]) for places, b in parts if b.size]
            columns[label] = self._column(cells)
        return columns

    def _column(self, parts: Sequence[_Part]) -> Column:
        if all(isinstance(values, np.ndarray) for _, values in parts):
            if len(parts) == 1 and len(parts[0][0]) == self.rows:
                return np.asarray(parts[0][1])
            column = np.full(self.rows, np.nan)
            for places, values in parts:
                column[places] = values
            return column
        cells = [""] * self.rows
        for places, values in parts:
            for row, cell in zip(places.tolist(), values, strict=True):
                cells[row] = _text(cell)
        words = numbers(cells)
        return texts(cells, self.source) if words is None else words


def _text(cell: str | float | None) -> str:
    if isinstance(cell, str):
        return cell
    return "" if cell is None or math.isnan(cell) else f"{cell:.15g}"


def _unpacked(value: Any) -> Any:
    """Return a message of ROS as a mapping, and a number of NumPy as one of Python."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes | bytearray) and len(value) <= number_lists.LONGEST:
        return [*value]
    if isinstance(value, list) and value and isinstance(value[0], tuple):
        return dict(value)  # as PyArrow returns maps
    if isinstance(value, SimpleNamespace) or dataclasses.is_dataclass(value):
        names = getattr(value, "__slots__", None) or value.__dataclass_fields__
        return {key: getattr(value, key) for key in names if not key.startswith("__")}
    return value


def readable_topics(
    path: Path,
    options: Mapping[str, Any],
    topics: Sequence[str],
    unread: Mapping[str, str],
    ledger: Ledger,
) -> list[str]:
    """Return topics without those that cannot be read, which have their kind; note them.

    `TrajectoryError` where none can be read, or the options name one that cannot.
    """
    if len(unread) == len(topics) or ("topics" in options and unread):
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in unread.items()) or "no topics"
        expected = "messages of JSON, or of ROS with their definitions"
        raise TrajectoryError(f"{path} has {listed}, expected {expected}")
    for topic, kind in unread.items():
        ledger.add("column", "dropped", f"its messages ({kind}) are not read", name=topic)
    return [topic for topic in topics if topic not in unread]


def recording_of(
    path: Path,
    options: Mapping[str, Any],
    topics: Iterable[str],
    messages: Iterable[tuple[str, int, Any]],
    ledger: Ledger,
) -> Recording:
    """Return a recording of messages; topics without any are left out.

    Parameters
    ----------
    path
        The file or directory, from which the recording has its name.
    options
        Values of `LISTS`.
    topics
        Names of all topics.
    messages
        Topic, nanoseconds since 1970, and what `Gathered.add` takes.
    ledger
        Takes what became of values in messages; the recording has it.
    """
    lists = options.get("lists", ())
    rows = {topic: Gathered(f"{path}, {topic}", lists) for topic in topics}
    for topic, stamp, value in messages:
        rows[topic].add(value, stamp / 1e9)
    filled = {topic: gathered.topic(TIME) for topic, gathered in rows.items() if gathered.rows}
    if not filled:
        raise TrajectoryError(f"{path} has no messages")
    for topic in filled:
        for entry in rows[topic].ledger:
            label = f"{topic}.{entry.name}"
            ledger.add(entry.item, entry.fate, entry.reason, name=label, count=entry.count)
    name = path.name if path.is_dir() else path.stem
    return Recording(name, str(path), filled, ledger=ledger)
