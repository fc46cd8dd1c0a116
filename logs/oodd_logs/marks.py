"""Anomalous rows of a recording: from columns with labels, lists of intervals, an onset.

Marks are in seconds where a recording has stamps, else in rows of the file; `rows_of` finds the
rows of an episode.
"""

import csv
import io
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import read_bytes
from oodd_eval.errors import TrajectoryError, UnknownNameError
from oodd_eval.names import is_plain, natural
from oodd_logs.recipe import Interval, Recipe
from oodd_logs.recording import Column

NOMINAL_LABELS: Final = ("", "0", "0.0", "false", "h")
"""Labels of nominal rows, regardless of case, unless a recipe names others; so is the number 0."""

_BYTES: Final = 10**7  # of a list of intervals


AnomalousRows = tuple[int, int, str]
"""First row, the row after the last, and name of the anomaly; a start of -1 is not known."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Anomalous rows of a recording.

    Parameters
    ----------
    start, stop
        First and the one after the last, in seconds or rows; minus and plus infinity where the
        start is not known, and where the recording ends anomalous.
    kind
        Name of the anomaly; empty where it is not said.
    """

    start: float
    stop: float
    kind: str = ""


def anomalous_cells(values: Column, recipe: Recipe, *, before: bool) -> NDArray[np.bool_]:
    """Return where a column with labels says that rows are anomalous.

    Parameters
    ----------
    values
        Cells; a missing number is as the cell before it.
    recipe
        Its `nominal_label` names labels of nominal rows.
    before
        What the cell before the first one said.
    """
    nominal = recipe.nominal_label
    if values.dtype.kind == "U":
        texts = {str(v).strip().lower() for v in nominal} if nominal else {*NOMINAL_LABELS}
        labels, codes = np.unique(values, return_inverse=True)
        wrong = np.array([text.strip().lower() not in texts for text in labels.tolist()], bool)
        return np.asarray(wrong[codes], bool)
    numbers = [float(v) for v in nominal if isinstance(v, int | float)] if nominal else [0.0]
    present = np.where(np.isnan(values), -1, np.arange(len(values)))
    held = np.maximum.accumulate(present)
    return np.asarray(np.where(held < 0, before, ~np.isin(values, numbers)[held]), bool)


def runs_of(anomalous: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of true values as [start, stop)."""
    edges = np.flatnonzero(np.diff(anomalous.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def rows_of(
    marks: Iterable[Mark], positions: NDArray[Any], tolerance: float = 0.0
) -> list[AnomalousRows]:
    """Return the rows [start, stop) of marks among rows at some positions, in order.

    A start of -1 is not known. What lies between two rows marks the later one, what ends before the
    first row none.
    """
    rows = []
    for mark in marks:
        if not len(positions) or mark.stop - tolerance <= positions[0]:
            continue
        start = int(np.searchsorted(positions, mark.start - tolerance))
        stop = max(int(np.searchsorted(positions, mark.stop - tolerance)), start + 1)
        if start < len(positions):
            marked_start = -1 if math.isinf(mark.start) else start
            rows.append((marked_start, min(stop, len(positions)), mark.kind))
    return sorted(rows)


def merged(rows: Sequence[AnomalousRows]) -> tuple[tuple[int, int], ...]:
    """Return intervals in order, those that touch or overlap as one."""
    joined: list[tuple[int, int]] = []
    for start, stop, _ in sorted(rows):
        if joined and max(start, 0) <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(stop, joined[-1][1])
        else:
            joined.append((start, stop))
    return tuple(joined)


class IntervalList:
    """The intervals of a recipe, by file.

    Parameters
    ----------
    intervals
        Rows of the list.
    source
        What messages call it.
    """

    def __init__(self, intervals: Iterable[Interval], source: str) -> None:
        self._source = source
        self._rows: dict[str, list[Interval]] = {}
        self._unused: set[str] = set()
        for interval in intervals:
            rows = self._rows.setdefault(interval[0], [])
            if interval in rows:
                raise TrajectoryError(f"{source} names {interval[0]!r} twice with the same rows")
            rows.append(interval)
            self._unused.add(interval[0])

    @classmethod
    def of(cls, recipe: Recipe, root: Path) -> "IntervalList":
        """Return those of a recipe; none where it has none."""
        if isinstance(recipe.intervals, str):
            path = root / recipe.intervals
            return cls(read_intervals(path), str(path))
        return cls(recipe.intervals, "intervals")

    def __bool__(self) -> bool:
        return bool(self._rows)

    def of_recording(self, path: Path, name: str, relative: str) -> list[Interval]:
        """Return the intervals of a recording.

        Parameters
        ----------
        path, relative
            Its file, and the path below the recipe's folder.
        name
            Of the recording, which may be a group of the file.
        """
        keys = dict.fromkeys([str(path), relative, path.name, path.stem, name])
        parts = Path(relative).parts
        tails = ["/".join(parts[i:]) for i in range(1, len(parts))]
        names = [key for key in dict.fromkeys([*keys, *tails]) if key in self._rows]
        self._unused -= {*names}
        return [interval for key in names for interval in self._rows[key]]

    def check_all_used(self, files: Iterable[str]) -> None:
        """Raise `UnknownNameError` when an interval is of no recording that was read."""
        for name in sorted(self._unused):
            raise UnknownNameError(f"file of {self._source}", name, files)


def read_intervals(path: Path) -> list[Interval]:
    """Return the rows of a CSV file with the columns file, start, stop and kind, or file, onset.

    Parameters
    ----------
    path
        The file. Whole numbers are rows from 0 on, numbers with a point are in the unit of the
        stamps, other texts ISO 8601. An empty start is not known, an empty stop is the end.

    Raises
    ------
    TrajectoryError
        When it cannot be read; the message names the line.
    """
    text = read_bytes(path, _BYTES, TrajectoryError).decode("utf-8-sig", errors="replace")
    table = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        header = [cell.strip() for cell in next(table, [])]
        rows = [(table.line_num, [cell.strip() for cell in row]) for row in table]
    except csv.Error as error:
        raise TrajectoryError(f"{path}, line {table.line_num}: {error}") from None
    start = "onset" if "onset" in header else "start"
    if not {"file", start} <= {*header}:
        raise TrajectoryError(
            f"{path} has the columns {header}, expected file, start, stop and maybe kind, or file "
            "and onset"
        )
    intervals = []
    for line, row in ((line, row) for line, row in rows if any(row)):
        cells = dict(itertools.zip_longest(header, row[: len(header)], fillvalue=""))
        is_no_row = start == "onset" and natural(cells[start]) < 0
        if not cells["file"] or any(row[len(header) :]) or is_no_row:
            raise TrajectoryError(
                f"{path}, line {line}: {row}, expected the columns file and {start}, a row or time"
            )
        first, last = _moment(cells[start]), _moment(cells.get("stop", ""))
        intervals.append((cells["file"], first, last, cells.get("kind", "")))
    names = [row[0] for row in intervals]
    if start == "onset" and len({*names}) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise TrajectoryError(f"{path} names {double!r} twice, expected one onset a file")
    return intervals


def _moment(text: str) -> int | float | str | None:
    """Return a row, a time or a stamp."""
    if text in {"", "-1"}:
        return None
    if (row := natural(text)) >= 0:
        return row
    try:
        return float(text) if is_plain(text) else text
    except ValueError:
        return text
