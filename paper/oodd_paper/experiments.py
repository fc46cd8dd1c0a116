"""The paper's tables and figures, its numbers, and tiers, all from ``experiments.toml``."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, Self, TypeVar

import numpy as np

from oodd_eval.data.bounded import read_toml
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, TABLE1, paper_tables
from oodd_eval.errors import OoddError, ResultsError
from oodd_eval.names import check_known
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN

_T = TypeVar("_T")

FILE: Final = Path(__file__).with_name("experiments.toml")

MEAN: Final = "mean"
TABLE_2: Final = "table-2"  # returns of the policies, which need no detectors


class Series(NamedTuple):
    """A column of a table or a colour of a figure: one setting, or the mean over several."""

    label: str
    settings: tuple[Setting, ...]


class Scope(NamedTuple):
    """A mean over anomalies: an id that is also in CSV files, a title, the anomalies."""

    id: str
    title: str
    anomalies: tuple[str, ...]


class Grid(NamedTuple):
    """The arrangement of panels: width of the figure, height of a panel, who shares an axis."""

    axis: str = "rows"
    panel: str = "{metric}, {scope} anomalies"
    columns: int = 2
    width: float = 9.6
    height: float = 2.3
    share: Literal["row", "all", "none"] = "row"


_CHOICES: Final = {
    "across": ("series", "scopes"),
    "rows": ("both", "environments", "mean"),
    "axis": ("rows", "scopes", "horizons"),
    "share": ("row", "all", "none"),
}


@dataclass(frozen=True, slots=True)
class Experiment:
    """One table or figure; the head of ``experiments.toml`` says what the fields mean."""

    id: str
    title: str
    section: str
    series: tuple[Series, ...]
    scopes: tuple[Scope, ...]
    metrics: tuple[str, ...]
    beyond: tuple[str, ...] = ()
    across: str = "series"
    rows: str = "both"
    environments: tuple[str, ...] = tuple(ENVIRONMENTS)
    same_seeds: bool = False
    picture: Grid = field(default_factory=Grid)
    note: str = ""

    @property
    def settings(self) -> list[Setting]:
        """Every setting once, in order."""
        return list(dict.fromkeys(s for one in self.series for s in one.settings))

    @property
    def row_titles(self) -> dict[str, str]:
        """Titles of the rows by environment, or `MEAN`."""
        titles = (
            {} if self.rows == "mean" else {e: ENVIRONMENTS[e].title for e in self.environments}
        )
        return titles if self.rows == "environments" else titles | {MEAN: "Mean"}

    @classmethod
    def of(cls, *, series: Mapping[str, list[str]], scopes: list[str], **others: Any) -> Self:
        """Make an experiment from a table of ``experiments.toml``."""
        grid = others.pop("picture", {})
        plain: Any = {k: tuple(v) if isinstance(v, list) else v for k, v in others.items()}
        check_known("environment", ENVIRONMENTS, *plain.get("environments", ()))
        for key, known in _CHOICES.items():
            check_known(key, known, (plain | grid).get(key, known[0]))
        by_label = tuple(Series(k, tuple(map(Setting.parse, v))) for k, v in series.items())
        return cls(series=by_label, scopes=tuple(map(scope, scopes)), picture=Grid(**grid), **plain)


@dataclass(frozen=True, slots=True)
class Tier:
    """A split and numbers of detector seeds: at Δ = 1, and where scoring is expensive."""

    name: str
    split: str
    seeds_near: int
    seeds_far: int

    def seeds(self, setting: Setting) -> range:
        """Return the detector seeds of a setting; deterministic detectors have one."""
        if setting.detector in CONTROLS:
            return range(1)
        expensive = setting.horizon > 1 or "samples" in setting.overrides  # a sweep of sizes
        return range(self.seeds_far if expensive else self.seeds_near)


def scope(name: str) -> Scope:
    """Return a mean over anomalies by its id: ``all``, a group, or an anomaly."""
    if name in GROUPS:
        within = tuple(a for a in TABLE1 if ANOMALIES[a].group == name)
        return Scope(name, f"{name.capitalize()}-injected", within)
    if name == "all":
        return Scope(name, "All anomalies", TABLE1)
    check_known("scope", ("all", *GROUPS, *TABLE1), name)
    return Scope(name, ANOMALIES[name].title, (name,))


def read_tables(file: Path, kind: str, make: Callable[..., _T]) -> tuple[_T, ...]:
    """Make an object of every table ``[[kind]]`` of a TOML file; ResultsError names a wrong one."""
    tables = read_toml(file, ResultsError).get(kind, [])
    objects: dict[str, _T] = {}
    for number, table in enumerate(tables, start=1):
        name = str(table.get("id") or table.get("name") or number)
        try:
            if name in objects:
                raise ResultsError("an earlier one has the same id")
            objects[name] = make(**table)
        except (OoddError, TypeError, ValueError, AttributeError) as error:
            raise ResultsError(f"{str(file)!r}: {kind} {name!r}: {error}") from None
    return tuple(objects.values())


_TABLES: Final = tomllib.loads(FILE.read_text("utf-8"))
# Deterministic detectors; all experiments but Table 2, in the order of the page.
CONTROLS: Final[tuple[str, ...]] = tuple(_TABLES["controls"])
PAPER: Final[Mapping[str, Mapping[str, Any]]] = _TABLES["paper"]
"""The paper's parameters by detector, where they are not our defaults."""


def of_paper(setting: Setting, parameters: Mapping[str, Any] = MappingProxyType({})) -> Setting:
    """Return a setting that tells what differs from the paper's parameters, not from defaults."""
    paper = PAPER.get(setting.detector, {})
    used = {name: parameters[name] for name in paper if name in parameters} | setting.overrides
    differing = {n: v for n, v in used.items() if n not in paper or v != paper[n]}
    return Setting.of(setting.detector, setting.horizon, differing, rolling=setting.rolling)


EXPERIMENTS: Final = read_tables(FILE, "experiment", Experiment.of)
TIERS: Final = {tier.name: tier for tier in read_tables(FILE, "tier", Tier)}


def settings_of(experiments: Iterable[Experiment]) -> list[Setting]:
    """Return every setting of some experiments once."""
    return list(dict.fromkeys(setting for e in experiments for setting in e.settings))


def paper_number(
    experiment: Experiment, series: Series, environment: str, scope: Scope, metric: str
) -> float:
    """Return what the paper prints for one of our numbers, AUCs as fractions; NaN for nothing.

    The models' means, which a figure of the paper shows without digits, follow from Table 5.
    """
    first, tables = series.settings[0], paper_tables()
    if experiment.id in ("table-5", "figure-models"):
        if first.horizon != 1:
            return NAN
        by_group = tables["table5_groups_delta1"].get(environment, {}).get(metric, {})
        models = [setting.detector for setting in series.settings]
        rows = [by_group.get(group, {}) for group in ([scope.id] if scope.id in GROUPS else GROUPS)]
        if len(models) == 1:
            digits = [row.get(models[0], NAN) for row in rows]
        else:  # the table's average is over all of its models
            digits = [row["avg"] if {*models, "avg"} == row.keys() else NAN for row in rows]
        return float(np.mean(digits)) / (100 if metric == "auc" else 1)
    if (metric, scope.id, len(series.settings)) != ("auc", "all", 1):
        return NAN
    if experiment.id == "table-3":
        name, column = "table3_memory_auc", first.detector
    elif first.detector == "riqn" and "samples" not in first.overrides:
        name, column = "table4_ensemble_auc", str(first.overrides.get("members", 5))
    else:
        return NAN
    row = tables[name].get(environment, {}).get(str(first.horizon), {})
    return float(row.get(column, NAN)) / 100
