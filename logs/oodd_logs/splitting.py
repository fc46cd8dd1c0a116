"""Several episodes in one table, told apart by a key, by flags, or by a counter that starts anew.

A recipe's ``episode`` names the columns; cells and names tell which of these they are. Rows of an
episode need not be neighbours, as several robots may write into one table. Other columns are read
when they are asked for.
"""

import dataclasses
import functools
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import reader_for
from oodd_logs.recipe import Recipe
from oodd_logs.recording import MISSING, Column, Recording, Topic
from oodd_logs.rows import read_column
from oodd_logs.selecting import find_columns, layout_of, named_columns

TERMINAL: Final = frozenset(
    {"terminal", "terminals", "terminated", "termination", "terminations", "is_terminal"}
)
"""Names of flags, in lower case, in the last row of an episode that ended of its own."""

ENDS: Final = TERMINAL | {
    *("timeout", "timeouts", "truncated", "truncation", "truncations", "done", "dones", "is_done"),
    *("last", "is_last", "end", "is_end", "episode_end", "episode_ends"),
}
"""Names of flags in the last row of an episode."""

BEGINS: Final = frozenset(
    {"first", "is_first", "start", "is_start", "reset", "episode_start", "episode_starts"}
)
"""Names of flags in the first row of an episode."""

COUNTS: Final = re.compile(
    r"(?:^|[^a-z])(?:time|timestamp|stamp|t|step|timestep|frame|cycle|tick|sample|row)s?(?:$|[^a-z])",
    re.IGNORECASE,
)
"""Names of columns that count the rows of an episode, or tell their times."""

_STEADY: Final = 0.9  # share of the rows in which a counter rises
_BLOCK: Final = 1 << 16  # rows of a large table that are read at once
_NO_VALUE: Final = (*MISSING, "inf")

_Kind = Literal["key", "begins", "ends", "counter"]
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
    runs = {column.column: _Runs.of(marked, column.column) for (column,) in matches.values()}
    episodes = _episodes(recording.source, runs, ledger)
    parts = {main: [episode.rows for episode in episodes]}
    parts |= _by_stamps(recording, main, episodes, ledger)
    names = tuple(n for n in marked.names if n not in runs or runs[n].kind == "counter")
    topics = {**recording.topics, main: dataclasses.replace(marked, names=names)}
    topics = {name: _held(topic, parts[name]) for name, topic in topics.items()}
    for i, episode in enumerate(episodes):
        ended = [bool(v) for name, v in episode.fields.items() if last_part(name) in TERMINAL]
        terminated = {"terminated": any(ended)} if ended else {}
        yield dataclasses.replace(
            recording,
            name=f"{recording.name}-{episode.name}",
            source=f"{recording.source}, {episode.title}",
            topics={name: _slice(topic, parts[name][i]) for name, topic in topics.items()},
            fields={**recording.fields, **episode.fields, **terminated},
            ledger=Ledger() if i else ledger,
        )


@dataclass(frozen=True, slots=True)
class _Part:
    """Rows of an episode, and the values of its keys and flags."""

    name: str
    title: str
    fields: dict[str, Any]
    rows: _Rows


@dataclass(frozen=True, slots=True)
class _Runs:
    """Runs of equal cells of a column: first rows, values, and what the column is to episodes."""

    starts: _Rows
    values: Column
    rows: int
    kind: _Kind

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
        heads = np.concatenate(starts)
        joined = np.concatenate(values) if values else np.zeros(0)
        return cls(heads, joined, topic.rows, kind_of(name, heads, joined, topic.rows))

    def at(self, rows: _Rows) -> Column:
        """Return the cells of some rows."""
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


def kind_of(name: str, starts: _Rows, values: Column, rows: int) -> _Kind:
    """Return what a column is to episodes: by its cells and, where these leave it open, its name.

    Parameters
    ----------
    name
        Of the column.
    starts, values
        First rows of the runs of equal cells, and their values; infinity where one is missing.
    rows
        Number of cells.
    """
    if values.dtype.kind == "U":
        return "key"
    distinct = np.unique(values[np.isfinite(values)])
    if {*distinct.tolist()} <= {0.0, 1.0}:
        if last_part(name) in BEGINS | ENDS:
            return "begins" if last_part(name) in BEGINS else "ends"
        lengths = np.diff(np.append(starts, rows))
        if lengths[values == 1].max(initial=0) == 1 < lengths.max():
            return "begins" if values[0] == 1 else "ends"
    steps = np.diff(values)
    rises, falls = int((steps > 0).sum()), int((steps < 0).sum())
    # The numbers of robots that write in turn rise as often as a counter of few rows.
    rising = rises + (falls < rises and bool(COUNTS.search(name))) * falls
    counts = COUNTS.search(name) or len(distinct) > falls + 1
    return "counter" if counts and rising >= _STEADY * (rows - 1) else "key"


def last_part(name: str) -> str:
    """Return the last part of a name, in lower case: ``done`` of ``next.done``."""
    return re.split(r"[./:]", name)[-1].strip().lower()


def _episodes(source: str, runs: Mapping[str, _Runs], ledger: Ledger) -> list[_Part]:
    """Return the episodes, in the order of their first rows."""
    total = next(iter(runs.values())).rows
    keys = {name: r for name, r in runs.items() if r.kind == "key"}
    marks = {name: r for name, r in runs.items() if r.kind != "key"}
    groups = _by_key(keys, source, ledger) if keys else [({}, np.arange(total))]
    episodes, single = [], 0
    for fields, rows in groups:
        cuts = np.concatenate([np.zeros(1, np.int64), *(r.firsts(rows) for r in marks.values())])
        for i, part in enumerate(np.split(rows, np.unique(cuts)[1:])):
            if len(part) < 2:
                single += 1
                continue
            flags = {n: int(r.at(part[-1:])[0] == 1) for n, r in marks.items() if r.kind == "ends"}
            values, titles = [*fields.values(), *[i] * bool(marks)], fields | {"episode": i}
            title = ", ".join(f"{k} {v}" for k, v in (titles if marks else fields).items())
            episodes.append(_Part("-".join(map(str, values)), title, {**fields, **flags}, part))
    if not episodes or single > len(episodes):
        names = " and ".join(map(repr, runs))
        raise UsageError(
            f"{source}: by {names} (episode), {single} of {single + len(episodes)} episodes have a "
            "single row, expected a column that stays the same in an episode, flags of its last "
            "row, or a counter that starts anew"
        )
    ledger.add("episode", "dropped", "it has a single row", count=single, source=source)
    return sorted(episodes, key=lambda episode: int(episode.rows[0]))


def _by_key(
    keys: Mapping[str, _Runs], source: str, ledger: Ledger
) -> Iterator[tuple[dict[str, Any], _Rows]]:
    """Yield the values of keys and the rows that have them."""
    total = next(iter(keys.values())).rows
    starts = functools.reduce(np.union1d, [r.starts for r in keys.values()])
    lengths = np.diff(np.append(starts, total))
    group, lacks = np.zeros(len(starts), np.int64), np.zeros(len(starts), bool)
    for r in keys.values():
        values, codes = np.unique(r.at(starts), return_inverse=True)
        lacks |= np.array([*map(_is_missing, values.tolist())], bool)[codes]
        group = group * len(values) + codes
    # A cell that is missing within an episode is of this episode.
    there = np.flatnonzero(~lacks)
    before = np.searchsorted(there, np.arange(len(starts)), side="right") - 1
    inside = lacks & (before >= 0) & (before < len(there) - 1)
    last, following = there[before[inside]], there[before[inside] + 1]
    inside[inside] = group[last] == group[following]
    group[inside] = group[there[before[inside]]]
    lacks &= ~inside
    absent = int(lengths[lacks].sum())
    first = int(starts[lacks][0]) if absent else None
    reason = "no value of the column that tells episodes apart"
    name = " and ".join(keys)
    ledger.add("row", "dropped", reason, name=name, count=absent, source=source, row=first)
    kept = np.flatnonzero(~lacks)
    order = kept[np.argsort(group[kept], kind="stable")]
    for block in np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if len(order) else ():
        cells = {name: r.at(starts[block[:1]]) for name, r in keys.items()}
        whole = {name for name, cell in cells.items() if cell.dtype.kind == "f" and not cell % 1}
        fields = {n: int(cell[0]) if n in whole else cell.item() for n, cell in cells.items()}
        yield fields, _spread(starts[block], lengths[block])


def _is_missing(value: Any) -> bool:
    return str(value).strip().lower() in _NO_VALUE


def _spread(starts: _Rows, lengths: _Rows) -> _Rows:
    """Return the rows of runs, one behind the other."""
    ends = np.cumsum(lengths)
    return np.arange(ends[-1]) + np.repeat(starts - ends + lengths, lengths)


def _by_stamps(
    recording: Recording, main: str, episodes: Sequence[_Part], ledger: Ledger
) -> dict[str, list[_Rows]]:
    """Return the rows of each episode in the other topics: from its first stamp to the next one."""
    others = {name: topic for name, topic in recording.topics.items() if name != main}
    if not others:
        return {}
    spans = [(int(episode.rows[0]), int(episode.rows[-1])) for episode in episodes]
    is_mixed = any(b[0] < a[1] for a, b in itertools.pairwise(spans))
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
    begins = stamps[main][[first for first, _ in spans]]
    cuts = {n: np.append(np.searchsorted(stamps[n], begins), len(stamps[n])) for n in others}
    for name, rows in cuts.items():
        reason, source = "before the first episode", recording.source
        ledger.add("row", "dropped", reason, name=name, count=int(rows[0]), source=source, row=0)
    return {n: [*map(np.arange, rows[:-1], rows[1:])] for n, rows in cuts.items()}


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
        parts: dict[str, list[Column]] = {name: [] for name in names}
        # Large tables on disk are read in blocks.
        while len(left):
            begin = int(left[0])
            here = left[left < begin + _BLOCK]
            cells = topic.read(names, begin, int(here[-1]) + 1)
            for name, column in cells.items():
                parts[name].append(column[here - begin])
            left = left[len(here) :]
        return {name: np.concatenate(blocks or [np.zeros(0)]) for name, blocks in parts.items()}

    return dataclasses.replace(topic, rows=count, read=read)
