"""``oodd-eval data inspect``: look at logs, and write a first recipe for them."""

import json
import shlex

import click

from oodd_eval.cli import FILE, PARAMETER, Options, command
from oodd_eval.cli.terminal import make_console, register_formats
from oodd_eval.data.files import write_text
from oodd_eval.data.inspection.draft import draft
from oodd_eval.data.inspection.logs import inspect_logs
from oodd_eval.data.inspection.report import describe_logs
from oodd_eval.errors import OutputError


@command(
    "data inspect logs",
    "data inspect logs --recipe arm.toml",
    "data inspect run.csv --read 'separator=;' --read decimal=,",
    plugins=True,
)
@click.argument("path", type=FILE)
@click.option("--recipe", type=FILE, help="write a first recipe there, for `data import`")
@click.option("--format", metavar="NAME", help="of the files (default: by their endings)")
@click.option(
    "--read", multiple=True, type=PARAMETER, help="an option of the format; V is JSON or text"
)
def inspect(options: Options) -> int:
    """Look at logs of your own: a file, a folder of files, or the directory of a data set.

    Prints episodes, columns with units and ranges, rates, gaps, missing values, and what a recipe
    has to say of them.
    """
    register_formats(options)
    console = make_console(quiet=options.verbosity < 0)
    if options.recipe and options.recipe.exists():
        raise OutputError(f"{str(options.recipe)!r} exists: remove it, or choose another name")
    logs = inspect_logs(
        options.path,
        options.format or "",
        dict(options.read),
        lambda file: console.print(file) if options.verbosity > 0 else None,
    )
    console.print(describe_logs(logs, console.width))
    console.print("")
    scan = ["oodd-eval", "scan", str(options.path)]
    scan += [f"--format={options.format}"] if options.format else []
    scan += [f"--read={key}={json.dumps(value)}" for key, value in options.read]
    console.print(f"Which of them are odd: {shlex.join(scan)}")
    folder = options.path if logs.recordings[0].file != options.path.name else options.path.parent
    if not options.recipe:
        console.print(f"A first recipe for them: {options.invocation} --recipe FILE.toml")
        return 0
    home, root = options.recipe.resolve().parent, folder.resolve()
    below = root.is_relative_to(home)
    prefix = root.relative_to(home).as_posix() if below else ""
    write_text(options.recipe, draft(logs, prefix, options.recipe.stem))
    arguments = [str(options.recipe), *([] if below else ["--root", str(folder)])]
    console.print(
        f"Read and edit it, then: {shlex.join(['oodd-eval', 'data', 'import', *arguments])}"
    )
    return 0
