"""In which order units are run, and what of them remains: cheap and most informative first."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.data.facts import PROTOCOL
from oodd_eval.data.split import Split
from oodd_eval.paper.costs import Cost, estimate, scored_rows
from oodd_eval.paper.experiments import (
    CONTROLS,
    Experiment,
    Setup,
    Tier,
    row_of,
    setups_of,
)
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.results.directory import fit_key, unit_key
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan, Unit, make_plan

STAGES: Final = (
    "controls",
    "models, Δ = 1",
    "variants of RIQN, Δ = 1",
    "Δ = 10",
    "Δ = 20",
    "more seeds of RIQN, Δ = 1",
    "more seeds of others, Δ = 1",
    "more seeds, Δ > 1",
)
"""What is run one after another, each environment by environment."""


@dataclass(frozen=True, slots=True)
class Work:
    """One unit of the reproduction.

    Attributes
    ----------
    plan
        The unit as a plan of its own.
    stage
        Index into `STAGES`.
    key, fit
        Content keys of its scores and of its fit; units with the same `fit` share it.
    cost
        What it is expected to cost.
    """

    plan: Plan
    stage: int
    key: str
    fit: str
    cost: Cost

    @property
    def unit(self) -> Unit:
        """Detector, settings and environment."""
        return self.plan.units[0]


def lay_out(
    experiments: Sequence[Experiment],
    tier: Tier,
    split: Split,
    plugins: Plugins,
    device: str | None = None,
) -> list[Work]:
    """Return every unit that some experiments need, in the order in which they are to be run.

    Parameters
    ----------
    experiments, tier, split, plugins
        What is to be run, on what, by what.
    device
        Where networks compute; None leaves it to the detectors.

    Raises
    ------
    UnknownNameError
        When one of the paper's detectors is not installed.
    """
    rows = {e: scored_rows(split, e) for e in split.environments}
    found = [
        _work(unit, setup, split, plugins, rows[unit.environment])
        for setup in setups_of(experiments)
        for unit in make_plan(
            plugins,
            split=split.name,
            split_digest=split.digest,
            detectors=[setup.detector],
            environments=split.environments,
            horizons=[setup.horizon],
            seeds=tier.seeds(setup),
            parameters={**dict(setup.parameters), **_placed(setup, plugins, device)},
        ).units
    ]
    place = {environment: i for i, environment in enumerate(split.environments)}
    return sorted(found, key=lambda w: (w.stage, place[w.unit.environment]))


def _work(unit: Unit, setup: Setup, split: Split, plugins: Plugins, rows: int) -> Work:
    plan = Plan(split.name, split.digest, (unit,))
    offer = plugins.offer(unit.detector)
    return Work(
        plan=plan,
        stage=_stage(setup, unit.seed),
        key=unit_key(plan, unit, offer).text,
        fit=fit_key(plan, unit, offer),
        cost=estimate(unit, rows),
    )


def _placed(setup: Setup, plugins: Plugins, device: str | None) -> dict[str, str]:
    """Return the parameter ``device`` for a detector that has one and where it is not default."""
    default = plugins.offer(setup.detector).spec.parameters.get("device", device)
    return {} if device is None or device == default else {"device": device}


def _stage(setup: Setup, seed: int) -> int:
    if setup.detector in CONTROLS:
        return 0
    near = setup.horizon == 1
    if seed:
        own = setup.detector in ("riqn", "riqn-ms") and not setup.parameters
        return 7 if not near else 5 if own else 6
    if near:
        return 2 if setup.parameters or setup.detector == "n-riqn" else 1
    return 3 if setup.horizon == 10 else 4


def own_records(
    records: Iterable[Record], digest: str, tier: Tier, setups: Sequence[Setup]
) -> list[Record]:
    """Return the records that belong to a reproduction: its whole data, its setups, its seeds."""
    seeds: dict[Setting, range] = {setup.entry: tier.seeds(setup) for setup in setups}
    return [
        r
        for r in records
        if (r.split_digest, r.protocol, r.limit) == (digest, PROTOCOL, None)
        and r.seed in seeds.get(row_of(r), ())
    ]


def finished_keys(records: Iterable[Record]) -> dict[str, set[str]]:
    """Return by content key the anomalies that have been scored without failure."""
    found: dict[str, set[str]] = {}
    for r in records:
        if r.ok:
            found.setdefault(r.scores, set()).add(r.anomaly)
    return found


def is_done(work: Work, finished: dict[str, set[str]]) -> bool:
    """Whether all cells of a unit have been scored."""
    return set(work.unit.anomalies) <= finished.get(work.key, set())


def remaining_seconds(works: Iterable[Work], fitted: Collection[str]) -> float:
    """Return seconds on one core for these units; a fit is counted once, and not if it is kept.

    Parameters
    ----------
    works
        What remains.
    fitted
        Keys of fits that are there already.
    """
    seen = set(fitted)
    total = 0.0
    for work in works:
        total += work.cost.score + (0.0 if work.fit in seen else work.cost.fit)
        seen.add(work.fit)
    return total


def next_batch(works: Sequence[Work], seconds: float, fitted: Collection[str]) -> list[Work]:
    """Return the first units that make up so many seconds on one core, at least one.

    Within the batch, units that bring a new fit go first and long ones before short ones: then no
    worker waits for a fit that another is at, and all finish at about the same time.
    """
    chosen: list[Work] = []
    for work in works:
        if chosen and remaining_seconds([*chosen, work], fitted) > seconds:
            break
        chosen.append(work)
    seen = set(fitted)
    first: list[Work] = []
    second: list[Work] = []
    for work in chosen:
        (second if work.fit in seen else first).append(work)
        seen.add(work.fit)
    first.sort(key=lambda w: -(w.cost.fit + w.cost.score))
    second.sort(key=lambda w: -w.cost.score)
    return [*first, *second]
