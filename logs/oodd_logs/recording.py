"""Recordings: what a reader of logs returns, before a recipe makes episodes of it.

A recording is a file, a group of a file, or an episode of a data set. It has topics of rows
(formats with a single table have one, named ``""``), and fields that hold for all of it.
Rows are read when asked for, in ranges, so that a recording may be larger than memory.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError
from oodd_eval.names import check_known
from oodd_logs.ledger import Ledger

Column = NDArray[Any]
"""Cells of one column: float64 with NaN for what is missing, or fixed-width text (kind ``U``)."""


MISSING: Final = frozenset({"", "nan", "-nan", "na", "n/a", "null", "none"})
"""Texts, in lower case, that stand for a value that is missing."""

_SECONDS: Final = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Units of time by how many of them a second has."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


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
            Arrays of equal length by name.
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
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        for name, array in arrays.items():
            if array.dtype.kind != "U":
                arrays[name] = np.asarray(array, np.float64)
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


def parse_times(column: Column, unit: str = "") -> NDArray[np.float64]:
    """Return times in seconds.

    Parameters
    ----------
    column
        Numbers, or texts as ISO 8601 has them: with ``T`` or a blank before the time of day, with
        ``Z``, an offset, or neither, which stands for UTC.
    unit
        Unit of the numbers: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; ``"iso"`` for texts. By
        default seconds for numbers and ISO 8601 for texts.

    Returns
    -------
    numpy.ndarray
        float64 of shape (rows,): since 1970 for texts, else since what the numbers count from; NaN
        for what is missing.

    Raises
    ------
    UsageError
        When the unit is unknown.
    TrajectoryError
        When a cell is no time in this unit; the message has its row, from 0 on.
    """
    check_known("unit of time", {*_SECONDS, "iso", ""}, unit)
    if column.dtype.kind != "U":
        if unit == "iso":
            raise TrajectoryError("times are numbers, expected ISO 8601, or the unit s, ms, us, ns")
        return np.asarray(column, np.float64) / _SECONDS[unit or "s"]
    if unit not in {"", "iso"}:
        raise TrajectoryError(f"times are texts such as {column[:1].tolist()}, expected numbers")
    return _since_1970(column)


def _since_1970(column: Column) -> NDArray[np.float64]:
    if not len(column):
        return np.empty(0)
    cells = np.strings.replace(np.strings.strip(column), ",", ".")
    missing = np.isin(np.strings.lower(cells), [*MISSING])
    # NumPy takes "now" and a single number, too.
    dated = np.strings.isdigit(cells.astype("U4")) & (np.strings.str_len(cells) >= 8)
    plain = np.strings.rstrip(np.where(missing, "NaT", cells), "Zz")
    # A sign behind the day is that of an offset; hyphens before it belong to the date.
    signs = np.maximum(np.strings.rfind(plain, "+"), np.strings.rfind(plain, "-"))
    zoned, offsets, heads = np.flatnonzero(signs > 9).tolist(), np.zeros(len(plain)), plain.tolist()
    tails = [heads[row][signs[row] :] for row in zoned]
    for row in zoned:
        heads[row] = heads[row][: signs[row]]
    try:
        shifts = {tail: _offset(tail) for tail in {*tails}}
        offsets[zoned] = [shifts[tail] for tail in tails]
        stamps = (np.array(heads) if tails else plain).astype("M8[ns]")
    except ValueError:
        return _one_by_one(cells.tolist(), missing)
    if not (dated | missing).all():
        return _one_by_one(cells.tolist(), missing)
    return np.where(missing, np.nan, stamps.astype(np.int64) / 1e9 - offsets)


def _offset(text: str) -> float:
    zone = datetime.fromisoformat(f"2000-01-01T00:00:00{text}").utcoffset()
    return 0.0 if zone is None else zone.total_seconds()


def _one_by_one(cells: Sequence[str], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return times that NumPy cannot read, such as 20180718T195650Z."""
    times = np.full(len(cells), np.nan)
    for row in np.flatnonzero(~missing).tolist():
        try:
            stamp = datetime.fromisoformat(cells[row])
        except ValueError:
            raise TrajectoryError(
                f"row {row}: {cells[row]!r:.80} is no time, expected ISO 8601, such as "
                "2024-05-01T12:00:00.5Z"
            ) from None
        zoned = stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)
        times[row] = (zoned - _EPOCH).total_seconds()
    return times
