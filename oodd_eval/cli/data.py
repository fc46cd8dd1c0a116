"""``oodd-eval data``: import, describe, verify, fetch and export splits."""

from typing import Final

import click

from oodd_eval.cli import COUNT, DIRECTORY, Converted, Name, Names, Options, command
from oodd_eval.cli.terminal import make_console
from oodd_eval.data.facts import Quantity
from oodd_eval.data.fetch import fetch as fetch_split
from oodd_eval.data.importing import import_data
from oodd_eval.data.info import describe
from oodd_eval.data.logs import FORMATS, quantity
from oodd_eval.data.logs.minari import export as export_split
from oodd_eval.data.split import load_split
from oodd_eval.names import assignment, select


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


@command("data import plant --env pump --format csv --train logs/a --calibration logs/b")
@click.argument(
    "name", help="of a split of your own; one that was imported gets a further environment"
)
@click.option("--env", required=True, metavar="NAME", help="name of the environment")
@click.option("--format", required=True, type=click.Choice([*FORMATS]), help="of the files")
@click.option("--train", required=True, type=DIRECTORY, help="nominal episodes to fit on")
@click.option(
    "--calibration", required=True, type=DIRECTORY, help="nominal episodes for alarm thresholds"
)
@click.option(
    "--test", type=DIRECTORY, help="DIR/nominal has twins, DIR/ANOMALY the anomalous episodes"
)
@click.option("--sensors", type=_QUANTITIES, help="sensors, if the files do not name them")
@click.option("--actions", type=_QUANTITIES, help="actions, if the files do not name them")
@click.option("--discrete", type=COUNT, help="actions are whole numbers from 0 to N - 1")
@click.option("--group", multiple=True, type=_GROUP, help="group of an anomaly (default: dynamics)")
@_output_option
def import_logs(options: Options) -> int:
    """Import logs of your own as an environment of a split."""
    notes = make_console(quiet=options.verbosity < 0)
    split = import_data(
        options.name,
        options.env,
        form=options.format,
        train=options.train,
        calibration=options.calibration,
        test=options.test,
        sensors=options.sensors or (),
        actions=options.actions or (),
        discrete=options.discrete or 0,
        groups=dict(options.group),
        output=options.output,
        progress=lambda part: notes.print(f"{options.env} {part}"),
    )
    make_console().print(f"split {split.name}, digest {split.digest}, in {split.path}")
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
    good = f"{sum(check.ok for check in checks)} of {len(checks)} groups as they should be"
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


@command("data export mini --format minari --output datasets")
@_split_argument
@click.option(
    "--format", required=True, type=click.Choice(["minari"]), help="minari: one dataset a part"
)
@click.option("--output", required=True, type=DIRECTORY, help="root of the datasets")
@click.option("--env", default="all", type=Names("envs"), help="environments")
def export(options: Options) -> int:
    """Write a split in another project's format."""
    split = load_split(options.name)
    environments = select("environment", options.env, split.environments)
    notes = make_console(quiet=options.verbosity < 0)
    written = export_split(split, options.output, environments=environments, progress=notes.print)
    hint = f"Minari finds them with MINARI_DATASETS_PATH={options.output}"
    make_console().print(f"{len(written)} datasets in {options.output}: {hint}")
    return 0


@command("data info mini")
@_split_argument
def info(options: Options) -> int:
    """Describe a split."""
    make_console().print(describe(load_split(options.name)))
    return 0
