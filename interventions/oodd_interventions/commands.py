"""``oodd-eval intervene``: what an alarm saves.

The evaluator knows it by name only (`oodd_eval.cli.main`).
"""

from typing import Final

import click

from oodd_eval.cli import (
    COUNT,
    NAMES,
    OUTPUT_DIRECTORY,
    PARAM,
    PARAMETER,
    Name,
    Names,
    Options,
    command,
    jobs_option,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.names import counted
from oodd_eval.prose import print_prose, print_sections
from oodd_interventions import study
from oodd_interventions.page import REPORT, sections, write_pages

_SETTINGS: Final = ("split", "kinds", "acts", "seeds", "base", "jobs", "fresh", "output")
_PERCENT: Final = click.FloatRange(0, 100, min_open=True, max_open=True)
_PERCENT.name = "PERCENT"


@command(
    "intervene --detector mewma-a --env cartpole",
    "intervene --detector panel-a,riqn --env all --act mask --jobs 2",
    further={"Other": "--base --param"},
)
@click.option("--detector", required=True, type=Names("detectors"), help=NAMES)
@click.option("--env", required=True, type=Names("envs"), help=NAMES)
@click.option("--split", default="mini", type=Name("splits"), help="recorded split to fit on")
@click.option("--kind", "kinds", default="all", type=Names("anomalies"), help=NAMES)
@click.option("--act", "acts", default="all", help="acts, such as mask, stop and switch")
@click.option("--seeds", default=10, type=COUNT, help="episodes of each kind, recorded anew")
@click.option("--base", default=study.BASE, type=COUNT, help="millions of the first seed")
@click.option("--level", default=5.0, type=_PERCENT, help="nominal episodes with alarms, at most")
@click.option("--param", multiple=True, type=PARAMETER, help=PARAM)
@jobs_option
@click.option("--fresh", is_flag=True, help="fit and run again what the directory has already")
@click.option("--output", default="oodd-interventions", type=OUTPUT_DIRECTORY, help="directory")
def intervene(options: Options) -> int:
    """Tell what an alarm saves, by acting on it in the simulator.

    Faulty episodes run again, and at a detector's alarm an act takes over from the policy. Mask,
    for example, no longer trusts the sensors that the detector names. The tables say how much of
    the lost return comes back, beside acting at once on the true parts, and at alarms of other
    episodes; and what false alarms cost.

    The exit code is 1 when a detector failed, and 2 when the study was interrupted. What was done
    is kept: the same command goes on.
    """
    console, notes = make_console(), make_console(quiet=options.verbosity < 0)
    settings = {name: getattr(options, name) for name in _SETTINGS}
    settings |= {"level": options.level / 100, "parameters": dict(options.param)}
    settings["observer"] = lambda n, total, text: notes.print(f"{n}/{total}  {text}")
    try:
        done = study.intervene(options.detector, options.env, **settings)
    except KeyboardInterrupt:
        say(f"what was done is kept in {options.output}; the same command continues")
        raise
    for name, reason in done.reasons.items():
        print_prose(f"FAILED {name}: {reason}", console, "red")
    if not done.cells:
        advice = "mask is for faults of sensors, stop and switch for others in some environments"
        return 1 if done.reasons else say(f"no act suits these kinds of anomalies: {advice}", 5)
    write_pages(done.output, done.cells)
    parts = sections(done.records)
    if options.verbosity >= 0:
        print_sections(parts, console)
    else:
        print_prose(" ".join(part.verdict for part in parts), console)
    cells = counted(len(done.cells), "cell(s)")
    console.print(f"{cells} in {done.output}: tables in {REPORT}, plots in a page by environment")
    return int(bool(done.reasons))
