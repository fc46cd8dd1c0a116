"""``oodd-eval forget``: remove cells from a results directory."""

import click

from oodd_eval.cli import OUTPUT_DIRECTORY, Options, command, expression_option, say
from oodd_eval.errors import UsageError
from oodd_eval.names import counted, expression
from oodd_eval.results.directory import ResultsDirectory


@command("forget oodd-results --failed", "forget oodd-results -k 'riqn and hopper'")
@click.argument("directory", type=OUTPUT_DIRECTORY, help="results directory")
@expression_option
@click.option("--failed", is_flag=True, help="only cells that failed")
def forget(options: Options) -> int:
    """Remove cells from a results directory, such as those of a failed detector.

    Their records, scores and logs go; fits that other cells may share stay. The exit code is 5 when
    nothing is selected.
    """
    if not options.failed and not options.expression:
        raise UsageError("nothing to forget: expected --failed or -k EXPR")
    selects = expression(options.expression)
    results = ResultsDirectory(options.directory)
    gone = [r for r in results.records() if selects(str(r.cell)) and not (options.failed and r.ok)]
    if not gone:
        return say(f"no cell of {options.directory} is selected: nothing was removed", 5)
    results.forget(gone)
    if options.verbosity >= 0:
        print(f"{counted(len(gone), 'cell(s)')} removed from {options.directory}")
    return 0
