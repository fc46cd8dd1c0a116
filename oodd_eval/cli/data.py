"""``oodd-eval data``: describe, verify and fetch splits."""

from collections.abc import Iterator
from typing import Final

import click

from oodd_eval.cli import OUTPUT_DIRECTORY, Name, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.data.description import describe
from oodd_eval.data.fetch import fetch as fetch_split
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import load_split
from oodd_eval.names import counted
from oodd_eval.scoring.promises import promises_of

output_option: Final = click.option(
    "--output",
    type=OUTPUT_DIRECTORY,
    help="directory of the split (default: where splits are found)",
)
split_argument: Final = click.argument(
    "name", type=Name("splits"), metavar="SPLIT", help="name or path of a split"
)


@command("data verify mini")
@split_argument
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
@output_option
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


@command("data info mini")
@split_argument
def info(options: Options) -> int:
    """Describe a split, and what speaks for and against promises that rest on it."""
    make_console().print(describe(load_split(options.name), _promises))
    return 0


def _promises(data: EnvironmentData) -> Iterator[str]:
    return (str(finding) for finding in promises_of(data))
