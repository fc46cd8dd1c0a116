"""``oodd-eval data``: import, describe, verify, fetch and export splits."""

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import click

from oodd_eval.cli import COUNT, DIRECTORY, Converted, Name, Names, Options, command, say
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import register_formats
from oodd_eval.data import croissant
from oodd_eval.data.facts import Quantity
from oodd_eval.data.fetch import fetch as fetch_split
from oodd_eval.data.importing import import_data, import_recipe
from oodd_eval.data.info import describe
from oodd_eval.data.logs import quantity
from oodd_eval.data.logs.minari import export as export_split
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.recipe import Recipe
from oodd_eval.data.shipped_recipes import shipped_recipes
from oodd_eval.data.split import SHIPPED, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import assignment, counted, select
from oodd_eval.prose import print_prose
from oodd_eval.scoring.promises import promises_of


def _quantities(text: str) -> tuple[Quantity, ...]:
    return tuple(map(quantity, text.split(",")))


_QUANTITIES: Final = Converted(_quantities, "NAME[UNIT],...")
_GROUP: Final = Converted(assignment, "ANOMALY=sensor|dynamics")

_output_option: Final = click.option(
    "--output", type=DIRECTORY, help="directory of the split (default: where splits are found)"
)
_split_argument: Final = click.argument(
    "name", type=Name("splits"), metavar="SPLIT", help="name or path of a split"
)


_SHORT: Final = [
    "env",
    "format",
    "train",
    "calibration",
    "test",
    "sensors",
    "actions",
    "discrete",
    "group",
]
"""Options that stand for a recipe."""

_DETECTORS: Final = "mewma,mahalanobis,range,clock"  # fitted in seconds, without an extra


@command(
    "data import arm.toml --root logs",
    "data import plant --env pump --format csv --train logs/a --calibration logs/b",
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
@_output_option
def import_logs(options: Options) -> int:
    """Import logs of your own as an environment of a split."""
    register_formats(options)
    notes, console = make_console(quiet=options.verbosity < 0), make_console()
    say: dict[str, Any] = {
        "output": options.output,
        "replace": options.replace,
        "progress": lambda part: notes.print(f"writing {part}"),
        "report": lambda line: print_prose(line, console),
    }
    chosen = {name: value for name in _SHORT if (value := getattr(options, name))}
    shipped = None if chosen else shipped_recipes().get(options.name)
    if options.name.endswith(".toml") or shipped:
        if chosen:
            raise UsageError(
                f"--{next(iter(chosen))} is said by the recipe {options.name}: write it there"
            )
        if shipped and not options.root:
            raise UsageError(f"--root is missing: the folder with the files of {options.name}")
        path = shipped or Path(options.name)
        recipe = Recipe.load(path)
        environment = recipe.environment
        split = import_recipe(recipe, options.root or path.parent, **say)
    else:
        required = ("env", "format", "train", "calibration")
        if lacking := [name for name in required if name not in chosen]:
            raise UsageError(
                f"{options.name!r} is no recipe (FILE.toml, or {', '.join(shipped_recipes())}), "
                f"and --{lacking[0]} is missing: expected "
                f"{', '.join(f'--{name}' for name in required)} without one"
            )
        if options.root:
            raise UsageError("--root is the folder of a recipe's files, expected FILE.toml with it")
        environment, form = chosen.pop("env"), chosen.pop("format")
        groups = dict(chosen.pop("group", ()))
        split = import_data(options.name, environment, form=form, groups=groups, **chosen, **say)
    console.print(f"split {split.name}, digest {split.digest[:12]}, in {split.path}")
    with split.opened() as opened:
        data = opened(environment)
        for sentence in _promises(data):
            print_prose(sentence, notes)
        tested = len(data.twins) + len(data.anomalies)
    if tested:
        name = split.path if options.output else split.name
        arguments = ["--env", environment, "--split", str(name)]
        notes.print(
            f"Evaluate detectors: oodd-eval run --detector {_DETECTORS} {shlex.join(arguments)}"
        )
    return 0


@command("data verify mini")
@_split_argument
def verify(options: Options) -> int:
    """Compare a split with its digests.

    The exit code is 1 when a group's content is not what the manifest names.
    """
    console = make_console()
    split = load_split(options.name)
    checks = list(split.verify())
    for check in checks:
        if options.verbosity > 0 or not check.ok:
            expected = "" if check.ok else f"expected {check.expected}, found "
            console.print(f"{check.file}, {check.group}: {expected}{check.actual}")
    groups = counted(len(checks), "group(s)")
    good = f"{sum(check.ok for check in checks)} of {groups} as they should be"
    console.print(f"split {split.name}, digest {split.digest}: {good}")
    return int(not all(check.ok for check in checks))


@command("data fetch standard.tar.gz")
@click.argument(
    "source", type=click.Path(), help="directory, tar or zip archive of a split, or the URL of one"
)
@click.option("--digest", metavar="SHA256", help="the split's digest; another one is refused")
@_output_option
def fetch(options: Options) -> int:
    """Verify a copy of a split and install it; what an earlier call has brought is kept."""
    notes = make_console(quiet=options.verbosity < 0)
    fetched = fetch_split(
        options.source,
        output=options.output,
        digest=options.digest,
        progress=lambda file: notes.print(f"{file}  verified"),
    )
    split, there = fetched.split, " already" if fetched.already else ""
    make_console().print(f"split {split.name}, digest {split.digest}, is{there} in {split.path}")
    return 0


@command(
    "data export mini --format minari --output datasets",
    "data export mini --format croissant --output metadata",
)
@_split_argument
@click.option(
    "--format",
    required=True,
    type=click.Choice(["minari", "croissant"]),
    help="minari: one dataset a part; croissant: metadata for searches of data sets",
)
@click.option("--output", type=DIRECTORY, help="root of the datasets; folder of the metadata")
@click.option("--env", default="all", type=Names("envs"), help="environments, for minari")
@click.option("--url", default="", help="where the split can be had, for croissant")
def export(options: Options) -> int:
    """Write a split, or what it is, in another project's format.

    Metadata are written beside the manifest unless --output names a folder.
    """
    split = load_split(options.name)
    if options.format == "croissant":
        if options.env != "all":
            raise UsageError("--env is for --format minari: metadata are of a whole split")
        if options.output is None and split.path.parent == SHIPPED:
            raise UsageError(
                f"split {split.name} is in the installed package, which has its metadata already: "
                "name a folder for others with --output"
            )
        metadata = croissant.write(split, options.output, url=options.url)
        if lacking := metadata.lacking:
            advice = ["name the address with --url"] if "url" in lacking else []
            if {*lacking} - {"url"}:
                advice.append("write the others into the file" if advice else "write into the file")
            say(
                f"not known, and required by searches for data sets: {', '.join(lacking)}; before "
                f"publishing {' and '.join(advice)}"
            )
        make_console().print(f"metadata of split {split.name} are in {metadata.path}")
        return 0
    if options.output is None or options.url:
        raise UsageError("--format minari needs --output, and has no --url")
    environments = select("environment", options.env, split.environments)
    notes = make_console(quiet=options.verbosity < 0)
    written = export_split(split, options.output, environments=environments, progress=notes.print)
    hint = f"Minari finds them with MINARI_DATASETS_PATH={options.output}"
    make_console().print(f"{counted(len(written), 'dataset(s)')} in {options.output}: {hint}")
    return 0


@command("data info mini")
@_split_argument
def info(options: Options) -> int:
    """Describe a split, and what speaks for and against promises that rest on it."""
    make_console().print(describe(load_split(options.name), _promises))
    return 0


def _promises(data: EnvironmentData) -> Iterator[str]:
    return (str(finding) for finding in promises_of(data))
