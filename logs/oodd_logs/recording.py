"""Recordings: what a reader of logs returns, before a recipe makes episodes of it.

A recording is a file, a group of a file, or an episode of a data set. It has topics of rows
(formats with a single table have one, named ``""``), and fields that hold for all of it.
Rows are read when asked for, in ranges, so that a recording may be larger than memory.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from numpy.typing import NDArray

from oodd_eval.arrays import as_array, as_numbers
from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger

Column = NDArray[Any]
"""Cells of one column: float64 with NaN for what is missing, or fixed-width text (kind ``U``)."""


MISSING: Final = frozenset({"", "nan", "-nan", "na", "n/a", "null", "none"})
"""Texts, in lower case, that stand for a value that is missing."""


CELLS: Final = 1 << 18
"""Cells that are read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Rows of one topic.

    Parameters
    ----------
    names
        Names of the columns as the file has them, a unit in brackets among them, as in
        ``"q1[rad]"``; each occurs once.
    rows
        Number of rows.
    read
        Called with names, first row and the row after the last; returns `Column` arrays by name,
        in order, as float64 wherever every cell of the column is a number, a truth value or
        missing. It raises `TrajectoryError`, with file and row, for what cannot be read.
    time
        Name of the column whose values the format defines to be seconds; empty where it does not.
    """

    names: tuple[str, ...]
    rows: int
    read: Callable[[Sequence[str], int, int], dict[str, Column]]
    time: str = ""

    @classmethod
    def of(cls, columns: Mapping[str, Column], time: str = "") -> "Topic":
        """Return a topic of arrays that are in memory.

        Parameters
        ----------
        columns
            Arrays of equal length by name; what is masked is missing.
        time
            Name of the column with seconds, if any.

        Returns
        -------
        Topic

        Raises
        ------
        TrajectoryError
            When lengths differ.
        """
        arrays = {name: as_array(values) for name, values in columns.items()}
        for name, array in arrays.items():
            arrays[name] = array if array.dtype.kind == "U" else as_numbers(array)
        lengths = {name: len(values) for name, values in arrays.items()}
        if len({*lengths.values()}) > 1:
            raise TrajectoryError(f"columns have lengths {lengths}, expected equal ones")
        rows = next(iter(lengths.values()), 0)

        def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
            return {name: arrays[name][start:stop] for name in names}

        return cls(tuple(arrays), rows, read, time)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recording as a reader returns it.

    Parameters
    ----------
    name
        Of the file without its ending, of the group, or of the episode.
    source
        File, and group or episode if there are several, as messages name it.
    topics
        By name; ``""`` is that of formats with one table.
    fields
        Values that hold for the whole recording, by name: outcome, task, seed and the like. Those
        that the project's own layouts define are ``onset``, ``seed``, ``terminated`` and
        ``parameters``.
    ledger
        What the reader left out or changed when it opened the recording. What becomes of rows is
        added by those who read them.
    """

    name: str
    source: str
    topics: Mapping[str, Topic]
    fields: Mapping[str, Any] = field(default_factory=dict)
    ledger: Ledger = field(default_factory=Ledger)


def read_column(topic: Topic, column: str) -> Iterator[tuple[int, Column]]:
    """Yield the first row and the cells of blocks of a column."""
    for start in range(0, topic.rows, CELLS):
        yield start, topic.read([column], start, min(start + CELLS, topic.rows))[column]
