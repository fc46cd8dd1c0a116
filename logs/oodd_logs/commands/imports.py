"""``oodd-eval data import``: make a split of logs."""

import json
import shlex
from pathlib import Path
from typing import Any, Final

import click

from oodd_eval.cli import COUNT, DIRECTORY, OUTPUT_FILE, Converted, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.cli.data import output_option
from oodd_eval.data.files import refuse_inputs, write_text
from oodd_eval.errors import UsageError
from oodd_eval.names import assignment
from oodd_eval.prose import print_prose
from oodd_eval.scoring.promises import promises_of
from oodd_logs.commands.reader_plugins import register_formats
from oodd_logs.episodes import files_of
from oodd_logs.importing import import_data, import_recipe
from oodd_logs.ledger import Ledger
from oodd_logs.readers import quantity
from oodd_logs.recipe import Recipe
from oodd_logs.shipped_recipes import shipped_recipes

_QUANTITIES: Final = Converted(lambda text: tuple(map(quantity, text.split(","))), "NAME[UNIT],...")
_GROUP: Final = Converted(assignment, "ANOMALY=sensor|dynamics")

_REQUIRED: Final = ("env", "format", "train", "calibration")
_SHORT: Final = (*_REQUIRED, "test", "sensors", "actions", "discrete", "group")
"""Options that stand for a recipe."""

_DETECTORS: Final = "mewma,mahalanobis,range,clock"  # fitted in seconds, without an extra


@command(
    "data import arm.toml --root logs",
    "data import plant --env pump --format csv --train logs/a --calibration logs/b",
    further={"Columns": "--discrete --group", "Other": "--json -p"},
    plugins=True,
)
@click.argument(
    "name",
    metavar="FILE.toml|NAME",
    help="a recipe, or the name of a shipped one; "
    "or the name of a split of your own, with the options below for paired parts",
)
@click.option(
    "--root", type=DIRECTORY, help="folder of the recipe's files (default: where the recipe lies)"
)
@click.option("--env", metavar="NAME", help="name of the environment")
@click.option("--format", metavar="NAME", help="of the files")
@click.option("--train", type=DIRECTORY, help="nominal episodes to fit on")
@click.option("--calibration", type=DIRECTORY, help="nominal episodes for alarm thresholds")
@click.option(
    "--test", type=DIRECTORY, help="DIR/nominal has twins, DIR/ANOMALY the anomalous episodes"
)
@click.option("--sensors", type=_QUANTITIES, help="sensors, if the files do not name them")
@click.option("--actions", type=_QUANTITIES, help="actions, if the files do not name them")
@click.option("--discrete", type=COUNT, help="actions are whole numbers from 0 to N - 1")
@click.option("--group", multiple=True, type=_GROUP, help="group of an anomaly (default: dynamics)")
@click.option("--replace", is_flag=True, help="import anew what the split has by that name")
@click.option("--json", type=OUTPUT_FILE, help="write what was left out, held or changed as JSON")
@output_option
def import_logs(options: Options) -> int:
    """Import logs of your own as an environment of a split."""
    register_formats(options)
    notes, console = make_console(quiet=options.verbosity < 0), make_console()
    ledger = Ledger()
    say: dict[str, Any] = {
        "ledger": ledger,
        "output": options.output,
        "replace": options.replace,
        "progress": lambda part: notes.print(f"writing {part}"),
        "report": lambda line: print_prose(line, console),
    }
    keys = {name: value for name in _SHORT if (value := getattr(options, name))}
    shipped = None if keys else shipped_recipes().get(options.name)
    if options.name.endswith(".toml") or shipped:
        if keys:
            option = f"--{next(iter(keys))}"
            raise UsageError(f"{option} is said by the recipe {options.name}: write it there")
        if shipped and not options.root:
            raise UsageError(f"--root is missing: the folder with the files of {options.name}")
        path = shipped or Path(options.name)
        recipe = Recipe.load(path)
        environment, root = recipe.environment, options.root or path.parent
        if options.output:
            refuse_inputs(options.output, [root], "--output")
        if options.json:
            refuse_inputs(options.json, [path, *files_of(recipe, root)], "--json")
        split = import_recipe(recipe, root, **say)
    else:
        if lacking := [name for name in _REQUIRED if name not in keys]:
            required = ", ".join(f"--{name}" for name in _REQUIRED)
            raise UsageError(
                f"{options.name!r} is no recipe (FILE.toml, or {', '.join(shipped_recipes())}), "
                f"and --{lacking[0]} is missing: expected {required} without one"
            )
        if options.root:
            raise UsageError("--root is the folder of a recipe's files, expected FILE.toml with it")
        environment, form = keys.pop("env"), keys.pop("format")
        groups = dict(keys.pop("group", ()))
        split = import_data(options.name, environment, form=form, groups=groups, **keys, **say)
    if options.json:
        write_text(options.json, json.dumps({"ledger": ledger.as_json()}, indent=1) + "\n")
    console.print(f"split {split.name}, digest {split.digest[:12]}, in {split.path}")
    with split.opened() as opened:
        data = opened(environment)
        for finding in promises_of(data):
            print_prose(str(finding), notes)
        tested = len(data.twins) + len(data.anomalies)
    if tested:
        name = split.path if options.output else split.name
        arguments = shlex.join(["--env", environment, "--split", str(name)])
        notes.print(f"Evaluate detectors: oodd-eval run --detector {_DETECTORS} {arguments}")
    return 0
