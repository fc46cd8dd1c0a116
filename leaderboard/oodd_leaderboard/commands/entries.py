"""``oodd-eval leaderboard build`` and ``submit``: the files of the board, and an entry."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import click

from oodd_eval.cli import DIRECTORY, FILE, OUTPUT_DIRECTORY, Options, command, say
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import only_writer, temporary_directory
from oodd_leaderboard import submit as submission
from oodd_leaderboard.entry import ENTRY, Entry, read_entry
from oodd_leaderboard.pages import PARTS, STALE, differences, read_leaderboard, stale
from oodd_leaderboard.pages import build as build_board

LEADERBOARD: Final = "leaderboard"  # its directory, from the root of a checkout


@command("leaderboard build --check")
@click.argument(
    "directory", default=LEADERBOARD, type=DIRECTORY, help="of the leaderboard, or of one season"
)
@click.option("--output", type=OUTPUT_DIRECTORY, help="where to write, by default there")
@click.option(
    "--check", is_flag=True, help="write nothing, exit 1 where a file beside the site would change"
)
def build(options: Options) -> int:
    """Render page, tables and site from seasons and reported records.

    The exit code is 1 when --check finds a difference, and 5 when there is nothing to show.
    """
    output = options.output or options.directory
    quiet = options.verbosity < 0
    with progress_shown("leaderboard", quiet=quiet) as show, temporary_directory() as fresh:
        show("records")
        leaderboard = read_leaderboard(options.directory)
        if not (leaderboard.seasons or leaderboard.reported):
            return say(f"no season and no reported rows in {options.directory}", 5)
        target = fresh if options.check else output
        with only_writer(target):
            written = build_board(leaderboard, target, at=output, on_part=show)
        lines = differences(target, output) if options.check else []
    if not options.check:
        if options.verbosity >= 0:
            print("\n".join(str(output / name) for name in written if PARTS not in name))
        for name in stale(output, written):
            say(f"{output / name} is {STALE}: delete it", 0)
        return 0
    print("\n".join(lines) if lines else f"{output} is up to date")
    if not lines:
        return 0
    advice = "run leaderboard build, delete what is no part of it, and commit"
    return say(f"{output} is not what its records say: {advice}", 1)


@contextmanager
def progress_shown(doing: str, *, quiet: bool) -> Iterator[Callable[[str], object]]:
    """Show how far something is that is being done; nothing where standard error is no terminal."""
    console = make_console(quiet=quiet, stderr=True)
    if quiet or not console.is_terminal:
        yield str
        return
    with console.status(doing) as status:
        yield lambda part: status.update(f"{doing}: {part}")


@command(
    "leaderboard submit oodd-results --detector mine --wheel dist/oodd_mine-0.1.0.whl",
    further={"Other": "--sha256 --variant"},
)
@click.argument("directory", type=DIRECTORY, help="results of oodd-eval run")
@click.option(
    "--detector", required=True, metavar="ROW", help="the row, such as mine or 'mine[window=5]'"
)
@click.option("--wheel", type=FILE, help="file that pip installs; it is copied")
@click.option("--requirement", help="what pip installs instead (default: the version of the run)")
@click.option("--sha256", help="digest of the file that pip installs for the requirement")
@click.option("--name", help="name of the row (default: the detector's)")
@click.option("--authors", help="who made the method")
@click.option("--paper", help="its title and where it appeared")
@click.option("--year", type=int, help="of the paper")
@click.option("--url", help="page of the method or its code")
@click.option("--licence", help="such as MIT")
@click.option("--variant", is_flag=True, help="a further row of a distribution, never ranked")
@click.option(
    "--entries",
    default=f"{LEADERBOARD}/entries",
    type=OUTPUT_DIRECTORY,
    help="directory of the entries",
)
def submit(options: Options) -> int:
    """Write an entry from a run: what a season installs and runs, and the run's records beside it.

    Its records are shown as reported rows. A season ranks its own.
    """
    names = ("name", "requirement", "sha256", "authors", "paper", "url", "licence")
    texts: dict[str, Any] = {
        name: " ".join((getattr(options, name) or "").split()) for name in names
    }
    stated = Entry(**texts, year=options.year, variant=options.variant)
    path = submission.submit(
        options.directory, options.detector, options.entries, stated, options.wheel
    )
    if options.verbosity >= 0:
        console = make_console()
        console.print((path / ENTRY).read_text(encoding="utf-8"), markup=False, end="")
        size = sum(p.stat().st_size for p in path.rglob("*"))
        entry = read_entry(path / ENTRY)
        uninstall = "" if entry.shipped else f"  pip uninstall {entry.distribution}\n"
        console.print(
            f"\nwritten to {path}, {size / 1e6:.2g} MB; next:\n"
            f"{uninstall}  oodd-eval leaderboard season --entries {path} --env cartpole "
            "--train 12 --calibration 40 --test 4 --output my-season\n"
            f"  git add {path}\n"
            "commit it alone, and open a pull request (docs/submitting.md)",
            markup=False,
        )
    return 0
