"""Options of ``leaderboard``."""

from __future__ import annotations

from typing import Final

from oodd_eval.cli.options import NAMES, Commands, Parser, command

RESULTS: Final = "leaderboard/results"
"""Where the entries of the leaderboard lie, from the root of a checkout."""


def add(commands: Commands[Parser]) -> None:
    """Add ``leaderboard`` and its actions."""
    board = commands.add_parser("leaderboard", help="submit, verify and show entries of the board")
    actions = board.add_subparsers(dest="action", metavar="ACTION", required=True)
    _add_build(actions)
    _add_verify(actions)
    _add_submit(actions)


def _add_build(actions: Commands[Parser]) -> None:
    build = command(
        actions, "build", "leaderboard_build:run", "render tables and site from the entries"
    )
    add = build.add_argument
    add("results", nargs="?", default=RESULTS, metavar="RESULTS_DIR",
        help=f"directory of the entries (default: {RESULTS})")  # fmt: skip
    add("--output", default="leaderboard", metavar="DIR",
        help="where to write (default: leaderboard)")  # fmt: skip
    add("--check", action="store_true", help="write nothing, exit 1 where something would change")


def _add_verify(actions: Commands[Parser]) -> None:
    verify = command(
        actions, "verify", "leaderboard:verify", "check entries as data, running none of their code"
    )
    add = verify.add_argument
    add("paths", nargs="+", metavar="PATH", help="an entry, or a directory of entries")
    add("--split", metavar="PATH", help="where the split is, if not at its usual place")
    add("--rerun", metavar="DIR",
        help="results of a run of your own, to compare the entry with (for one entry)")  # fmt: skip
    add("--grant", default="", metavar="NAME",
        help="write the trust level that was reached into the entry, in this name")  # fmt: skip


def _add_submit(actions: Commands[Parser]) -> None:
    submit = command(
        actions, "submit", "leaderboard:submit", "write an entry from a results directory"
    )
    add = submit.add_argument
    add("directory", metavar="DIR",
        help="results directory, written by oodd-eval run or reproduce")  # fmt: skip
    add("--results", default=RESULTS, metavar="RESULTS_DIR",
        help=f"directory of the entries (default: {RESULTS})")  # fmt: skip
    add("--detector", default="all", metavar="NAMES", help=f"{NAMES} (default: all)")
    add("-k", dest="expression", default="", metavar="EXPR",
        help="only cells whose id contains this; and, or, not")  # fmt: skip
    add("--complete", action="store_true",
        help="leave out those seeds of a row that lack cells which others have")  # fmt: skip
    add("--id", metavar="ID", help="name of the entry's directory (default: detectors and split)")
    add("--title", default="", metavar="TEXT", help="one line, shown on the board")
    add("--submitter", default="", metavar="TEXT", help="who stands behind the results")
    add("--citation", default="", metavar="TEXT", help="how to cite the method")
    add("--url", default="", metavar="URL", help="page of the method or its code")
    add("--caption", default="", metavar="TEXT",
        help="a note above the tables, such as a reduced setting")  # fmt: skip
    add("--scores", action="store_true",
        help="include every score, so that others can recompute the metrics")  # fmt: skip
    add("--split", metavar="PATH", help="where the split is, if not at its usual place")
    add("--trust", default="reported", choices=("reported", "re-scored"),
        help="trust level to claim; re-scored needs --scores (default: reported)")  # fmt: skip
    add("--curves", default="rows", choices=("rows", "detectors", "none"),
        help="curves and examples for the site: of every row, of each detector's plainest row, "
        "or none (default: rows)")  # fmt: skip
