"""Options of ``check``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command


def add(commands: Commands[Parser]) -> None:
    """Add ``check``."""
    check = command(
        commands, "check", "check:run", "check that a detector honours the contract", plugins=True
    )
    add = check.add_argument
    add("detector", metavar="DETECTOR", help="name of a detector")
    add("--param", action="append", default=[], metavar="K=V",
        help="a parameter of the detector, V in JSON or plain text")  # fmt: skip
    add("--horizon", default="1", metavar="N,...", help="prediction horizons (default: 1)")
    add("--seed", type=int, default=0, metavar="N", help="seed of the detector (default: 0)")
    add("-k", dest="expression", metavar="EXPR",
        help="only checks whose name matches, such as 'files or network'")  # fmt: skip
    add("--expect", action="append", default=[], metavar="NAME=REASON",
        help="a check that is known to fail, and why; if it passes, that is a failure")  # fmt: skip
    add("--timeout", default="10m", help="wall-clock time of a check (default: 10m)")
    add("--memory", default="8GB", help="resident memory of a check (default: 8GB)")
