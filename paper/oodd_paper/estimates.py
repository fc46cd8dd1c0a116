"""Numbers with intervals: means of metrics over cells, and paired differences of such means.

Every number is a weighted sum of means, such as RIQN's AUC minus NPN's. Its interval resamples test
trajectories, the same for all cells of an environment; detector seeds are fixed. Numbers are
computed as arrays of the value and then its resamples.
"""

import functools
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from oodd_eval.metrics import bootstrap
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import RESAMPLES, Samples, mean_samples
from oodd_eval.results.board import contribution
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.render.tabular import number
from oodd_paper.experiments import MEAN, Experiment, Scope, Series, paper_number, scope
from oodd_paper.inputs import KINDS, Returns


@dataclass(frozen=True, slots=True)
class Side:
    """One side of a difference: a weight times the mean over settings and anomalies."""

    weight: float
    settings: tuple[Setting, ...]
    anomalies: tuple[str, ...]

    @classmethod
    def of(cls, weight: float, anomalies: str | list[str], settings: Sequence[str] = ()) -> "Side":
        """Make a side from texts: ids of anomalies or groups, and settings as they are printed."""
        names = [anomalies] if isinstance(anomalies, str) else anomalies
        over = tuple(a for name in names for a in scope(name).anomalies)
        return cls(weight, tuple(map(Setting.parse, settings)), over)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over `environments` of the `expected` ones, with its 95 % interval.

    Each has at least `seeds` detector seeds. Values are NaN where undefined or not run, and where
    a cell failed: `state` is the status of the first such.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    environments: int = 0
    expected: int = 0
    seeds: int = 0
    state: str = ""

    @property
    def ends(self) -> tuple[float, float, float]:
        """The value and both ends of its interval."""
        return self.value, self.low, self.high

    @property
    def columns(self) -> dict[str, str]:
        """Its texts for CSV."""
        ends = zip(("value", "low", "high"), map(number, self.ends), strict=True)
        return {**dict(ends), "environments": str(self.environments), "seeds": str(self.seeds)}

    @property
    def partial(self) -> bool:
        """True if environments are missing from the mean."""
        return 0 < self.environments < self.expected


def _estimate(
    samples: Sequence[Samples], sizes: Sequence[int], expected: int, seeds: int = 0
) -> Estimate:
    """Return the mean over those of the expected environments where there is a number."""
    # `sizes` are the numbers of test trajectories by environment.
    if not samples:
        return Estimate(expected=expected)
    mean = mean_samples(samples)
    defined = sum(not math.isnan(one[0]) for one in samples) or len(samples)
    ends = bootstrap.bounds(mean[1:], float(mean[0]), sizes)
    return Estimate(float(mean[0]), *ends, defined, expected, seeds)


def _defined(records: Iterable[Record], metric: str) -> int:
    """Return the least number of trajectories that a metric of some cells is defined for."""
    terms = (contribution(r, metric) for r in records if metric in r.per_trajectory)
    return min((term.n for term in terms if term.n), default=0)


class Estimator:
    """Makes estimates from records of one split and protocol; of a cell's, the last one counts."""

    def __init__(self, records: Iterable[Record]) -> None:
        self._cells: dict[tuple[Setting, str], dict[str, dict[int, Record]]] = {}
        for record in records:
            row = self._cells.setdefault((record.setting, record.environment), {})
            row.setdefault(record.anomaly, {})[record.seed] = record
        # Several tables and claims ask for the same number.
        self._mean = functools.lru_cache(maxsize=8192)(self._mean_over_anomalies)

    def has(self, settings: Iterable[Setting]) -> bool:
        """Tell whether there is a record of any of these settings."""
        required = set(settings)
        return any(setting in required for setting, _ in self._cells)

    def combine(
        self,
        sides: Sequence[Side],
        metric: str,
        environments: Sequence[str],
        same_seeds: Sequence[Setting] = (),
    ) -> Estimate:
        """Return the mean over the environments where no side lacks a cell of a sum of sides.

        Only detector seeds count that all sides have, and those of `same_seeds` that were run.
        """
        samples, counts, sizes = [], [], []
        for environment in environments:
            held = [
                self._by_seed(setting, environment, side.anomalies)
                for side in sides
                for setting in side.settings
            ]
            for record in (r for by_seed in held for cells in by_seed.values() for r in cells):
                if not record.ok:
                    return Estimate(expected=len(environments), state=record.status)
            common = set[int].intersection(*map(set, held))
            for setting in same_seeds:
                common &= self._by_seed(setting, environment, sides[0].anomalies).keys() or common
            if common:
                samples.append(self._sum(sides, metric, environment, sorted(common)))
                counts.append(len(common))
                sizes.append(
                    _defined((r for by_seed in held for s in common for r in by_seed[s]), metric)
                )
        return _estimate(samples, sizes, len(environments), min(counts, default=0))

    def _by_seed(
        self, setting: Setting, environment: str, anomalies: Sequence[str]
    ) -> dict[int, list[Record]]:
        """Return a setting's cells by detector seed, for seeds with all of these anomalies."""
        cells = [self._cells.get((setting, environment), {}).get(a, {}) for a in anomalies]
        seeds = sorted(set[int].intersection(*map(set, cells)))
        return {seed: [cell[seed] for cell in cells] for seed in seeds}

    def _sum(
        self, sides: Sequence[Side], metric: str, environment: str, seeds: list[int]
    ) -> Samples:
        total = np.zeros(1 + RESAMPLES)
        for side, setting in ((one, setting) for one in sides for setting in one.settings):
            mean = mean_samples(
                [self._mean(setting, environment, side.anomalies, metric, s) for s in seeds]
            )
            total = total + side.weight / len(side.settings) * mean
        return total

    def _mean_over_anomalies(
        self, setting: Setting, environment: str, anomalies: tuple[str, ...], metric: str, seed: int
    ) -> Samples:
        cells = [self._cells[setting, environment][a][seed] for a in anomalies]
        none = np.full(1 + RESAMPLES, NAN)
        return mean_samples(
            [
                _samples(environment, contribution(cell, metric))
                if metric in cell.per_trajectory
                else none
                for cell in cells
            ]
        )


def _samples(environment: str, values: Contribution | ArrayLike) -> Samples:
    """Return a value and its resamples: of a cell, or of the mean of a number per trajectory."""
    if not isinstance(values, Contribution):
        numbers = np.asarray(values, dtype=np.float64)
        values = Contribution(numbers, np.ones_like(numbers))
    return np.concatenate([[values.value], bootstrap.cell_samples(environment, values)])


def mean_return(returns: Returns, environment: str, kind: str) -> Estimate:
    """Return a mean over test seeds with its interval; undefined where it was not recorded."""
    values = returns.get(environment, {}).get(kind)
    return _estimate([_samples(environment, values)] if values else [], [len(values or ())], 1)


def lost_return(returns: Returns, sides: Sequence[Side], environments: Sequence[str]) -> Estimate:
    """Return a sum of sides of the lost share of the return, (nominal - anomalous) / |nominal|."""
    samples, sizes = [], []
    for environment in environments:
        by_kind = {k: np.asarray(v) for k, v in returns.get(environment, {}).items()}
        if any(kind not in by_kind for kind in KINDS):
            continue
        whole, total = abs(_samples(environment, by_kind["nominal"])), np.zeros(1 + RESAMPLES)
        for side in sides:
            lost = by_kind["nominal"] - np.mean([by_kind[a] for a in side.anomalies], axis=0)
            total = total + side.weight * _samples(environment, lost) / whole
        samples.append(total)
        sizes.append(len(by_kind["nominal"]))
    return _estimate(samples, sizes, len(environments))


@dataclass(frozen=True, slots=True)
class TableNumber:
    """One number of an experiment: ours with its interval, and the paper's or NaN."""

    environment: str
    series: Series
    scope: Scope
    metric: str
    estimate: Estimate
    paper: float = NAN


# By environment (or `MEAN`), label of the series, id of the scope, and metric.
Numbers = Mapping[tuple[str, str, str, str], TableNumber]


def compute(experiment: Experiment, estimator: Estimator) -> Numbers:
    """Return every number of an experiment; what was not run is there, without a value."""
    numbers = {}
    same = experiment.settings if experiment.same_seeds else []
    metrics = (*experiment.metrics, *experiment.beyond)
    for row, series, over, metric in itertools.product(
        experiment.row_titles, experiment.series, experiment.scopes, metrics
    ):
        environments = experiment.environments if row == MEAN else (row,)
        sides = [Side(1.0, series.settings, over.anomalies)]
        estimate = estimator.combine(sides, metric, environments, same)
        paper = np.mean([paper_number(experiment, series, e, over, metric) for e in environments])
        key = row, series.label, over.id, metric
        numbers[key] = TableNumber(row, series, over, metric, estimate, float(paper))
    return numbers
