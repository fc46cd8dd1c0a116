"""Recordings as lines of JSON, packed by gzip or not: an object an episode, or an object a row."""

import json
from collections.abc import Iterator, Mapping
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
from oodd_logs.readers.packed import open_bytes, stem
from oodd_logs.recording import Recording, Topic

LINE: Final = EPISODE.most // 4
"""Bytes of a line, at most."""

CLOCKS: Final = frozenset(
    {"t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "step", "header"}
)
"""Keys of times, in lower case."""


def _open(path: Path, _options: Options) -> Iterator[Recording]:
    name, ledger = stem(path), Ledger()
    rows, last = Gathered(str(path)), None
    for i, (line, value) in enumerate(_objects(path, ledger)):
        source = f"{path}, line {line}"
        if not rows.rows and (episode := _episode(value, source)):
            if last:
                yield last
            last = Recording(f"{name}-{i}", source, *episode)
        elif i and not rows.rows:
            raise TrajectoryError(f"{source} has no list of steps, as the lines above it have")
        else:
            rows.add(value)
    if rows.rows:
        last = Recording(name, str(path), {"": rows.topic()}, ledger=rows.ledger)
    if last:
        last.ledger.merge(ledger)
        yield last


def _objects(path: Path, ledger: Ledger) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the objects of a file with the numbers of their lines; note lines that are cut."""
    with open_bytes(path) as file:
        for number, line in enumerate(iter(lambda: file.readline(LINE + 1), b""), start=1):
            if len(line) > LINE:
                raise EPISODE.failure(f"{path}, line {number} has more than {LINE} bytes")
            plain = line.strip(b"\0 \t\r\n")
            if b"\0" in line:
                ledger.add("file", "changed", "zero bytes are left out")
            if not plain:
                continue
            try:
                value = json.loads(plain)
            except (ValueError, RecursionError) as error:
                if number > 1 and (b"\0" in line or not line.endswith(b"\n")):
                    cell = plain[:80].decode(errors="replace")
                    ledger.add("row", "dropped", f"line {number} is cut", cell=cell)
                    continue
                raise unreadable(f"{path}, line {number}", error) from error
            if not isinstance(value, dict):
                raise TrajectoryError(
                    f"{path}, line {number} holds {value!r:.80}, expected an object"
                )
            yield number, value


def _episode(
    value: Mapping[str, Any], source: str
) -> tuple[dict[str, Topic], dict[str, Any], Ledger] | None:
    """Return the rows, fields and ledger of an object that is an episode; None for a row."""
    # An episode has a list of objects, one a step, or lists of rows of numbers. What has a stamp
    # of its own, or names of its parts, is a row.
    steps = [k for k, v in value.items() if isinstance(v, list) and v and isinstance(v[0], dict)]
    stamped = any(
        k.lower() in CLOCKS and isinstance(v, int | float | dict) for k, v in value.items()
    )
    if len(steps) == 1 and value[steps[0]][0].keys() & CLOCKS:
        stamped = False
    if stamped or any(flattened(k, value[k]) for k in steps):
        return None
    if len(steps) == 1:
        rows = Gathered(source)
        for step in value[steps[0]]:
            if not isinstance(step, dict):
                raise TrajectoryError(f"{source}: a step is {step!r:.80}, expected an object")
            rows.add(step)
        fields = {k: v for k, v in value.items() if k != steps[0]}
        return {"": rows.topic()}, fields, rows.ledger
    if any(isinstance(v, list) and v and isinstance(v[0], list) for v in value.values()):
        arrays = {k: np.asarray(v) for k, v in value.items() if isinstance(v, list)}
        topic, fields, ledger = episode_of(cast("Mapping[str, MatrixRows]", arrays), source)
        fields |= {k: v for k, v in value.items() if not isinstance(v, list)}
        return {"": topic}, fields, ledger
    return None


READER: Final = Reader(
    "jsonl", "a file with a JSON object a line", (".jsonl", ".jsonl.gz", ".ndjson"), _open
)
