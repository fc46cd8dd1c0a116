"""``oodd-eval scan``: which recorded episodes are odd, and which of their rows and sensors."""

import json
import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Final

import click
import numpy as np
from oodd_live.watchdog import Watchdog
from rich.text import Text
from tabulate import tabulate

from oodd_eval.cli import COUNT, FILE, OUTPUT_FILE, PARAM, PARAMETER, Name, Options, command, refuse
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import refuse_inputs, write_text
from oodd_eval.names import counted
from oodd_eval.plugins.parameters import parameters_by_detector
from oodd_eval.prose import print_prose
from oodd_logs.commands.reader_plugins import register_formats
from oodd_logs.episodes import files_of
from oodd_logs.inspection.logs import refuse_logs
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import read_logs
from oodd_logs.scanning.scan import SCANNER, Scan, scan_episodes
from oodd_logs.scanning.scan_page import NUMBERS, cells, figure, page, summary, titles
from oodd_logs.scanning.viewers import write_mcap, write_rerun

_SHARE: Final = click.FloatRange(0, 1, min_open=True, max_open=True)
_SHARE.name = "SHARE"
_MANY: Final = 40  # episodes of which the table has a line each
_LARGEST_SHARE: Final = 0.2  # of odd episodes, beyond which they hide one another
_COLUMNS: Final = (
    "largest: the episode's largest statistic; p: how often a nominal episode has one that is as "
    "large; q: the smallest false discovery rate (--fdr) at which the episode is odd."
)
_ALWAYS: Final = 5  # columns that are there in any case
_NEXT: Final = 10  # of more, the nominal ones that it has beside the odd ones


@command(
    "scan logs",
    "scan logs --html scan.html --json scan.json",
    "scan logs --recipe arm.toml --detector pe --jobs 4",
    "scan today --recipe arm.toml --watchdog arm.npz --mcap scan.mcap",
    plugins=True,
)
@click.argument("logs", type=FILE)
@click.option(
    "--recipe", type=FILE, help="how the logs are read (default: as `data inspect` has it)"
)
@click.option("--format", metavar="NAME", help="of the files (default: by their endings)")
@click.option(
    "--read", multiple=True, type=PARAMETER, help="an option of the format; V is JSON or text"
)
@click.option("--window", type=COUNT, help="cut recordings into episodes of N rows")
@click.option("--detector", default=SCANNER, type=Name("detectors"), help="that judges")
@click.option("--param", multiple=True, type=PARAMETER, help=PARAM)
@click.option("--watchdog", type=FILE, help="a saved watchdog judges, and nothing is fitted")
@click.option(
    "--fdr", default=0.1, type=_SHARE, help="share of nominal ones among those called odd, at most"
)
@click.option("--jobs", default=1, type=COUNT, help="fits at a time")
@click.option("--json", type=OUTPUT_FILE, help="write everything as JSON")
@click.option("--html", type=OUTPUT_FILE, help="write a page with a picture of each odd episode")
@click.option("--rerun", type=OUTPUT_FILE, help="write a recording for Rerun, .rrd (extra viewers)")
@click.option(
    "--mcap", type=OUTPUT_FILE, help="write MCAP, for Foxglove and others (extra viewers)"
)
def scan(options: Options) -> int:
    """Tell which recorded episodes are odd, and which of their rows and sensors.

    LOGS is a file, a folder of files, or the directory of a data set; with a recipe, the folder
    that its files are relative to. Each episode is judged by a fit on the others, whatever labels
    say. Most have to be nominal. The exit code is 1 when an episode is odd.
    """
    if options.watchdog:
        judges = "is for fits, and --watchdog judges without one: leave out one of them"
        refuse(options, ["detector", "param", "jobs"], judges)
    if options.recipe:
        refuse(options, ["format", "read"], "is said by the recipe: write it there")
    register_formats(options)
    recipe = Recipe.load(options.recipe) if options.recipe else None
    home = options.recipe.parent if options.recipe else None
    form, read = options.format or "", dict(options.read)
    outputs = [path for path in (options.json, options.html, options.rerun, options.mcap) if path]
    for path, root in product(outputs, (options.logs, home)):
        if recipe and root:
            refuse_inputs(path, files_of(recipe, root))
    refuse_logs(outputs, options.logs, recipe.format if recipe else form)
    logs = read_logs(options.logs, recipe, form, read, options.window, home)
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
    )
    _print(result, logs.notes, options)
    if options.json:
        write_text(options.json, json.dumps(result.as_json(), indent=1, allow_nan=False) + "\n")
    if options.html:
        write_text(options.html, page(result, options.logs.resolve().name))
    if options.rerun:
        write_rerun(result, options.rerun)
    if options.mcap:
        write_mcap(result, options.mcap)
    return int(bool(result.odd))


def _print(result: Scan, notes: Sequence[str], options: Options) -> None:
    console = make_console()
    if options.verbosity >= 0:
        # The oddest first: of many, odd ones and the next to these.
        listed = sorted(
            result.episodes,
            key=lambda scanned: (
                not scanned.odd,
                math.inf if math.isnan(scanned.p) else scanned.p,
                -scanned.largest,
            ),
        )
        if options.verbosity == 0 and len(listed) > _MANY:
            listed = listed[: len(result.odd) + _NEXT]
        heads = titles(listed)
        # Names may have line breaks.
        lines = [
            [" ".join(cell.split()) for cell in cells(scanned, brief=True)[: len(heads)]]
            for scanned in listed
        ]
        kept = [i for i in range(len(heads)) if i < _ALWAYS or any(line[i] for line in lines)]
        align = ["left", *("right" if heads[i] in NUMBERS else "left" for i in kept)]
        marks = ["odd" * scanned.odd for scanned in listed]
        rows = [[mark, *(line[i] for i in kept)] for mark, line in zip(marks, lines, strict=True)]
        head = ["", *(heads[i] for i in kept)]
        table = tabulate(rows, head, "simple", disable_numparse=True, colalign=align)
        colours = ["", "", *("bold red" * scanned.odd for scanned in listed)]
        for line, colour in zip(table.splitlines(), colours, strict=True):
            console.print(Text(line.rstrip(), colour))
        console.print("")
        left = len(result.episodes) - len(listed)
        unlisted = f"Not listed: {counted(left, 'less odd episode(s)')} (-v lists all)."
        remarks = [*notes, *result.notes, *_on_labels(result, fitted=not options.watchdog)]
        for note in (_COLUMNS, *([unlisted] * (left > 0)), *remarks):
            print_prose(note, console)
    console.print(Text(summary(result)))
    if result.odd and not options.html and options.verbosity >= 0:
        console.print(Text("--html FILE writes a page with a picture of each odd episode."))


def _on_labels(result: Scan, *, fitted: bool) -> Iterator[str]:
    """Yield what became of episodes that the logs call anomalous, and whether they are many."""
    labelled = [scanned for scanned in result.episodes if scanned.label]
    if not labelled:
        return
    missed = [scanned for scanned in labelled if not scanned.odd]
    anomalous = counted(len(labelled), "episode(s)")
    yield (
        f"Anomalous by their labels: {anomalous}, {len(labelled) - len(missed)} of them odd here."
    )
    largest_unlabelled = [scanned.largest for scanned in result.episodes if not scanned.label]
    limits = [scanned.threshold for scanned in missed if math.isfinite(scanned.threshold)]
    if not (fitted and limits and largest_unlabelled):
        return
    usual = np.median(largest_unlabelled)
    anomalies = np.median([scanned.largest for scanned in labelled])
    yield (
        f"The largest statistic of these is {figure(anomalies)} in the median, that of the others "
        f"{figure(usual)}; an episode is odd from about {figure(np.median(limits))} on, as a scan "
        "does not know which episodes are nominal."
    )
    many = len(labelled) > len(result.episodes) * _LARGEST_SHARE
    yield (
        "Where more than a fifth are anomalous, they pass for nominal: scan nominal logs alone, or "
        "judge by a watchdog that was fitted on these (--watchdog FILE)."
        if many
        else "A detector that is fitted on nominal episodes alone finds smaller faults: use "
        "`oodd-eval data import` and `run`, or a watchdog (--watchdog FILE)."
    )
