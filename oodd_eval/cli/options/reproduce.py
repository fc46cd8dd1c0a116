"""Options of ``reproduce``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command

DEFAULT_OUTPUT = "reproduction"


def add(commands: Commands[Parser]) -> None:
    """Add ``reproduce``."""
    summary = "regenerate the paper's tables, figures and claims; resumes where it was"
    reproduce = command(commands, "reproduce", "reproduce:run", summary, plugins=True)
    add = reproduce.add_argument
    add("--tier", default="full", metavar="full|reduced|mini",
        help="how much: split standard; its first trajectories and fewer seeds; split mini "
        "(default: full)")  # fmt: skip
    add("--split", metavar="NAME", help="name or path of a split (default: the tier's)")
    add("--output", default=DEFAULT_OUTPUT, metavar="DIR",
        help=f"directory of the reproduction (default: {DEFAULT_OUTPUT})")  # fmt: skip
    add("--only", default="all", metavar="NAMES",
        help="run what these need, such as table-5,figure-horizon (default: all)")  # fmt: skip
    add("--plan", action="store_true", help="show what remains and how long it takes; do nothing")
    add("--budget", metavar="TIME", help="start nothing after this time, such as 2h; exit code 2")
    add("--jobs", type=int, metavar="N", help="fits at a time (default: one per core)")
    add("--device", metavar="auto|cpu|cuda", help="where networks compute (default: cpu)")
    add("--timeout", default="3h", help="wall-clock time of a fit with its scores (default: 3h)")
    add("--memory", default="8GB", help="resident memory of a fit (default: 8GB)")
    add("--fresh", action="store_true", help="run again what the directory has already")
    add("--build", action="store_true", help="build the split if it is not on this machine")
    add("--render-only", action="store_true",
        help="run nothing; make tables and figures again from the directory's records")  # fmt: skip
    add("--records", nargs="+", metavar="DIR",
        help="with --render-only: read all results below these directories instead")  # fmt: skip
    add("--no-figures", dest="figures", action="store_false", help="write tables only")
