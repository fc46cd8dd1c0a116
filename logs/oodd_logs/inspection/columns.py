"""Contents of the columns of logs, counted over blocks of rows: nothing here needs a whole file.

A `ColumnFacts` takes the cells of a column block by block, of one recording after another. Its
properties say what it looks like: a constant, a flag, a counter, an angle that wraps, values that
float32 cannot tell apart.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.offsets import RunningMoments, is_coarse
from oodd_eval.errors import TrajectoryError
from oodd_logs.kinds.missing_codes import NUMBERS
from oodd_logs.kinds.times import SCALES, orders_of, parse_times, past_midnight, unit_in
from oodd_logs.ledger import Fate
from oodd_logs.marks import runs_of
from oodd_logs.readers.cells import mixed
from oodd_logs.recording import Column
from oodd_logs.stamps import Steps

FEW: Final = 8
"""Distinct values up to which a column is a flag, or may be a label."""

_PERIODS: Final = (2 * math.pi, 360.0, 1.0, 24.0, 60.0, 100.0, 400.0, 3600.0, 6400.0, 86400.0)
"""Usual periods: full turns in many units, hours and days; powers of 2 and 10 are others."""

TEXT: Final = "text among numbers"
_INFINITE: Final = "no finite number"
_BEYOND: Final = "a million times as far from the median as usual"
EXCEPTIONS: Final[Mapping[str, Fate]] = {TEXT: "held", _INFINITE: "held", _BEYOND: "kept"}
"""What becomes of cells that are no such values as most others of a column, by the reason."""

_WHOLE: Final = np.zeros(1, np.int64)  # cells of one recording
_FAR: Final = 1e6  # median deviations
_JUMP: Final = 0.45  # share of the range, from which a step may be back to the beginning
_ROUNDED: Final = 1e-4  # share by which the mean step of stamps differs from the median
_NEAR: Final = 0.001  # share by which a period is rounded


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
    exceptions
        By reason and recording, the number of cells that are no such values as most others, the
        row of the first, and its text.
    numbers
        Range, mean and spread of the numbers.
    values
        Cells by value, None where there are more than `FEW` values.
    codes, inner
        By numbers that often stand for a missing value, their cells by recording, and of blocks
        with such the first and the 99th percentile of the other numbers.
    steps, falls, rises
        Number of differences between neighbouring rows, and of those below and above zero.
    span
        Range of the numbers on which `turns` are based.
    turns
        Steps by their sizes, of each recording, or block of several: number of jumps of about the
        range, and of others of more than an eighth of it, sums of the jumps, of their sizes, of all
        other steps, of the sizes of these, and the number of all.
    sources, firsts
        The recordings whose cells are taken, and the first cell of each.
    recent, filled
        Of each of these, cells by value as in `values`, and whether it has a number.
    run, at_start, last, row
        Missing cells before the next one, whether there was none but these in the recording, its
        last number, and its next row.
    """

    recordings: int = 0
    cells: int = 0
    missing: int = 0
    leading: int = 0
    longest: int = 0
    exceptions: dict[tuple[str, str], tuple[int, int, str]] = field(default_factory=dict)
    numbers: RunningMoments = field(default_factory=RunningMoments)
    values: Counter[float | str] | None = field(default_factory=Counter)
    codes: dict[float, Counter[str]] = field(default_factory=dict)
    inner: list[tuple[float, float]] = field(default_factory=list)
    steps: int = 0
    falls: int = 0
    rises: int = 0
    span: float = 0.0
    turns: list[NDArray[np.float64]] = field(default_factory=list)
    sources: Sequence[str] = ()
    firsts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    recent: list[Counter[float | str]] = field(default_factory=list)
    filled: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(1, np.bool_))
    run: int = 0
    at_start: bool = True
    last: float = math.nan
    row: int = 0

    def begin(self, sources: Sequence[str] = ("",), firsts: NDArray[np.int64] = _WHOLE) -> None:
        """Say that the next cells are of another recording, or of several in one block.

        Parameters
        ----------
        sources
            Names of the recordings.
        firsts
            Position of the first cell of each.
        """
        self.recordings += len(sources)
        self.turns.append(np.zeros(7))
        self.sources, self.firsts = sources, firsts
        self.recent, self.filled = [Counter() for _ in sources], np.zeros(len(sources), np.bool_)
        self.run, self.at_start, self.last, self.row = 0, True, math.nan, 0

    def add(self, cells: Column, start: int | None = None) -> None:
        """Take cells of the recording from some row on, by default the next one."""
        start = self.row if start is None else start
        if start != self.row:
            self.run, self.at_start, self.last = 0, False, math.nan
        self.row = start + len(cells)
        numbers = cells
        self.cells += len(cells)
        if cells.dtype.kind == "U":
            numbers, words = mixed(cells)
            self._except(TEXT, words, cells, start)
            if 2 * words.sum() >= len(cells) - (np.isnan(numbers) & ~words).sum():
                absent = np.strings.str_len(cells) == 0
                self._count_missing(absent)
                self._count_values(cells, ~absent)
                return
            self._count_values(cells, words)
        present = np.isfinite(numbers)
        self._count_missing(~present)
        self._except(_INFINITE, np.isinf(numbers), cells, start)
        if not present.any():
            return
        self._count_values(numbers, present)
        self.numbers.add(numbers[present])
        self._count_codes(numbers, present)
        self.filled |= np.logical_or.reduceat(present, self.firsts)
        if self._count_steps(numbers, present):
            away = np.abs(numbers - np.median(numbers[present]))
            usual = np.median(away[present])
            beyond = present & (away > _FAR * usual)
            if usual > 0 and beyond.sum() <= 1 + present.sum() // 100:
                self._except(_BEYOND, beyond, cells, start)

    def _except(self, reason: str, cells: NDArray[np.bool_], values: Column, start: int) -> None:
        """Keep how many cells of a recording are no such values as the others, and the first."""
        rows = np.flatnonzero(cells)
        recordings = np.searchsorted(self.firsts, rows, side="right") - 1
        for i, first, count in zip(
            *np.unique(recordings, return_index=True, return_counts=True), strict=True
        ):
            row, key = int(rows[first]), (reason, self.sources[i])
            fresh = 0, start + row - int(self.firsts[i]), f"{values[row]!s:.60}"
            before, first_row, cell = self.exceptions.get(key, fresh)
            self.exceptions[key] = before + int(count), first_row, cell

    def _count_codes(self, numbers: NDArray[np.float64], present: NDArray[np.bool_]) -> None:
        """Count cells that may stand for a missing value, and keep where most others are."""
        if NUMBERS.isdisjoint((float(numbers[present].min()), float(numbers[present].max()))):
            return
        coded = np.isin(numbers, [*NUMBERS])
        recordings = np.searchsorted(self.firsts, np.flatnonzero(coded), side="right") - 1
        for code, i in zip(numbers[coded].tolist(), recordings.tolist(), strict=True):
            self.codes.setdefault(code, Counter())[self.sources[i]] += 1
        if (others := numbers[present & ~coded]).size:
            low, high = np.percentile(others, (1, 99)).tolist()
            self.inner.append((low, high))

    def _count_missing(self, absent: NDArray[np.bool_]) -> None:
        if not absent.any():
            self.run, self.at_start = 0, False
            return
        self.missing += int(absent.sum())
        for part in np.split(absent, self.firsts[1:]):
            if len(self.sources) > 1:
                self.run, self.at_start = 0, True
            for first, stop in runs_of(part):
                length = stop - first + (self.run if first == 0 else 0)
                if self.at_start and first == 0:
                    self.leading = max(self.leading, length)
                else:
                    self.longest = max(self.longest, length)
            # The run goes on in the next block.
            self.at_start = self.at_start and bool(part.all())
            self.run = len(part) + self.run if part.all() else int(part[::-1].argmin())

    def _count_values(self, cells: Column, present: NDArray[np.bool_]) -> None:
        if self.values is None or len({*cells[present][:1000].tolist()}) > FEW:
            self.values = None
            return
        parts = zip(*(np.split(x, self.firsts[1:]) for x in (cells, present)), strict=True)
        for recent, (values, there) in zip(self.recent, parts, strict=True):
            counts = Counter(values[there].tolist())
            recent.update(counts)
            self.values.update(counts)
            if len(self.values) > FEW:
                self.values = None
                return

    @np.errstate(all="ignore")
    def _count_steps(self, numbers: NDArray[np.float64], present: NDArray[np.bool_]) -> bool:
        """Count steps by their sizes; tell whether one is much larger than the others.

        Steps count that are inside a recording.
        """
        there = numbers[present]
        steps = np.diff(there if math.isnan(self.last) else np.append(self.last, there))
        self.last = float(there[-1])
        if len(self.sources) > 1:  # which begin in this block
            recordings = np.searchsorted(self.firsts, np.flatnonzero(present), side="right")
            steps = steps[np.diff(recordings) == 0]
        self.steps += len(steps)
        span = self.numbers.high - self.numbers.low
        if span > 1.2 * self.span:  # what seemed to be jumps was none
            self.span = span
            for turns in self.turns:
                turns[4:6] += turns[2:4]
                turns[:4] = 0.0
        if not len(steps) or not 0 < span < np.inf:
            return False
        self.falls += int((steps < 0).sum())
        self.rises += int((steps > 0).sum())
        sizes = np.abs(steps)
        jumps = sizes > _JUMP * span
        sums = np.array([steps[jumps].sum(), sizes[jumps].sum(), steps.sum(), sizes.sum()])
        sums[2:] -= sums[:2]
        wild = (sizes > span / 8).sum() - jumps.sum()
        self.turns[-1] += [jumps.sum(), wild, *sums, len(steps)]
        return bool(sizes.max() > max(span / 8, 0.2 * sizes.sum()))

    @property
    def text(self) -> bool:
        """True if at least half of the cells with a value are text."""
        return self.words > 0 and self.words >= self.numbers.count

    @property
    def words(self) -> int:
        """Number of cells that are text."""
        return sum(n for (reason, _), (n, *_) in self.exceptions.items() if reason == TEXT)

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
        if self.text or self.steps <= FEW or self.rises <= self.steps / 2:
            return False
        jumps, *_, moved, _, steps = np.sum(self.turns, axis=0)
        begins_anew = self.period and self.falls == jumps and moved == steps - jumps
        return bool(not self.falls or begins_anew)

    @property
    def set_point(self) -> bool:
        """True if it never changes within a recording, but does between recordings."""
        several = self.recordings > 1 and (self.values is None or len(self.values) > 1)
        return several and not self.rises + self.falls and not self.text

    @property
    def period(self) -> float:
        """The period after which it begins anew; 0 for what does not.

        It jumps by nearly a period, and moves slowly otherwise: through the whole range, unless the
        period is a usual one.
        """
        if self.flag or self.text or not self.turns:
            return 0.0
        jumps, wild, jumped, size, moved, walked, steps = np.transpose(self.turns)
        jumping = jumps > 0
        if not jumping.any() or wild.sum() > jumps.sum():
            return 0.0
        jump = float(size.sum() / jumps.sum())
        slow = float(np.abs(moved).sum() / self.steps)
        span = float(self.numbers.high - self.numbers.low)
        for period in _PERIODS[:2]:
            if abs(jump - period) < 0.08 * period and 0.9 * period < span < 1.3 * period:
                return period
        usual_step = float(walked[jumping].sum() / max(1, (steps - jumps)[jumping].sum()))
        if jump + 3 * usual_step < 0.98 * span:
            return 0.0
        power = 2.0 ** min(max(math.ceil(math.log2(span)), 8), 32)
        if 0.98 * power < span <= power:
            return power
        # From the end to the beginning and through the range again, not to and fro.
        through = (np.abs(jumped) > 0.6 * size) & (jumped * moved < 0) & (abs(moved) > 0.3 * span)
        if 2 * through.sum() < jumping.sum():
            return 0.0
        likely, most = max(span, jump + slow), max(span, jump) + 3 * usual_step
        usual = [*_PERIODS, *(10.0**k for k in range(-3, 10))]
        if fitting := [p for p in usual if 0.999 * max(span, jump) <= p <= 1.01 * most]:
            return min(fitting, key=lambda period: abs(period - likely))
        rounded = (float(f"{likely:.{digits}g}") for digits in range(1, 6))
        return next((p for p in rounded if abs(p / likely - 1) < _NEAR), likely)

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
    unit
        ``"date"`` of texts, ``"s"`` of seconds and nanoseconds; empty where it is to be guessed.
    largest, whole
        The largest stamp, and whether all are whole numbers.
    by_order
        The same by order of day and month, of dates that need one, the likelier first.
    """

    steps: Steps
    unit: str
    largest: float
    whole: bool
    by_order: Mapping[str, "ClockFacts"] = field(default_factory=dict)

    @classmethod
    def of(cls, rows: NDArray[np.int64], columns: Sequence[Column]) -> "ClockFacts | None":
        """Return the facts of one recording's stamps; None where no two rows have one.

        Parameters
        ----------
        rows
            Numbers of the rows.
        columns
            One column of numbers or texts, NaN or empty where one is missing, or two whose times
            add up: date and time of day, or seconds and nanoseconds.

        Raises
        ------
        TrajectoryError
            When a text is no time.
        """
        dated = columns[0].dtype.kind == "U"
        orders = orders_of(*columns) if dated else ()
        units = ("", "") if dated or len(columns) == 1 else ("s", "ns")
        unit = "date" if dated else units[0]
        readings: dict[str, ClockFacts] = {}
        for order in orders or [""]:
            columns_and_units = zip(columns, units, strict=False)
            times = np.sum([parse_times(*pair, order) for pair in columns_and_units], axis=0)
            times = past_midnight(times) if dated else times
            present = np.isfinite(times)
            times = times[present]
            if len(times) < 2:
                return None
            steps, whole = Steps.of(times, rows[present]), bool((times == np.round(times)).all())
            # Of stamps that were rounded the mean step tells the rate, not the median.
            apart = np.diff(times)
            even = apart[np.abs(apart - steps.usual) < steps.usual / 4]
            if len(even) and abs(even.mean() / steps.usual - 1) > _ROUNDED:
                steps = replace(steps, usual=float(even.mean()))
            readings[order] = cls(steps, unit, float(np.abs(times).max()), whole)
        return replace(readings[orders[0]], by_order=readings) if orders else readings[""]


def time_unit(name: str, clocks: Sequence[ClockFacts]) -> str:
    """Return the unit of stamps: ``"date"``, or one from ``"ns"`` to ``"d"``.

    The name decides where it has a unit, then the size of stamps since 1970, then whether whole
    numbers are far apart, or steps are whole seconds in hours or days.

    Examples
    --------
    >>> rows = [ClockFacts(Steps.of(np.array([0.0, 15.0])), "", 9900.0, True)]
    >>> time_unit("Time", rows), time_unit("t[s]", rows), time_unit("t (min)", rows)
    ('ms', 's', 'min')
    """
    if unit := next((clock.unit for clock in clocks if clock.unit), "") or unit_in(name):
        return unit
    largest = max(clock.largest for clock in clocks)
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit
    step = float(np.median([clock.steps.usual for clock in clocks]))
    # Days since 1900 or the year 0, as spreadsheets and MATLAB count them.
    if step < 0.01 and (2e4 < largest < 1e5 or 6e5 < largest < 1e6):
        return "d"
    for unit, most in (("d", 2e-5), ("h", 4e-4)):
        seconds = step * SCALES[unit]
        if 0 < step < most and _is_round(seconds) and not _is_round(step):
            return unit
    far = 1 < step < 10_000 and all(clock.whole for clock in clocks)
    return "ms" if far else "s"


def _is_round(step: float) -> bool:
    """Tell whether a step, or the rate that it makes, has one digit, as people choose them."""
    digits = [x / 10.0 ** math.floor(math.log10(x)) for x in (step, 1 / step)]
    return any(abs(x - round(2 * x) / 2) < 2e-3 * x for x in digits)


def parse_dates(texts: Column) -> NDArray[np.float64] | None:
    """Return stamps in seconds, NaN for empty texts; None when any is no time.

    Examples
    --------
    >>> parse_dates(np.array(["1970-01-01 00:00:01", "01/01/1970 0:00:01.250", ""]))
    array([1.  , 1.25,  nan])
    >>> parse_dates(np.array(["open", "closed"])) is None
    True
    """
    with contextlib.suppress(TrajectoryError):
        return parse_times(texts, "iso", next(iter(orders_of(texts)), ""))
    return None
