"""``oodd-eval calibrate``: a threshold with a promise for a score that somebody else computed."""

import json

import click
from oodd_logs.commands.reader_plugins import register_formats

from oodd_eval.cli import COUNT, FILE, Name, Options, command
from oodd_eval.cli.console import make_console
from oodd_eval.data.bounded import without_nan
from oodd_eval.errors import UsageError
from oodd_eval.prose import print_prose
from oodd_monitors.calibrating import calibrate
from oodd_monitors.describing import as_json, by_group, condition, sentences
from oodd_monitors.recorded_scores import read_scores

_PERCENT = click.FloatRange(0, 100, min_open=True, max_open=True)
_PERCENT.name = "PERCENT"
_ALARMS = click.Choice(["threshold", "cusum", "ewma", "score"])


@command(
    "calibrate flights --score 'estimator_innovation_test_ratios.hvel.0'",
    "calibrate runs --score '|residual|' --level 10 --hold 3",
    "calibrate arm.toml --score chunk_mse --alarm cusum --per task",
    "calibrate my-split --score chunk_mse --json",
    plugins=True,
)
@click.argument("logs", type=Name("splits"))
@click.option(
    "--score", required=True, metavar="COLUMN", help="the column: NAME, -NAME, or |NAME| for size"
)
@click.option(
    "--level", default=5.0, type=_PERCENT, help="largest percentage of healthy logs with an alarm"
)
@click.option(
    "--alarm",
    default="threshold",
    type=_ALARMS,
    help="of the score itself (threshold, score), its CUSUM, or its weighted mean (ewma)",
)
@click.option("--hold", default=1, type=COUNT, help="rows in a row above the threshold")
@click.option(
    "--per", metavar="GROUP", default="", help="a threshold for each value of a field or column"
)
@click.option("--recipe", type=FILE, help="how the logs are read, whose files are below LOGS")
@click.option("--json", is_flag=True, help="print everything as JSON")
def calibrate_score(options: Options) -> int:
    """Find the threshold of a recorded score, and say what it promises.

    LOGS is a file, a folder, the directory of a data set, a recipe, or an imported split. The first
    line is the threshold to copy: at most so many healthy logs go above it. Each recording is one
    log; windows of one recording count once. Nothing is fitted.
    """
    register_formats(options)
    scores = read_scores(options.logs, options.score, recipe=options.recipe, per=options.per)
    try:
        calibration = calibrate(
            scores.scores,
            options.level / 100,
            alarm=options.alarm,
            hold=options.hold,
            recordings=scores.recordings,
            labelled=scores.labelled,
            healthy=scores.healthy,
            groups=scores.groups or None,
        )
    except UsageError as error:
        raise UsageError(" ".join([f"{error}.", *scores.notes]).removesuffix(".")) from None
    name = options.score
    if options.json:
        content = as_json(calibration, name, scores.unit) | {"read": scores.notes}
        click.echo(json.dumps(without_nan(content), indent=1, allow_nan=False))
        return 0
    console = make_console()
    for line in by_group(calibration, name, scores.unit):
        console.print(line)
    console.print(condition(calibration, name, scores.unit))
    if options.verbosity >= 0:
        for text in (*sentences(calibration, name), *scores.notes):
            print_prose(text, console)
    return 0
