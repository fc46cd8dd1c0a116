"""Data sets of LeRobot, versions 2 and 3: episodes in Parquet files, their facts beside them.

Observations and actions have as many rows: what the last action led to was not recorded, so that it
counts as missing.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE, read_bytes, read_json
from oodd_eval.errors import TrajectoryError
from oodd_eval.names import natural
from oodd_logs.ledger import Ledger
from oodd_logs.readers import Options, Reader, in_order, library, readable
from oodd_logs.readers.cells import column_names
from oodd_logs.readers.parquet import ParquetRows
from oodd_logs.recording import Column, Recording, Topic

_TIME: Final = "timestamp"
_COUNTERS: Final = ("episode_index", "index", "task_index", "frame_index")

_DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

Facts = Mapping[str, Any]
_Part = tuple[str, str, ParquetRows, tuple[int, int], Facts, str]
"""Name and source of an episode, its file and rows there, what its table says, and otherwise."""


def _open(directory: Path, _options: Options) -> Iterator[Recording]:
    info = next((directory / p for p in READER.directory_markers if (directory / p).exists()), None)
    if info is None:
        raise TrajectoryError(f"{directory} has no meta/info.json, expected {READER.part}")
    facts = _object(read_json(info, EPISODE.most, TrajectoryError), info)
    fps = facts.get("fps")
    if not isinstance(fps, int | float) or not 0 < fps < 1e9:
        raise TrajectoryError(f"{info}: fps is {fps!r}, expected rows a second")
    tables = sorted(directory.glob("meta/episodes/**/*.parquet"))
    tasks = _by_number(info.with_name(f"tasks.{'parquet' if tables else 'jsonl'}"), "task_index")
    parts = _version_3(directory, facts, tables) if tables else _version_2(directory, info)
    for name, source, rows, span, entry, note in parts:
        recording = _episode(name, source, rows, span, facts)
        task = tasks.get(recording.fields.get("task_index", -1), {})
        text = task.get("task", task.get("__index_level_0__")) or entry.get("tasks")
        if isinstance(text, list | tuple):
            text = text[0] if len(text) == 1 else None
        if isinstance(text, str):
            recording = dataclasses.replace(recording, fields={**recording.fields, "task": text})
        if note:
            reason = "rows are those that the data has, not those of the table of episodes"
            recording.ledger.add("recording", "changed", reason, cell=note)
        yield recording


def _version_2(directory: Path, info: Path) -> Iterator[_Part]:
    """Yield the parts of a data set with a file an episode."""
    globs = ("data/chunk-*/episode_*.parquet", "episode_*.parquet")
    files = [path for glob in globs for path in directory.glob(glob)]
    entries = _by_number(info.with_name("episodes.jsonl"), "episode_index")
    for path in sorted(files, key=lambda path: in_order(path.stem)):
        rows = ParquetRows(path, ["*"])
        entry = entries.get(natural(path.stem.removeprefix("episode_")), {})
        length = entry.get("length", rows.rows)
        note = "" if length == rows.rows else f"{length}, but {rows.rows}"
        yield path.stem, str(path), rows, (0, rows.rows), entry, note


def _version_3(directory: Path, facts: Facts, tables: Sequence[Path]) -> Iterator[_Part]:
    """Yield the parts of a data set with several episodes a file.

    The table of episodes says where. Where the rows themselves number their episodes, they do.
    """
    pattern = str(facts.get("data_path", _DATA_PATH))
    path: Path | None = None
    for table, entry in ((path, entry) for path in tables for entry in _rows(path)):
        with readable(table):
            chunk, file = int(entry["data/chunk_index"]), int(entry["data/file_index"])
            low, high = int(entry["dataset_from_index"]), int(entry["dataset_to_index"])
            number = int(entry["episode_index"])
            relative = pattern.format(chunk_index=chunk, file_index=file)
        if not (directory / relative).resolve().is_relative_to(directory.resolve()):
            raise TrajectoryError(f"{table}: {relative!r} is outside the data set")
        if path != directory / relative:
            path = directory / relative
            rows = ParquetRows(path, ["*"])
            # Rows are numbered through all files.
            first = int(rows.read(["index"], 0, 1)["index"][0]) if rows.rows else 0
            spans = _spans(rows)
        start, stop = low - first, high - first
        counted = spans.get(number, (start, stop) if not spans else (0, 0))
        if not 0 <= counted[0] < counted[1] <= rows.rows:
            raise TrajectoryError(
                f"{table}: episode {number} is rows {start} to {stop} of {path}, which has "
                f"{rows.rows}, of the episodes {sorted(spans)[:20]}"
            )
        wrong = f"{start} to {stop}, but {counted[0]} to {counted[1]}"
        note = "" if counted == (start, stop) else wrong
        yield f"episode_{number:06d}", f"{path}, episode {number}", rows, counted, entry, note


def _spans(rows: ParquetRows) -> dict[int, tuple[int, int]]:
    """Return the first row of each episode and the row after its last, by its number."""
    if "episode_index" not in rows.names or not rows.rows:
        return {}
    numbers = rows.read(["episode_index"], 0, rows.rows)["episode_index"]
    starts = np.flatnonzero(np.append(True, numbers[1:] != numbers[:-1]))
    stops = np.append(starts[1:], rows.rows)
    if len({*numbers[starts].tolist()}) < len(starts):
        raise TrajectoryError(f"{rows.path}: rows of an episode do not follow one another")
    pairs = zip(starts.tolist(), stops.tolist(), strict=True)
    return {int(numbers[start]): (start, stop) for start, stop in pairs}


def _episode(
    name: str, source: str, rows: ParquetRows, span: tuple[int, int], facts: Facts
) -> Recording:
    """Return an episode; `span` is its rows in the file."""
    columns = _columns(rows.names, facts, source)
    first, count = span[0], span[1] - span[0]
    counters = [n for n in ("episode_index", "task_index") if n in rows.names and count]
    head = rows.read(counters, first, first + 1)
    fields: dict[str, Any] = {counter: int(head[counter][0]) for counter in counters}
    success = next((c for c in ("next.success", "success", "is_success") if c in rows.names), None)
    if success and count:
        fields["success"] = bool(np.nanmax(rows.read([success], first, span[1])[success]) > 0)
    time = next((label for label, inner in columns.items() if inner == _TIME), "time")

    def read(labels: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        inner = [columns[label] for label in labels if label in columns]
        cells = rows.read(inner, first + start, first + stop)
        table = {}
        for label in labels:
            known = label in columns
            cell = cells[columns[label]] if known else np.arange(start, stop) / facts["fps"]
            lacks_last = stop == count and (label.startswith("action:") or label == "reward")
            table[label] = np.append(cell[:-1], np.nan) if lacks_last else cell
        return table

    ledger = Ledger()
    ledger.merge(rows.ledger)
    topic = Topic(tuple(dict.fromkeys([*columns, time])), count, read, time)
    return Recording(name, source, {"": topic}, fields, ledger)


def _columns(names: Sequence[str], facts: Facts, source: str) -> dict[str, str]:
    """Return the columns of the files by the names that the data set has for them."""
    features = facts.get("features")
    if not isinstance(features, dict):
        raise TrajectoryError(f"{source}: features are {features!r:.80}, expected a table")
    labels: dict[str, str] = {}
    for name in names:
        feature, _, item = name.rpartition(".")
        if feature not in features or natural(item) < 0 or name in features:
            feature, item = name, ""
        if feature in _COUNTERS:
            continue
        items = _flat(features.get(feature, {}).get("names"))
        position = int(item) if item else 0
        inner = items[position] if position < len(items) and (item or len(items) == 1) else item
        labels[name] = _label(feature, str(inner))
    return dict(zip(column_names(labels.values()), labels, strict=True))


def _label(feature: str, item: str) -> str:
    """Return the name of a column: ``obs:NAME`` and ``action:NAME`` for the usual features."""
    if feature in {"reward", "next.reward"}:
        return "reward"
    head, _, rest = feature.partition(".")
    is_named = rest in {"", "state"} and item and not item.isdigit()
    label = item if is_named else ".".join(filter(None, (rest or head, item)))
    kind = {"observation": "obs", "action": "action"}.get(head)
    return f"{kind}:{label}" if kind else ".".join(filter(None, (feature, item)))


def _flat(names: Any) -> list[str]:
    """Return names that may be a list, a list of lists, or lists by their kind."""
    if isinstance(names, dict):
        names = [*names.values()]
    if isinstance(names, list):
        return [text for inner in names for text in _flat(inner)]
    return [] if names is None else [str(names)]


def _object(value: Any, path: Path) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TrajectoryError(f"{path} holds {value!r:.80}, expected a JSON object")
    return value


def _by_number(path: Path, key: str) -> dict[int, Facts]:
    """Return the rows of a file by one of their numbers; none without it."""
    rows = _rows(path) if path.exists() else []
    return {row[key]: row for row in rows if isinstance(row.get(key), int)}


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file with one a line, or the rows of a table without statistics."""
    if path.suffix == ".jsonl":
        lines = read_bytes(path, EPISODE.most, TrajectoryError).splitlines()
        return [_object(json.loads(line), path) for line in lines if line.strip()]
    with library("pyarrow.parquet").ParquetFile(path) as file:
        names = [n for n in file.schema_arrow.names if not n.startswith(("stats/", "videos/"))]
        if file.metadata.num_rows > EPISODE.most // 1000:
            raise EPISODE.failure(f"{path} has {file.metadata.num_rows} episodes")
        rows: list[dict[str, Any]] = file.read(columns=names).to_pylist()
    return rows


READER: Final = Reader(
    "lerobot",
    "the directory of a LeRobot data set",
    (),
    _open,
    extra="logs",
    directory_markers=("meta/info.json", "info.json"),
)
