"""Recordings as CSV files, whatever separates their cells."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from oodd_logs.readers import Options, Reader, is_transposed
from oodd_logs.readers.tables import OPTIONS, table, transposed_table
from oodd_logs.recording import Recording


def _open(path: Path, options: Options) -> Iterator[Recording]:
    read = transposed_table if is_transposed(path, options) else table
    yield Recording(path.stem, str(path), {"": read(path, options)})


READER: Final = Reader("csv", "a CSV file", (".csv", ".tsv"), _open, options=OPTIONS)
