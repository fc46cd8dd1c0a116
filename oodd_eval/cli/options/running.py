"""Options of ``run``, ``list`` and ``show``."""

from __future__ import annotations

from oodd_eval.cli.options import NAMES, Commands, Parser, command

DEFAULT_OUTPUT = "oodd-results"


def add(commands: Commands[Parser]) -> None:
    """Add the three commands."""
    _add_run(commands)
    _add_list(commands)
    _add_show(commands)


def _add_run(commands: Commands[Parser]) -> None:
    run = command(commands, "run", "run:run", "fit and score every selected cell", plugins=True)
    add = run.add_argument
    add("--detector", metavar="NAMES", help=f"{NAMES} (required)")
    add("--env", metavar="NAMES", help=f"{NAMES} (required)")
    add("--anomaly", default="all", metavar="NAMES", help=f"{NAMES} (default: all)")
    add("--split", default="mini", help="name or path of a split (default: mini)")
    add("--horizon", default="1", metavar="N,...", help="prediction horizons (default: 1)")
    add("--seed", default="0", metavar="N,...", help="seeds of the detectors (default: 0)")
    add("--param", action="append", default=[], metavar="K=V",
        help="a parameter of the selected detectors, V in JSON or plain text")  # fmt: skip
    add("--device", metavar="auto|cpu|cuda",
        help="where networks compute: the parameter device of detectors that have it")  # fmt: skip
    add("-k", dest="expression", metavar="EXPR",
        help="only cells whose id matches, such as 'hopper and not (iid or drift)'")  # fmt: skip
    add("--collect-only", action="store_true", help="print the selected cells and do nothing")
    add("-x", dest="stop", action="store_true", help="stop at the first failure")
    add("--limit", type=int, metavar="N", help="use the first N trajectories of each part")
    add("--jobs", type=int, metavar="N", help="fits at a time (default: one per core)")
    add("--executor", default="local", metavar="local|dask://HOST:PORT",
        help="where fits are carried out: here, or on a Dask cluster (default: local)")  # fmt: skip
    add("--timeout", default="30m", help="wall-clock time of a fit with its scores (default: 30m)")
    add("--memory", default="8GB", help="resident memory of a fit (default: 8GB)")
    add("--fresh", action="store_true", help="fit again what the results directory has already")
    add("--intervals", action="store_true", help="print 95 %% intervals in the tables")
    add("--config", metavar="FILE", help="TOML file with these options by their long names")
    add("--output", default=DEFAULT_OUTPUT, metavar="DIR",
        help=f"results directory (default: {DEFAULT_OUTPUT})")  # fmt: skip


def _add_list(commands: Commands[Parser]) -> None:
    what = command(commands, "list", "listing:run", "list what there is, one line each",
                    plugins=True)  # fmt: skip
    what.add_argument("what", metavar="detectors|envs|anomalies|splits|metrics")


def _add_show(commands: Commands[Parser]) -> None:
    show = command(
        commands, "show", "show:run", "print the tables of earlier results from stored scores"
    )
    add = show.add_argument
    add("directory", metavar="DIR", help="results directory")
    add("--split", metavar="NAME", help="where the split is, if not at its usual place")
    add("--stored", action="store_true", help="print stored metrics without recomputing them")
    add("--intervals", action="store_true", help="print 95 %% intervals")
    add("--detector", metavar="NAME", help="print the table by anomaly of one detector")
    add("--metric", default="auc_matched",
        help="metric of that table (default: auc_matched; see oodd-eval list metrics)")  # fmt: skip
    add("--wide", action="store_true",
        help="print all metrics, pooled AUC, average precision and FPR95 among them")  # fmt: skip
    add("--markdown", action="store_true", help="print Markdown, everything in it")
