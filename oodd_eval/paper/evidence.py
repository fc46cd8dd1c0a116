"""Numbers with intervals from records: means over cells, and paired differences of them.

Every number is a weighted sum of means, such as RIQN's AUC minus NPN's. Its interval resamples test
trajectories (the same ones for all cells of an environment) and, where there are several, detector
seeds (the same ones for all terms), independently by environment. So differences are paired twice.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.bootstrap import RESAMPLES, bootstrap_weights, percentiles, resampled
from oodd_eval.paper.experiments import Setup, row_of
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.tables.board import contribution

_weights = functools.lru_cache(maxsize=32)(bootstrap_weights)

Sample = tuple[float, NDArray[np.float64]]
"""A value, and the same in every resample: shape (R,)."""


@dataclass(frozen=True, slots=True)
class Term:
    """A weight times the mean of a metric over one setup's cells of some anomalies."""

    weight: float
    setup: Setup
    anomalies: tuple[str, ...]
    metric: str


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its 95 % interval, and what it rests on.

    Attributes
    ----------
    value, low, high
        NaN where undefined or not run.
    environments, expected
        How many environments it is a mean over, and how many were asked for. Where it is undefined
        in all that were run, these are counted.
    seeds
        Fewest detector seeds in any of these environments.
    state
        Status of the first failed cell; then there is no value.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    environments: int = 0
    expected: int = 0
    seeds: int = 0
    state: str = ""

    @property
    def partial(self) -> bool:
        """Whether environments are missing from the mean."""
        return 0 < self.environments < self.expected


class Evidence:
    """Records of one split digest and protocol, by setup, environment and anomaly.

    Parameters
    ----------
    records
        Where several are of the same cell, the last one counts.
    """

    def __init__(self, records: Iterable[Record]) -> None:
        self._cells: dict[tuple[Setting, str], dict[str, dict[int, Record]]] = {}
        for record in records:
            row = self._cells.setdefault((row_of(record), record.environment), {})
            row.setdefault(record.anomaly, {})[record.seed] = record
        # A number is asked for by several tables and claims.
        self._mean = functools.lru_cache(maxsize=8192)(self._mean_over_anomalies)

    def has(self, setups: Iterable[Setup]) -> bool:
        """Whether there is a record of any of these setups."""
        wanted = {setup.entry for setup in setups}
        return any(entry in wanted for entry, _ in self._cells)

    def seeds(self, setup: Setup, environment: str, anomalies: tuple[str, ...]) -> set[int]:
        """Return the detector seeds for which all of these cells are there."""
        cells = self._cells.get((setup.entry, environment), {})
        return set[int].intersection(*(set(cells.get(a, ())) for a in anomalies))

    def combine(
        self,
        terms: Sequence[Term],
        environments: Sequence[str],
        same_seeds: Iterable[Setup] = (),
    ) -> Estimate:
        """Return the mean over environments of a weighted sum of means over anomalies.

        Environments in which a term lacks a cell are left out, and so are detector seeds that not
        all terms have, or that one of the setups of `same_seeds` lacks where it was run.
        """
        others = list(same_seeds)
        found: list[Sample] = []
        fewest = 0
        for environment in environments:
            held = [self._held(term, environment) for term in terms]
            failed = [r.status for by_seed in held for r in by_seed.values() if not r.ok]
            if failed:
                return Estimate(expected=len(environments), state=failed[0])
            common = set[int].intersection(*(set(by_seed) for by_seed in held))
            for setup in others:
                common &= self.seeds(setup, environment, terms[0].anomalies) or common
            seeds = sorted(common)
            if not seeds:
                continue
            fewest = min(fewest, len(seeds)) if found else len(seeds)
            value, series = 0.0, np.zeros(RESAMPLES)
            for term in terms:
                one = self._over_seeds(term, environment, tuple(seeds))
                value += term.weight * one[0]
                series = series + term.weight * one[1]
            found.append((value, series))
        if not found:
            return Estimate(expected=len(environments))
        value, series = _average(found)
        defined = sum(not math.isnan(v) for v, _ in found) or len(found)
        return Estimate(value, *percentiles(series), defined, len(environments), fewest)

    def _held(self, term: Term, environment: str) -> dict[int, Record]:
        """Return a record of every seed that has all of a term's cells, a failed one if any."""
        seeds = self.seeds(term.setup, environment, term.anomalies)
        cells = self._cells.get((term.setup.entry, environment), {})
        return {
            seed: min((cells[a][seed] for a in term.anomalies), key=lambda r: r.ok)
            for seed in sorted(seeds)
        }

    def _over_seeds(self, term: Term, environment: str, seeds: tuple[int, ...]) -> Sample:
        by_seed = [
            self._mean(term.setup, environment, term.anomalies, term.metric, s) for s in seeds
        ]
        value = _nan_mean(np.array([v for v, _ in by_seed])[:, None])[0]
        series = np.array([s for _, s in by_seed])
        drawn = _drawn_seeds(environment, len(seeds))
        return float(value), _nan_mean(np.take_along_axis(series, drawn, axis=0))

    def _mean_over_anomalies(
        self, setup: Setup, environment: str, anomalies: tuple[str, ...], metric: str, seed: int
    ) -> Sample:
        cells = self._cells[setup.entry, environment]
        return _average([_cell(cells[a][seed], metric) for a in anomalies])


def _cell(record: Record, metric: str) -> Sample:
    if metric not in record.per_trajectory:
        return NAN, np.full(RESAMPLES, NAN)
    own = contribution(record, metric)
    return own.value, resampled(own, _weights(len(own.numerator), key=record.environment))


def _average(samples: Sequence[Sample]) -> Sample:
    """Mean over samples, those left out that are undefined."""
    value = _nan_mean(np.array([v for v, _ in samples])[:, None])[0]
    return float(value), _nan_mean(np.array([s for _, s in samples]))


def _nan_mean(stacked: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the first axis of what is not NaN, without a warning where nothing is."""
    whole: NDArray[np.float64] = stacked.sum(axis=0)
    if not np.isnan(whole).any():
        return np.divide(whole, len(stacked))
    defined = ~np.isnan(stacked)
    count = defined.sum(axis=0)
    total = np.where(defined, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@functools.lru_cache(maxsize=64)
def _drawn_seeds(environment: str, seeds: int) -> NDArray[np.int64]:
    """Return which of S detector seeds each resample draws: shape (S, R)."""
    rng = np.random.default_rng([zlib.crc32(environment.encode()), seeds])
    return rng.integers(seeds, size=(seeds, RESAMPLES))
