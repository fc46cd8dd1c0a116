"""``oodd-eval forget``: remove cells from a results directory, such as those of a failed detector.

Their records, scores and logs go; fits that other cells may share stay.
"""

import argparse

from oodd_eval.cli import EXPRESSION, Parser, say
from oodd_eval.errors import UsageError
from oodd_eval.names import expression
from oodd_eval.results.directory import ResultsDirectory


def define(parser: Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.options(
        run, "forget oodd-results --failed", "forget oodd-results -k 'riqn and hopper'"
    )
    add("directory", metavar="DIR", help="results directory")
    add("-k", dest="expression", default="", metavar="EXPR", help=EXPRESSION)
    add("--failed", action="store_true", help="only cells that failed")
    # fmt: on


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval forget``; 5 when nothing is selected."""
    if not options.failed and not options.expression:
        raise UsageError("nothing to forget: expected --failed or -k EXPR")
    wanted = expression(options.expression)
    results = ResultsDirectory(options.directory)
    gone = [r for r in results.records() if wanted(str(r.cell)) and not (options.failed and r.ok)]
    if not gone:
        return say(f"no cell of {options.directory} is selected: nothing was removed", 5)
    results.forget(gone)
    if options.verbosity >= 0:
        print(f"{len(gone)} cells removed from {options.directory}")
    return 0
