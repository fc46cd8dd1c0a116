"""Times: numbers in units from nanoseconds to days, dates of many countries, times of day."""

import functools
import re
from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError, UnknownNameError
from oodd_logs.recording import MISSING, Column

_PER_SECOND: Final = {"ns": 10**9, "us": 10**6, "ms": 10**3, "s": 1}
_SECONDS_IN: Final = {"min": 60, "h": 3600, "d": 86400}

SCALES: Final = {u: 1 / n for u, n in _PER_SECOND.items()} | _SECONDS_IN | {"date": 1.0}
"""Seconds in the units of stamps; dates, and times as texts, are read as seconds."""

UNIT_NAMES: Final = {
    "date": "dates",
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "min": "minutes",
    "h": "hours",
    "d": "days",
}
"""Words for the units of stamps."""

_SPELLINGS: Final = {
    "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
    "us": "us µs μs usec usecs micros microsec microsecs microsecond microseconds",
    "ms": "ms msec msecs millis millisec millisecs millisecond milliseconds",
    "s": "s sec secs second seconds sekunden",
    "min": "min mins minute minutes minuten",
    "h": "h hr hrs hour hours stunden",
    "d": "d day days tage",
}
_UNIT_OF: Final = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
_TIME_WORDS: Final = frozenset(
    ("time", "timestamp", "datetime", "date", "stamp", "ts", "t", "elapsed", "uptime", "epoch",
     "zeit", "zeitstempel", "datum", "uhrzeit")
)  # fmt: skip
_WORD: Final = re.compile(r"[A-Zµμ]?[a-zµμ]+|[A-Zµμ]+")
_MONTHS: Final = (
    "jan", "feb", "mar mär mrz", "apr", "may mai", "jun", "jul", "aug", "sep", "oct okt", "nov",
    "dec dez",
)  # fmt: skip
_MONTH_OF: Final = {name: i for i, names in enumerate(_MONTHS, 1) for name in names.split()}
_DAY: Final = 86400.0
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_TEXT: Final = re.compile(
    r"(?:(?:(?P<first>\d{1,4})[-/. ](?P<second>\d{1,2}|[^\W\d]{3,9})[-/. ]+(?P<third>\d{2,4})"
    r"|(?P<name>[^\W\d]{3,9})[. ]+(?P<day>\d{1,2})[. ]+(?P<year>\d{4})|(?P<days>-?\d+) ?days?)"
    r"(?:[T. ]+|$))?"
    r"(?:(?P<sign>-?)(?P<hours>\d{1,4}):(?P<minutes>\d\d)(?::(?P<seconds>\d\d))?(?P<part>\.\d*)?"
    r"(?: ?(?P<half>[ap])\.?m\.?)?)?"
    r"(?: ?(?P<zone>Z|UTC|GMT|[+-]\d\d:?\d\d))?|(?P<plain>-?\d+(?:\.\d*)?) ?s",
    re.IGNORECASE,
)
"""Dates and times of day, durations such as ``1 days 00:00:01.5``, and ``1.5s``."""


def words_of(name: str) -> list[str]:
    """Return the words in the name of a column.

    >>> words_of("timeStamp_ns"), words_of("Time (min)")
    (['time', 'stamp', 'ns'], ['time', 'min'])
    """
    return [word.lower() for word in _WORD.findall(name)]


def unit_of(text: str) -> str:
    """Return a unit of time in its usual spelling; empty for other texts.

    >>> unit_of("Minutes"), unit_of("nsecs"), unit_of("rad")
    ('min', 'ns', '')
    """
    return _UNIT_OF.get(text.strip(" .()[]").lower(), "")


def unit_in(name: str) -> str:
    """Return the unit that ends the name of a column, empty without one.

    >>> unit_in("time [min]"), unit_in("t_us"), unit_in("timeMs"), unit_in("time")
    ('min', 'us', 'ms', '')
    """
    last = (re.findall(r"[^\W_]+", name) or [""])[-1]
    return unit_of(last) or unit_of((words_of(last) or [""])[-1] if last.isalpha() else "")


@functools.lru_cache(maxsize=1 << 16)
def names_time(name: str) -> bool:
    """Tell whether a column's name says that it has times.

    >>> names_time("header.stamp.sec"), names_time("rpm_t"), names_time("torque")
    (True, True, False)
    """
    if len(name.strip()) > 1 and unit_of(name):  # a column called seconds
        return True
    words = re.findall(r"[^\W\d_]+", name.lower())
    return not _TIME_WORDS.isdisjoint([*words, *(w for w in words_of(name) if len(w) > 1)])


def pairs_of(names: Sequence[str]) -> dict[str, str]:
    """Return columns with seconds, and those with the nanoseconds to add, by their names.

    >>> pairs_of(["stamp.nanosec", "stamp.sec", "a"])
    {'stamp.sec': 'stamp.nanosec'}
    """
    by_stem: dict[tuple[str, str], str] = {}
    for name in names:
        last = (re.findall(r"[^\W\d_]+", name) or [""])[-1]
        by_stem.setdefault((name[: name.rfind(last)], unit_of(last)), name)
    return {
        name: by_stem[stem, "ns"]
        for (stem, unit), name in by_stem.items()
        if unit == "s" and (stem, "ns") in by_stem
    }


def parse_times(column: Column, unit: str = "", order: str = "") -> NDArray[np.float64]:
    """Return times in seconds.

    Parameters
    ----------
    column
        Numbers, or texts as ISO 8601 has them: with ``T`` or a blank before the time of day, with
        ``Z``, an offset, or neither, which stands for UTC. Texts may also be dates of another
        order, with ``/`` or ``.`` or the name of a month, times of day with am and pm, and
        durations such as ``1 days 00:00:01.5``.
    unit
        Unit of the numbers, from ``"ns"`` to ``"d"``; ``"iso"`` for texts. By default seconds for
        numbers and any known form for texts.
    order
        ``"day first"`` or ``"month first"``; by default the cells have to tell.

    Returns
    -------
    numpy.ndarray
        float64 of shape (rows,): since 1970 for dates, since midnight or the start for times
        alone, else since what the numbers count from; NaN for what is missing.

    Raises
    ------
    UnknownNameError
        When the unit is unknown.
    TrajectoryError
        When a cell is no time in this unit; the message has its row, from 0 on.
    """
    known = unit_of(unit) or {"iso": "iso", "": "s", "1": "s"}.get(unit, "")
    if not known:
        raise UnknownNameError("unit of time", unit, [*_PER_SECOND, *_SECONDS_IN, "iso"])
    if column.dtype.kind != "U":
        if known == "iso":
            raise TrajectoryError("times are numbers, expected dates, or a unit such as s or ms")
        times = np.asarray(column, np.float64)
        return times * _SECONDS_IN[known] if known in _SECONDS_IN else times / _PER_SECOND[known]
    if unit not in {"", "iso"}:
        raise TrajectoryError(f"times are texts such as {column[:1].tolist()}, expected numbers")
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
        return _one_by_one(cells.tolist(), missing, order)
    if not (dated | missing).all():
        return _one_by_one(cells.tolist(), missing, order)
    return np.where(missing, np.nan, stamps.astype(np.int64) / 1e9 - offsets)


def past_midnight(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return times of day that go on where a day ends; other times come back as they are.

    >>> past_midnight(np.array([86399.0, 0.0, 1.0]))
    array([86399., 86400., 86401.])
    """
    present = np.isfinite(times)
    clock = times[present]
    if not len(clock) or clock.min() < 0 or clock.max() >= _DAY:
        return times
    risen = times.copy()
    risen[present] += _DAY * np.cumsum(np.diff(clock, prepend=clock[0]) < -_DAY / 2)
    return risen


def orders_of(*columns: Column) -> tuple[str, ...]:
    """Return the orders of day and month that dates may have, the likelier first.

    Empty where no date needs one. Who writes am and pm writes the month first.

    >>> orders_of(np.array(["04/03/2025", "14/03/2025"])), orders_of(np.array(["2025-03-04"]))
    (('day first',), ())
    """
    pairs, halves = set(), False
    for cell in {cell for column in columns for cell in column.tolist()}:
        match = _TEXT.fullmatch(cell.strip().replace(",", "."))
        if match and match["first"] and len(match["first"]) < 3 and match["second"].isdigit():
            pairs.add((int(match["first"]), int(match["second"])))
        halves = halves or bool(match and match["half"])
    if not pairs:
        return ()
    orders = ["day first"] if all(month <= 12 for _, month in pairs) else []
    orders += ["month first"] if all(month <= 12 for month, _ in pairs) else []
    return tuple(orders[::-1] if halves else orders)


def _offset(text: str) -> float:
    zone = datetime.fromisoformat(f"2000-01-01T00:00:00{text}").utcoffset()
    return 0.0 if zone is None else zone.total_seconds()


def _one_by_one(
    cells: Sequence[str], missing: NDArray[np.bool_], order: str
) -> NDArray[np.float64]:
    """Return times that NumPy cannot read, such as 20180718T195650Z and 14/03/2025 11:58."""
    times, orders = np.full(len(cells), np.nan), [order] if order else None
    for row in np.flatnonzero(~missing).tolist():
        try:
            stamp = datetime.fromisoformat(cells[row])
        except ValueError:
            if orders is None:
                orders = [*orders_of(np.array(cells))]
                if len(orders) > 1:
                    raise TrajectoryError(
                        f"row {row}: day or month may be first in {cells[row]!r:.80}, expected "
                        'dates = "day first" or dates = "month first" in the recipe'
                    ) from None
            times[row] = _parsed(cells[row], row, *orders)
            continue
        zoned = stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)
        times[row] = (zoned - _EPOCH).total_seconds()
    return times


def _parsed(cell: str, row: int, order: str = "day first") -> float:
    match = _TEXT.fullmatch(cell)
    problem = TrajectoryError(
        f"row {row}: {cell!r:.80} is no time, expected a date such as 2024-05-01T12:00:00.5Z, a "
        "time of day or a duration"
    )
    if not match or not cell:
        raise problem
    if match["plain"]:
        return float(match["plain"])
    seconds = float(match["days"] or 0) * 86400
    try:
        if match["first"] or match["name"]:
            seconds += 86400 * (_date(match, order) - date(1970, 1, 1)).days
        if match["hours"]:
            seconds += _time_of_day(match)
        if zone := match["zone"]:
            seconds -= _offset(zone) if zone[0] in "+-" else 0.0
    except (KeyError, ValueError):
        raise problem from None
    return seconds


def _date(match: re.Match[str], order: str) -> date:
    if match["name"]:
        return date(int(match["year"]), _MONTH_OF[match["name"][:3].lower()], int(match["day"]))
    first, second, third = match["first"], match["second"], match["third"]
    if len(first) > 2:  # 2025/03/04
        first, third = third, first
    elif second.isdigit() and order == "month first":
        first, second = second, first
    month = int(second) if second.isdigit() else _MONTH_OF[second[:3].lower()]
    return date(int(third) + 2000 * (len(third) == 2), month, int(first))


def _time_of_day(match: re.Match[str]) -> float:
    hours, minutes, part = int(match["hours"]), float(match["minutes"]), match["part"] or ""
    seconds = float((match["seconds"] or "0") + part)
    if part and not match["seconds"]:  # 01:02.5 has minutes and seconds
        hours, minutes, seconds = 0, float(match["hours"]), float(match["minutes"] + part)
    if match["half"]:
        if not 1 <= hours <= 12:
            raise ValueError(hours)
        hours = hours % 12 + 12 * (match["half"].lower() == "p")
    if (minutes >= 60 and hours) or seconds >= 61:
        raise ValueError(minutes)
    total = 3600 * hours + 60 * minutes + seconds
    return -total if match["sign"] else total
