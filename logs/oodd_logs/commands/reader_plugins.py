"""Formats of logs that plug-ins offer."""

from oodd_eval.cli import Options
from oodd_eval.cli.plugins import discovered
from oodd_logs.readers import Reader, check_reader, register_readers


def register_formats(options: Options) -> None:
    """Make formats of logs of plug-ins known in this process."""
    readers = discovered(options).offered_by("oodd_readers", Reader, check_reader)
    register_readers(reader for reader, _ in readers.values())
