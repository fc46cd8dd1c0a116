"""Episodes as CSV files with the columns ``obs:NAME[UNIT]``, ``action:NAME[UNIT]``, ``reward``."""

import array
import csv
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from oodd_eval.data.bounded import EPISODE, LINE_CHARACTERS
from oodd_eval.data.logs import (
    Array,
    Log,
    Logs,
    Reader,
    episode_files,
    quantity,
    read_onsets,
    unreadable,
)
from oodd_eval.errors import TrajectoryError

_KINDS: Final = ("obs", "action", "reward")

_Row = tuple[list[str], int]  # cells, number of the line


def _open(folder: Path) -> Logs:
    files = episode_files(folder, ".csv")
    columns, _ = next(_rows(files[0]))
    sensors, actions = (
        tuple(quantity(c.partition(":")[2]) for c in columns if c.startswith(f"{kind}:"))
        for kind in ("obs", "action")
    )
    if not sensors:
        expected = "obs:NAME[UNIT] for sensors, action:NAME[UNIT] for actions, and maybe reward"
        raise TrajectoryError(f"{files[0]} has the columns {columns}, expected {expected}")

    def read() -> Iterator[Log]:
        onsets = read_onsets(folder)
        for path in files:
            numbers = _table(path, columns)
            commands = numbers["action"] if actions else None
            rewards = numbers["reward"].ravel() if "reward" in columns else None
            onset = onsets.get(path.stem)
            yield Log(path.stem, str(path), numbers["obs"], commands, rewards, onset)

    return Logs(read, sensors, actions)


def _rows(path: Path) -> Iterator[_Row]:
    """Yield header and rows of a file, without empty rows at its end.

    They come one at a time: in memory, the text of a cell takes 20 times its bytes in the file.
    """
    if not path.is_file() or path.stat().st_size > EPISODE.most:
        raise EPISODE.failure(f"{path} is no plain file of at most {EPISODE.most} bytes")
    empty: list[_Row] = []
    line = 0
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            lines = iter(lambda: text.readline(LINE_CHARACTERS + 1), "")
            for line, row in enumerate(csv.reader(map(_bounded, lines)), start=1):
                if line > 1 and not any(row):
                    empty = empty or [(row, line)]
                    continue
                yield from empty
                yield row, line
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise unreadable(path, error) from error
    if not line:
        yield [], 1


def _bounded(line: str) -> str:
    if len(line) > LINE_CHARACTERS:
        raise csv.Error(f"a line has more than {LINE_CHARACTERS} characters")
    return line


def _table(path: Path, columns: Sequence[str]) -> dict[str, Array]:
    """Return the numbers of each kind of columns; only observations follow the last transition."""
    rows = _rows(path)
    header, _ = next(rows)
    if header != columns:
        raise TrajectoryError(
            f"{path} has the columns {header}, expected those of the other files: {columns}"
        )
    chosen = {
        kind: [i for i, c in enumerate(columns) if c.partition(":")[0] == kind] for kind in _KINDS
    }
    numbers = {kind: array.array("d") for kind in _KINDS}
    end: _Row = [], 0
    for (row, line), following in itertools.pairwise(itertools.chain(rows, [end])):
        for kind in _KINDS if following is not end else ("obs",):
            for i in chosen[kind]:
                try:
                    numbers[kind].append(float(row[i]))
                except (ValueError, IndexError):
                    cell = repr(row[i]) if i < len(row) else "nothing"
                    raise TrajectoryError(
                        f"{path}, line {line}, column {columns[i]!r}: {cell}, expected a number"
                    ) from None
        size = 8 * sum(map(len, numbers.values()))
        EPISODE.check(str(path), np.dtype(float), size)
    return {kind: np.array(numbers[kind]).reshape(-1, len(chosen[kind]) or 1) for kind in _KINDS}


READER: Final = Reader("csv", "a folder with a file *.csv for each episode", _open)
