"""Recordings as lines of JSON, packed by gzip or not: an object an episode, or an object a row."""

from typing import Final

from oodd_logs.readers import Reader
from oodd_logs.readers.json_files import open_lines

_ENDINGS: Final = (".jsonl", ".jsonl.gz", ".ndjson")
READER: Final = Reader("jsonl", "a file with a JSON object a line", _ENDINGS, open_lines)
