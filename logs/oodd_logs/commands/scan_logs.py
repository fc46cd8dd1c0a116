"""``oodd-eval scan``: which recorded episodes to look at first, and at which rows and sensors."""

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import filter as fitting
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import quote

import click
from oodd_live.watchdog import Watchdog
from rich.console import Console
from rich.text import Text
from tabulate import tabulate

from oodd_eval.cli import (
    COUNT,
    FILE,
    LOGS,
    OUTPUT_FILE,
    PARAM,
    PARAMETER,
    Name,
    Options,
    command,
    refuse,
)
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import read_text, refuse_inputs, write_text
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.names import counted
from oodd_eval.plugins.parameters import parameters_by_detector
from oodd_eval.prose import print_prose
from oodd_logs.commands.reader_plugins import register_formats
from oodd_logs.episodes import Episode, files_of
from oodd_logs.inspection.logs import recognised, refuse_logs
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import RecordedLogs, read_logs
from oodd_logs.scanning.scan import SCANNER, Progress, Scan, ScannedEpisode, scan_episodes
from oodd_logs.scanning.scan_page import NUMBERS, WORDS, page, summary, table_of
from oodd_logs.scanning.viewers import foxglove_link, write_mcap, write_rerun

_SHARE: Final = click.FloatRange(0, 1, min_open=True, max_open=True)
_SHARE.name = "SHARE"
_STYLES: Final = {"surely": "bold red", "look at": "yellow", "fine": ""}
_OUTPUTS: Final = ("keep", "drop", "json", "html", "rerun", "mcap")
_COLUMNS: Final = (
    "p: how often a fine episode is as odd by chance; q: the smallest false discovery rate (--fdr) "
    "at which the episode is odd."
)


@command(
    "scan logs",
    "scan logs --html scan.html --json scan.json",
    "scan logs --fine 'monday-*,run-07' --drop delete.txt",
    "scan logs --recipe arm.toml --detector pe --jobs 4",
    "scan today --recipe arm.toml --watchdog arm.npz --mcap scan.mcap",
    further={
        "How logs are read": "--format --read",
        "Judging": "--param --watchdog -p",
        "Further files": "--keep --rerun --mcap --served",
    },
    plugins=True,
)
@click.argument("logs", type=LOGS)
@click.option(
    "--recipe", type=FILE, help="how the logs are read (default: as `data inspect` has it)"
)
@click.option("--format", metavar="NAME", help="of the files (default: by their endings)")
@click.option(
    "--read", multiple=True, type=PARAMETER, help="an option of the format; V is JSON or text"
)
@click.option("--window", type=COUNT, help="cut recordings into episodes of N rows")
@click.option(
    "--fine",
    metavar="NAMES",
    default="",
    help="episodes that somebody confirmed: names, globs, or a file with a name a line",
)
@click.option("--first", default=10, type=COUNT, help="episodes that are listed in any case")
@click.option("--detector", default=SCANNER, type=Name("detectors"), help="that judges")
@click.option("--param", multiple=True, type=PARAMETER, help=PARAM)
@click.option("--watchdog", type=FILE, help="a saved watchdog judges, and nothing is fitted")
@click.option(
    "--fdr", default=0.1, type=_SHARE, help="share of nominal ones among those called odd, at most"
)
@click.option("--jobs", default=1, type=COUNT, help="fits at a time")
@click.option("--keep", type=OUTPUT_FILE, help="write the names of recordings that are not odd")
@click.option("--drop", type=OUTPUT_FILE, help="write the names of odd ones; a list for .json")
@click.option("--json", type=OUTPUT_FILE, help="write everything as JSON")
@click.option("--html", type=OUTPUT_FILE, help="write a page with pictures of the first episodes")
@click.option("--rerun", type=OUTPUT_FILE, help="write a recording for Rerun, .rrd (extra viewers)")
@click.option(
    "--mcap", type=OUTPUT_FILE, help="write MCAP, for Foxglove and others (extra viewers)"
)
@click.option(
    "--served", metavar="URL", help="of the MCAP file's folder, for links that open Foxglove"
)
def scan(options: Options) -> int:
    """Tell which recorded episodes are odd, and which of their rows and sensors.

    LOGS is a file, a folder of files, or the directory of a data set; with a recipe, the folder
    that its files are relative to. Each episode is judged by fits on the others, whatever labels
    say; up to a fifth may be odd. The exit code is 1 when an episode is odd.
    """
    if options.watchdog:
        judges = "is for fits, and --watchdog judges without one: leave out one of them"
        refuse(options, ["detector", "param", "jobs"], judges)
    if options.recipe:
        refuse(options, ["format", "read"], "is said by the recipe: write it there")
    register_formats(options)
    recipe = Recipe.load(options.recipe) if options.recipe else None
    home = options.recipe.parent if options.recipe else None
    _check_outputs(options, recipe)
    quiet = options.verbosity < 0
    with _reporting(make_console(stderr=True, quiet=quiet)) as report:
        report(f"reading {options.logs}", [])
        form = options.format or ""
        logs = read_logs(options.logs, recipe, form, dict(options.read), options.window, home)
        if options.served and not (options.mcap or logs.form == "mcap"):
            raise UsageError("--served is for MCAP: expected --mcap FILE, or logs that are MCAP")
        parameters = parameters_by_detector([options.detector], dict(options.param))
        result = scan_episodes(
            logs.episodes,
            sensors=logs.sensors,
            detector=options.detector,
            watchdog=Watchdog.load(options.watchdog) if options.watchdog else None,
            fdr=options.fdr,
            baseline=logs.baseline,
            parameters=parameters[options.detector],
            jobs=options.jobs,
            fine=_confirmed(options.fine, [episode.name for episode in logs.episodes]),
            first=options.first,
            progress=report,
            ledger=logs.ledger,
        )
    names = {_recording(scanned.episode): False for scanned in result.episodes}
    names |= {_recording(scanned.episode): True for scanned in result.odd}
    drop = [name for name, is_odd in names.items() if is_odd]
    keep = [name for name, is_odd in names.items() if not is_odd]
    link = partial(_link, options)
    console = make_console()
    if not quiet:
        _print_table(result, options, console)
        _print_notes(result, logs, console)
    console.print(Text(summary(result)))
    for note, code in _next_steps(result, logs, drop, options) if not quiet else ():
        print_prose(note, console)
        if code:
            console.print(Text(f"  {code}"))
    for file, listed in ((options.keep, keep), (options.drop, drop)):
        if file and file.suffix == ".json":
            write_text(file, json.dumps(_numbers(listed) or listed) + "\n")
        elif file:
            write_text(file, "".join(f"{name}\n" for name in listed))
    if options.json:
        write_text(options.json, json.dumps(result.as_json(), indent=1, allow_nan=False) + "\n")
    if options.html:
        title = options.logs.resolve().name
        text = page(result, title, first=options.first, link=link, notes=logs.notes)
        write_text(options.html, text)
    if options.rerun:
        write_rerun(result, options.rerun, options.first)
    if options.mcap:
        write_mcap(result, options.mcap)
    return int(bool(result.odd))


def _check_outputs(options: Options, recipe: Recipe | None) -> None:
    """Raise `UsageError` for an output that is one of the files that are read."""
    outputs = {name: path for name in _OUTPUTS if (path := getattr(options, name))}
    if not outputs:
        return
    form = recipe.format if recipe else options.format or ""
    inputs = [*recognised(options.logs, form)[1], *filter(Path.is_file, [Path(options.fine)])]
    if recipe:
        inputs += [*files_of(recipe, options.logs), *files_of(recipe, options.recipe.parent)]
    for name, path in outputs.items():
        refuse_inputs(path, inputs, f"--{name}")
    refuse_logs(outputs.values(), options.logs, form)


@contextmanager
def _reporting(console: Console) -> Iterator[Progress]:
    """Show what is done on a terminal, and everywhere the first verdicts as soon as there are."""
    with console.status("", spinner="line") as status:
        verdicts: list[str] = []

        def report(done: str, names: Sequence[str]) -> None:
            status.update(done)
            if names and not verdicts:
                verdicts.extend(names[:5])
                console.print(f"First verdicts, the oddest first: {', '.join(verdicts)}")

        yield report


def _confirmed(text: str, names: Sequence[str]) -> list[str]:
    """Return the names of episodes that somebody confirmed, of all pieces of a recording."""
    is_file = text not in names and Path(text).is_file()
    patterns = read_text(Path(text)).splitlines() if is_file else text.split(",")
    confirmed: dict[str, None] = {}
    for pattern in filter(None, map(str.strip, patterns)):
        pieces = [name for name in names if name == pattern or name.startswith(f"{pattern}#")]
        selected = pieces or fitting(names, pattern)
        if not selected:
            raise UnknownNameError("episode", pattern, names)
        confirmed.update(dict.fromkeys(selected))
    return [*confirmed]


def _recording(episode: Episode) -> str:
    """Return the name of the recording that an episode is a piece of."""
    is_whole = Path(episode.source).stem == episode.name
    return episode.name if is_whole else re.sub(r"#\d+$", "", episode.name)


def _numbers(names: Sequence[str]) -> list[int]:
    """Return the numbers of episodes of data sets that number them; none for other names."""
    matches = [re.fullmatch(r"episode_(\d{1,9})", name) for name in names]
    return [int(match[1]) for match in matches if match] if all(matches) else []


def _print_table(result: Scan, options: Options, console: Console) -> None:
    """Print the first episodes and all that are not fine, with -v all, a line each."""
    listed = [
        scanned
        for scanned in result.ranked
        if scanned.position <= options.first or scanned.band != "fine" or options.verbosity > 0
    ]
    titles, rows = table_of(listed)
    # Names may have line breaks.
    cells = [[" ".join(cell.split()) for cell in (WORDS[scanned.band], *row)]
             for scanned, row in zip(listed, rows, strict=True)]  # fmt: skip
    head = ["", *titles]
    align = ["right" if title in NUMBERS else "left" for title in head]
    table = tabulate(cells, head, "simple", disable_numparse=True, colalign=align)
    styles = ["", "", *(_STYLES[scanned.band] for scanned in listed)]
    for line, style in zip(table.splitlines(), styles, strict=True):
        console.print(Text(line.rstrip(), style))
    console.print("")
    if left := len(result.episodes) - len(listed):
        print_prose(f"Not listed: {counted(left, 'less odd episode(s)')} (-v lists all).", console)
    if "p" in titles:
        print_prose(_COLUMNS, console)


def _print_notes(result: Scan, logs: RecordedLogs, console: Console) -> None:
    """Print what became of the logs, how they were judged, and what labels say."""
    for note in (*logs.notes, *result.notes):
        print_prose(note, console)
    if labelled := [scanned for scanned in result.ranked if scanned.label]:
        anomalous = counted(len(labelled), "episode(s)")
        odd = sum(scanned.odd for scanned in labelled)
        places = ", ".join(str(scanned.position) for scanned in labelled[:20])
        print_prose(
            f"Anomalous by their labels: {anomalous}, {odd} of them odd here; their places are "
            f"{places}{', ...' * (len(labelled) > 20)}.",
            console,
        )


def _next_steps(
    result: Scan, logs: RecordedLogs, drop: Sequence[str], options: Options
) -> Iterator[tuple[str, str]]:
    """Yield what a person would do next, each with a command or what to look at."""
    suspicious = [scanned for scanned in result.ranked if scanned.band != "fine"]
    if not suspicious:
        return
    first = suspicious[0]
    at = "" if first.first is None else f" from row {first.first}"
    link = _link(options, first) or ("" if options.html else "--html FILE draws it")
    yield f"Next, look at {first.episode.name}{at}: {first.reason}.", link
    if options.rerun:
        yield "Rerun opens a tab for each of the first:", shlex.join(["rerun", str(options.rerun)])
    yield "Say which are fine; from 20 on they make the ranks of the others exact:", "--fine NAMES"
    if drop and logs.form == "lerobot":
        indices = shlex.quote(json.dumps(_numbers(drop)))
        root = f"--root {shlex.quote(str(options.logs))} --repo_id NAME --new_repo_id NEW"
        operation = f"--operation.type delete_episodes --operation.episode_indices {indices}"
        yield (
            "Delete the odd ones, into a new data set:",
            f"lerobot-edit-dataset {root} {operation}",
        )
    elif drop and not options.drop:
        yield "Write the names of the odd ones, and of the others:", "--drop FILE --keep FILE"


def _link(options: Options, scanned: ScannedEpisode) -> str:
    """Return a link that opens an episode in Foxglove; empty where nothing is served."""
    if not options.served:
        return ""
    root = options.logs if options.logs.is_dir() else options.logs.parent
    file = Path(options.mcap or scanned.episode.source)
    name = file.name if options.mcap else file.relative_to(root).as_posix()
    return foxglove_link(scanned, f"{options.served.rstrip('/')}/{quote(name)}")
