"""Options of ``new``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command


def add(commands: Commands[Parser]) -> None:
    """Add ``new``."""
    new = command(commands, "new", "new:run", "write a ready plug-in project", plugins=True)
    add = new.add_argument
    add("name", metavar="NAME", help="name of the detector: lower-case letters, digits, hyphens")
    add("--output", metavar="DIR", help="where to write it (default: oodd-NAME)")
