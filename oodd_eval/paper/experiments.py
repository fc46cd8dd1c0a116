"""What is run and shown: the tables and figures of Danesh & Fern (2021), and the tiers.

A setup is one row of a comparison, a detector with its horizon and parameters. An experiment lays
setups out beside one another; experiments share setups, and each is run once.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record


@dataclass(frozen=True, slots=True)
class Setup:
    """A detector with its horizon and those parameters that are not at their default."""

    detector: str
    horizon: int = 1
    parameters: tuple[tuple[str, Any], ...] = ()

    @property
    def entry(self) -> Setting:
        """The row of a board that its records belong to."""
        return _entry(self.detector, self.horizon, self.parameters)


@functools.cache
def _entry(detector: str, horizon: int, parameters: tuple[tuple[str, Any], ...]) -> Setting:
    return Setting.of(detector, horizon, dict(parameters))


def row_of(record: Record) -> Setting:
    """Return the row that a record belongs to."""
    return record.setting


@dataclass(frozen=True, slots=True)
class Series:
    """A column or a colour: one setup, or the mean over several."""

    label: str
    setups: tuple[Setup, ...]


@dataclass(frozen=True, slots=True)
class Scope:
    """A mean over anomalies: an id that is also in the CSV file, a title, the anomalies."""

    id: str
    title: str
    anomalies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Experiment:
    """One table or figure.

    Attributes
    ----------
    id, title, place
        Its name on the command line, its heading, and where the paper has it.
    series, environments, scopes
        What is compared, where, and over which anomalies.
    metrics, beyond
        The paper's metrics, and those that it lacks.
    across
        What stands side by side in a table (and shares a panel): series or scopes.
    rows
        Whether there is a row per environment, one for the mean over them, or both.
    same_seeds
        Whether only those detector seeds count that all series have: where series share their fits,
        a seed that one of them lacks would be taken for a difference.
    note
        What a reader should know.
    """

    id: str
    title: str
    place: str
    series: tuple[Series, ...]
    scopes: tuple[Scope, ...]
    metrics: tuple[str, ...]
    beyond: tuple[str, ...] = ()
    across: Literal["series", "scopes"] = "series"
    rows: Literal["environments", "mean", "both"] = "both"
    environments: tuple[str, ...] = tuple(ENVIRONMENTS)
    same_seeds: bool = False
    note: str = ""

    @property
    def setups(self) -> list[Setup]:
        """Every setup once, in order."""
        return list(dict.fromkeys(setup for s in self.series for setup in s.setups))


ALL: Final = Scope("all", "All anomalies", tuple(ANOMALIES))
BY_GROUP: Final = {
    group: Scope(
        group,
        f"{group.capitalize()}-injected",
        tuple(a.id for a in ANOMALIES.values() if a.group == group),
    )
    for group in GROUPS
}
GROUPED: Final = tuple(BY_GROUP.values())
SINGLE: Final = tuple(Scope(a.id, a.title, (a.id,)) for a in ANOMALIES.values())

HORIZONS: Final = (1, 10, 20)
SAMPLES: Final = (4, 8, 32, 128)
MODELS: Final = {"riqn": "RIQN", "riqn-ms": "RIQN+MS", "npn": "NPN", "rf": "RF"}
CONTROLS: Final = {
    "mewma": "MEWMA",
    "persistence": "persistence",
    "clock": "clock",
    "random": "random",
}

RIQN: Final = Setup("riqn")


def with_samples(samples: int) -> Setup:
    """Return RIQN with M samples; 8 is its default."""
    return RIQN if samples == 8 else Setup("riqn", 1, (("samples", samples),))


def with_members(members: int, horizon: int) -> Setup:
    """Return RIQN with e networks; 5 is its default."""
    return Setup("riqn", horizon, () if members == 5 else (("members", members),))


EXPERIMENTS: Final = (
    Experiment(
        "table-3",
        "Role of memory: RIQN against N-RIQN, which has a window instead",
        "Table 3 and section 4.2",
        tuple(
            Series(f"Δ = {h}: {label}", (Setup(detector, h),))
            for h in HORIZONS
            for detector, label in (("riqn", "RIQN"), ("n-riqn", "N-RIQN"))
        ),
        (ALL,),
        ("auc",),
        ("auc_matched",),
        note="The paper has Acrobot and Ant, Δ = 1 and 10, and says that Δ = 20 is similar.",
    ),
    Experiment(
        "table-4",
        "Ensemble size: one network against five",
        "Table 4",
        tuple(
            Series(f"Δ = {h}: e = {members}", (with_members(members, h),))
            for h in (1, 10)
            for members in (1, 5)
        ),
        (ALL,),
        ("auc",),
        ("auc_matched",),
    ),
    Experiment(
        "table-5",
        "Models by group of anomalies, Δ = 1",
        "Table 5",
        (
            *(Series(label, (Setup(detector),)) for detector, label in MODELS.items()),
            Series("AVG", tuple(Setup(detector) for detector in MODELS)),
        ),
        GROUPED,
        ("auc", "delay", "far"),
        ("auc_matched", "auc_null", "delay_censored", "missed", "missed_at_1pct"),
        note="At Δ = 1 RIQN and RIQN+MS are the same by the paper's definition: mean sampling "
        "acts on the steps of a rollout, and there is one.",
    ),
    Experiment(
        "figure-horizon",
        "Horizon Δ = 1, 10, 20 of RIQN by environment and anomaly",
        "Figure “How changing the prediction horizon affects anomaly detection”",
        tuple(Series(f"Δ = {h}", (Setup("riqn", h),)) for h in HORIZONS),
        (*SINGLE, ALL),
        ("auc",),
        ("auc_matched",),
        across="scopes",
        same_seeds=True,
    ),
    Experiment(
        "figure-models",
        "Models, mean over all environments and anomalies",
        "Figure “Average AUC of different models across all settings”",
        tuple(
            Series(f"Δ = {h}: {label}", (Setup(detector, h),))
            for h in HORIZONS
            for detector, label in MODELS.items()
        ),
        (ALL, *GROUPED),
        ("auc",),
        ("auc_matched",),
        across="scopes",
        rows="mean",
        note="The paper's numbers at Δ = 1 are means of its Table 5; its figure has none.",
    ),
    Experiment(
        "figure-samples",
        "Sampling size M = 4, 8, 32, 128 of RIQN, Δ = 1",
        "Appendix A, figure “The impact of sampling size”",
        tuple(Series(f"M = {m}", (with_samples(m),)) for m in SAMPLES),
        (*SINGLE, ALL),
        ("auc",),
        ("auc_matched",),
        across="scopes",
        same_seeds=True,
    ),
    Experiment(
        "delays",
        "Delays and false alarms of RIQN at Δ = 1, 10, 20",
        "Section 4.3, “not shown” in the paper",
        tuple(Series(f"Δ = {h}", (Setup("riqn", h),)) for h in HORIZONS),
        GROUPED,
        ("delay", "far"),
        ("delay_censored", "missed"),
        same_seeds=True,
    ),
    Experiment(
        "controls",
        "Beyond the paper: rows without a learned dynamics model beside its models, Δ = 1",
        "not in the paper",
        tuple(Series(label, (Setup(detector),)) for detector, label in (MODELS | CONTROLS).items()),
        GROUPED,
        ("auc",),
        ("auc_matched",),
        note="The clock, s = t, has an AUC of 100 by construction: the paper's AUC rewards "
        "whatever grows with time. Its matched AUC is 50.",
    ),
)
"""All experiments but Table 2, in the order of the report."""

TABLE_2: Final = "table-2"
"""Returns of the policies: from the split's data; no detector is needed."""

IDS: Final = (TABLE_2, *(e.id for e in EXPERIMENTS))
"""What ``--only`` may name."""


@dataclass(frozen=True, slots=True)
class Tier:
    """How much is run.

    Attributes
    ----------
    name, split
        On the command line; `split` is what it is meant for.
    seeds_near, seeds_far
        Numbers of detector seeds at Δ = 1, and where scoring is dear: at Δ > 1 and in the sweep
        of sampling sizes.
    """

    name: str
    split: str
    seeds_near: int
    seeds_far: int

    def seeds(self, setup: Setup) -> range:
        """Return the detector seeds of a setup; controls have no training to vary, and one."""
        if setup.detector in CONTROLS:
            return range(1)
        dear = setup.horizon > 1 or "samples" in dict(setup.parameters)
        return range(self.seeds_far if dear else self.seeds_near)


TIERS: Final = {
    tier.name: tier
    for tier in (
        Tier("full", "standard", 3, 3),
        Tier("reduced", "reduced", 3, 1),
        Tier("mini", "mini", 3, 1),
    )
}


def setups_of(experiments: Iterable[Experiment]) -> list[Setup]:
    """Return every setup of some experiments once."""
    return list(dict.fromkeys(setup for e in experiments for setup in e.setups))
