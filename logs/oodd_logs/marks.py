"""Anomalous rows of a recording: from columns with labels, lists of intervals, an onset.

Marks are in seconds where a recording has stamps, else in rows of the file; `rows_of` finds the
rows of an episode.
"""

import csv
import io
import itertools
import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import read_bytes
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.names import is_plain, natural
from oodd_logs.readers.packed import stem
from oodd_logs.recipe import Interval, Recipe
from oodd_logs.recording import Column
from oodd_logs.selecting import split_unit

NOMINAL_LABELS: Final = ("", "0", "0.0", "false", "h")
"""Labels of nominal rows, regardless of case, unless a recipe names others; so is the number 0."""

NOMINAL_WORDS: Final = re.compile(
    r"(?:^|[^a-z])(?:nominal|normal|healthy|good|free|baseline|reference|no[^a-z]?(?:fault|failure|anomal\w*))"
    r"(?:$|[^a-z])",
    re.IGNORECASE,
)
"""Words of nominal files, values and labels."""

_SHORT: Final = frozenset({"h", "0", "n", "ok", "pass", "passed", "inlier", "none", "no"})
_TRUE: Final = frozenset({"1", "1.0", "true", "yes", "y"})
_KEPT: Final = 64  # labels of a column that are counted
_CLEAR: Final = 0.6  # share of rows from which on a label is that of the majority
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
        texts = [str(v).strip().lower() for v in nominal] or [*NOMINAL_LABELS]
        return ~np.isin(np.strings.lower(np.strings.strip(values)), texts)
    numbers = [float(v) for v in nominal if isinstance(v, int | float)] if nominal else [0.0]
    present = np.where(np.isnan(values), -1, np.arange(len(values)))
    held = np.maximum.accumulate(present)
    return np.asarray(np.where(held < 0, before, ~np.isin(values, numbers)[held]), bool)


LabelCounts = dict[str, Counter[float | str]]
"""Number of rows of each label, by the text of the column in the recipe."""


def counted_labels(cells: Column) -> Counter[float | str]:
    """Return how often the values of a column are there, those of the first ones in order."""
    values, counts = np.unique(cells[cells == cells], return_counts=True)  # noqa: PLR0124
    return Counter(dict(zip(values.tolist()[:_KEPT], counts.tolist(), strict=False)))


def are_signed(labels: Iterable[float | str], recipe: Recipe) -> bool:
    """Tell whether -1 is a label, and nothing says of what rows."""
    return not recipe.nominal_label and bool({-1.0, "-1"} & {*labels})


def label_problems(
    counts: LabelCounts, lacking: Collection[str], recipe: Recipe
) -> Iterator[tuple[str, str]]:
    """Yield the columns that do not say which rows are nominal, each with what to do.

    Parameters
    ----------
    counts
        Labels of all recordings.
    lacking
        Columns that some recordings do not have.
    recipe
        Its `nominal_label` says which labels are nominal.
    """
    nominal = recipe.nominal_label
    for text, values in counts.items():
        labels = Counter({v: n for v, n in values.items() if str(v).strip()})
        said = [not anomalous_cells(np.array([v]), recipe, before=False) for v in values]
        if are_signed(values, recipe):
            why = "-1 is the label of nominal rows in some logs, of anomalous ones in others"
        elif not any(said) and text not in lacking:
            accepted = f"nominal_label is {[*nominal]}" if nominal else "0, false, H, or nothing"
            why = f"none of them is nominal ({accepted})"
        elif not nominal and says_nominal(text):
            why = "by its name 1 is nominal, and without nominal_label 0 is"
        else:
            continue
        rows = ", ".join(f"{plain_label(v)!r} ({n} rows)" for v, n in labels.most_common(6))
        likely, reason = likely_nominal(text, labels)
        key = f"nominal_label = {json.dumps([*map(plain_label, likely)])}"
        advice = f"{key}, if that is nominal{reason}" if likely else "nominal_label = [...]"
        yield text, f"labels {text!r} are {rows}, and {why}: write {advice}"


def likely_nominal(
    name: str, values: Mapping[float | str, int]
) -> tuple[tuple[float | str, ...], str]:
    """Return the labels that are nominal as far as one can tell, and why in words.

    Parameters
    ----------
    name
        Of the column.
    values
        Number of rows by label.

    Returns
    -------
    tuple
        Labels, and ``, as in most rows`` where nothing else speaks for them; both are empty where
        no label is.

    Examples
    --------
    >>> likely_nominal("fault", {0.0: 7, 1.0: 9}), likely_nominal("y", {1.0: 90, -1.0: 9})
    (((0.0,), ''), ((1.0,), ', as in most rows'))
    """
    texts = {v: v.strip().lower() if isinstance(v, str) else "" for v in values}
    words = [v for v, text in texts.items() if text in _SHORT or NOMINAL_WORDS.search(text)]
    if says_nominal(name):
        words = [v for v in values if str(v).lower() in _TRUE]
    if words and len(words) < len(values):
        return tuple(words), ""
    if 0.0 in values and -1.0 not in values:
        return (0.0,), ""
    most = max(values, key=lambda value: values[value], default=0.0)
    if values and values[most] >= _CLEAR * sum(values.values()):
        return (most,), ", as in most rows"
    return (), ""


def says_nominal(name: str) -> bool:
    """Tell whether the name of a label says that it is true of nominal rows."""
    plain = split_unit(name)[0].rpartition(".")[2].lower()
    return bool(re.fullmatch(r"(?:is[_ ]?)?(?:healthy|normal|nominal|ok|good|inlier)", plain))


def plain_label(value: float | str) -> int | float | str:
    """Return a label as a recipe has it, whole numbers without a point."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


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
        start = int(np.searchsorted(positions, mark.start - tolerance))
        stop = max(int(np.searchsorted(positions, mark.stop - tolerance)), start + 1)
        if start < len(positions) and mark.stop - tolerance > positions[0]:
            first = -1 if math.isinf(mark.start) else start
            rows.append((first, min(stop, len(positions)), mark.kind))
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
        self._rows: dict[str, list[Interval]] = defaultdict(list)
        for interval in intervals:
            if interval in self._rows[interval[0]]:
                raise TrajectoryError(f"{source} names {interval[0]!r} twice with the same rows")
            self._rows[interval[0]].append(interval)
        self._unused = {*self._rows}

    @classmethod
    def of(cls, recipe: Recipe, root: Path) -> "IntervalList":
        """Return those of a recipe; none where it has none."""
        if isinstance(recipe.intervals, str):
            path = root / recipe.intervals
            return cls(read_intervals(path), str(path))
        return cls(recipe.intervals, "intervals")

    def __bool__(self) -> bool:
        return bool(self._rows)

    def of_recording(
        self, path: Path, name: str, relative: str, *, is_cut: bool = False
    ) -> list[Interval]:
        """Return the intervals of a recording.

        Parameters
        ----------
        path, relative
            Its file, and the path below the recipe's folder.
        name
            Of the recording, which may be a group of the file.
        is_cut
            Whether it is one of several episodes that a recipe makes of a table.

        Raises
        ------
        UsageError
            When an interval names a file that is cut: rows and times may be of any of its episodes.
        """
        parts = Path(relative).parts
        tails = ["/".join(parts[i:]) for i in range(len(parts))]
        keys = dict.fromkeys([str(path), relative, *tails, path.stem, stem(path), name])
        names = [key for key in keys if key in self._rows]
        self._unused -= {*names}
        if is_cut and (files := [key for key in names if key != name]):
            raise UsageError(
                f"{self._source} names {files[0]!r}, which is cut into episodes: name the episodes "
                f"in its place, such as {name!r}, and their rows or times"
            )
        return [interval for key in names for interval in self._rows[key]]

    def unused(self, files: Iterable[str]) -> list[UnknownNameError]:
        """Return an error for each name that is of no recording that was read."""
        names = sorted(self._unused)
        return [UnknownNameError(f"file of {self._source}", name, files) for name in names]


def read_intervals(path: Path) -> list[Interval]:
    """Return the rows of a CSV file with the columns file, start, stop and kind, or file, onset.

    Parameters
    ----------
    path
        The file. Whole numbers are rows from 0 on, numbers with a point are in the unit of the
        stamps, other texts ISO 8601. An empty start is not known, an empty stop is the end. An
        onset is a row, also where it is written as 3.0.

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
        if start == "onset":  # programs write whole numbers so where the column is of floats
            cells[start] = re.sub(r"\.0+$", "", cells[start])
        is_no_row = start == "onset" and natural(cells[start]) < 0
        if not cells["file"] or any(row[len(header) :]) or is_no_row:
            raise TrajectoryError(
                f"{path}, line {line}: {row}, expected the columns file and {start}, a row or time"
            )
        first, last = _moment(cells[start]), _moment(cells.get("stop", ""))
        intervals.append((cells["file"], first, last, cells.get("kind", "")))
    ((name, count),) = Counter(row[0] for row in intervals).most_common(1) or [("", 0)]
    if start == "onset" and count > 1:
        raise TrajectoryError(f"{path} names {name!r} twice, expected one onset a file")
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
