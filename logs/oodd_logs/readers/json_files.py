"""Recordings as JSON files: columns, steps or rows, below a key or not, in an object or a list.

Lines of JSON are objects, an episode or a row each.
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.kinds import flattened
from oodd_logs.ledger import Ledger
from oodd_logs.readers import Options, Reader, unreadable
from oodd_logs.readers.gathered import Gathered
from oodd_logs.readers.matrices import MatrixRows, episode_of
from oodd_logs.readers.packed import open_bytes, read_text, stem
from oodd_logs.recording import Recording, Topic

_DEEPEST: Final = 3  # levels below which no table is looked for
_LINE: Final = EPISODE.most // 4  # bytes, at most
_CLOCKS: Final = frozenset(
    {"t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "step", "header"}
)
"""Keys of times, in lower case."""


def _open(path: Path, options: Options) -> Iterator[Recording]:
    if _has_lines(path):
        yield from open_lines(path, options)
        return
    value = json.loads(read_text(path, "utf-8-sig"))
    episodes = [*_episodes(value, str(path))]
    if not episodes:
        keys = ", ".join(map(str, [*value][:8])) if isinstance(value, dict) else ""
        held = f"an object with {keys}" if keys else f"{value!r:.60}"
        raise TrajectoryError(
            f"{path} holds {held}: expected lists of equal length, one a column, a list of steps "
            "or rows that are objects, or these below one key"
        )
    for i, r in enumerate(episodes):
        name, source = f"{stem(path)}-{r.name or i}", r.source
        if len(episodes) == 1:
            name, source = stem(path), str(path)
        yield dataclasses.replace(r, name=name, source=source)


def _has_lines(path: Path) -> bool:
    """Tell whether an object stands in the first line, and something behind it."""
    with open_bytes(path) as file:
        first, second = file.readline(_LINE + 1), file.read(64).strip()
    try:
        return bool(second) and isinstance(json.loads(first), dict)
    except (ValueError, RecursionError):
        return False


def open_lines(path: Path, _options: Options) -> Iterator[Recording]:
    """Yield the recordings in lines of JSON: one where lines are rows, else one of each line."""
    name, ledger = stem(path), Ledger()
    rows, last = Gathered(str(path)), None
    for i, (source, value) in enumerate(_objects(path, ledger)):
        if not rows.rows and (episode := _line(value, source)):
            if last:
                yield last
            last = dataclasses.replace(episode, name=f"{name}-{i}")
        elif i and not rows.rows:
            raise TrajectoryError(f"{source} has no list of steps, as the lines above it have")
        else:
            rows.add(value)
    if rows.rows:
        last = Recording(name, str(path), {"": rows.topic()}, ledger=rows.ledger)
    if last:
        last.ledger.merge(ledger)
        yield last


def _objects(path: Path, ledger: Ledger) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the objects of a file with what messages call them; note lines that are cut."""
    with open_bytes(path) as file:
        for number, line in enumerate(iter(lambda: file.readline(_LINE + 1), b""), start=1):
            source, plain = f"{path}, line {number}", line.strip(b"\0 \t\r\n")
            if len(line) > _LINE:
                raise EPISODE.failure(f"{source} has more than {_LINE} bytes")
            if b"\0" in line:
                ledger.add("file", "changed", "zero bytes are left out")
            try:
                if plain:
                    yield source, _object(json.loads(plain), source)
            except (ValueError, RecursionError) as error:
                if number == 1 or (b"\0" not in line and line.endswith(b"\n")):
                    raise unreadable(source, error) from error
                cell = plain[:80].decode(errors="replace")
                ledger.add("row", "dropped", f"line {number} is cut", cell=cell)


def _object(value: Any, source: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TrajectoryError(f"{source} holds {value!r:.80}, expected an object")
    return value


def _line(value: Mapping[str, Any], source: str) -> Recording | None:
    """Return the episode that an object is; None for a row."""
    # An episode has a list of objects, one a step, or lists of rows of numbers. What has a stamp
    # of its own, or names of its parts, is a row.
    lists = {k: v for k, v in value.items() if isinstance(v, list)}
    steps = [k for k, v in lists.items() if v and isinstance(v[0], dict)]
    has_stamps = len(steps) == 1 and lists[steps[0]][0].keys() & _CLOCKS
    for key, v in value.items() if not has_stamps else ():
        if key.lower() in _CLOCKS and isinstance(v, int | float | dict):
            return None
    if any(flattened(key, lists[key]) for key in steps):
        return None
    content: list[Any] | dict[str, Any]
    if len(steps) == 1:
        used, content = steps, [_object(v, f"{source}: a list of steps") for v in lists[steps[0]]]
    elif any(v and isinstance(v[0], list) for v in lists.values()):
        used, content = [*lists], {key: np.asarray(v) for key, v in lists.items()}
    else:
        return None
    return _recording(content, source, {k: v for k, v in value.items() if k not in used}, Ledger())


def _episodes(value: Any, source: str, depth: int = 0) -> Iterator[Recording]:
    """Yield the episodes that a value holds, each with its name if it has one."""
    value = _listed(value)
    table = _table(value, source)
    kinds = dict if table else dict | list
    inner: dict[str, list[Recording]] = {}
    if depth < _DEEPEST and isinstance(value, kinds):
        for key, v in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(_listed(v), kinds):
                inner[str(key)] = [*_episodes(v, f"{source}, {key}", depth + 1)]
    inner = {key: episodes for key, episodes in inner.items() if episodes}
    below = [topic.rows for rs in inner.values() for r in rs for topic in r.topics.values()]
    if table and max(below, default=0) <= table.topics[""].rows:
        yield table
        return
    ledger = Ledger()
    fields = _fields(value, source, inner, ledger) if isinstance(value, dict) else {}
    tables = {key: episodes[0] for key, episodes in inner.items() if len(episodes) == 1}
    names = {frozenset(n for t in r.topics.values() for n in t.names) for r in tables.values()}
    if len(names) == len(tables) == len(inner) > 1:
        # Tables of different columns are topics of one recording.
        topics: dict[str, Topic] = {}
        for key, r in tables.items():
            topics |= {".".join(filter(None, [key, n])): topic for n, topic in r.topics.items()}
            fields |= {f"{key}.{name}": v for name, v in r.fields.items()}
            ledger.merge(r.ledger)
        if len({topic.rows for topic in topics.values()}) == 1:
            cells = {k: t.read(t.names, 0, t.rows).items() for k, t in topics.items()}
            topics = {"": Topic.of({f"{k}.{n}": x for k, block in cells.items() for n, x in block})}
        yield Recording("", source, topics, fields, ledger)
        return
    for key, episodes in inner.items():
        for r in episodes:
            r.ledger.merge(ledger)
            name = "-".join(filter(None, [key if len(inner) > 1 else "", r.name]))
            yield dataclasses.replace(r, name=name, fields={**fields, **r.fields})


def _listed(value: Any) -> Any:
    """Return an object whose keys count from 0 on as a list, and others as they are."""
    if isinstance(value, dict) and len(value) > 1 and [*value] == [*map(str, range(len(value)))]:
        return [*value.values()]
    return value


def _table(value: Any, source: str) -> Recording | None:
    """Return the rows that a value is, with what holds for all of them; None for what is none."""
    if isinstance(value, list):
        rows = value
        if all(isinstance(row, list) for row in rows):
            rows = [{str(i): cell for i, cell in enumerate(row)} for row in rows]
        return _recording(rows, source, {}, Ledger()) if _are_rows(rows) else None
    if not isinstance(value, dict):
        return None
    lists = {key: v for key, inner in value.items() if isinstance(v := _listed(inner), list)}
    content: Iterable[Any] | dict[str, Any]
    names, data = lists.get("columns"), lists.get("data")
    lengths = Counter(len(v) for v in lists.values() if len(v) > 1)
    steps = [key for key, v in lists.items() if _are_rows(v)]
    if names and data and all(isinstance(r, list) and len(r) == len(names) for r in data):
        used: Collection[str] = ("columns", "data", "index")
        content = [dict(zip(map(str, names), row, strict=True)) for row in data]
    elif len(steps) == 1:
        used, content = steps, lists[steps[0]]
    elif steps or not lengths:
        return None
    else:
        count = max(lengths, key=lambda n: (lengths[n], n))
        # What the last step led to may be missing.
        used = columns = {key: v for key, v in lists.items() if len(v) in {count, count - 1}}
        if all(isinstance(cell, str | dict) for v in columns.values() for cell in v):
            return None
        has_vectors = any(isinstance(row, list) for v in columns.values() for row in v[:1])
        content = {key: np.asarray(v) for key, v in columns.items()} if has_vectors else {}
        if not content or any(array.dtype.kind not in "fiub" for array in content.values()):
            content = ({k: v[i] for k, v in columns.items() if i < len(v)} for i in range(count))
    ledger = Ledger()
    return _recording(content, source, _fields(value, source, used, ledger), ledger)


def _are_rows(values: list[Any]) -> bool:
    """Tell whether items are rows: objects, but none that are episodes."""
    if len(values) < 2 or not all(isinstance(row, dict) for row in values):
        return False
    lists = {key: v for key, v in values[0].items() if isinstance(v, list) and len(v) > 1}
    longest = max(map(len, lists.values()), default=0)
    has_steps = any(isinstance(v[0], dict) for v in lists.values())
    return not (has_steps or longest > len(values) or {key.lower() for key in lists} & _CLOCKS)


def _fields(
    value: Mapping[str, Any], source: str, used: Collection[str], ledger: Ledger, prefix: str = ""
) -> dict[str, Any]:
    """Return single values beside rows; note what is left out."""
    fields: dict[str, Any] = {}
    for key, inner in ((key, inner) for key, inner in value.items() if key not in used):
        name = f"{prefix}{key}"
        if isinstance(inner, dict):
            fields |= _fields(inner, source, (), ledger, f"{name}.")
        elif isinstance(inner, list):
            reason = "a list of another length than the rows"
            ledger.add("column", "dropped", reason, name=name, source=source)
        else:
            fields[name] = inner
    return fields


def _recording(
    content: Iterable[Any] | dict[str, Any], source: str, fields: dict[str, Any], ledger: Ledger
) -> Recording:
    """Return rows, or arrays under their conventional names, with what holds for all of them."""
    if isinstance(content, dict):
        topic, single, left_out = episode_of(cast("Mapping[str, MatrixRows]", content), source)
        fields = {**single, **fields}
    else:
        gathered = Gathered(source)
        for row in content:
            gathered.add(row)
        topic, left_out = gathered.topic(), gathered.ledger
    ledger.merge(left_out, source)
    return Recording("", source, {"": topic}, fields, ledger)


READER: Final = Reader("json", "a JSON file", (".json", ".json.gz"), _open)
