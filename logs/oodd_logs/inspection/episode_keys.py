"""Columns that tell the episodes of a table apart, where nobody has said which they are.

A key changes where a counter or the time starts anew, or has a name that says so; the numbers of
robots that write in turn each have times that rise. Flags are known by their names.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_logs.inspection.columns import parse_dates
from oodd_logs.kinds.times import names_time, pairs_of
from oodd_logs.recording import Column, Recording, Topic
from oodd_logs.splitting import BEGINS, COUNTS, ENDS, names_flag

_CELLS: Final = 1 << 20  # that are looked at
_SHORTEST: Final = 8  # rows of an episode, in the mean
_STEADY: Final = 0.9  # share of rows in which a counter makes its usual step
_IN_TURN: Final = 0.2  # share of rows whose stamp does not rise, where several robots write
_NUMBER: Final = r"(?:[^a-z]*(?:id|index|idx|no|nr|num|number|name))?$"
_EPISODE: Final = re.compile(
    r"(?:^|[^a-z])(?:run|episode|ep|trial|traj|trajectory|rollout|demo|demonstration|experiment"
    r"|flight)" + _NUMBER
)
_NO_KEY: Final = re.compile(
    r"anomal|fault|fail|label|health|attack|alarm|error|class|status|phase|stage|state|mode|signal"
    r"|variable|channel|topic|metric|tag$|parameter|sensor|flag"
    r"|month|year|week|dates$"
)
_WRITER: Final = re.compile(
    r"(?:^|[^a-z])(?:robot|vehicle|machine|device|agent|drone|rover|car|truck|turbine|engine|unit|env"
    r"|asset)" + _NUMBER
)
_STEP: Final = re.compile(r"(?:^|[^a-z])(?:step|timestep|frame|tick)s?(?:$|[^a-z])")

_Mask = NDArray[np.bool_]


def episode_columns(recording: Recording) -> tuple[str, ...]:
    """Return the columns that tell episodes of a recording apart, none where it seems to be one.

    Parameters
    ----------
    recording
        What was recorded; with several topics it counts as one episode.
    """
    topics = [topic for topic in recording.topics.values() if topic.names]
    if len(topics) != 1:
        return ()
    topic = topics[0]
    rows = min(topic.rows, max(1000, _CELLS // len(topic.names)))
    stamps = pairs_of(topic.names)  # whole seconds, and what is added to them
    names = [name for name in topic.names if name not in {*stamps, *stamps.values()}]
    sample = topic.read(names, 0, rows)
    counters = {n: x for n, cells in sample.items() if (x := _counter(cells)) is not None}
    restarts = {n: np.diff(x) < 0 for n, x in counters.items() if _starts_anew(n, x)}
    keys = _keys(topic, sample, restarts)
    writer = _in_turn(sample, counters, keys)
    steps = [n for n in restarts if _STEP.search(_words(n)) and not _NO_KEY.search(_words(n))]
    return (*writer, *(keys or _flags(topic) or ([] if writer else steps[:1])))


def _words(name: str) -> str:
    """Return a name in lower case, with a mark where it had a capital."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


def _counter(cells: Column) -> NDArray[np.float64] | None:
    """Return a column that may count rows or tell the time, dates in seconds."""
    if cells.dtype.kind == "U":
        dates = len(cells) > 1 and bool(cells[0]) and parse_dates(cells[:3]) is not None
        return parse_dates(cells) if dates else None
    return cells if len(cells) > 1 and not np.isnan(cells).any() else None


def _starts_anew(name: str, counter: NDArray[np.float64]) -> bool:
    """Tell whether a column rises, in even steps or as its name says, but for a few falls."""
    steps = np.diff(counter)
    rising, falls = steps[steps > 0], int((steps < 0).sum())
    if not 1 <= falls <= len(steps) / _SHORTEST or len(rising) < _STEADY * (len(steps) - falls):
        return False
    is_even = (np.abs(rising - np.median(rising)) <= 1e-3 * np.median(rising)).mean() >= _STEADY
    return bool(is_even or COUNTS.search(_words(name)))


def _keys(topic: Topic, sample: Mapping[str, Column], restarts: Mapping[str, _Mask]) -> list[str]:
    """Return the likeliest key whose values follow one another, and another one that it needs."""
    ranked: list[tuple[bool, bool, list[str]]] = []
    for name, cells in sample.items():
        says_so = bool(_EPISODE.search(_words(name)))
        column = topic.read([name], 0, topic.rows)[name] if says_so else cells
        changes = column[1:] != column[:-1]
        episodes = int(changes.sum()) + 1
        # Whole seconds rise where fractions start anew, and so do days.
        is_key = name not in restarts and not _NO_KEY.search(_words(name)) and not names_time(name)
        if not is_key or not 1 < episodes <= len(column) / _SHORTEST:
            continue
        explains = any(np.array_equal(falls, changes[: len(falls)]) for falls in restarts.values())
        values = column[np.append(0, np.flatnonzero(changes) + 1)]
        distinct = {*values.tolist()}
        # A machine that runs or not is no number of a run.
        if not explains and (not says_so or distinct <= {0.0, 1.0}):
            continue
        partner = [] if len(distinct) == episodes else _partner(sample, name, changes)
        if partner is not None and (explains or not partner):
            counts_up = values.dtype.kind == "f" and bool((np.diff(values) == 1).all())
            ranked.append((not says_so, not counts_up, [*partner, name]))
    return min(ranked, key=lambda row: row[:2], default=(True, True, []))[2]


def _partner(sample: Mapping[str, Column], name: str, changes: _Mask) -> list[str] | None:
    """Return a column that makes the recurring values of a key unique; None without any."""
    rows = np.append(0, np.flatnonzero(changes) + 1)
    rows = rows[rows < len(sample[name])]
    for other, cells in sample.items():
        is_within = ((cells[1:] != cells[:-1]) <= changes[: len(cells) - 1]).all()
        pairs = {*zip(cells[rows].tolist(), sample[name][rows].tolist(), strict=True)}
        if other != name and is_within and len(pairs) == len(rows):
            return [other]
    return None


def _flags(topic: Topic) -> list[str]:
    """Return flags of last rows, else of first ones."""
    for pattern in (ENDS, BEGINS):
        columns = [name for name in topic.names if names_flag(pattern, name)]
        cells = topic.read(columns, 0, topic.rows)
        flags = [name for name in columns if _is_flag(cells[name])]
        if any((cells[name][1:-1] == 1).any() for name in flags):
            return flags
    return []


def _is_flag(cells: Column) -> bool:
    """Tell whether cells are 0 but for single rows of 1."""
    if cells.dtype.kind == "U" or not np.isin(cells, [0, 1]).all():
        return False
    return bool(cells.any()) and not (cells[1:] * cells[:-1]).any()


def _in_turn(
    sample: Mapping[str, Column], counters: Mapping[str, Column], keys: Sequence[str]
) -> list[str]:
    """Return the column that names who wrote each row, where several write in turn."""
    # Their stamps do not rise from row to row, but from each one's row to the next.
    groups = [sample[name] for name in keys]
    clocks = [x for name, x in counters.items() if COUNTS.search(_words(name))]
    unclear = [x for x in clocks if _rising(x, groups) < 1 - _IN_TURN]
    for name, cells in sample.items():
        _, counts = np.unique(cells, return_counts=True)
        is_key = name not in keys and not _NO_KEY.search(_words(name))
        if not is_key or not 1 < len(counts) <= len(cells) / _SHORTEST:
            continue
        takes_turns = (cells[1:] != cells[:-1]).mean() >= _STEADY and max(counts) < 2 * min(counts)
        if (takes_turns and _WRITER.search(_words(name))) or any(
            _rising(x, [*groups, cells]) == 1 for x in unclear
        ):
            return [name]
    return []


def _rising(counter: Column, groups: Sequence[Column]) -> float:
    """Return the share of rows with more than the row before that has the same cells in groups."""
    columns = [np.zeros(len(counter)), *groups]
    order = np.lexsort(columns)
    same = np.all([cells[order][1:] == cells[order][:-1] for cells in columns], axis=0)
    return float((np.diff(counter[order]) > 0)[same].mean()) if same.any() else 0.0
