"""``oodd-eval reproduce``: compute the paper's tables, figures and claims."""

from typing import Final

import click

from oodd_eval.cli import (
    DIRECTORY,
    OUTPUT_DIRECTORY,
    TIME,
    Name,
    Options,
    command,
    fit_options,
    load,
    refuse,
    say_notes,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.data.facts import PROTOCOL, SPLITS
from oodd_eval.data.files import refuse_inputs
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import MissingExtraError, SplitNotFoundError, UsageError
from oodd_eval.names import check_known, counted, select
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.prose import print_table
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.cores import available_cores
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan
from oodd_eval.scoring.runner import RunOutcome, run
from oodd_paper.experiments import EXPERIMENTS, TABLE_2, TIERS
from oodd_paper.inputs import Other, Reproduction, keep_inputs, load_records, load_returns
from oodd_paper.reproduction_page import publish
from oodd_paper.run import Progress, duration, lay_out, scored_rows, stages, unfinished

_OF_RUNS: Final = (
    *("tier", "split", "only", "plan", "budget", "fresh", "build"),
    *("jobs", "device", "timeout", "memory"),
)


@command(
    "reproduce --tier mini",
    "reproduce --tier reduced --plan",
    plugins=True,
    further={
        "Where, and within which limits": "--device --timeout --memory -p",
        "Pages": "--records --beside --no-figures",
    },
)
@click.option(
    "--tier",
    default="full",
    metavar="full|reduced|mini",
    help="how much: split standard; its first trajectories and fewer seeds; split mini",
)
@click.option("--split", type=Name("splits"), help="name or path of a split (default: the tier's)")
@click.option(
    "--output", default="reproduction", type=OUTPUT_DIRECTORY, help="directory of the reproduction"
)
@click.option(
    "--only",
    default="all",
    metavar="NAMES",
    help="run what these need, such as table-5,figure-horizon",
)
@click.option("--plan", is_flag=True, help="show what remains and how long it takes; do nothing")
@click.option("--budget", type=TIME, help="start nothing after this time, such as 2h; exit code 2")
@fit_options("3h")
@click.option("--fresh", is_flag=True, help="run again what the directory has already")
@click.option("--build", is_flag=True, help="build the split if it is not on this machine")
@click.option(
    "--render-only",
    is_flag=True,
    help="run nothing; make tables and figures again from the directory's records",
)
@click.option(
    "--records",
    multiple=True,
    type=DIRECTORY,
    help="with --render-only: read results below this directory instead, or below several",
)
@click.option(
    "--beside",
    type=DIRECTORY,
    help="show the numbers of another reproduction beside these, such as one of Table 1's "
    "strengths beside one of the paper's losses",
)
@click.option("--no-figures", is_flag=True, help="write tables only")
def reproduce(options: Options) -> int:
    """Compute the paper's tables, figures and claims; the same command goes on where it was.

    The exit code is 1 when units failed, and 2 when units are left.
    """
    check_known("tier", TIERS, options.tier)
    if options.render_only:
        refuse(options, _OF_RUNS, "is for a run, and --render-only runs nothing: leave out one")
        header = Reproduction.load(options.output)
        records = load_records(header, options.records or [options.output])
        return _render(options, header, records)
    if options.records:
        raise UsageError("--records is what --render-only reads; a run reads its own directory")
    return _run(options)


def _run(options: Options) -> int:
    """Run what remains, as far as the budget goes, and write tables and figures."""
    console, results = make_console(), ResultsDirectory(options.output)
    directory, jobs = results.path, options.jobs or available_cores()
    names = select("table or figure", options.only, [TABLE_2, *(e.id for e in EXPERIMENTS)])
    experiments = [e for e in EXPERIMENTS if e.id in names]
    plugins = discovered(options)
    split = _split(options)
    refuse_inputs(options.output, [split.path], "--output")
    tier, definition = TIERS[options.tier], split.manifest["definition"]
    train, calibration, test = (int(definition[p]) for p in ("train", "calibration", "test"))
    units = len(lay_out(EXPERIMENTS, tier, split, plugins))
    header = Reproduction(tier, split.name, split.digest, PROTOCOL, train, calibration, test, units)
    selected = lay_out(experiments, tier, split, plugins, options.device)
    header.check_same_data(directory)
    here = results.records() if (directory / RECORDS).exists() and not options.fresh else []
    left = unfinished(selected, here)
    fitted = {u.fit_key for u in left if results.fits.has(u.fit_key, fresh=options.fresh)}
    rows = scored_rows(split)
    if options.verbosity >= 0 or options.plan:
        data = f"split {header.split}, digest {header.split_digest[:12]}"
        console.print(f"reproduction, tier {header.tier.name}: {data}")
        print_table(stages(selected, left, rows, fitted, jobs), console)
    if options.plan:
        return 0
    results.prepare()
    keep_inputs(directory, header, split)
    outcome = RunOutcome([])
    progress = Progress(left, rows, jobs, console.print if options.verbosity >= 0 else None, fitted)
    if left:
        limits = Limits(options.timeout, options.memory)
        settings = RunSettings(
            jobs=jobs,
            limits=limits,
            fresh=options.fresh,
            deadline=options.budget,
            command=options.invocation,
        )
        plan = Plan(split.name, split.digest, tuple(left), split.groups)
        outcome = run(plan, split, plugins, settings, results, observers=[progress])
    say_notes(results.notes)
    code = _render(options, header, results.records() if (directory / RECORDS).exists() else [])
    if outcome.left:
        why = "interrupted" if outcome.interrupted else "the budget is used up"
        left_over = (
            f"{counted(outcome.left, 'unit(s)')} left, about {duration(progress.remaining())}"
        )
        console.print(f"{why}: {left_over}; the same command goes on")
    return 2 if outcome.left else code


def _split(options: Options) -> Split:
    """Open the split, building it first where that was asked for."""
    name = options.split or TIERS[options.tier].split
    try:
        return load_split(name)
    except SplitNotFoundError as error:
        if name not in SPLITS:
            raise
        if not options.build:
            raise SplitNotFoundError(f"{error}, or let reproduce do so with --build") from None
    load("oodd_recording.commands:record_split")(SPLITS[name], options)
    return load_split(name)


def _render(options: Options, header: Reproduction, records: list[Record]) -> int:
    """Write tables and figures; 1 when units failed, as far as there are records."""
    console, directory = make_console(), options.output
    returns = load_returns(directory, header.split_digest)
    other = Other.load(options.beside) if options.beside else None
    try:
        publish(directory, header, records, returns, figures=not options.no_figures, other=other)
    except MissingExtraError as error:
        console.print(f"without figures: {error}")
        publish(directory, header, records, returns, figures=False, other=other)
    if options.verbosity >= 0:
        console.print(f"tables, figures and claims in {directory / 'README.md'}")
    return int(not all(r.ok for r in header.select(records)))
