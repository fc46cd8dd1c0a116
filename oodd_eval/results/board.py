"""Records arranged for comparison: rows of detectors with means over cells."""

import functools
import itertools
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np

from oodd_eval.data.condition import Condition, conditions_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS, in_order
from oodd_eval.data.split import published_digests
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import DrawnCells, mean_interval, mean_over_cells
from oodd_eval.metrics.catalogue import NAMES, metric_info
from oodd_eval.metrics.ranking import Position
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record

Item = TypeVar("Item")
Key = TypeVar("Key")


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which records can be compared; of the split, the digest decides."""

    split: str = field(compare=False)
    split_digest: str
    protocol: int
    limit: int | None

    @classmethod
    def of(cls, record: Record) -> "Conditions":
        """Return the conditions of a record."""
        return cls(record.split, record.split_digest, record.protocol, record.limit)

    def __str__(self) -> str:
        limit = f", limit {self.limit}" if self.limit is not None else ""
        digest = f"digest {self.split_digest[:12]}"
        return f"split {self.split}, {digest}, protocol {self.protocol}{limit}"


class Value(NamedTuple):
    """A mean over some cells and its interval, NaN where undefined or not asked for.

    `state` is the status of the first failed cell, without which there is a value; `partial` says
    that expected cells are missing in it, `brief` that all of the cells are brief.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    state: str = ""
    cells: int = 0
    partial: bool = False
    brief: bool = False


class Board:
    """Records of one split digest, protocol and limit, see `boards`.

    Parameters
    ----------
    records
        At least one.
    expected
        Environments and conditions that every row should have; by default `expected_cells`.
    """

    def __init__(self, records: Sequence[Record], expected: Collection[Position] = ()) -> None:
        self.records = list(records)
        self.conditions = Conditions.of(self.records[0])
        self.split, self.digest = self.conditions.split, self.conditions.split_digest
        self.protocol, self.limit = self.conditions.protocol, self.conditions.limit
        self._cells = grouped(self.records, lambda r: (r.setting, r.environment, r.anomaly))
        cells = expected or expected_cells(self.records)
        self._expected = {(e, Condition.parse(condition).anomaly) for e, condition in cells}
        self._plugins: dict[Setting, str] = {}
        for r in self.records:
            self._plugins.setdefault(r.setting, r.plugin)
        self.entries = list(self._plugins)
        self.environments = in_order((e for _, e, _ in self._cells), ENVIRONMENTS)
        self.anomalies = in_order((a for _, _, a in self._cells), ANOMALIES)
        self._groups = {r.anomaly: r.group for r in self.records}
        self.horizons = sorted({entry.horizon for entry in self.entries})
        brief = {(r.environment, r.anomaly) for r in self.records if r.brief}
        everywhere = itertools.product(self.environments, self.anomalies)
        self.brief = [cell for cell in everywhere if cell in brief]
        self._mean = functools.cache(self._computed)  # several tables show the same means

    def in_group(self, group: str) -> list[str]:
        """Return the anomalies of a group that were evaluated."""
        return [a for a in self.anomalies if self._groups[a] == group]

    def test_seeds(self) -> list[int]:
        """Return the numbers of test trajectories per cell that occur."""
        return sorted({r.counts["test"] for r in self.records if "test" in r.counts})

    def is_trivial(self, entry: Setting) -> bool:
        """Return whether an entry is one of the harness's own trivial rows."""
        return self._plugins[entry].endswith(":trivial")

    def present(self, names: Iterable[str]) -> list[str]:
        """Return the metrics that any record has."""
        metrics = {name for record in self.records for name in record.metrics}
        return [name for name in names if name in metrics]

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
        and detector seeds where there are several. Cells that are not expected, see
        `expected_cells`, count only where none of the others is.
        """
        return self._mean(entry, tuple(environments), tuple(anomalies), metric, intervals)

    def _computed(
        self,
        entry: Setting,
        environments: Sequence[str],
        anomalies: Sequence[str],
        metric: str,
        intervals: bool,
    ) -> Value:
        everywhere = list(itertools.product(environments, anomalies))
        chosen = [cell for cell in everywhere if cell in self._expected] or everywhere
        cells = [self._cells[entry, *cell] for cell in chosen if (entry, *cell) in self._cells]
        records = [record for cell in cells for record in cell]
        blank = Value(
            state=next((r.status for r in records if not r.ok), ""),
            cells=sum(not r.ok or metric in r.metrics for r in records),
            partial=0 < len(cells) < len(chosen),
            brief=bool(records) and all(r.brief for r in records),
        )
        if blank.state:
            return blank
        value, low, high = _mean_of(records, metric, intervals=intervals)
        return blank._replace(value=value, low=low, high=high)

    def compare(self, first: Setting, second: Setting, metric: str) -> tuple[float, float, int]:
        """Return both means over the cells that both have, and the number of those cells."""
        common = [
            (e, a)
            for e, a in itertools.product(self.environments, self.anomalies)
            if not any(math.isnan(self.mean(s, [e], [a], metric).value) for s in (first, second))
        ]
        cells = ([self._cells[s, *cell] for cell in common] for s in (first, second))
        one, two = (_mean_of(itertools.chain(*groups), metric)[0] for groups in cells)
        return one, two, len(common)

    def failures(self) -> list[Record]:
        """Return one record of every failed fit."""
        failed = [r for r in self.records if not r.ok]
        units = {(r.cell.label, r.environment, r.status): r for r in reversed(failed)}
        return list(reversed(units.values()))


def expected_cells(records: Sequence[Record]) -> set[Position]:
    """Return the environments and conditions in which a row of a board has to have a result.

    Those of a published split follow from its definition. Of another split they are the ones that
    at least half of the rows have: its directory may be on one machine and not on the next, and a
    board must not depend on that. So no single row can add a cell that all others then lack.
    """
    if not records:
        return set()
    conditions = Conditions.of(records[0])
    name = conditions.split
    if name in SPLITS and published_digests().get(name) == conditions.split_digest:
        suite, cap = SPLITS[name].suite, SPLITS[name].episode_cap
        return {(e, str(c)) for e in ENVIRONMENTS for c in conditions_of(suite, e, cap)}
    rows = grouped(records, lambda r: r.setting).values()
    counts = Counter(cell for row in rows for cell in {r.position for r in row})
    return {cell for cell, n in counts.items() if 2 * n >= len(rows)}


def boards(records: Sequence[Record]) -> list[Board]:
    """Sort records into boards: no table mixes split digests, protocols or limits."""
    return [Board(group) for group in grouped(records, Conditions.of).values()]


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return records or the like by key, keys in the order in which they occur."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def contribution(record: Record, metric: str) -> Contribution:
    """Return a record's numerators and denominators of a metric."""
    numerators, denominators = record.per_trajectory[metric]
    return Contribution(numerators, denominators, _is_median(metric))


def _is_median(metric: str) -> bool:
    return metric in NAMES and metric_info(metric).median


def _mean_of(
    records: Iterable[Record], metric: str, *, intervals: bool = False
) -> tuple[float, float, float]:
    """Return the mean of a metric over records, and its interval, NaN without terms of the metric.

    Thresholds are no ratios of sums, and have no terms.
    """
    by_shape: dict[tuple[str, int], list[Record]] = {}
    values = []
    for r in records:
        if metric in r.per_trajectory:
            shape = r.environment, len(r.per_trajectory[metric][0])
            by_shape.setdefault(shape, []).append(r)
        else:
            values.append((r.seed, r.value(metric)))
    cells = []
    for (environment, _), group in by_shape.items():
        terms = np.array([r.per_trajectory[metric] for r in group])
        seeds = [r.seed for r in group]
        median = _is_median(metric)
        cells.append(DrawnCells(environment, seeds, terms[:, 0], terms[:, 1], median=median))
        values += zip(seeds, cells[-1].values, strict=True)
    ends = NAN, NAN
    if intervals and cells:
        ends = mean_interval(cells, kind=metric_info(metric).interval)
    return mean_over_cells(values), *ends
