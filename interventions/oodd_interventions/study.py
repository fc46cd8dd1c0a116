"""A study of interventions: every detector, environment, condition and act, with shared arms.

Fits and cells are files of the output directory, whole or absent, so that an interrupted study goes
on where it was. Detectors that fail are reported with the reason, and the others go on.
"""

from __future__ import annotations

import functools
import itertools
import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from oodd_common.naming import ReadingModel
from oodd_live.handle import DetectorHandle, columns_of
from oodd_recording.build import MOST_CANDIDATES, Progress, workers
from oodd_recording.closed_loop import (
    SHORTEST_TWIN,
    RecordedEpisode,
    Setup,
    measure,
    record_anomalous,
)
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of

from oodd_eval.data import layout
from oodd_eval.data.facts import Group, SplitDefinition
from oodd_eval.data.files import only_writer, write_text
from oodd_eval.data.offers import OfferedSpecs
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.registry import EnvironmentSpec, environment_spec, inner_of
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import SimulationError, UnknownNameError, UsageError
from oodd_eval.metrics.alarms import Calibration, GuaranteedAlarm
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.names import comma_list, listed, read, select, whole_number
from oodd_eval.plugins.contract import StorableDetector
from oodd_eval.plugins.discovery import Plugins, describe, discover
from oodd_eval.plugins.state import pack, read_state, write_state
from oodd_eval.prose import terminal_text
from oodd_eval.results.board import grouped
from oodd_eval.results.record import Record, gather
from oodd_eval.scoring.plan import Unit, make_plan, source_digest
from oodd_interventions.acts import ACTS
from oodd_interventions.columns import InterventionRecord, records_of
from oodd_interventions.loop import FittedDetector, Loop, LoopArm, LoopPair, run_cell
from oodd_interventions.page import sections
from oodd_interventions.situation import ActSpec

SCHEMA: Final = "oodd-eval/intervention/1"
IDENTITY: Final = (
    "detector",
    "detector_version",
    "plugin",
    "plugin_source",
    "parameters",
    "overrides",
    "seed",
    "horizon",
    "environment",
    "group",
    "split",
    "split_digest",
)
"""Fields of a record that say what a cell is of."""
BASE: Final = 680
"""Seeds of a study are this number in millions, and those after it: no split's, by default."""

_SHIPPED: Final = ("oodd_interventions.", "oodd_worlds.")

Names = str | Sequence[str]


@dataclass(frozen=True, slots=True)
class Interventions:
    """What came of a study.

    Attributes
    ----------
    output
        Its directory.
    cells
        Raw cells as the files have them, in the order environments x conditions x acts x detectors.
    reasons
        Why a cell is missing, by ``ENV/DETECTOR`` or ``ENV/DETECTOR/CONDITION--ACT``, and what is
        wrong with broken plug-ins.
    """

    output: Path
    cells: Sequence[Mapping[str, Any]]
    reasons: Mapping[str, str]

    @property
    def records(self) -> list[InterventionRecord]:
        """Records of the cells, see `oodd_interventions.columns`."""
        return records_of(self.cells)

    def __str__(self) -> str:
        """Return the tables as a terminal shows them."""
        return terminal_text(sections(self.records))


@dataclass(frozen=True, slots=True)
class Study:
    """What all cells share: split, directory, episodes and the level of alarms."""

    split: Path
    output: Path
    seeds: int
    base: int
    level: float

    def fit_file(self, unit: Unit) -> Path:
        """Return the file of a detector's fit and alarm."""
        # The alarm's threshold is of scores, which more parameters decide than a fit.
        name = f"{unit.scores_key}-{100 * self.level:g}.npz"
        return self.output / "fits" / unit.environment / name


@dataclass(frozen=True, slots=True)
class StudyCell:
    """A detector in an environment, a condition and an act; `record` says which."""

    study: Study
    unit: Unit
    record: Record
    act: ActSpec

    @property
    def file(self) -> Path:
        """Its file, which is whole or absent."""
        name = self.unit.setting.detector.replace(":", "-")  # as a directory can have it
        directory = self.study.output / "cells" / self.unit.environment / name
        return directory / f"{self.record.condition}--{self.act.name}.json"

    def identity(self) -> dict[str, Any]:
        """Return what it is of, as JSON has it."""
        environment, study = self.unit.environment, self.study
        cap = _definition(study.split, environment).episode_cap or info_of(environment).episode_cap
        identity = {name: getattr(self.record, name) for name in IDENTITY}
        identity |= {"schema": SCHEMA, "anomaly": str(self.record.condition), "cap": cap}
        identity |= {"act": self.act.name, "level": study.level, "base": study.base}
        if source := source_of(self.act):
            identity["act_source"] = source
        plain: dict[str, Any] = json.loads(json.dumps(identity))
        return plain

    def read(self) -> dict[str, Any] | None:
        """Return the cell that an earlier study of the same wrote; None without one."""
        with suppress(OSError, ValueError, TypeError):
            cell: dict[str, Any] = json.loads(self.file.read_text(encoding="utf-8"))
            if cell | self.identity() == cell and len(cell["episodes"]) == self.study.seeds:
                return cell
        return None


def intervene(
    detectors: Names,
    environments: Names,
    *,
    split: str | Path = "mini",
    kinds: Names | None = None,
    acts: Names | None = None,
    seeds: int = 10,
    base: int = BASE,
    level: float = 0.05,
    parameters: Mapping[str, Any] | None = None,
    jobs: int | None = None,
    fresh: bool = False,
    output: str | Path = "oodd-interventions",
    observer: Progress = lambda _done, _total, _text: None,
) -> Interventions:
    """Run the closed loop with acts at alarms: what detectors' alarms save.

    Cells that are in `output` already are taken from there. Processes import the script that calls
    it, so that the call stands under ``if __name__ == "__main__":``.

    Parameters
    ----------
    detectors, environments
        Names, or texts as on the command line: comma lists and globs.
    split
        Name or path of a recorded split, whose training and calibration episodes, noise, cap and
        strengths are used.
    kinds
        Kinds of anomalies or conditions; by default all of the split.
    acts
        Names of acts; by default all that suit.
    seeds, base
        Episodes a cell, and the millions of the first one's seed.
    level
        Share of nominal episodes with an alarm, at most.
    parameters
        As those of `oodd_eval.evaluate`.
    jobs
        Processes; by default one per core.
    fresh
        Whether to fit and run again what `output` has already.
    output
        Directory of fits and cells.
    observer
        Called with the cells that are done, all cells, and what was done last.

    Returns
    -------
    Interventions

    Raises
    ------
    UsageError
        For unknown names, other numbers, and a split that was not recorded.
    """
    seeds = read("seeds", functools.partial(whole_number, least=1), seeds)
    base = read("base", functools.partial(whole_number, least=0), base)
    if not 0 < level < 1:
        raise UsageError(f"level is {level!r}, expected a share of episodes between 0 and 1")
    opened, plugins = load_split(split), discover()
    detector_names = plugins.select(comma_list(detectors), opened.columns)
    if recorded := [name for name in detector_names if columns_of(name)]:
        raise UsageError(
            f"{recorded[0]} is a column that is recorded, and no monitor computes it in a closed "
            "loop: name detectors of sensors"
        )
    environment_names, kinds = opened.select(comma_list(environments), comma_list(kinds or "all"))
    for environment in environment_names:
        _check_recorded(opened, environment, base)
    specs = plugins.custom_specs
    pairs = ((e, condition) for e in environment_names for condition in opened.conditions(e))
    long_kinds = [opened.long_name(e, condition.anomaly) for e, condition in pairs]
    specs.register(map(opened.long_name, environment_names), long_kinds)
    for environment in environment_names:
        measure(environment, load_policy(environment))
    plan = make_plan(
        plugins,
        split=opened,
        detectors=detector_names,
        environments=environment_names,
        anomalies=kinds,
        parameters=parameters,
    )
    offered = offered_acts(plugins)
    broken = {f"plug-in {b.plugin!r} of {b.distribution}": b.reason for b in plugins.broken}
    act_names = _selected(comma_list(acts or "all"), offered, broken)
    study = Study(opened.path, Path(output), seeds, base, level)
    acts_of = functools.partial(suiting, offered, act_names, specs)
    cells = [
        StudyCell(study, unit, plan.blank(unit, condition, status="ok"), act)
        for unit in plan.units
        for condition in unit.conditions
        for act in acts_of(environment_spec(unit.environment), plan.groups[condition.anomaly])
    ]
    with only_writer(study.output):
        for cell in cells if fresh else ():
            for file in (cell.file, study.fit_file(cell.unit)):
                file.unlink(missing_ok=True)
        reasons = broken | _run(cells, jobs, observer)
    done = (cell.read() for cell in cells)
    return Interventions(study.output, [cell for cell in done if cell is not None], reasons)


def offered_acts(plugins: Plugins) -> list[tuple[ActSpec, str]]:
    """Return the shipped acts and those of plug-ins, with the plug-in; several may share a name."""
    acts = [(act, "") for act in ACTS]
    _ = plugins.offers  # loads all
    for plugin in list(plugins.loaded.values()):
        with plugins.blaming(plugin.point):
            acts += [(act, plugin.point.name) for act in plugin.listed("oodd_acts", ActSpec)]
    return acts


def _selected(
    names: str, offered: Sequence[tuple[ActSpec, str]], broken: Mapping[str, str]
) -> list[str]:
    """Return short or long names of acts; those that nobody offers may be a broken plug-in's."""
    short = dict.fromkeys(act.name for act, _ in offered)
    try:
        return select("act", names, [*short, *(f"{p}/{act.name}" for act, p in offered if p)])
    except UnknownNameError as error:
        if broken:
            plugins = "; ".join(f"{plugin}: {reason}" for plugin, reason in broken.items())
            raise UsageError(f"{error}; broken is {plugins}") from error
        raise


def source_of(act: ActSpec) -> str:
    """Return the digest of a foreign act's code, so that a change of it is run; else nothing."""
    module = getattr(inner_of(act.make), "__module__", "oodd_interventions.")
    return "" if module.startswith(_SHIPPED) else source_digest(module)


def suiting(
    acts: Sequence[tuple[ActSpec, str]],
    names: Sequence[str],
    specs: OfferedSpecs,
    environment: EnvironmentSpec,
    group: Group,
) -> tuple[ActSpec, ...]:
    """Return the named acts that suit, of each short name one.

    First come those for the environment, then those of its plug-in, then the shipped ones. Of one
    plug-in the last is taken; `UsageError` where two plug-ins are left.
    """
    suited: dict[str, dict[tuple[bool, ...], dict[str, ActSpec]]] = {}
    for act, plugin in acts:
        is_named = act.name in names or f"{plugin}/{act.name}" in names
        suits = specs.is_for(act, plugin, environment) and group in act.groups
        if is_named and suits:
            rank = bool(act.environments), plugin == environment.plugin, not plugin
            suited.setdefault(act.name, {}).setdefault(rank, {})[plugin] = act
    first = [by_rank[max(by_rank)] for by_rank in suited.values()]
    for by_plugin in first:
        if len(by_plugin) > 1:
            long = listed([f"{plugin}/{act.name}" for plugin, act in by_plugin.items()])
            raise UsageError(f"several plug-ins have an act of one name, {long}: name one of them")
    return tuple(act for by_plugin in first for act in by_plugin.values())


def _run(cells: Sequence[StudyCell], jobs: int | None, observer: Progress) -> dict[str, str]:
    """Fit detectors, then run the cells that are missing; return why some could not be run."""
    missing = [cell for cell in cells if cell.read() is None]
    done, reasons = len(cells) - len(missing), dict[str, str]()
    with workers(jobs) as pool:
        units = {_name_of(cell.unit): (cell.study, cell.unit) for cell in missing}
        fits = {pool.submit(fit, *units[name]): name for name in units}
        for fitting in as_completed(fits):
            failure = _failure(fitting, fits[fitting])
            observer(done, len(cells), f"{fits[fitting]} {'failed' if failure else 'fitted'}")
            reasons |= failure
        fitted = [cell for cell in missing if _name_of(cell.unit) not in reasons]
        batches = grouped(fitted, lambda c: f"{c.unit.environment}/{c.record.condition}")
        tasks = {pool.submit(run_cells, batch): name for name, batch in batches.items()}
        for future in as_completed(tasks):
            reasons |= _failure(future, tasks[future]) or future.result()
            done += len(batches[tasks[future]])
            observer(done, len(cells), tasks[future])
    return reasons


def _failure(future: Future[Any], name: str) -> dict[str, str]:
    """Return why something in a process failed, by its name; nothing where it did not."""
    error = future.exception()
    if isinstance(error, BrokenProcessPool):
        raise SimulationError(
            "a process of the study ended all at once, for want of memory or by a detector's or an "
            "act's native code: the same command goes on; take fewer jobs, or leave out the last "
            "detector without cells; in a script call intervene under if __name__ == '__main__'"
        ) from error
    return {name: describe(error)} if error else {}


def fit(study: Study, unit: Unit) -> None:
    """Fit a detector and keep its state with its alarm, if it can hand its state over."""
    detector, file = _handle(unit).detector, study.fit_file(unit)
    if file.exists() or not isinstance(detector, StorableDetector):
        return
    fitted = _fitted(study, unit)
    scale = fitted.rule.standardization
    rule = [fitted.rule.threshold, *(scale.numbers if scale else ())]
    write_state(file, pack({"rule": rule, **fitted.handle.fitted()}))


def _fitted(study: Study, unit: Unit) -> FittedDetector:
    """Fit a detector, and find the threshold of its alarm."""
    handle, data = _handle(unit), _data(study.split, unit.environment)
    handle.fit(data.train)
    scores = [handle.scores(episode) for episode in data.calibration]
    return FittedDetector(handle, Calibration.fit(scores, handle.alarm).rule(study.level))


def _restored(study: Study, unit: Unit) -> FittedDetector:
    """Return what `fit` kept; without a file, fit here."""
    if not (file := study.fit_file(unit)).exists():
        return _fitted(study, unit)
    state, handle = read_state(file).state(), _handle(unit)
    handle.restore(state)
    threshold, *scale = map(float, state["rule"])
    rule = GuaranteedAlarm(Standardization(*scale) if scale else None, threshold)
    return FittedDetector(handle, rule)


def _handle(unit: Unit) -> DetectorHandle:
    """Make a detector, not fitted."""
    setting = unit.setting
    call = (setting.detector, unit.alarm, unit.seed, setting.horizon, unit.parameters)
    return DetectorHandle.make(*call, roles=unit.roles)


_detectors: Final[dict[Path, FittedDetector]] = {}
"""Fitted detectors of this process, by the files of their fits."""


@functools.cache
def _data(split: Path, environment: str) -> EnvironmentData:
    return load_split(split).environment(environment)


@functools.cache
def _loop(split: Path, environment: str) -> Loop:
    """Return policy, noise and cap of a split's environment, and a model of its readings."""
    definition = _definition(split, environment)
    setup = Setup(environment, load_policy(environment), definition.episode_cap, definition.noise)
    return Loop(setup, ReadingModel.fit(list(_data(split, environment).train)))


@functools.cache
def _twins(study: Study, environment: str) -> list[RecordedEpisode]:
    """Record the nominal episodes of a study; short ones give way to the next seed."""
    setup, first = _loop(study.split, environment).setup, study.base * 10**6
    seeds = range(first, first + MOST_CANDIDATES * study.seeds)
    recorded = map(setup.record, seeds)
    whole = (twin for twin in recorded if twin.trajectory.transitions >= SHORTEST_TWIN)
    twins = [*itertools.islice(whole, study.seeds)]
    if len(twins) < study.seeds:
        raise SimulationError(
            f"of {len(seeds)} seeds of {environment} only {len(twins)} have nominal episodes of "
            f"{SHORTEST_TWIN} transitions, expected {study.seeds}: train the policy more"
        )
    return twins


def run_cells(cells: Sequence[StudyCell]) -> dict[str, str]:
    """Run cells of one environment and condition, with shared arms; return why some failed."""
    study, unit, record = cells[0].study, cells[0].unit, cells[0].record
    loop, fault = _loop(study.split, unit.environment), (record.anomaly, record.magnitude)
    pairs = [
        LoopPair(*fault, record.group, twin, record_anomalous(loop.setup, *fault, twin))
        for twin in _twins(study, unit.environment)
    ]
    oracles: dict[str, list[LoopArm]] = {}
    reasons: dict[str, str] = {}
    for cell in cells:
        name, act, file = _name_of(cell.unit), cell.act, study.fit_file(cell.unit)
        if name in reasons:
            continue
        try:
            if file not in _detectors:
                _detectors[file] = _restored(study, cell.unit)
            if act.name not in oracles:
                oracles[act.name] = [loop.oracle(pair, act) for pair in pairs]
            start = time.perf_counter()
            outcome = run_cell(loop, pairs, oracles[act.name], act, _detectors[file])
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  foreign code may raise anything
            failed = f"{name}/{record.condition}--{act.name}" if file in _detectors else name
            reasons[failed] = describe(error)
            continue
        facts = {"provenance": gather(), "seconds": round(time.perf_counter() - start, 3)}
        write_text(cell.file, json.dumps(cell.identity() | facts | outcome))
    return reasons


def _name_of(unit: Unit) -> str:
    """Return the name of a detector in an environment, in reasons."""
    return f"{unit.environment}/{unit.setting.detector}"


def _definition(split: Path, environment: str) -> SplitDefinition:
    """Return what a split's environment was recorded with."""
    return SplitDefinition(**load_split(split).manifest["definition"]).of(environment)


def _check_recorded(split: Split, environment: str, base: int) -> None:
    """Raise `UsageError` unless a split's environment was recorded, from other seeds."""
    if layout.log_facts(split.manifest["environments"][environment]) is not None:
        raise UsageError(
            f"{environment} of split {split.name} was imported from logs: an intervention needs a "
            "simulator, expected a split that was recorded"
        )
    if base == _definition(split.path, environment).seed_base:
        raise UsageError(f"base={base} is that of split {split.name}: expected another one")
