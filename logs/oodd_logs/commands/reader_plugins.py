"""Formats of logs and kinds of columns that plug-ins offer."""

from oodd_eval.cli import Options
from oodd_eval.cli.plugins import discovered
from oodd_logs.kinds import Kind, check_kind, register_kinds, shipped_kinds
from oodd_logs.readers import Reader, check_reader, register_readers, shipped_readers


def register_formats(options: Options) -> None:
    """Make formats of logs and kinds of columns of plug-ins known in this process."""
    plugins = discovered(options)
    register_readers(plugins.offered_by("oodd_readers", Reader, check_reader, shipped_readers()))
    register_kinds(plugins.offered_by("oodd_kinds", Kind, check_kind, shipped_kinds()))
