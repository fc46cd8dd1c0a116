"""Records arranged for comparison: rows of detectors with means over cells, and their rankings."""

import functools
import itertools
import math
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, in_order
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import DrawnCells, mean_interval, mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import ALARM_RANKING, NAMES, RANKING, metric_info
from oodd_eval.metrics.ranking import Position, Ranking, rank, win_rates
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record

Item = TypeVar("Item")
Key = TypeVar("Key")

SEEDS: Final = 3  # detector seeds that a primary row with randomness needs for a rank


class Value(NamedTuple):
    """A mean over some cells and its interval, NaN where undefined or not asked for.

    `state` is the status of the first failed cell, without which there is a value; `partial` says
    that other rows have cells here that this one lacks, `brief` that all of the cells are brief.
    """

    value: float = NAN
    low: float = NAN
    high: float = NAN
    state: str = ""
    cells: int = 0
    partial: bool = False
    brief: bool = False


class _RowCells:
    """A row's metric in the cells of an environment, given as anomalies and records."""

    def __init__(self, cells: Sequence[tuple[str, Record]], environment: str, metric: str) -> None:
        # Thresholds are no ratios of sums.
        self._values = [
            (a, r.seed, r.value(metric)) for a, r in cells if metric not in r.per_trajectory
        ]
        self._drawn: list[tuple[DrawnCells, tuple[str, ...]]] = []
        stored = [
            (a, r.seed, r.per_trajectory[metric]) for a, r in cells if metric in r.per_trajectory
        ]
        for n in {len(terms[0]) for _, _, terms in stored}:
            names, seeds, own = zip(*(one for one in stored if len(one[2][0]) == n), strict=True)
            both = np.array(own)
            drawn = DrawnCells(environment, seeds, both[:, 0], both[:, 1], _is_median(metric))
            self._drawn.append((drawn, names))
            self._values += zip(names, seeds, drawn.values, strict=True)

    def values(self, anomalies: Collection[str]) -> list[tuple[int, float]]:
        """Return detector seeds and values of some anomalies' cells."""
        return [(seed, value) for a, seed, value in self._values if a in anomalies]

    def drawn(self, anomalies: Sequence[str]) -> Iterator[DrawnCells]:
        """Yield the cells of some anomalies that have terms, of one number of trajectories each."""
        for whole, names in self._drawn:
            places = tuple(i for a in anomalies for i, name in enumerate(names) if name == a)
            if places:
                yield whole if places == (*range(len(names)),) else whole.only(places)


class Board:
    """Records of one split digest, protocol and limit, see `boards`."""

    def __init__(self, records: Sequence[Record]) -> None:
        self.records = list(records)
        first = self.records[0]
        self.split, self.digest = first.split, first.split_digest
        self.protocol, self.limit = first.protocol, first.limit
        self._cells = grouped(self.records, lambda r: (r.setting, r.environment, r.anomaly))
        self._made: dict[tuple[object, ...], Any] = {}
        self._row_cells = functools.lru_cache(maxsize=256)(self._uncached_row_cells)
        self._places = {(e, a) for _, e, a in self._cells}
        self._plugins: dict[Setting, str] = {}
        for (setting, _, _), own in self._cells.items():
            self._plugins.setdefault(setting, own[0].plugin)
        self.entries = list(self._plugins)
        self.environments = in_order((e for _, e, _ in self._cells), ENVIRONMENTS)
        self.anomalies = in_order((a for _, _, a in self._cells), ANOMALIES)
        self._groups = {r.anomaly: r.group for r in self.records}
        self.horizons = sorted({entry.horizon for entry in self.entries})
        brief = {(r.environment, r.anomaly) for r in self.records if r.brief}
        everywhere = itertools.product(self.environments, self.anomalies)
        self.brief = [place for place in everywhere if place in brief]

    def in_group(self, group: str) -> list[str]:
        """Return the anomalies of a group that were evaluated."""
        return [a for a in self.anomalies if self._groups[a] == group]

    def test_seeds(self) -> list[int]:
        """Return the numbers of test trajectories per cell that occur."""
        return sorted({r.counts["test"] for r in self.records if "test" in r.counts})

    def is_trivial(self, entry: Setting) -> bool:
        """Return whether an entry is one of the harness's own trivial rows."""
        return self._plugins[entry].endswith(":trivial")

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
        and detector seeds where there are several. A mean is computed once: tables share many.
        """
        places = tuple(environments), tuple(anomalies)
        return self._once(self._computed, entry, *places, metric, intervals)

    def _once(self, make: Callable[..., Item], *arguments: Hashable) -> Item:
        """Call a method, once with the same arguments."""
        key = make.__name__, *arguments
        if key not in self._made:
            self._made[key] = make(*arguments)
        made: Item = self._made[key]
        return made

    def _computed(
        self,
        entry: Setting,
        environments: Sequence[str],
        anomalies: Sequence[str],
        metric: str,
        intervals: bool,
    ) -> Value:
        blank = self._once(self._without_value, entry, environments, anomalies)
        if blank.state:
            return blank
        own = [self._row_cells(entry, e, metric) for e in environments]
        value = mean_over_cells(pair for one in own for pair in one.values(anomalies))
        ends = NAN, NAN
        if intervals and (drawn := [c for one in own for c in one.drawn(anomalies)]):
            ends = mean_interval(drawn, kind=metric_info(metric).interval)
        return blank._replace(value=value, low=ends[0], high=ends[1])

    def _without_value(
        self, entry: Setting, environments: Sequence[str], anomalies: Sequence[str]
    ) -> Value:
        """Return all of an entry's mean but its value: the same for every metric."""
        wanted = [p for p in itertools.product(environments, anomalies) if p in self._places]
        cells = [self._cells[entry, *p] for p in wanted if (entry, *p) in self._cells]
        records = [record for cell in cells for record in cell]
        state = next((r.status for r in records if not r.ok), "")
        brief = bool(records) and all(r.brief for r in records)
        partial = 0 < len(cells) < len(wanted)
        return Value(state=state, cells=len(records), partial=partial, brief=brief)

    def compare(self, first: Setting, second: Setting, metric: str) -> tuple[float, float, int]:
        """Return both means over the cells that both have, and the number of those cells."""
        own = [self._once(self._defined, entry, metric) for entry in (first, second)]
        both = [place for place in own[0] if place in own[1]]
        one, two = (mean_over_cells(v for place in both for v in side[place]) for side in own)
        return one, two, len(both)

    def _defined(self, entry: Setting, metric: str) -> dict[Position, list[tuple[int, float]]]:
        """Return detector seeds and values of the cells in which a row has a mean."""
        found = {}
        for e, a in itertools.product(self.environments, self.anomalies):
            if all(r.ok for r in self._cells.get((entry, e, a), ())):
                values = self._row_cells(entry, e, metric).values([a])
                if not math.isnan(mean_over_cells(values)):
                    found[e, a] = values
        return found

    def _uncached_row_cells(self, entry: Setting, environment: str, metric: str) -> _RowCells:
        """Return a row's metric in the cells of an environment."""
        found = ((a, self._cells.get((entry, environment, a), ())) for a in self.anomalies)
        return _RowCells([(a, r) for a, own in found for r in own], environment, metric)

    def failures(self) -> list[Record]:
        """Return one record of every failed fit."""
        failed = [r for r in self.records if not r.ok]
        units = {(r.cell.label, r.environment, r.status): r for r in reversed(failed)}
        return list(reversed(units.values()))


def boards(records: Sequence[Record]) -> list[Board]:
    """Sort records into boards: no table mixes split digests, protocols or limits."""
    groups = grouped(records, lambda r: (r.split_digest, r.protocol, r.limit))
    return [Board(group) for group in groups.values()]


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return records or the like by key, keys in the order in which they occur."""
    found: dict[Key, list[Item]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


def contribution(record: Record, metric: str) -> Contribution:
    """Return a record's numerators and denominators of a metric."""
    numerators, denominators = record.per_trajectory[metric]
    return Contribution(numerators, denominators, _is_median(metric))


def _is_median(metric: str) -> bool:
    return metric in NAMES and metric_info(metric).median


class Cost(NamedTuple):
    """Mean seconds of a row's fits, microseconds per scored step, and most memory in MB."""

    fit: float = NAN
    step: float = NAN
    peak: float = NAN


@dataclass(frozen=True, slots=True)
class Standing:
    """One row of a board with its place.

    `rank` is None, and `state` says why, for a row that is not ranked; `alarm_rank` is its rank by
    alarms, None where `alarm_state` says why. `primary` rows are one a detector; the others are
    variants, whose rank is the one that they would have. So is that of a row `below` the ranking,
    which was not run again where others were. `ties` are the letters of its tie groups,
    `wins` is the mean of its win rates against the other ranked rows, and `inputs` is empty where
    no record names the detector's inputs.
    """

    entry: Setting
    records: list[Record]
    trivial: bool
    primary: bool
    below: bool
    rank: int | None
    alarm_rank: int | None
    ties: str
    state: str
    alarm_state: str
    wins: float
    inputs: str
    cost: Cost

    @property
    def seeds(self) -> int:
        """The number of detector seeds."""
        return len({r.seed for r in self.records})


class RankedBoard(NamedTuple):
    """A board with its rankings and win rates, by the labels of the ranked rows.

    All have the order of the standings: ranked rows by rank and mean, then the others by name, and
    last what stands below the ranking, likewise.
    `alarms` is the ranking by alarms; it has no rows where the board lacks that metric.
    """

    board: Board
    standings: list[Standing]
    ranking: Ranking
    alarms: Ranking
    rates: dict[tuple[str, str], float]


def primary_settings(records: Iterable[Record], rerun: Collection[Setting] = ()) -> set[Setting]:
    """Return one row of each detector: of those with most cells and seeds enough the simplest.

    That is the row with the fewest other than default parameters, and then the least horizon. Cells
    and seeds come first, so that part of a row does not stand for a detector that has a whole one,
    and `rerun` rows before all, so that nobody's claim takes the place of what was confirmed.
    """
    by_row = grouped(records, lambda r: r.setting)

    def order(row: Setting) -> tuple[Any, ...]:
        cells, few = {r.position for r in by_row[row]}, has_few_seeds(by_row[row])
        return row not in rerun, -len(cells), few, len(row.parameters), *_name(row)

    found: dict[str, Setting] = {}
    for row in sorted(by_row, key=order):
        found.setdefault(row.detector, row)
    return set(found.values())


def ranked(
    records: Sequence[Record],
    primary: Collection[Setting] | None = None,
    rerun: Collection[Setting] = (),
) -> RankedBoard:
    """Rank the rows of one board that have a value in every cell, with all their detector seeds.

    Primary rows, one a detector, push others down; by default `primary_settings`. They need three
    detector seeds, unless the seed changes nothing. Where rows are `rerun`, others stand below
    these and push nobody down. `ResultsError`: ranked rows differ in their numbers of test
    trajectories, or two rows have one name.
    """
    own = sorted(records, key=lambda r: (_name(r.setting), r.seed, r.position))
    by_row = grouped(own, lambda r: r.setting)
    labels = Counter(map(str, by_row))
    if twice := [label for label, n in labels.items() if n > 1]:
        raise ResultsError(
            f"two rows of a board are both called {twice[0]!r}, expected names and settings that "
            "tell rows apart: give one of the detectors another name"
        )
    first = primary_settings(records) if primary is None else set(primary)
    cells = {r.position for r in records}
    states = {e: _state(own, len(cells), RANKING, e in first) for e, own in by_row.items()}
    below = set(by_row).difference(rerun) if rerun else set()
    ranking, rows = _ranking(by_row, states, first - below, RANKING)
    by_alarms = {e: _state(own, len(cells), ALARM_RANKING, e in first) for e, own in by_row.items()}
    alarms, _ = _ranking(by_row, by_alarms, first - below, ALARM_RANKING)
    rates = win_rates(
        {
            label: {
                c: nan_mean(own[c].value for own in rows[label].values()) for c in sorted(cells)
            }
            for label in ranking.ranks
        }
    )
    unranked = set(map(str, below))
    place = {label: i for i, label in enumerate(ranking.ranks)}
    order = sorted(by_row, key=lambda e: (e in below, place.get(str(e), len(place)), _name(e)))
    board = Board([record for entry in order for record in by_row[entry]])
    standings = [
        Standing(
            entry=entry,
            records=by_row[entry],
            trivial=board.is_trivial(entry),
            primary=entry in first,
            below=entry in below,
            rank=ranking.ranks.get(str(entry)),
            alarm_rank=alarms.ranks.get(str(entry)),
            ties=ranking.letters(str(entry)),
            state=states[entry],
            alarm_state=by_alarms[entry],
            wins=nan_mean(
                rate
                for (one, other), rate in rates.items()
                if one == str(entry) and other not in unranked
            ),
            inputs=next((r.inputs for r in by_row[entry] if r.inputs), ""),
            cost=cost_of(by_row[entry]),
        )
        for entry in order
    ]
    return RankedBoard(board, standings, ranking, alarms, rates)


_Rows = dict[str, dict[int, dict[Position, Contribution]]]


def _ranking(
    by_row: Mapping[Setting, Sequence[Record]],
    states: Mapping[Setting, str],
    primary: Collection[Setting],
    metric: str,
) -> tuple[Ranking, _Rows]:
    """Rank the rows without a state by a metric; where lower is better its sign is turned."""
    rows: _Rows = {}
    for entry in (e for e, state in states.items() if not state):
        row = rows.setdefault(str(entry), {})
        for r in by_row[entry]:
            own = contribution(r, metric)
            if metric_info(metric).better == "lower":
                own = Contribution(-own.numerator, own.denominator)
            row.setdefault(r.seed, {})[r.position] = own
    return rank(rows, {str(entry) for entry in primary}), rows


def cost_of(records: Iterable[Record]) -> Cost:
    """Return what the fits behind some records cost; records of one fit share its cost."""
    fits = list({(r.environment, r.seed): r for r in records if r.ok}.values())
    timed = [(r.seconds_score, r.steps_scored) for r in fits if not math.isnan(r.seconds_score)]
    steps = [(seconds, n) for seconds, n in timed if n and n > 0]
    seconds = math.fsum(s for s, _ in steps)
    return Cost(
        nan_mean(r.seconds_fit for r in fits),
        1e6 * seconds / sum(n for _, n in steps) if steps else NAN,
        max((r.peak_rss_mb for r in fits if not math.isnan(r.peak_rss_mb)), default=NAN),
    )


def _state(records: Sequence[Record], cells: int, metric: str, primary: bool) -> str:
    """Return why a row is not ranked by a metric; empty if it is."""
    seeds = len({r.seed for r in records})
    expected = cells * seeds
    failed = Counter(r.status for r in records if not r.ok)
    reasons = [f"{status} in {n} of {expected} cells" for status, n in failed.items()]
    if len(records) < expected:
        reasons.append(f"{expected - len(records)} of {expected} cells missing")
    stored = [contribution(r, metric) for r in records if r.ok and metric in r.per_trajectory]
    defined = sum(not math.isnan(c.value) for c in stored)
    if undefined := sum(r.ok for r in records) - defined:
        reasons.append(f"undefined in {undefined} of {expected} cells")
    if primary and has_few_seeds(records):
        reasons.append(f"{seeds} of {SEEDS} detector seeds")
    return ", ".join(reasons)


def has_few_seeds(records: Sequence[Record]) -> bool:
    """Tell whether a row has fewer detector seeds than a primary row needs."""
    seeds = {r.seed for r in records}
    return len(seeds) < SEEDS and not all(r.deterministic for r in records)


def _name(entry: Setting) -> tuple[str, int, str]:
    return entry.detector, entry.horizon, entry.overrides_json
