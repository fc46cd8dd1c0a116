"""Records arranged for comparison: rows of detectors, means over cells with paired intervals."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import bootstrap_weights, mean_value, percentiles, resampled_mean
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record

_weights = functools.lru_cache(maxsize=32)(bootstrap_weights)


@dataclass(frozen=True, slots=True)
class Value:
    """A mean over cells, or why there is none.

    Attributes
    ----------
    value, low, high
        NaN where undefined; the interval is NaN, too, where none was asked for.
    state
        Status of the first failed cell; then there is no value.
    cells
        Number of cells it is over.
    partial
        Whether other rows have cells here that this one lacks.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    state: str = ""
    cells: int = 0
    partial: bool = False


class Board:
    """Records of one split digest, protocol and limit.

    Parameters
    ----------
    records
        All of one board, see `boards`.
    """

    def __init__(self, records: Sequence[Record]) -> None:
        self.records = list(records)
        first = self.records[0]
        self.split, self.digest = first.split, first.split_digest
        self.protocol, self.limit = first.protocol, first.limit
        self._cells: dict[tuple[Setting, str, str], list[Record]] = {}
        for record in self.records:
            key = record.setting, record.environment, record.anomaly
            self._cells.setdefault(key, []).append(record)
        self.entries = list(dict.fromkeys(entry for entry, _, _ in self._cells))
        found = {environment for _, environment, _ in self._cells}
        self.environments = [e for e in ENVIRONMENTS if e in found]
        found = {anomaly for _, _, anomaly in self._cells}
        self.anomalies = [a for a in ANOMALIES if a in found]

    @property
    def horizons(self) -> list[int]:
        """Prediction horizons, ascending."""
        return sorted({entry.horizon for entry in self.entries})

    def in_group(self, group: str) -> list[str]:
        """Return the anomalies of a group that were evaluated."""
        return [a for a in self.anomalies if ANOMALIES[a].group == group]

    def test_seeds(self) -> list[int]:
        """Return the numbers of test trajectories per cell that occur."""
        return sorted({r.counts["test"] for r in self.records if "test" in r.counts})

    def is_trivial(self, entry: Setting) -> bool:
        """Whether an entry is one of the harness's own trivial rows."""
        plugins = (r.plugin for (e, _, _), cell in self._cells.items() if e == entry for r in cell)
        return next(plugins, "").endswith(":trivial")

    def mean(
        self,
        entry: Setting,
        environments: Sequence[str],
        anomalies: Sequence[str],
        metric: str,
        *,
        intervals: bool = False,
    ) -> Value:
        """Return an entry's mean of a metric over cells, seeds included.

        The interval resamples test trajectories, the same ones for all cells of an environment,
        and detector seeds where there are several.
        """
        wanted = [(e, a) for e in environments for a in anomalies]
        cells = {w: self._cells[entry, *w] for w in wanted if (entry, *w) in self._cells}
        others = {w for w in wanted if any((x, *w) in self._cells for x in self.entries)}
        records = [record for cell in cells.values() for record in cell]
        partial = 0 < len(cells) < len(others)
        if failed := next((r for r in records if not r.ok), None):
            return Value(state=failed.status, cells=len(records), partial=partial)
        with_metric = [r for r in records if metric in r.per_trajectory]
        value = _mean(records, metric)
        low, high = _interval(with_metric, metric) if intervals else (NAN, NAN)
        return Value(value, low, high, cells=len(records), partial=partial)

    def compare(self, first: Setting, second: Setting, metric: str) -> tuple[float, float, int]:
        """Return both means over the cells that both have, and the number of those cells."""
        common = [
            (self._cells[first, e, a], self._cells[second, e, a])
            for e in self.environments
            for a in self.anomalies
            if (first, e, a) in self._cells and (second, e, a) in self._cells
        ]
        pairs = [
            (_seed_mean(one, metric), _seed_mean(two, metric))
            for one, two in common
            if all(r.ok for r in (*one, *two))
        ]
        pairs = [p for p in pairs if not any(map(math.isnan, p))]
        if not pairs:
            return NAN, NAN, 0
        one, two = np.mean(pairs, axis=0).tolist()
        return one, two, len(pairs)

    def failures(self) -> list[Record]:
        """Return one record of every failed fit."""
        failed = [r for r in self.records if not r.ok]
        units = {(r.label, r.environment, r.status): r for r in reversed(failed)}
        return list(reversed(units.values()))


def boards(records: Sequence[Record]) -> list[Board]:
    """Sort records into boards: no table mixes split digests, protocols or limits."""
    groups: dict[tuple[str, int, object], list[Record]] = {}
    for record in records:
        key = record.split_digest, record.protocol, record.limit
        groups.setdefault(key, []).append(record)
    return [Board(group) for group in groups.values()]


def contribution(record: Record, metric: str) -> Contribution:
    """Return a record's numerators and denominators of a metric."""
    numerators, denominators = record.per_trajectory[metric]
    return Contribution(np.array(numerators), np.array(denominators))


def _mean(records: Sequence[Record], metric: str) -> float:
    """Mean over cells where it is defined."""
    if any(metric in r.per_trajectory for r in records):
        return _seed_mean(records, metric)
    # One number of all trajectories of a cell, such as a pooled AUC.
    defined = [v for v in (r.value(metric) for r in records) if not math.isnan(v)]
    return sum(defined) / len(defined) if defined else NAN


def _seed_mean(cell: Sequence[Record], metric: str) -> float:
    return mean_value([contribution(r, metric) for r in cell if metric in r.per_trajectory])


def _interval(records: Sequence[Record], metric: str) -> tuple[float, float]:
    """Bootstrap over test trajectories and, where there are several, over detector seeds."""
    if not records:
        return NAN, NAN
    by_seed: dict[int, list[Record]] = {}
    for record in records:
        by_seed.setdefault(record.seed, []).append(record)
    resampled = np.array(
        [
            resampled_mean(
                [contribution(r, metric) for r in group],
                [_weights(len(r.per_trajectory[metric][0]), key=r.environment) for r in group],
            )
            for group in by_seed.values()
        ]
    )  # (seeds, resamples)
    seeds, resamples = resampled.shape
    drawn = np.random.default_rng(0).integers(seeds, size=(seeds, resamples))
    return percentiles(np.take_along_axis(resampled, drawn, axis=0).mean(axis=0))
