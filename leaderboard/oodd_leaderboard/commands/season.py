"""``oodd-eval leaderboard season``: run every entry on a fresh split, in sandboxes."""

import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import click
from oodd_recording.build import build_split
from oodd_recording.season import SEASON_ENVIRONMENTS, SeasonSizes, season_definition
from rich.console import Console

from oodd_eval.cli import (
    COUNT,
    DIRECTORY,
    OUTPUT_DIRECTORY,
    Converted,
    Names,
    Options,
    command,
    jobs_option,
    limit_options,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.data.facts import LONG_NAMES
from oodd_eval.data.files import only_writer
from oodd_eval.errors import UsageError
from oodd_eval.names import counted, select
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.record import Record
from oodd_eval.scoring.display import Display
from oodd_eval.scoring.executors import RunSettings, check_executor
from oodd_leaderboard import season as running
from oodd_leaderboard.commands.entries import progress_shown
from oodd_leaderboard.entry import FORMS, read_entries
from oodd_leaderboard.pages import PAGE, SITE, build, read_leaderboard
from oodd_leaderboard.sandbox.launcher import make_sandbox
from oodd_leaderboard.season_files import SEASON, SPLIT, read_season, row_path

_SIZE: Final = click.types.IntParamType()


def _bits(text: str) -> int:
    if not re.fullmatch("[0-9a-f]{32}", text):
        raise UsageError(f"{text!r}, expected 128 bits as 32 digits 0-9 and a-f")
    return int(text, 16)


@command(
    "leaderboard season --entries leaderboard/entries --output leaderboard/seasons/2026-11",
    "leaderboard season --entries mine --env cartpole,tank --train 12 --calibration 40 --test 4",
    "leaderboard season --bits 7e0c5a4df6db7db56e4a2ab8c1e4c9a1 --output rebuilt",
    further={"Other": "--cap --executor -p"},
    plugins=True,
)
@click.option("--entries", type=DIRECTORY, help="what to run (default: only record the split)")
@click.option(
    "--bits",
    type=Converted(_bits, "HEX"),
    help="bits of a published season, whose split is to be recorded again (default: drawn now)",
)
@click.option("--env", default="all", type=Names("envs"), help="environments, fewer for a trial")
@click.option("--train", type=COUNT, help="training episodes per environment, in a trial")
@click.option("--calibration", type=COUNT, help="calibration episodes per environment, in a trial")
@click.option("--test", type=COUNT, help="test seeds per environment, in a trial")
@click.option("--cap", type=_SIZE, help="longest episode, in a trial")
@click.option("--executor", default="local", help="local, or dask://HOST:PORT, a Dask cluster")
@jobs_option
@limit_options("a fit with its scores", "1h")
@click.option(
    "--output", default="oodd-season", type=OUTPUT_DIRECTORY, help="directory of the season"
)
def season(options: Options) -> int:
    """Run a season: each entry in each environment, with the same seeds, in sandboxes.

    Its split is recorded anew from 128 random bits. Killed or interrupted, the same command goes
    on. The exit code is 1 when a cell failed, which is the row's reason, and 2 when the season was
    interrupted.
    """
    environments = select("environment of seasons", options.env, SEASON_ENVIRONMENTS)
    passed = {name: getattr(options, name) for name in SeasonSizes._fields}
    sizes = SeasonSizes(**{name: size for name, size in passed.items() if size is not None})
    plugins = discovered(options)
    plugins.custom_specs.register(LONG_NAMES.get(name, name) for name in environments)
    entries = []
    if options.entries:
        if not (entries := read_entries(options.entries)):
            return say(f"no entries in {options.entries}: expected {FORMS} there", 5)
        running.check_entries(entries, options.entries, plugins)
        check_executor(options.executor)
        make_sandbox()  # what is missing for it is said before anything is recorded
    directory: Path = options.output
    console = make_console(quiet=options.verbosity < 0)
    with only_writer(directory):
        bits = _bits_of(directory, options.bits)
        definition = season_definition(bits, environments, sizes)
        trial = sizes != SeasonSizes() or len(environments) < len(SEASON_ENVIRONMENTS)
        begun = running.begin(directory, definition, bits, trial=trial, entries=entries)
        with progress_shown("recording the split", quiet=options.verbosity < 0) as show:
            build_split(
                definition,
                directory / SPLIT,
                bits=bits,
                environments=environments,
                jobs=options.jobs,
                progress=lambda done, total, part: show(f"{done}/{total}, {part}"),
            )
        begun = running.noted_split(begun, directory)
        split = f"split {begun.split.name}, digest {begun.split.digest}"
        console.print(f"season {begun.name}: bits {begun.bits}, {split}")
        if not entries:
            return 0
        settings = RunSettings(
            jobs=options.jobs,
            limits=Limits(options.timeout, options.memory),
            executor=options.executor,
            command=options.invocation,
        )
        runner = running.SeasonRunner(directory, begun, options.entries, plugins, settings)
        return _run(runner, console, quiet=options.verbosity < 0)


def _bits_of(directory: Path, bits: int | None) -> int:
    """Return the bits that are given, or those of the season that is there, or draw some."""
    if bits is None and (directory / SEASON).is_file():
        return int(read_season(directory).bits, 16)
    return secrets.randbits(128) if bits is None else bits


def _run(runner: running.SeasonRunner, console: Console, *, quiet: bool) -> int:
    """Run the rows that are not there yet, each with its progress, and build the board."""
    entries = runner.season.entries.values()
    for number, entry in enumerate(entries, start=1):
        label = f"[{number}/{len(entries)}] {entry.name}"
        if row_path(runner.directory, entry.name).is_file():
            continue
        with _row_shown(label, quiet=quiet) as observers:
            records = runner.run(entry, observers)
        if records is None:
            return say(f"interrupted in row {entry.name}: the same command goes on", 2)
        console.print(f"{label}: {_outcome(records)}")
    records = runner.season.records(runner.directory)
    if lines := runner.season.missing(records):
        return say(f"the season is not whole: {'; '.join(lines)}", 1)
    runner.season = running.end(runner.season, runner.directory)
    with progress_shown("board", quiet=quiet) as show:
        build(read_leaderboard(runner.directory), runner.directory, on_part=show)
    page, site = runner.directory / PAGE, runner.directory / SITE / "index.html"
    failed = sum(not record.ok for record in records)
    errors = f", with {counted(failed, 'failed result(s)')}" if failed else ""
    console.print(f"season {runner.season.name} is whole{errors}: page {page}, site {site}")
    return int(bool(failed))


def _outcome(records: Sequence[Record]) -> str:
    """Return how many cells a row has, and why some of them failed."""
    failed = [record for record in records if not record.ok]
    text = counted(len(records), "cell(s)")
    if failed:
        first = failed[0]
        text += f", {len(failed)} failed ({first.environment}: {first.status}: {first.reason})"
    return text


@contextmanager
def _row_shown(label: str, *, quiet: bool) -> Iterator[list[object]]:
    """Show on a terminal what is at work in a row."""
    console = make_console(quiet=quiet, stderr=True)
    if quiet or not console.is_terminal:
        yield []
        return
    with Display(console) as display:
        display.line(label)
        yield [display]
