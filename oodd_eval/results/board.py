"""Records arranged for comparison: rows of detectors with means over cells."""

import functools
import itertools
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeVar

import numpy as np

from oodd_eval.data.condition import Condition, conditions_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, SPLITS, in_order
from oodd_eval.data.split import published_digests
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import (
    DrawnCells,
    mean_interval,
    mean_over_cells,
    nan_mean,
    sums_of_recordings,
)
from oodd_eval.metrics.catalogue import ALARM_RANKING, HEADLINE, LEVELS, NAMES, RANKING, metric_info
from oodd_eval.metrics.ranking import Position
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record

Item = TypeVar("Item")
Key = TypeVar("Key")


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which records can be compared; of the split, the digest decides.

    Environments with twins and without have other metrics, so `paired` tells them apart.
    """

    split: str = field(compare=False)
    split_digest: str
    protocol: int
    limit: int | None
    paired: bool = True

    @classmethod
    def of(cls, record: Record) -> "Conditions":
        """Return the conditions of a record."""
        return cls(record.split, record.split_digest, record.protocol, record.limit, record.paired)

    def __str__(self) -> str:
        limit = f", limit {self.limit}" if self.limit is not None else ""
        digest = f"digest {self.split_digest[:12]}"
        return f"split {self.split}, {digest}, protocol {self.protocol}{limit}"


class Value(NamedTuple):
    """A mean over some cells and its interval, NaN where undefined or not asked for.

    `state` is the status of the first failed cell, without which there is a value; `cells` are
    those that were run, `partial` says that expected ones are missing, `brief` that all are brief.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    state: str = ""
    cells: int = 0
    partial: bool = False
    brief: bool = False


class Column(NamedTuple):
    """A column of a table: the mean of a metric over some cells of a board, by default over all."""

    metric: str
    title: str = ""
    environments: Sequence[str] = ()
    anomalies: Sequence[str] = ()
    intervals: bool = False


class Board:
    """Records of one split digest, protocol and limit, with twins or without, see `boards`.

    Parameters
    ----------
    records
        At least one.
    expected
        Environments and conditions that every row should have; by default `expected_cells`.

    Attributes
    ----------
    paired
        Whether each anomalous episode has a nominal twin.
    level
        Suffix of the level of guaranteed alarms that rows are ranked at: 5 %, or without twins
        10 % where more rows have that.
    ranking, alarm_ranking
        Names of the metrics that rows are ordered and ranked by.
    supervised
        Rows that learn from failures: a band of their own below the others, never ranked with them.
    """

    def __init__(self, records: Sequence[Record], expected: Collection[Position] = ()) -> None:
        self.records = list(records)
        self.conditions = Conditions.of(self.records[0])
        self.split, self.digest = self.conditions.split, self.conditions.split_digest
        self.protocol, self.limit = self.conditions.protocol, self.conditions.limit
        self.paired = self.conditions.paired
        self.level = level_of(self.records)
        self.ranking, self.alarm_ranking = ranked_by(self.records)
        self.supervised = supervised(self.records)
        self._rows = grouped(self.records, lambda r: r.setting)
        self._cells: dict[Setting, dict[Position, list[int]]] = {}  # indices of a row's records
        for row, of_row in self._rows.items():
            cells_of_row = self._cells.setdefault(row, {})
            for i, r in enumerate(of_row):
                cells_of_row.setdefault((r.environment, r.anomaly), []).append(i)
        cells = expected or expected_cells(self.records)
        self._expected = {(e, Condition.parse(condition).anomaly) for e, condition in cells}
        self.entries = list(self._rows)
        self.environments = in_order((r.environment for r in self.records), ENVIRONMENTS)
        self.anomalies = in_order((r.anomaly for r in self.records), ANOMALIES)
        self._groups = {r.anomaly: r.group for r in self.records}
        self.horizons = sorted({entry.horizon for entry in self.entries})
        brief = {(r.environment, r.anomaly) for r in self.records if r.brief}
        everywhere = itertools.product(self.environments, self.anomalies)
        self.brief = [cell for cell in everywhere if cell in brief]
        # Several tables show the same means, and many means are over the same values.
        self._mean = functools.cache(self._computed)
        self._values = functools.cache(lambda row, name: _values_of(self._rows[row], name))

    def in_group(self, group: str) -> list[str]:
        """Return the anomalies of a group that were evaluated."""
        return [a for a in self.anomalies if self._groups[a] == group]

    @property
    def groups(self) -> dict[str, list[str]]:
        """The anomalies of each group that some have; without twins there are two groups or none.

        Logs name groups where they like to: one alone tells nothing.
        """
        groups: dict[str, list[str]] = {g: kinds for g in GROUPS if (kinds := self.in_group(g))}
        return groups if self.paired or len(groups) > 1 else {}

    def test_seeds(self) -> list[int]:
        """Return the numbers of test trajectories per cell that occur."""
        return sorted({r.counts["test"] for r in self.records if "test" in r.counts})

    def is_trivial(self, entry: Setting) -> bool:
        """Return whether an entry is one of the harness's own trivial rows."""
        return self._rows[entry][0].plugin.endswith(":trivial")

    def present(self, names: Iterable[str]) -> list[str]:
        """Return the metrics that any record has."""
        metrics = {name for record in self.records for name in record.metrics}
        return [name for name in names if name in metrics]

    def leaves_out(self, names: Iterable[str]) -> bool:
        """Tell whether records have metrics, but none of these, as in a suite that keeps others."""
        return any(record.metrics for record in self.records) and not self.present(names)

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

        The interval resamples test trajectories, the same ones for all cells of an environment;
        detector seeds are fixed. Delays of fewer than ten finds have none. Cells that are not
        expected, see `expected_cells`, count only where none of the others is.
        """
        return self._mean(entry, tuple(environments), tuple(anomalies), metric, intervals)

    def of(self, entry: Setting, column: Column) -> Value:
        """Return an entry's value in a column."""
        over = column.environments or self.environments, column.anomalies or self.anomalies
        return self.mean(entry, *over, column.metric, intervals=column.intervals)

    def _computed(
        self,
        entry: Setting,
        environments: Sequence[str],
        anomalies: Sequence[str],
        metric: str,
        intervals: bool,
    ) -> Value:
        everywhere = list(itertools.product(environments, anomalies))
        counted_cells = [cell for cell in everywhere if cell in self._expected] or everywhere
        of_row, cells_of_row = self._rows[entry], self._cells[entry]
        cells = [cells_of_row[cell] for cell in counted_cells if cell in cells_of_row]
        indices = [i for cell in cells for i in cell]
        records = [of_row[i] for i in indices]
        blank = Value(
            state=next((r.status for r in records if not r.ok), ""),
            cells=len(records),
            partial=0 < len(cells) < len(counted_cells),
            brief=bool(records) and all(r.brief for r in records),
        )
        if blank.state:
            return blank
        ends = (NAN, NAN)
        drawn = _drawn_cells(records, metric) if intervals else {}
        if drawn and not _has_few_finds(records, metric):
            ends = mean_interval([*drawn.values()], kind=metric_info(metric).interval)
        values = self._values(entry, metric)
        value = mean_over_cells((of_row[i].seed, values[i]) for i in indices)
        return blank._replace(value=value, low=ends[0], high=ends[1])

    def seed_means(self, entry: Setting, metric: str) -> list[float]:
        """Return an entry's mean over expected cells with each detector seed, NaN left out."""
        values = zip(self._rows[entry], self._values(entry, metric), strict=True)
        by_seed: dict[int, list[float]] = {}
        for r, value in values:
            if (r.environment, r.anomaly) in self._expected:
                by_seed.setdefault(r.seed, []).append(value)
        means = (nan_mean(by_seed[seed]) for seed in sorted(by_seed))
        return [mean for mean in means if not math.isnan(mean)]

    def compare(self, first: Setting, second: Setting, metric: str) -> tuple[float, float]:
        """Return both means over the cells that both have."""
        common = [
            (e, a)
            for e, a in itertools.product(self.environments, self.anomalies)
            if not any(math.isnan(self.mean(s, [e], [a], metric).value) for s in (first, second))
        ]
        first_mean, second_mean = (
            mean_over_cells(
                (self._rows[s][i].seed, self._values(s, metric)[i])
                for cell in common
                for i in self._cells[s][cell]
            )
            for s in (first, second)
        )
        return first_mean, second_mean

    def worst(self, entry: Setting, places: Sequence[Column] = ()) -> tuple[str, Value] | None:
        """Return the title of the place where an entry's mean is lowest, and that mean.

        Places are columns, by default one an environment.
        """
        places = places or [Column(self.ranking, e, [e]) for e in self.environments]
        means = [(column.title, self.of(entry, column)) for column in places]
        defined = [pair for pair in means if not math.isnan(pair[1].value)]
        return min(defined, key=lambda pair: pair[1].value, default=None)

    def failures(self) -> list[Record]:
        """Return one record of every failed fit."""
        failed = [r for r in self.records if not r.ok]
        units = {(r.cell.label, r.environment, r.status): r for r in reversed(failed)}
        return list(reversed(units.values()))


def supervised(records: Iterable[Record]) -> set[Setting]:
    """Return the rows that learn from failures."""
    return {r.setting for r in records if r.training == "failures"}


def ranked_by(records: Sequence[Record]) -> tuple[str, str]:
    """Return the metrics that the rows of a board are ranked by: of separability, and of alarms.

    Without twins they are those of anomalous rows, or where only outcomes are known those of these.

    Parameters
    ----------
    records
        Of one board.
    """
    if records[0].paired:
        return RANKING, ALARM_RANKING
    level = level_of(records)
    present = {name for record in records for name in record.metrics}
    if "auc_outcome" in present and f"delay_censored_{level}" not in present:
        return "auc_outcome", f"found_outcome_{level}"
    return "auc_pool", f"delay_censored_{level}"


def level_of(records: Sequence[Record]) -> str:
    """Return the suffix of the level that a board's tables show: the headline's, or a weaker one.

    With twins it is the headline's; without, the one that most records have.
    """
    if records[0].paired:
        return HEADLINE
    weaker = (suffix for suffix, share in LEVELS.items() if share >= LEVELS[HEADLINE])
    usual = sorted(weaker, key=LEVELS.__getitem__)  # the strictest first
    counts = [sum(f"false_episodes_{s}" in r.metrics for r in records) for s in usual]
    return usual[counts.index(max(counts))]


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
    if published_digests().get(name) == conditions.split_digest:
        suite, cap = SPLITS[name].suite, SPLITS[name].episode_cap
        return {(e, str(c)) for e in ENVIRONMENTS for c in conditions_of(suite, e, cap)}
    rows = grouped(records, lambda r: r.setting).values()
    counts = Counter(cell for row in rows for cell in {r.position for r in row})
    return {cell for cell, n in counts.items() if 2 * n >= len(rows)}


def cells_with(metric: str, records: Iterable[Record]) -> set[Position]:
    """Return the environments and conditions in which any of some records has a metric's value."""
    with_terms = (r for r in records if metric in r.per_trajectory)
    return {r.position for r in with_terms if not math.isnan(contribution(r, metric).value)}


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
    """Return a record's terms of a metric, and what its calibration episodes do to it."""
    terms, nominal = record.per_trajectory[metric], _nominal(record)
    deviations = record.calibration_draws.get(metric, _NONE)
    further = nominal, deviations, record.recordings_of_terms
    return Contribution(terms[0], terms[1], _is_median(metric), *further)


_NONE: Final = np.zeros(0)


def _nominal(record: Record) -> int | None:
    """Return with how many nominal test episodes terms begin; None where episodes have twins."""
    return None if record.paired else record.counts["nominal"]


def _is_median(metric: str) -> bool:
    return metric in NAMES and metric_info(metric).median


def _drawn_cells(records: Sequence[Record], metric: str) -> dict[tuple[int, ...], DrawnCells]:
    """Return the cells of a row that have terms of a metric, by the indices of their records."""
    # Thresholds are no ratios of sums, and have no terms.
    by_shape: dict[tuple[str, str, int | None, tuple[int, ...], int], list[int]] = {}
    for i, r in enumerate(records):
        if metric in r.per_trajectory:
            # Each condition without twins has a sample of its own.
            condition = "" if r.paired else str(r.condition)
            size = len(r.per_trajectory[metric][0])
            key = r.environment, condition, _nominal(r), r.recordings_of_terms, size
            by_shape.setdefault(key, []).append(i)
    cells = {}
    for (environment, condition, episodes, recordings, _), indices in by_shape.items():
        group = [records[i] for i in indices]
        terms = np.array([r.per_trajectory[metric] for r in group])
        terms, nominal = sums_of_recordings(terms, episodes, recordings)
        both = terms[:, 0], terms[:, 1]
        deviations = [r.calibration_draws.get(metric, _NONE) for r in group]
        seeds = [r.seed for r in group]
        cells[tuple(indices)] = DrawnCells(
            environment, seeds, *both, _is_median(metric), nominal, condition, deviations
        )
    return cells


def _has_few_finds(records: Sequence[Record], metric: str) -> bool:
    """Tell whether a metric is the delay of too few found episodes for an interval."""
    if metric.partition("_at_")[0] not in ("delay", "delay_null"):
        return False
    terms = [r.per_trajectory[metric] for r in records if metric in r.per_trajectory]
    finds = sum(np.count_nonzero(denominators) for _, denominators in terms)
    return bool(finds < _FEWEST_FINDS * len({r.seed for r in records}))


_FEWEST_FINDS: Final = 10  # a seed, below which a mean delay of found episodes has no interval


def _values_of(records: Sequence[Record], metric: str) -> list[float]:
    """Return a metric of records of a row, from its terms where there are any."""
    values = [NAN] * len(records)
    with_terms: set[int] = set()
    for indices, drawn in _drawn_cells(records, metric).items():
        with_terms.update(indices)
        for i, value in zip(indices, drawn.values, strict=True):
            values[i] = value
    for i in set(range(len(records))) - with_terms:
        values[i] = records[i].value(metric)
    return values
