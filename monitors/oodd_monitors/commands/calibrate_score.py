"""``oodd-eval calibrate``: a threshold with a promise for a score that somebody else computed."""

import json
from typing import get_args

import click
from oodd_logs.commands.reader_plugins import register_formats

from oodd_eval.cli import COUNT, FILE, Name, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.data.bounded import without_nan
from oodd_eval.errors import UsageError
from oodd_eval.prose import print_prose
from oodd_monitors.calibrating import ScoreAlarm, calibrate
from oodd_monitors.describing import as_json, by_group, condition, sentences
from oodd_monitors.recorded_scores import read_scores

_PERCENT = click.FloatRange(0, 100, min_open=True, max_open=True)
_PERCENT.name = "PERCENT"
_ALARMS = click.Choice(get_args(ScoreAlarm))


@command(
    "calibrate flights --score estimator_innovation_test_ratios.heading",
    "calibrate runs --score '|residual|' --level 10 --hold 3",
    "calibrate arm.toml --score chunk_mse --alarm cusum --per task",
    plugins=True,
)
@click.argument("logs", type=Name("splits"))
@click.option("--score", required=True, metavar="COLUMN", help="NAME, -NAME, or |NAME|")
@click.option(
    "--level", default=5.0, type=_PERCENT, help="per cent of healthy logs that may alarm, at most"
)
@click.option("--alarm", default="threshold", type=_ALARMS, help="statistic of the score")
@click.option("--hold", default=1, type=COUNT, help="rows in a row above the threshold")
@click.option("--per", metavar="GROUP", help="a threshold for each value of a field")
@click.option("--recipe", type=FILE, help="how the logs are read, whose files are below LOGS")
@click.option("--json", is_flag=True, help="print everything as JSON")
def calibrate_score(options: Options) -> int:
    """Find the threshold of a recorded score, and say what it promises.

    LOGS is a file, a folder, the directory of a data set, a recipe, or an imported split. The first
    line is the threshold to copy: at most so many healthy logs go above it. Each recording is one
    log; windows of one recording count once. Nothing is fitted.
    """
    register_formats(options)
    scores = read_scores(options.logs, options.score, recipe=options.recipe, per=options.per or "")
    level, alarm, hold = options.level / 100, options.alarm, options.hold
    try:
        calibration = calibrate(**scores.arguments, level=level, alarm=alarm, hold=hold)
    except UsageError as error:
        raise UsageError(" ".join([f"{error}.", *scores.notes]).removesuffix(".")) from None
    name, unit = options.score, scores.unit
    if options.json:
        content = {"score": name, "unit": unit, "read": scores.notes} | as_json(calibration)
        click.echo(json.dumps(without_nan(content), indent=1, allow_nan=False))
        return 0
    console = make_console()
    for line in (*by_group(calibration, name, unit), condition(calibration, name, unit)):
        console.print(line)
    for text in (*sentences(calibration, name), *scores.notes) if options.verbosity >= 0 else ():
        print_prose(text, console)
    return 0
