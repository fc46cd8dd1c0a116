"""Options of ``data``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command


def add(commands: Commands[Parser]) -> None:
    """Add ``data`` and its actions."""
    data = commands.add_parser("data", help="build, verify, fetch and export splits")
    actions = data.add_subparsers(dest="action", metavar="ACTION", required=True)
    build = command(actions, "build", "data:build", "record a split (needs the extra sim)")
    add = build.add_argument
    add("name", help="a published split, or a new name with sizes and a seed base of its own")
    add("--train", type=int, metavar="N", help="training trajectories per environment")
    add("--calibration", type=int, metavar="N", help="calibration trajectories per environment")
    add("--test", type=int, metavar="N", help="test seeds per environment")
    add("--cap", type=int, metavar="T", help="longest episode (default: the simulator's)")
    add("--seed-base", type=int, metavar="K", help="base of the seeds, apart from published ones")
    add("--env", default="all", metavar="NAMES", help="environments (default: all)")
    add("--jobs", type=int, metavar="N", help="worker processes (default: one per core)")
    add("--output", metavar="DIR", help="directory of the split (default: where splits are found)")
    verify = command(actions, "verify", "data:verify", "compare a split with its digests")
    verify.add_argument("name", help="name or path of a split")
    fetch = command(actions, "fetch", "data:fetch", "verify a copy of a split and install it")
    add = fetch.add_argument
    add("place", metavar="FILE|DIR|URL", help="a split's directory, or a tar or zip archive of it")
    add("--digest", metavar="SHA256", help="the split's digest; another one is refused")
    add("--output", metavar="DIR", help="directory of the split (default: where splits are found)")
    export = command(actions, "export", "data:export", "write a split in another project's format")
    add = export.add_argument
    add("name", help="name or path of a split")
    add("--format", required=True, choices=["minari"], help="minari: one dataset a part")
    add("--output", required=True, metavar="DIR", help="root of the datasets")
    add("--env", default="all", metavar="NAMES", help="environments (default: all)")
    info = command(actions, "info", "data:info", "describe a split")
    info.add_argument("name", help="name or path of a split")
