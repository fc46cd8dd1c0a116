"""Contents of the columns of logs, counted over blocks of rows: nothing here needs a whole file.

A `ColumnFacts` takes the cells of a column block by block, of one recording after another. Its
properties say what it looks like: a constant, a flag, a counter, an angle that wraps, values that
float32 cannot tell apart.
"""

import contextlib
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.offsets import RunningMoments, is_coarse
from oodd_eval.errors import TrajectoryError
from oodd_logs.marks import runs_of
from oodd_logs.readers.cells import mixed
from oodd_logs.recording import Column, parse_times
from oodd_logs.stamps import Steps

FEW: Final = 8
"""Distinct values up to which a column is a flag, or may be a label."""

PERIODS: Final = (2 * math.pi, 360.0)
"""Full turns in radians and degrees."""


@dataclass(slots=True)
class ColumnFacts:
    """Contents of one column, over all recordings that have it.

    Parameters
    ----------
    recordings
        Number of recordings that have the column.
    cells, missing
        Number of cells, and of those without a value.
    leading, longest
        Most missing cells at the start of a recording, and the longest run of them behind that.
    words
        By recording, the number of cells that are text, the row of the first, and that.
    numbers
        Range, mean and spread of the numbers.
    values
        Cells by value, None where there are more than `FEW` values.
    steps, falls, rises
        Number of differences between neighbouring rows, and of those below and above zero.
    jumps, wild
        For each of `PERIODS`, steps of nearly that size, and others of more than an eighth of it.
    source, run, at_start, last
        The recording, its missing cells before the next one, whether there was none but these, and
        its last number.
    """

    recordings: int = 0
    cells: int = 0
    missing: int = 0
    leading: int = 0
    longest: int = 0
    words: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    numbers: RunningMoments = field(default_factory=RunningMoments)
    values: Counter[float | str] | None = field(default_factory=Counter)
    steps: int = 0
    falls: int = 0
    rises: int = 0
    jumps: list[int] = field(default_factory=lambda: [0] * len(PERIODS))
    wild: list[int] = field(default_factory=lambda: [0] * len(PERIODS))
    source: str = ""
    run: int = 0
    at_start: bool = True
    last: float = math.nan

    def begin(self, source: str = "") -> None:
        """Say that the next cells are of another recording."""
        self.recordings += 1
        self.source, self.run, self.at_start, self.last = source, 0, True, math.nan

    def leap(self) -> None:
        """Say that rows before the next cells were left out."""
        self.run, self.at_start, self.last = 0, False, math.nan

    def add(self, cells: Column, start: int = 0) -> None:
        """Take the next cells of the recording, from some row on."""
        numbers = cells
        if cells.dtype.kind == "U":
            numbers, words = mixed(cells)
            if words.any():
                first = int(words.argmax())
                place = 0, start + first, str(cells[first])
                count, row, word = self.words.get(self.source, place)
                self.words[self.source] = (count + int(words.sum()), row, word)
            if 2 * words.sum() >= len(cells) - (np.isnan(numbers) & ~words).sum():
                absent = np.strings.str_len(cells) == 0
                self.cells += len(cells)
                self._count_missing(absent)
                self._count_values(cells[~absent])
                return
            self._count_values(cells[words])
        absent = np.isnan(numbers)
        self.cells += len(cells)
        self._count_missing(absent)
        present = numbers[~absent]
        self._count_values(present)
        if len(present):
            self.numbers.add(present)
            self._count_steps(present)

    def _count_missing(self, absent: NDArray[np.bool_]) -> None:
        self.missing += int(absent.sum())
        for start, stop in runs_of(absent):
            length = stop - start + (self.run if start == 0 else 0)
            if self.at_start and start == 0:
                self.leading = max(self.leading, length)
            else:
                self.longest = max(self.longest, length)
        trailing = int(absent[::-1].argmin()) if not absent.all() else len(absent)
        self.run = trailing + (self.run if trailing == len(absent) else 0)
        self.at_start = self.at_start and trailing == len(absent)

    def _count_values(self, present: Column) -> None:
        if self.values is None:
            return
        if len({*present[:1000].tolist()}) <= FEW:
            values, counts = np.unique(present, return_counts=True)
            if len(values) <= FEW:
                self.values.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))
                if len(self.values) <= FEW:
                    return
        self.values = None

    def _count_steps(self, numbers: NDArray[np.float64]) -> None:
        joined = numbers if math.isnan(self.last) else np.append(self.last, numbers)
        with np.errstate(all="ignore"):
            steps = np.diff(joined)
        self.last = float(numbers[-1])
        self.steps += len(steps)
        self.falls += int((steps < 0).sum())
        self.rises += int((steps > 0).sum())
        sizes = np.abs(steps)
        for i, period in enumerate(PERIODS):
            jumps = np.abs(sizes - period) < 0.08 * period
            self.jumps[i] += int(jumps.sum())
            self.wild[i] += int((sizes > period / 8).sum() - jumps.sum())

    @property
    def text(self) -> bool:
        """True if at least half of the cells with a value are text."""
        words = sum(count for count, *_ in self.words.values())
        return words > 0 and words >= self.numbers.count

    @property
    def empty(self) -> bool:
        """True if no cell has a value."""
        return self.cells == self.missing

    @property
    def constant(self) -> bool:
        """True if all cells that have a value have the same."""
        return self.values is not None and len(self.values) == 1

    @property
    def flag(self) -> bool:
        """True if there are at least two values, and few."""
        return self.values is not None and len(self.values) > 1 and self.cells > 2 * FEW

    @property
    def counter(self) -> bool:
        """True if the numbers rise from nearly every row to the next and never fall."""
        return not self.text and self.steps > FEW and not self.falls and self.rises > self.steps / 2

    @property
    def set_point(self) -> bool:
        """True if it never changes within a recording, but does between recordings."""
        several = self.recordings > 1 and (self.values is None or len(self.values) > 1)
        return several and not self.rises + self.falls and not self.text

    @property
    def wraps(self) -> float:
        """The full turn by which an angle jumps, of `PERIODS`; 0 for what is no such angle.

        It jumps by nearly a full turn, and moves slowly otherwise.
        """
        for i, period in enumerate(PERIODS):
            turn = 0.9 * period < self.numbers.high - self.numbers.low < 2.1 * period
            if turn and self.jumps[i] and self.wild[i] <= self.jumps[i] and not self.flag:
                return period
        return 0.0

    @property
    def coarse(self) -> bool:
        """True if float32 cannot tell its values: an import subtracts the training mean."""
        if self.text or self.empty or self.constant or self.counter:
            return False
        return bool(is_coarse(self.numbers.spread, self.numbers.largest))


@dataclass(frozen=True, slots=True)
class ClockFacts:
    """Stamps of the rows of one recording.

    Parameters
    ----------
    steps
        Times between rows in the unit of the stamps.
    dated
        Whether the stamps are texts such as ``2024-05-01 12:00:00``; then the unit is a second.
    largest, whole
        The largest stamp, and whether all are whole numbers: they tell the unit.
    """

    steps: Steps
    dated: bool
    largest: float
    whole: bool

    @classmethod
    def of(
        cls, blocks: Sequence[tuple[int, NDArray[np.float64]]], *, dated: bool = False
    ) -> "ClockFacts | None":
        """Return the facts of one recording's stamps; None where no two rows have one.

        Parameters
        ----------
        blocks
            First row, and stamps, of blocks of rows; NaN where one is missing.
        dated
            Whether they were texts.
        """
        present = [(first + np.flatnonzero(~np.isnan(x)), x[~np.isnan(x)]) for first, x in blocks]
        rows = np.concatenate([np.zeros(0, np.int64), *(numbers for numbers, _ in present)])
        times = np.concatenate([np.zeros(0), *(stamps for _, stamps in present)])
        if len(times) < 2:
            return None
        steps, all_whole = Steps.of(times, rows), bool((times == np.round(times)).all())
        return cls(steps, dated, float(np.abs(times).max()), all_whole)


def time_unit(name: str, clocks: Sequence[ClockFacts]) -> str:
    """Return the unit of stamps: ``"date"``, ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``.

    The name decides where it has a unit, then the size of stamps since 1970, then whether whole
    numbers are far apart.

    Examples
    --------
    >>> rows = [ClockFacts(Steps.of(np.array([0.0, 15.0])), False, 9900.0, True)]
    >>> time_unit("Time", rows), time_unit("t[s]", rows)
    ('ms', 's')
    """
    if any(clock.dated for clock in clocks):
        return "date"
    if match := re.search(r"(?:[^a-zA-Zµ]|^)([nuµm]s|[nu]sec|msec|sec|s)\W*$", name.strip()):
        return match[1].replace("µ", "u").replace("sec", "s")
    largest = max(clock.largest for clock in clocks)
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit
    steps = [clock.steps.usual for clock in clocks]
    far = 1 < float(np.median(steps)) < 10_000 and all(clock.whole for clock in clocks)
    return "ms" if far else "s"


def parse_dates(texts: Column) -> NDArray[np.float64] | None:
    """Return stamps in seconds, NaN for empty texts; None when any is no time in ISO 8601.

    Examples
    --------
    >>> parse_dates(np.array(["1970-01-01 00:00:01", "1970-01-01T00:00:01.250Z", ""]))
    array([1.  , 1.25,  nan])
    >>> parse_dates(np.array(["open", "closed"])) is None
    True
    """
    with contextlib.suppress(TrajectoryError):
        return parse_times(texts, "iso")
    return None
