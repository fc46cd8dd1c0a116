"""``oodd-eval reproduce``: the paper from one command."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from oodd_eval.cli import data
from oodd_eval.cli.discovery import discovered, report_broken
from oodd_eval.cli.run import DEVICES
from oodd_eval.cli.terminal import TerminalReporter, make_console
from oodd_eval.data.facts import PROTOCOL, SPLITS
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import MissingExtraError, SplitNotFoundError, UnknownNameError, UsageError
from oodd_eval.names import memory_bytes, seconds, select
from oodd_eval.paper import header as headers
from oodd_eval.paper import returns
from oodd_eval.paper.carry import Outcome, Watch, carry_out
from oodd_eval.paper.costs import duration, scored_rows
from oodd_eval.paper.experiments import EXPERIMENTS, IDS, TIERS, Tier, setups_of
from oodd_eval.paper.gathering import gather
from oodd_eval.paper.header import Header
from oodd_eval.paper.publish import publish, put
from oodd_eval.paper.schedule import (
    STAGES,
    Work,
    finished_keys,
    is_done,
    lay_out,
    own_records,
    remaining_seconds,
)
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.results.tables.tables import Table
from oodd_eval.scoring.runner import Settings, available_cores


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval reproduce``.

    Returns
    -------
    0 when everything asked for is there, 1 when units failed, 2 when units are left because the
    run was interrupted or its budget is used up.
    """
    tier, directory = _tier(options), Path(options.output)
    console = make_console()
    if options.render_only:
        header = headers.load(directory)
        places = [Path(place) for place in options.records or [directory]]
        return _render(options, directory, header, gather(header, places), console)
    if options.records:
        raise UsageError("--records is what --render-only reads; a run reads its own directory")
    results = ResultsDirectory(directory)
    jobs, limits = _jobs(options), Limits(seconds(options.timeout), memory_bytes(options.memory))
    budget = None if options.budget is None else seconds(options.budget)
    chosen = select("table or figure", options.only, IDS)
    plugins = discovered(options.plugins)
    report_broken(plugins)
    split = _split(options, tier)
    device = _device(options)
    wanted = lay_out([e for e in EXPERIMENTS if e.id in chosen], tier, split, plugins, device)
    header = _header(tier, split, plugins)
    headers.check_same_data(directory, header)
    finished = {} if options.fresh else finished_keys(_records(results))
    left = [work for work in wanted if not is_done(work, finished)]
    fitted = set() if options.fresh else _fitted(results)
    if options.verbosity >= 0 or options.plan:
        _say_plan(console, header, wanted, left, fitted, jobs)
    if options.plan:
        return 0
    results.prepare()
    put(directory / headers.FILE, header.dump())
    _keep_returns(directory, split)
    rows = {e: scored_rows(split, e) for e in split.environments}
    tell = console.print if options.verbosity >= 0 else None
    watch = Watch(left, rows, jobs, tell, fitted)
    settings = Settings(jobs=jobs, limits=limits, fresh=options.fresh)
    outcome = carry_out(watch, split, plugins, settings, results, budget=budget)
    code = _render(options, directory, header, _records(results), console)
    return _say_end(console, outcome, watch) or code


def _tier(options: argparse.Namespace) -> Tier:
    if options.tier not in TIERS:
        raise UnknownNameError("tier", options.tier, TIERS)
    return TIERS[options.tier]


def _jobs(options: argparse.Namespace) -> int:
    if options.jobs is not None and options.jobs < 1:
        raise UsageError(f"--jobs is {options.jobs}, expected at least 1")
    return options.jobs or available_cores()


def _device(options: argparse.Namespace) -> str | None:
    device: str | None = options.device
    if device not in (None, *DEVICES):
        raise UsageError(f"--device is {device!r}, expected one of {', '.join(DEVICES)}")
    return device


def _split(options: argparse.Namespace, tier: Tier) -> Split:
    """Open the split, building it first where that was asked for."""
    name = options.split or tier.split
    try:
        return load_split(name)
    except SplitNotFoundError as error:
        if name not in SPLITS:
            raise
        if not options.build:
            raise SplitNotFoundError(f"{error}, or let reproduce do so with --build") from None
    data.build(
        argparse.Namespace(
            name=name, env="all", jobs=options.jobs, output=None, verbosity=options.verbosity,
            train=None, calibration=None, test=None, cap=None, seed_base=None,
        )
    )  # fmt: skip
    return load_split(name)


def _header(tier: Tier, split: Split, plugins: Plugins) -> Header:
    definition = split.manifest["definition"]
    sizes = {part: int(definition[part]) for part in ("train", "calibration", "test")}
    units = len(lay_out(EXPERIMENTS, tier, split, plugins))
    return Header(tier, split.name, split.digest, PROTOCOL, **sizes, units=units)


def _records(results: ResultsDirectory) -> list[Record]:
    return results.records() if (results.path / RECORDS).exists() else []


def _fitted(results: ResultsDirectory) -> set[str]:
    """Return the keys of the fits that are kept; a damaged one is fitted again, unforeseen."""
    place = results.path / "fitted"
    return {path.name for path in place.iterdir()} if place.is_dir() else set()


def _keep_returns(directory: Path, split: Split) -> None:
    """Read the returns for Table 2 once; they are in the split and not in records."""
    path = directory / returns.FILE
    if returns.load(path, split.digest) is None:
        put(path, returns.dump(returns.collect(split), split.digest))


def _render(
    options: argparse.Namespace,
    directory: Path,
    header: Header,
    records: list[Record],
    console: Console,
) -> int:
    """Write tables and figures; 1 when units failed, as far as there are records."""
    found = returns.load(directory / returns.FILE, header.split_digest)
    try:
        publish(directory, header, records, found, pictures=options.figures)
    except MissingExtraError as error:
        console.print(f"without figures: {error}")
        publish(directory, header, records, found, pictures=False)
    if options.verbosity >= 0:
        console.print(f"tables, figures and claims in {directory / 'README.md'}")
    own = own_records(records, header.split_digest, header.tier, setups_of(EXPERIMENTS))
    return int(not all(r.ok for r in own))


def _say_plan(
    console: Console,
    header: Header,
    wanted: list[Work],
    left: list[Work],
    fitted: set[str],
    jobs: int,
) -> None:
    """Print what remains, stage by stage, and how long it takes."""
    console.print(
        f"reproduction, tier {header.tier.name}: split {header.split}, digest "
        f"{header.split_digest[:12]}"
    )
    rows = []
    seen = set(fitted)
    for stage, title in enumerate(STAGES):
        units = [w for w in wanted if w.stage == stage]
        open_ = [w for w in left if w.stage == stage]
        time = remaining_seconds(open_, seen) / jobs
        seen |= {w.fit for w in open_}
        if units:
            rows.append([title, str(len(units)), str(len(units) - len(open_)),
                         str(len(open_)), duration(time) if open_ else ""])  # fmt: skip
    total = duration(remaining_seconds(left, fitted) / jobs) if left else ""
    rows.append(["all", str(len(wanted)), str(len(wanted) - len(left)), str(len(left)), total])
    on = f"time on {jobs} core{'s' if jobs > 1 else ''}"
    TerminalReporter(console).table(
        Table("What remains", ["", "units", "done", "to do", on], rows)
    )  # fmt: skip


def _say_end(console: Console, outcome: Outcome, watch: Watch) -> int:
    """Say what is left; return 2 when something is, 0 otherwise."""
    if not outcome.left:
        return 0
    why = "interrupted" if outcome.interrupted else "the budget is used up"
    console.print(
        f"{why}: {outcome.left} units left, about {duration(watch.remaining())}; "
        "the same command goes on"
    )
    return 2
