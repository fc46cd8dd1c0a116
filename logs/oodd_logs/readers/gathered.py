"""Columns that grow row by row, for formats whose rows are messages or objects."""

import array
import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers.cells import column_names, numbers, texts
from oodd_logs.recording import Column, Topic

WIDEST: Final = 4096
"""Items of a list that become columns; images and clouds of points have more and are left out."""

TIME: Final = "log_time"
"""Column with the seconds since 1970 at which a message was logged."""

_DEEPEST: Final = 16
_STAMPS: Final = ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"})


def flat(value: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield what is in nested mappings and lists, under names such as ``pose.position.x``.

    Messages of ROS are mappings; a stamp of theirs is its seconds.

    Parameters
    ----------
    value
        Mapping, message, sequence, array, number, truth value, text or None.
    name
        What the names begin with.
    depth
        Levels above the value.
    """
    if depth > _DEEPEST:
        raise TrajectoryError(f"{name!r:.80} has more than {_DEEPEST} levels of structure")
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.size <= WIDEST else ()
    elif hasattr(value, "__slots__") and isinstance(value, SimpleNamespace):
        value = {key: getattr(value, key) for key in value.__slots__}
    elif dataclasses.is_dataclass(value):
        names = (f.name for f in dataclasses.fields(value) if not f.name.startswith("__"))
        value = {key: getattr(value, key) for key in names}
    if isinstance(value, Mapping) and {*value} in _STAMPS:
        seconds, nanoseconds = value.values()
        value = seconds + nanoseconds / 1e9
    prefix = f"{name}." if name else ""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from flat(inner, f"{prefix}{key}", depth + 1)
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value if len(value) <= WIDEST else ()):
            yield from flat(inner, f"{prefix}{i}", depth + 1)
    elif value is None or isinstance(value, str | int | float | np.number | np.bool_):
        yield name, value


class Gathered:
    """Rows of named values, gathered one after the other.

    Parameters
    ----------
    source
        What messages call it.
    """

    def __init__(self, source: str) -> None:
        self.source, self.rows = source, 0
        self._numbers: dict[str, array.array[float]] = {}
        self._texts: dict[str, dict[int, str]] = {}
        self._size = 0

    def add(self, cells: Mapping[str, Any]) -> None:
        """Add a row; names that it lacks are missing there."""
        for name, value in cells.items():
            column = self._numbers.setdefault(name, array.array("d"))
            column.extend([math.nan] * (self.rows - len(column)))
            if isinstance(value, str):
                self._texts.setdefault(name, {})[self.rows] = value
                self._size += len(value)
            number = math.nan if value is None or isinstance(value, str) else float(value)
            column.append(number)
        self.rows += 1
        self._size += 8 * len(cells)
        if self._size > EPISODE.most or len(self._numbers) * self.rows * 8 > 4 * EPISODE.most:
            raise EPISODE.failure(
                f"{self.source} takes more than {EPISODE.most} bytes, choose topics or"
            )

    def topic(self, time: str = "") -> Topic:
        """Return the rows as a topic."""
        columns = map(self._column, self._numbers)
        return Topic.of(dict(zip(column_names(self._numbers), columns, strict=True)), time)

    def _column(self, name: str) -> Column:
        values = np.frombuffer(self._numbers[name], np.float64)
        values = np.append(values, np.full(self.rows - len(values), np.nan))
        if name not in self._texts:
            return values
        cells = ["" if np.isnan(value) else f"{value:g}" for value in values]
        for row, text in self._texts[name].items():
            cells[row] = text
        column = numbers(cells)
        return texts(cells, f"{self.source}, column {name!r}") if column is None else column


def topics_of(
    path: Path, topics: Iterable[str], messages: Iterable[tuple[str, int, Any]]
) -> dict[str, Topic]:
    """Return the topics that have messages, by name.

    Parameters
    ----------
    path
        The file.
    topics
        Names of all topics.
    messages
        Topic, nanoseconds since 1970, and what `flat` takes.
    """
    rows = {topic: Gathered(f"{path}, {topic}") for topic in topics}
    for topic, stamp, value in messages:
        rows[topic].add({TIME: stamp / 1e9} | dict(flat(value)))
    return {topic: gathered.topic(TIME) for topic, gathered in rows.items() if gathered.rows}
