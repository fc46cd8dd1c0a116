"""Recordings as lines of JSON, packed by gzip or not: an object an episode, or an object a row."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import Options, Reader, unreadable
from oodd_logs.readers.gathered import Gathered
from oodd_logs.readers.matrices import MatrixRows, episode_of
from oodd_logs.readers.packed import open_bytes, stem
from oodd_logs.recording import Recording, Topic

LINE: Final = EPISODE.most // 4
"""Bytes of a line, at most."""


def _open(path: Path, _options: Options) -> Iterator[Recording]:
    name = stem(path)
    rows = Gathered(str(path))
    for i, (line, value) in enumerate(_objects(path)):
        source = f"{path}, line {line}"
        if not rows.rows and (episode := _episode(value, source)):
            yield Recording(f"{name}-{i}", source, *episode)
        elif i and not rows.rows:
            raise TrajectoryError(f"{source} has no list of steps, as the lines above it have")
        else:
            rows.add(value)
    if rows.rows:
        yield Recording(name, str(path), {"": rows.topic()}, ledger=rows.ledger)


def _objects(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the objects of a file with the numbers of their lines."""
    with open_bytes(path) as file:
        for number, line in enumerate(iter(lambda: file.readline(LINE + 1), b""), start=1):
            if len(line) > LINE:
                raise EPISODE.failure(f"{path}, line {number} has more than {LINE} bytes")
            if not line.strip():
                continue
            try:
                value = json.loads(line)
            except (ValueError, RecursionError) as error:
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
    # An episode has a list of objects, one a step, or lists of rows of numbers.
    steps = [k for k, v in value.items() if isinstance(v, list) and v and isinstance(v[0], dict)]
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
