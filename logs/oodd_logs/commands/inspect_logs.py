"""``oodd-eval data inspect``: look at logs, and write a first recipe for them."""

import json
import shlex
from typing import Final

import click

from oodd_eval.cli import FILE, OUTPUT_FILE, PARAMETER, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import write_text
from oodd_eval.errors import OutputError
from oodd_eval.prose import print_prose
from oodd_logs.commands.reader_plugins import register_formats
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import Inspection, inspect_logs, refuse_logs
from oodd_logs.inspection.meaning import window_of
from oodd_logs.inspection.report import as_json, describe_logs
from oodd_logs.scanning.limits import SHORTEST, WINDOWS
from oodd_logs.scanning.outliers import LEAST

_NO_SENSOR: Final = (
    "No column can be a sensor, so that there is nothing to scan or import: expected columns of "
    "numbers that change, in all files. Correct the files, or say how they are read, as in --read "
    "separator=; or --read decimal=,"
)


@command(
    "data inspect logs",
    "data inspect logs --recipe arm.toml",
    "data inspect run.csv --read 'separator=;' --read decimal=,",
    plugins=True,
)
@click.argument("path", type=FILE)
@click.option("--recipe", type=OUTPUT_FILE, help="write a first recipe there, for `data import`")
@click.option("--json", type=OUTPUT_FILE, help="write everything as JSON")
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
    refuse_logs([options.recipe, options.json], options.path, options.format)
    files = make_console(quiet=options.verbosity < 1)
    logs = inspect_logs(options.path, options.format or "", dict(options.read), files.print)
    console.print(describe_logs(logs, console.width))
    if options.json:
        write_text(options.json, json.dumps(as_json(logs), indent=2) + "\n")
    console.print("")
    sensors = logs.sensors
    if not sensors:
        print_prose(_NO_SENSOR, console)
    elif scan := _scan(options, logs):
        console.print(f"Which of them are odd: {scan}")
    folder = options.path if logs.recordings[0].file != options.path.name else options.path.parent
    if not options.recipe:
        if sensors:
            console.print(f"A first recipe for them: {options.invocation} --recipe FILE.toml")
        return 0
    home, root = options.recipe.resolve().parent, folder.resolve()
    below = root.is_relative_to(home)
    prefix = root.relative_to(home).as_posix() if below else ""
    write_text(options.recipe, draft(logs, prefix, options.recipe.stem))
    arguments = [str(options.recipe), *([] if below else ["--root", str(folder)])]
    command = shlex.join(["oodd-eval", "data", "import", *arguments])
    console.print(f"Read and edit it, then: {command}")
    return 0


def _scan(options: Options, logs: Inspection) -> str:
    """Return the command that scans the logs; empty where they are too short for one."""
    command = ["oodd-eval", "scan", str(options.path)]
    command += [f"--format={options.format}"] if options.format else []
    command += [f"--read={key}={json.dumps(value)}" for key, value in options.read]
    rows = logs.recordings[0].length
    if len(logs.recordings) == 1 and not window_of(logs) and rows < WINDOWS * LEAST:
        window = max(SHORTEST, rows // (WINDOWS // 2))
        if rows < window * LEAST:
            return ""
        command.append(f"--window={window}")
    return shlex.join(command)
