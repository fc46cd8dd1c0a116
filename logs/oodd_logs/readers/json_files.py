"""Recordings as JSON files: columns, steps or rows, below a key or not, in an object or a list."""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import Options, Reader, jsonl
from oodd_logs.readers.gathered import Gathered
from oodd_logs.readers.matrices import MatrixRows, episode_of
from oodd_logs.readers.packed import open_bytes, read_text, stem
from oodd_logs.recording import Recording, Topic

_DEEPEST: Final = 3  # levels below which no table is looked for


def _open(path: Path, options: Options) -> Iterator[Recording]:
    if _has_lines(path):
        yield from jsonl.READER.open(path, options)
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
    for i, (label, recording) in enumerate(episodes):
        name = stem(path) if len(episodes) == 1 else f"{stem(path)}-{label or i}"
        source = str(path) if len(episodes) == 1 else recording.source
        yield Recording(name, source, recording.topics, recording.fields, recording.ledger)


def _has_lines(path: Path) -> bool:
    """Tell whether an object stands in the first line, and something behind it."""
    with open_bytes(path) as file:
        first, second = file.readline(jsonl.LINE + 1), file.read(64).strip()
    try:
        return bool(second) and isinstance(json.loads(first), dict)
    except (ValueError, RecursionError):
        return False


def _episodes(value: Any, source: str, depth: int = 0) -> Iterator[tuple[str, Recording]]:
    """Yield the episodes that a value holds, each with its name if it has one."""
    value = _listed(value)
    table = _table(value, source)
    inner: dict[str, list[tuple[str, Recording]]] = {}
    if depth < _DEEPEST and isinstance(value, dict if table else dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        inner = {
            str(key): [*_episodes(v, f"{source}, {key}", depth + 1)]
            for key, v in pairs
            if isinstance(_listed(v), dict if table else dict | list)
        }
        inner = {key: episodes for key, episodes in inner.items() if episodes}
    rows = max((_rows(r) for episodes in inner.values() for _, r in episodes), default=0)
    if table and rows <= _rows(table):
        yield "", table
        return
    fields, ledger = _fields(value, source, inner) if isinstance(value, dict) else ({}, Ledger())
    tables = {key: episodes[0][1] for key, episodes in inner.items() if len(episodes) == 1}
    if len({*map(_columns, tables.values())}) == len(tables) == len(inner) > 1:
        # Tables of different columns are topics of one recording.
        topics = {key: table.topics[""] for key, table in tables.items()}
        if len({topic.rows for topic in topics.values()}) == 1:
            cells = {k: t.read(t.names, 0, t.rows).items() for k, t in topics.items()}
            topics = {"": Topic.of({f"{k}.{n}": x for k, block in cells.items() for n, x in block})}
        yield "", Recording("", source, topics, fields, ledger)
        return
    for key, episodes in inner.items():
        for label, r in episodes:
            r.ledger.merge(ledger)
            name = "-".join(filter(None, [key if len(inner) > 1 else "", label]))
            yield name, Recording("", r.source, r.topics, {**fields, **r.fields}, r.ledger)


def _rows(recording: Recording) -> int:
    return max(topic.rows for topic in recording.topics.values())


def _columns(recording: Recording) -> tuple[str, ...]:
    return tuple(sorted(name for topic in recording.topics.values() for name in topic.names))


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
    names, data = lists.get("columns"), lists.get("data")
    if names and data and all(isinstance(r, list) and len(r) == len(names) for r in data):
        rows = [dict(zip(map(str, names), row, strict=True)) for row in data]
        return _recording(rows, source, *_fields(value, source, ["columns", "data", "index"]))
    lengths = Counter(len(v) for v in lists.values() if len(v) > 1)
    steps = [key for key, v in lists.items() if _are_rows(v)]
    if len(steps) == 1:
        return _recording(lists[steps[0]], source, *_fields(value, source, steps))
    if steps or not lengths:
        return None
    count = max(lengths, key=lambda n: (lengths[n], n))
    # What the last step led to may be missing.
    columns = {key: v for key, v in lists.items() if len(v) in {count, count - 1}}
    if all(isinstance(cell, str | dict) for v in columns.values() for cell in v):
        return None
    fields, ledger = _fields(value, source, columns)
    if recording := _arrays(columns, source, fields):
        return recording
    rows = [{key: v[i] for key, v in columns.items() if i < len(v)} for i in range(count)]
    return _recording(rows, source, fields, ledger)


def _are_rows(values: list[Any]) -> bool:
    """Tell whether items are rows: objects, but none that are episodes."""
    if len(values) < 2 or not all(isinstance(row, dict) for row in values):
        return False
    lists = {key: v for key, v in values[0].items() if isinstance(v, list) and len(v) > 1}
    longest = max(map(len, lists.values()), default=0)
    has_steps = any(isinstance(v[0], dict) for v in lists.values())
    return not (has_steps or longest > len(values) or {key.lower() for key in lists} & jsonl.CLOCKS)


def _fields(
    value: Mapping[str, Any], source: str, used: Collection[str], prefix: str = ""
) -> tuple[dict[str, Any], Ledger]:
    """Return single values beside rows, and what is left out."""
    fields: dict[str, Any] = {}
    ledger = Ledger()
    for key, inner in ((key, inner) for key, inner in value.items() if key not in used):
        if isinstance(inner, dict):
            below, left_out = _fields(inner, source, (), f"{prefix}{key}.")
            fields |= below
            ledger.merge(left_out)
        elif isinstance(inner, list):
            reason = "a list of another length than the rows"
            ledger.add("column", "dropped", reason, name=f"{prefix}{key}", source=source)
        else:
            fields[f"{prefix}{key}"] = inner
    return fields, ledger


def _arrays(lists: Mapping[str, Any], source: str, fields: Mapping[str, Any]) -> Recording | None:
    """Return rows of lists of numbers under their conventional names; None for other lists."""
    if not any(isinstance(row, list) for v in lists.values() for row in v[:1]):
        return None
    arrays = {key: np.asarray(v) for key, v in lists.items()}
    if any(array.dtype.kind not in "fiub" for array in arrays.values()):
        return None
    topic, single, ledger = episode_of(cast("Mapping[str, MatrixRows]", arrays), source)
    return Recording("", source, {"": topic}, {**single, **fields}, ledger)


def _recording(
    rows: Iterable[Any], source: str, fields: Mapping[str, Any], ledger: Ledger
) -> Recording:
    gathered = Gathered(source)
    for row in rows:
        gathered.add(row)
    topic = gathered.topic()
    ledger.merge(gathered.ledger, source)
    return Recording("", source, {"": topic}, fields, ledger)


READER: Final = Reader("json", "a JSON file", (".json", ".json.gz"), _open)
