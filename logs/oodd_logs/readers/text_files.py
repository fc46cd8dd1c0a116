"""Matrices of numbers as text with blanks between them; blocks with a line for their class, too."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from oodd_eval.data.bounded import LINE_CHARACTERS
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import Options, Reader, is_transposed
from oodd_logs.readers.cells import column_names, numbers
from oodd_logs.readers.packed import open_text, read_text, stem
from oodd_logs.readers.tables import BLANKS, OPTIONS, layout_of, table_recording
from oodd_logs.recording import Recording, Topic


def _open(path: Path, options: Options) -> Iterator[Recording]:
    if not is_transposed(path, options) and _has_classes(path, options):
        yield from _blocks(path, options)
    else:
        yield table_recording(path, options, BLANKS)


def _has_classes(path: Path, options: Options) -> bool:
    """Tell whether a single word stands above the first row of several numbers."""
    layout = layout_of(path, {k: v for k, v in options.items() if k != "names"}, BLANKS)
    with open_text(path, layout.encoding) as text:
        lines = [text.readline(LINE_CHARACTERS + 1) for _ in range(layout.lines + 1)]
    width = len(lines[-1].split())
    return layout.lines > 0 and len(layout.names) == 1 < width and _row(lines[-1]) is not None


def _blocks(path: Path, options: Options) -> Iterator[Recording]:
    """Yield blocks of rows, each below a line with its class, which is a field."""
    label, count = "", 0
    lines = read_text(path, layout_of(path, {}, BLANKS).encoding).splitlines()
    parsed = ((line, _row(line)) for line in lines if line.strip())
    for is_label, group in itertools.groupby(parsed, lambda pair: pair[1] is None):
        if is_label:
            label = " ".join([*group][-1][0].split())
            continue
        source, rows = f"{path}, block {count}", [row for _, row in group if row]
        if len({*map(len, rows)}) > 1:
            raise TrajectoryError(f"{source} has rows of {sorted({*map(len, rows)})} numbers")
        names = column_names(options.get("names") or map(str, range(len(rows[0]))))
        if len(names) != len(rows[0]):
            raise TrajectoryError(f"{source} has {len(rows[0])} columns, expected {len(names)}")
        topic = Topic.of(dict(zip(names, np.array(rows).T, strict=True)))
        yield Recording(f"{stem(path)}-{count}", source, {"": topic}, {"class": label})
        count += 1


def _row(line: str) -> list[float] | None:
    column = numbers(line.split())
    return column.tolist() if column is not None and len(column) else None


_ENDINGS: Final = (".dat", ".data", ".txt", ".dat.gz", ".data.gz", ".txt.gz")
READER: Final = Reader("text", "a text file of numbers", _ENDINGS, _open, options=OPTIONS)
