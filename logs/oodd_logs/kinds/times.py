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

_UNITS: Final = (
    ("ns", 1e-9, "nanoseconds nsec nsecs nanos nanosec nanosecs nanosecond"),
    ("us", 1e-6, "microseconds µs μs usec usecs micros microsec microsecs microsecond"),
    ("ms", 1e-3, "milliseconds msec msecs millis millisec millisecs millisecond"),
    ("s", 1.0, "seconds sec secs second sekunden"),
    ("min", 60.0, "minutes mins minute minuten"),
    ("h", 3600.0, "hours hr hrs hour stunden"),
    ("d", 86400.0, "days day tage"),
)
SCALES: Final = {"date": 1.0, **{unit: scale for unit, scale, _ in _UNITS}}
"""Seconds in the units of stamps; dates, and times as texts, are read as seconds."""

UNIT_NAMES: Final = {"date": "dates", **{unit: words.split()[0] for unit, _, words in _UNITS}}
"""Words for the units of stamps."""

_UNIT_OF: Final = {word: unit for unit, _, words in _UNITS for word in (unit, *words.split())}
_TIME_WORD: Final = re.compile(
    "(?:date)?time|(?:time)?stamp|ts?|date|elapsed|uptime|epoch|zeit(?:stempel)?|datum|uhrzeit"
)
_WORD: Final = re.compile(r"[A-Zµμ]?[a-zµμ]+|[A-Zµμ]+")
_MONTHS: Final = re.compile(
    "(jan)|(feb)|(m[aä]r|mrz)|(apr)|(ma[iy])|(jun)|(jul)|(aug)|(sep)|(o[ck]t)|(nov)|(de[cz])",
    re.IGNORECASE,
)
_DAY: Final = 86400.0
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
    words += [word for word in words_of(name) if len(word) > 1]
    return any(map(_TIME_WORD.fullmatch, words))


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
        raise UnknownNameError("unit of time", unit, [unit for unit, *_ in _UNITS] + ["iso"])
    if column.dtype.kind != "U":
        if known == "iso":
            raise TrajectoryError("times are numbers, expected dates, or a unit such as s or ms")
        times, scale = np.asarray(column, np.float64), SCALES[known]
        # Divided by a whole number, decimal fractions of a second are the nearest numbers.
        return times * scale if scale >= 1 else times / round(1 / scale)
    if unit not in {"", "iso"}:
        raise TrajectoryError(f"times are texts such as {column[:1].tolist()}, expected numbers")
    orders: Sequence[str] = [order] if order else []
    times = np.full(len(column), np.nan)
    for row, text in enumerate(column.tolist()):
        cell = text.strip().replace(",", ".")
        if cell.lower() in MISSING:
            continue
        try:
            stamp = datetime.fromisoformat(cell)
        except ValueError:
            orders = orders or orders_of(column) or ["day first"]
            if len(orders) > 1:
                raise TrajectoryError(
                    f"row {row}: day or month may be first in {cell!r:.80}, expected dates = "
                    '"day first" or dates = "month first" in the recipe'
                ) from None
            times[row] = _parsed(cell, row, orders[0])
        else:
            times[row] = (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
    return times


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
    months = {"day first": 1, "month first": 0}
    orders = [o for o, i in months.items() if pairs and max(pair[i] for pair in pairs) <= 12]
    return tuple(orders[::-1] if halves else orders)


def _parsed(cell: str, row: int, order: str) -> float:
    """Return a time that is in no form of ISO 8601, such as 14/03/2025 11:58."""
    match = _TEXT.fullmatch(cell)
    problem = TrajectoryError(
        f"row {row}: {cell!r:.80} is no time, expected a date such as 2024-05-01T12:00:00.5Z, a "
        "time of day or a duration"
    )
    if not match or not cell:
        raise problem
    if match["plain"]:
        return float(match["plain"])
    try:
        seconds = 86400.0 * int(match["days"] or 0)
        if match["first"] or match["name"]:
            seconds += 86400 * (_date(match, order) - date(1970, 1, 1)).days
        if match["hours"]:
            seconds += _time_of_day(match)
        if (zone := match["zone"]) and zone[0] in "+-":
            seconds -= int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[-2:]))
    except ValueError:
        raise problem from None
    return seconds


def _date(match: re.Match[str], order: str) -> date:
    first, second, third = match["first"], match["second"], match["third"]
    if match["name"]:
        first, second, third = match["day"], match["name"], match["year"]
    elif len(first) > 2:  # 2025/03/04
        first, third = third, first
    elif second.isdigit() and order == "month first":
        first, second = second, first
    month = int(second) if second.isdigit() else 0
    if named := _MONTHS.match(second):
        month = named.lastindex or 0
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
