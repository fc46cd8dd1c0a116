"""Several episodes in one table, told apart by a key, by flags, or by a counter that starts anew.

A recipe's ``episode`` names the columns; cells and names tell which of these they are. Rows of an
episode need not be neighbours, as several robots may write into one table. Other columns are read
when they are asked for.
"""

import dataclasses
import functools
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_logs.ledger import Ledger
from oodd_logs.marks import plain_label
from oodd_logs.readers import reader_for
from oodd_logs.recipe import Recipe
from oodd_logs.recording import MISSING, Column, Recording, Topic, read_column
from oodd_logs.selecting import find_columns, layout_of, named_columns

TERMINAL: Final = re.compile(r"(?:is_)?termina(?:ls?|ted|tions?)")
"""Names of flags, in lower case, in the last row of an episode that ended of its own."""

ENDS: Final = re.compile(
    rf"{TERMINAL.pattern}|timeouts?|truncat(?:ed|ions?)|(?:is_)?(?:dones?|last|end)|episode_ends?"
)
"""Names of flags in the last row of an episode."""

BEGINS: Final = re.compile(r"(?:is_)?(?:first|start)|reset|episode_starts?")
"""Names of flags in the first row of an episode."""

COUNTS: Final = re.compile(
    r"(?:^|[^a-z])(?:time|timestamp|stamp|t|step|timestep|frame|cycle|tick|sample|row)s?(?:$|[^a-z])",
    re.IGNORECASE,
)
"""Names of columns that count the rows of an episode, or tell their times."""

_STEADY: Final = 0.9  # share of the rows in which a counter rises
_BLOCK: Final = 1 << 16  # rows of a large table that are read at once
_NO_VALUE: Final = MISSING | {"inf"}

_Rows = NDArray[np.int64]


def recordings_in(path: Path, recipe: Recipe, *, lenient: bool = False) -> Iterator[Recording]:
    """Yield the recordings of a file as a recipe reads it, cut into their episodes.

    Parameters
    ----------
    path
        A file, or the directory of a data set.
    recipe
        Its `format`, `options` and `episode`.
    lenient
        As of `split_recording`.

    Yields
    ------
    Recording

    Raises
    ------
    UsageError, TrajectoryError
        As `oodd_logs.readers.Reader.read` and `split_recording`.
    """
    for recording in reader_for(path, recipe.format).read(path, recipe.options):
        yield from split_recording(recording, recipe.episode, lenient=lenient)


def split_recording(
    recording: Recording, columns: Sequence[str], *, lenient: bool = False
) -> Iterator[Recording]:
    """Yield the episodes of a recording, in the order of their first rows.

    Keys and flags become fields, as they hold for an episode.

    Parameters
    ----------
    recording
        What was recorded. Topics without the columns are cut by their stamps.
    columns
        Names of keys, flags or a counter; none for a recording that is one episode.
    lenient
        Whether a recording without the columns is taken for one episode, as its ledger says then.

    Yields
    ------
    Recording
        Its name ends in the values of the keys, else in a number.

    Raises
    ------
    UnknownNameError
        When a column is not there.
    UsageError
        When the columns tell no episodes apart, or another topic cannot be cut.
    """
    rows = max((topic.rows for topic in recording.topics.values()), default=0)
    if not rows or {*columns} <= {*recording.fields}:  # the format may have told them apart
        yield recording
        return
    layout = layout_of(recording)
    matches = {name: find_columns(layout, name)[:1] for name in columns}
    if lacking := [name for name in columns if not matches[name]]:
        if not lenient:
            kind = f"column of {recording.source} that tells episodes apart"
            raise UnknownNameError(kind, lacking[0], named_columns(layout))
        reason = f"it has no column {lacking[0]!r}, and counts as one episode"
        recording.ledger.add("recording", "kept", reason, source=recording.source)
        yield recording
        return
    main, *others = dict.fromkeys(column.topic for (column,) in matches.values())
    if others:
        raise UsageError(
            f"{recording.source}: episode names columns of the topics {main!r} and {others[0]!r}, "
            "expected those of one topic"
        )
    marked, ledger = recording.topics[main], Ledger()
    ledger.merge(recording.ledger)
    keys = dict.fromkeys(column.column for (column,) in matches.values())
    runs = [_Runs.of(marked, name) for name in keys]
    episodes = _episodes(recording.source, runs, ledger)
    parts = {main: [rows for _, _, rows in episodes]}
    parts |= _by_stamps(recording, main, parts[main], ledger)
    apart = {run.name for run in runs if run.kind != "counter"}
    names = tuple(name for name in marked.names if name not in apart)
    topics = {**recording.topics, main: dataclasses.replace(marked, names=names)}
    topics = {name: _held(topic, parts[name]) for name, topic in topics.items()}
    for i, (title, fields, _) in enumerate(episodes):
        ended = [bool(value) for name, value in fields.items() if names_flag(TERMINAL, name)]
        terminated = {"terminated": any(ended)} if ended else {}
        yield dataclasses.replace(
            recording,
            name="-".join([recording.name, *(value for _, value in title)]),
            source=", ".join([recording.source, *map(" ".join, title)]),
            topics={name: _slice(topic, parts[name][i]) for name, topic in topics.items()},
            fields={**recording.fields, **fields, **terminated},
            ledger=Ledger() if i else ledger,
        )


@dataclass(frozen=True)
class _Runs:
    """Runs of equal cells of a column: its name, their first rows and values, and all rows."""

    name: str
    starts: _Rows
    values: Column
    rows: int

    @classmethod
    def of(cls, topic: Topic, name: str) -> Self:
        starts, values, last = [np.zeros(0, np.int64)], [], None
        for start, block in read_column(topic, name):
            cells = block if block.dtype.kind == "U" else np.where(np.isnan(block), np.inf, block)
            first = last is None or cells[0] != last
            rows = np.flatnonzero(np.append(first, cells[1:] != cells[:-1]))
            starts.append(start + rows)
            values.append(cells[rows])
            last = cells[-1]
        return cls(name, np.concatenate(starts), np.concatenate(values), topic.rows)

    def at(self, rows: _Rows) -> Column:
        """Return the cells of some rows, infinity where a number is missing."""
        return self.values[np.searchsorted(self.starts, rows, side="right") - 1]

    def firsts(self, rows: _Rows) -> _Rows:
        """Return where, among rows, an episode begins by the flag or counter, besides the first."""
        cells = self.at(rows)
        if self.kind == "begins":
            return np.flatnonzero(cells == 1)
        if self.kind == "ends":
            return np.flatnonzero(cells[:-1] == 1) + 1
        present = np.flatnonzero(np.isfinite(cells))
        return present[1:][np.diff(cells[present]) < 0]

    @functools.cached_property
    def kind(self) -> Literal["key", "begins", "ends", "counter"]:
        """What the column is to episodes: by its cells and, where these leave it open, its name."""
        if self.values.dtype.kind == "U":
            return "key"
        distinct = np.unique(self.values[np.isfinite(self.values)])
        if {*distinct.tolist()} <= {0.0, 1.0}:
            if names_flag(ENDS, self.name):
                return "ends"
            if names_flag(BEGINS, self.name):
                return "begins"
            lengths = np.diff(np.append(self.starts, self.rows))
            if lengths[self.values == 1].max(initial=0) == 1 < lengths.max():
                return "begins" if self.values[0] == 1 else "ends"
        steps = np.diff(self.values)
        rises, falls = int((steps > 0).sum()), int((steps < 0).sum())
        # The numbers of robots that write in turn rise as often as a counter of few rows.
        rising = rises + (falls < rises and bool(COUNTS.search(self.name))) * falls
        counts = COUNTS.search(self.name) or len(distinct) > falls + 1
        return "counter" if counts and rising >= _STEADY * (self.rows - 1) else "key"


def names_flag(pattern: re.Pattern[str], name: str) -> bool:
    """Tell whether the last part of a name, such as ``done`` of ``next.done``, is one of flags."""
    return bool(pattern.fullmatch(re.split(r"[./:]", name)[-1].strip().lower()))


def _episodes(
    source: str, runs: Sequence[_Runs], ledger: Ledger
) -> list[tuple[list[tuple[str, str]], dict[str, Any], _Rows]]:
    """Return title, values of keys and flags, and rows of episodes, in the order of first rows."""
    keys = [r for r in runs if r.kind == "key"]
    marks = [r for r in runs if r.kind != "key"]
    episodes, single = [], 0
    for rows in _by_key(keys, source, ledger) if keys else [np.arange(runs[0].rows)]:
        fields = {r.name: plain_label(r.at(rows[:1]).item()) for r in keys}
        title = [(name, str(value)) for name, value in fields.items()]
        cuts = np.concatenate([np.zeros(1, np.int64), *(r.firsts(rows) for r in marks)])
        for i, part in enumerate(np.split(rows, np.unique(cuts)[1:])):
            flags = {r.name: int(r.at(part[-1:])[0] == 1) for r in marks if r.kind == "ends"}
            number = [("episode", str(i))] if marks else []
            if len(part) > 1:
                episodes.append((title + number, fields | flags, part))
            else:
                single += 1
    if not episodes or single > len(episodes):
        names = " and ".join(repr(r.name) for r in runs)
        raise UsageError(
            f"{source}: by {names} (episode), {single} of {single + len(episodes)} episodes have a "
            "single row, expected a column that stays the same in an episode, flags of its last "
            "row, or a counter that starts anew"
        )
    ledger.add("episode", "dropped", "it has a single row", count=single, source=source)
    return sorted(episodes, key=lambda episode: int(episode[2][0]))


def _by_key(keys: Sequence[_Runs], source: str, ledger: Ledger) -> Iterator[_Rows]:
    """Yield the rows that have the same values of keys."""
    starts = functools.reduce(np.union1d, [r.starts for r in keys])
    lengths = np.diff(np.append(starts, keys[0].rows))
    group, lacks = np.zeros(len(starts), np.int64), np.zeros(len(starts), bool)
    for r in keys:
        values, codes = np.unique(r.at(starts), return_inverse=True)
        lacks |= np.array([str(v).strip().lower() in _NO_VALUE for v in values.tolist()])[codes]
        group = group * len(values) + codes
    # A cell that is missing within an episode is of this episode.
    runs = np.arange(len(starts))
    before = np.maximum.accumulate(np.where(lacks, 0, runs))
    following = np.minimum.accumulate(np.where(lacks, runs[-1], runs)[::-1])[::-1]
    lacks &= lacks[before] | (group[before] != group[following])
    group = np.repeat(np.where(lacks, -1, group[before]), lengths)
    order = np.argsort(group, kind="stable")
    absent = int((group < 0).sum())
    reason = "no value of the column that tells episodes apart"
    name = " and ".join(r.name for r in keys)
    ledger.add("row", "dropped", reason, name=name, count=absent, source=source, row=int(order[0]))
    order = order[absent:]
    yield from filter(len, np.split(order, np.flatnonzero(np.diff(group[order])) + 1))


def _by_stamps(
    recording: Recording, main: str, episodes: Sequence[_Rows], ledger: Ledger
) -> dict[str, list[_Rows]]:
    """Return the rows of each episode in the other topics: from its first stamp to the next one."""
    others = [name for name in recording.topics if name != main]
    if not others:
        return {}
    is_mixed = any(b[0] < a[-1] for a, b in itertools.pairwise(episodes))
    if is_mixed or not all(topic.time for topic in recording.topics.values()):
        problem = "episodes overlap" if is_mixed else "not all topics have stamps"
        raise UsageError(
            f"{recording.source}: other topics are cut by the stamps of {main!r}, but {problem}: "
            "read topics one by one ([read] topics)"
        )
    stamps = {
        name: np.concatenate([cells for _, cells in read_column(topic, topic.time)])
        for name, topic in recording.topics.items()
    }
    begins = stamps[main][[rows[0] for rows in episodes]]
    parts = {}
    for name in others:
        cuts = np.append(np.searchsorted(stamps[name], begins), len(stamps[name]))
        reason, source = "before the first episode", recording.source
        ledger.add("row", "dropped", reason, name=name, count=int(cuts[0]), source=source, row=0)
        parts[name] = [*map(np.arange, cuts[:-1], cuts[1:])]
    return parts


def _held(topic: Topic, episodes: Sequence[_Rows]) -> Topic:
    """Return a topic, in memory once it is read, where episodes are interleaved and it is small."""
    spread = any(len(rows) and rows[-1] - rows[0] >= len(rows) for rows in episodes)
    if not spread or 8 * topic.rows * len(topic.names) > EPISODE.most:
        return topic
    held: dict[str, Column] = {}

    def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        if lacking := [name for name in names if name not in held]:
            held.update(topic.read(lacking, 0, topic.rows))
        return {name: held[name][start:stop] for name in names}

    return dataclasses.replace(topic, read=read)


def _slice(topic: Topic, rows: _Rows) -> Topic:
    """Return some rows of a topic as one."""
    count = len(rows)
    first = int(rows[0]) if count else 0
    if not count or int(rows[-1]) - first + 1 == count:  # the array of rows is not kept

        def read_range(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
            return topic.read(names, first + start, first + min(stop, count))

        return dataclasses.replace(topic, rows=count, read=read_range)

    def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        left = rows[start:stop]
        if not len(left):
            return dict.fromkeys(names, np.zeros(0))
        # Large tables on disk are read in blocks.
        blocks = np.split(left, np.flatnonzero(np.diff(left // _BLOCK)) + 1)
        cells = [
            {n: x[b - b[0]] for n, x in topic.read(names, int(b[0]), int(b[-1]) + 1).items()}
            for b in blocks
        ]
        return {name: np.concatenate([c[name] for c in cells]) for name in names}

    return dataclasses.replace(topic, rows=count, read=read)
