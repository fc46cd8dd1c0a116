"""Options of ``compare``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command


def add(commands: Commands[Parser]) -> None:
    """Add the command."""
    compare = command(commands, "compare", "compare:run", "compare results with a reference")
    add = compare.add_argument
    add("results", metavar="DIR", help="results directory, records.jsonl or reference.json")
    add("--against", metavar="REFERENCE", help="likewise: what the results should come up to")
    add("--fail", action="append", default=[], metavar="METRIC:[+-]NUMBER[%]",
        help="fail when the metric changed by more in the direction of the sign: auc:-0.01, "
             "delay:+10%% (default: when any metric is worse at all)")  # fmt: skip
    add("--two-sided", action="store_true", help="fail for improvements beyond the tolerance, too")
    add("--by", choices=("cell", "group", "mean"), default="cell",
        help="compare cells, means over the anomalies of a group in an environment, or means over "
             "all cells (default: cell)")  # fmt: skip
    add("-k", dest="expression", metavar="EXPR",
        help="only cells whose id matches, such as 'hopper and not (iid or drift)'")  # fmt: skip
    add("--junit", metavar="FILE", help="write JUnit XML, a test case per cell and metric")
    add("--markdown", metavar="FILE", help="write Markdown, for a pull request")
    add("--write-reference", metavar="FILE", help="write a compact reference file of the results")
