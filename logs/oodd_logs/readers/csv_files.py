"""Recordings as CSV files, whatever separates their cells."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from oodd_logs.readers import Options, Reader
from oodd_logs.readers.tables import OPTIONS, table_recording
from oodd_logs.recording import Recording


def _open(path: Path, options: Options) -> Iterator[Recording]:
    yield table_recording(path, options)


_ENDINGS: Final = (".csv", ".tsv", ".csv.gz", ".tsv.gz")
READER: Final = Reader("csv", "a CSV file", _ENDINGS, _open, options=OPTIONS)
