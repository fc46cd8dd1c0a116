"""From records at several strengths to detection thresholds and to curves over the strength.

A *pair* is an environment and a kind of anomaly. Its strengths are those at which there are
records that say their number, or whose strength is a rung of the benchmark's ladder.
"""

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.condition import GROWTH, PAPER, RUNGS, Rung, rungs_of
from oodd_eval.data.facts import ENVIRONMENTS, title_of
from oodd_eval.errors import SplitError, UnknownNameError
from oodd_eval.metrics.bootstrap import mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import FOUND_WITHIN, HEADLINE, UNDEFINED, metric_info
from oodd_eval.metrics.threshold import DetectionThreshold, MeanThreshold, geometric_mean
from oodd_eval.prose import Table
from oodd_eval.results.board import Board, Column
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.tables import best_first, marked, show_value, unranked

DETECTION: Final = f"found_within_{FOUND_WITHIN[-1]}_{HEADLINE}"
"""The metric whose share decides: found within 100 rows, where 5 % of nominal episodes alarm."""

UNITS: Final = ("kept99", "loss1")
"""The rungs whose strength is the unit where the ladder's strengths of pairs are put together."""

Pair = tuple[str, str]
Thresholds = dict[Setting, dict[Pair, DetectionThreshold]]


@dataclass(frozen=True, slots=True)
class Strengths:
    """The strengths at which there are records.

    Attributes
    ----------
    rungs
        Strengths of each pair by name, the weakest first.
    names
        Names of all strengths: rungs of the benchmark's ladder in its order, others by their mean
        number.
    calibrated
        Whether all are rungs of a ladder, which have a common unit, see `base`. Others are in the
        unit of their kind of anomaly.
    """

    rungs: Mapping[Pair, Mapping[str, Rung]]
    names: tuple[str, ...]
    calibrated: bool

    @classmethod
    def of(cls, records: Iterable[Record]) -> "Strengths":
        """Collect the strengths of some records.

        Parameters
        ----------
        records
            Of one board; those without a strength, or with one of unknown number, are left out.

        Returns
        -------
        Strengths
        """
        all_rungs = {
            (_pair(r), r.strength): rung for r in records if r.strength and (rung := _rung_of(r))
        }
        rungs: dict[Pair, dict[str, Rung]] = {}
        numbers: dict[str, list[float]] = {}
        for (pair, name), rung in sorted(all_rungs.items(), key=lambda item: item[1].strength):
            rungs.setdefault(pair, {})[name] = rung
            numbers.setdefault(name, []).append(rung.strength)
        names = sorted(numbers, key=lambda name: (_position(name), float(np.mean(numbers[name]))))
        return cls(rungs, tuple(names), calibrated=all(name in RUNGS for name in names))

    @property
    def base(self) -> str:
        """The rung whose strength is the unit, one of `UNITS`; empty where not `calibrated`."""
        if not self.calibrated:
            return ""
        return UNITS[1] if any(name in GROWTH for name in self.names) else UNITS[0]

    def unit(self, pair: Pair) -> float:
        """Return the strength of a pair that is 1 where several pairs are put together.

        NaN where there is none: strengths of different kinds then have no common scale.
        """
        rungs = {**_calibrated(*pair), **self.rungs[pair]} if self.calibrated else {}
        return next((rungs[name].strength for name in UNITS if name in rungs), math.nan)

    @property
    def scaled(self) -> bool:
        """True if the strengths of all pairs have a common scale, that of `unit`."""
        return not any(math.isnan(self.unit(pair)) for pair in self.rungs)

    def chosen(self, name: str) -> dict[Pair, str]:
        """Return the strength of each pair that counts in the column of a name.

        A pair has no rung of its own for a level of the ladder where the strength of a weaker rung
        is nearest to it: its largest sensible strength costs less, or the policy fails between two
        near strengths. The next weaker rung stands in there. A pair without records at a strength
        of that name is left out.
        """
        strength_names = {}
        for pair, rungs in self.rungs.items():
            ladder = _calibrated(*pair) or rungs
            weaker = [n for n in ladder if _position(n) <= _position(name)]
            counted = weaker[-1] if name in RUNGS and weaker else name
            if counted in rungs:
                strength_names[pair] = counted
        return strength_names

    def at(self, records: Iterable[Record], name: str) -> list[Record]:
        """Return the records in the column of a strength, see `chosen`."""
        strength_names = self.chosen(name)
        return [r for r in records if r.strength and r.strength == strength_names.get(_pair(r))]


@functools.cache
def _calibrated(environment: str, anomaly: str) -> Mapping[str, Rung]:
    """Return the rungs of the benchmark's ladder; none for what is not calibrated."""
    # Those of other environments are known from records alone, whatever is installed.
    if environment not in ENVIRONMENTS:
        return {}
    try:
        return rungs_of(environment, anomaly)
    except (SplitError, UnknownNameError):
        return {}


def _rung_of(record: Record) -> Rung | None:
    """Return the strength of a record, None where its number is not known."""
    # What a rung of the ladder costs is known from the ladder, as is the number of those that older
    # records lack.
    rung = _calibrated(*_pair(record)).get(record.strength)
    if record.magnitude is None or (rung and rung.strength == record.magnitude):
        return rung
    return Rung(record.magnitude) if record.strength != PAPER else None


def _position(name: str) -> int:
    return RUNGS.index(name) if name in RUNGS else len(RUNGS)


def thresholds(records: Sequence[Record]) -> Thresholds:
    """Return the detection thresholds of each row that has records at strengths, by pair.

    Parameters
    ----------
    records
        Of one board.

    Returns
    -------
    dict
        Thresholds by row and pair, in the unit of the kind of anomaly. A row has one where all its
        detector seeds have a result at every strength of the pair, and episodes have twins.
    """
    rungs = Strengths.of(records).rungs
    cells: dict[Setting, dict[Pair, dict[tuple[int, str], Record]]] = {}
    for r in records:
        if r.paired and r.strength in rungs.get(_pair(r), {}):
            pairs = cells.setdefault(r.setting, {})
            pairs.setdefault(_pair(r), {})[r.seed, r.strength] = r
    return {
        setting: {
            pair: threshold
            for pair, by_seed in pairs.items()
            if (threshold := _threshold(pair, by_seed, rungs[pair]))
        }
        for setting, pairs in cells.items()
    }


def _threshold(
    pair: Pair, cells: Mapping[tuple[int, str], Record], rungs: Mapping[str, Rung]
) -> DetectionThreshold | None:
    strengths = {name: rung.strength for name, rung in rungs.items() if rung.strength > 0}
    seeds = sorted({seed for seed, _ in cells})
    rows = [[cells[seed, n] for n in strengths if (seed, n) in cells] for seed in seeds]
    complete = strengths and all(len(row) == len(strengths) for row in rows)
    if not complete or not all(r.ok and DETECTION in r.per_trajectory for row in rows for r in row):
        return None
    terms = np.array([[r.per_trajectory[DETECTION] for r in row] for row in rows])
    threshold = DetectionThreshold.of(
        pair[0], [*strengths.values()], terms[:, :, 0], terms[:, :, 1]
    )
    return None if math.isnan(threshold.value) else threshold


def threshold_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return a flat mapping for each threshold: what it is of, its value, and its strengths."""
    strengths = Strengths.of(records)
    return [
        {
            "row": str(setting),
            "environment": pair[0],
            "anomaly": pair[1],
            "threshold": threshold.value,
            "low": threshold.interval[0],
            "high": threshold.interval[1],
            "weakest": threshold.weakest,
            "strongest": threshold.strongest,
            UNITS[0]: strengths.unit(pair),
        }
        for setting, pairs in thresholds(records).items()
        for pair, threshold in pairs.items()
    ]


class Point(NamedTuple):
    """One strength of a curve, as means over pairs.

    `strength` is the geometric mean in the units of `Strengths.unit`, or, of one kind without a
    common scale, in its own. `lost` is the share of the return that the strength costs, NaN where
    that is not known.
    """

    strength: float
    lost: float
    value: float


def curve(records: Sequence[Record], metric: str) -> list[Point]:
    """Return a metric of one row along the strengths, the weakest first.

    There is no point where strengths of several kinds have no common scale.

    Parameters
    ----------
    records
        Of one row.
    metric
        Name of a metric of the catalogue.
    """
    strengths, points = Strengths.of(records), []
    scaled = strengths.scaled
    for name in strengths.names:
        cells = [r for r in strengths.at(records, name) if r.ok]
        rungs = {_pair(r): strengths.rungs[_pair(r)][r.strength] for r in cells}
        one_kind = len({kind for _, kind in rungs}) == 1
        logs = [
            math.log(rung.strength / (strengths.unit(pair) if scaled else 1))
            for pair, rung in rungs.items()
            if rung.strength > 0 and (scaled or one_kind)
        ]
        lost = nan_mean(1 - rung.kept for rung in rungs.values())
        value = mean_over_cells((r.seed, r.value(metric)) for r in cells)
        points.append(Point(math.exp(nan_mean(logs)), lost, value))
    return sorted(p for p in points if not math.isnan(p.value) and not math.isnan(p.strength))


def _pair(record: Record) -> Pair:
    return record.environment, record.anomaly


REFERENCE: Final = Setting("riqn")
"""The row whose thresholds others are divided by, where a board has it."""

_RULE: Final = (
    "The threshold is the weakest strength that a detector finds within 100 rows in half of the "
    "episodes, where at most 5 % of nominal episodes have an alarm."
)
_SHARE: Final = (
    "Found is an episode with an alarm within 100 rows, where at most 5 % of nominal ones have one."
)
_BEYOND: Final = "≤ and > mark thresholds beyond the weakest and the strongest rung."
_SIDES: Final = (
    "What that hides is marked: the true mean is at most this (≤), more (>), or either (~)."
)
_COLUMNS: Final = {
    UNITS[0]: "At keptN the policy keeps N % of its return; 4th, 16th and 64th are those parts of "
    "kept99's strength. A ladder without a rung counts there with its next weaker one.",
    UNITS[1]: "At lossN the task's loss is N % higher. A ladder without a rung counts there with "
    "its next weaker one.",
    "": "Columns are named by strengths; their means are over the environments and anomalies "
    "that have the strength.",
}  # by the unit of the strengths
_APART: Final = (
    "Columns are named by anomaly and strength; their means are over the environments that have it."
)
COSTS: Final = MappingProxyType(
    {UNITS[0]: "costs 1 % of the return", UNITS[1]: "raises the task's loss by 1 %"}
)
"""The cost of a strength of 1, by `Strengths.base`."""


NO_UNITS: Final[Mapping[str, str]] = MappingProxyType({})


@dataclass(frozen=True)
class StrengthTables:
    """The tables of a board's records at strengths.

    Attributes
    ----------
    board
        The board.
    intervals
        Whether means by kind and thresholds of single places have their 95 % intervals.
    units
        Units of kinds of anomalies, for the headings of those that have one here.
    """

    board: Board
    intervals: bool = False
    units: Mapping[str, str] = field(default_factory=dict)

    @functools.cached_property
    def strengths(self) -> Strengths:
        """The strengths of the records."""
        return Strengths.of(self.board.records)

    @functools.cached_property
    def by_row(self) -> Thresholds:
        """The thresholds of the records."""
        return thresholds(self.board.records)

    def overview(self, *, places: bool = False) -> list[Table]:
        """Return all tables; none without records at strengths.

        With `places`, each row has a table with its threshold in every environment.
        """
        board, by_row, rows = self.board, self.by_row, best_first(self.board)
        if not board.paired:  # episodes of two strengths have nothing in common
            return [self.separability(rows)] if self.strengths.names else []
        ranked = by_row and not board.leaves_out([board.ranking])
        order = [entry for entry in rows if entry in by_row]
        tables = [self.separability(order)] if ranked else []
        if any(by_row.values()):  # else no level of 5 %, with few calibration episodes
            places = places and (self.strengths.scaled or len(board.environments) > 1)
            single = [self.by_place(e, by_row[e]) for e in order if places and by_row[e]]
            over_all, by_kind = [self.relative(order), *tables], self.by_kind(order)
            tables = [*over_all, by_kind] if self._unit_of_mean else [by_kind, *over_all]
            tables += single
        return tables

    def by_place(self, entry: Setting, by_pair: Mapping[Pair, DetectionThreshold]) -> Table:
        """Return one row's thresholds by environment and kind of anomaly, in the anomaly's unit."""
        kinds = self._kinds(by_pair)

        def text(threshold: DetectionThreshold | None) -> str:
            if threshold is None:
                return ""
            ends = ", ".join(map(threshold.text, threshold.interval))
            return threshold.text(threshold.value) + f" [{ends}]" * self.intervals

        rows = [
            [title_of(e), *(text(by_pair.get((e, kind))) for kind in kinds)]
            for e in self.board.environments
        ]
        title = f"{entry}: detection thresholds by anomaly, each in its own unit"
        header = ["Environment", *map(self._with_unit, kinds)]
        return Table(title, header, rows, note=f"{_RULE} {_BEYOND}")

    @property
    def _unit_of_mean(self) -> str:
        """Say in what thresholds of several kinds have a mean; empty where they have none."""
        if self.by_row.get(REFERENCE):
            return f"as a multiple of {REFERENCE}'s"
        if self.strengths.scaled:
            return f"as a multiple of the strength that {COSTS[self.strengths.base]}"
        return ""

    def relative(self, order: Sequence[Setting]) -> Table:
        """Return shares found by strength, and relative thresholds where these have a mean."""
        reference, unit = self.by_row.get(REFERENCE, {}), self._unit_of_mean
        names, shares = self._by_strength(order, DETECTION)
        title, header = "share of episodes found by strength (%)", ["detector", *names]
        rows, note = [[str(entry), *shares[entry]] for entry in order], _SHARE
        if unit:
            means = {
                e: _mean(by_pair, reference, self.strengths) for e, by_pair in self.by_row.items()
            }
            most = max((mean.pairs for mean in means.values() if mean), default=0)
            for row, mean in zip(rows, map(means.get, order), strict=True):
                figures: tuple[object, ...] = (UNDEFINED, 0, "", "")
                if mean:
                    text = mean.text() + "*" * (mean.pairs < most)
                    figures = text, mean.pairs, mean.below, mean.above
                row[1:1] = map(str, figures)
            header[1:1] = ["threshold", "pairs", "below", "above"]
            title = f"Detection thresholds, lower is better, and {title}"
            note = (
                f"{_RULE} Shown is its geometric mean {unit}, over pairs of environment and "
                "anomaly, with its 95 % interval. In so many pairs it lies below or above the "
                f"ladder, and counts as the end of the ladder. {_SIDES}"
            )
        note = f"{note} {self._columns_note} {unranked(self.board)}".rstrip()
        return Table(title[0].upper() + title[1:], header, rows, note=note)

    def separability(self, order: Sequence[Setting]) -> Table:
        """Return the metric that ranks by strength."""
        names, texts = self._by_strength(order, self.board.ranking)
        title = metric_info(self.board.ranking).title
        rows = [[marked(self.board, e), *texts[e]] for e in order]
        title = f"{title[0].upper()}{title[1:]} (%) by strength"
        return Table(title, ["detector", *names], rows, note=self._columns_note)

    def by_kind(self, order: Sequence[Setting]) -> Table:
        """Return thresholds by kind of anomaly, with a common scale means over environments."""
        pairs = list(dict.fromkeys(pair for by_pair in self.by_row.values() for pair in by_pair))
        kinds, scaled = self._kinds(pairs), self.strengths.scaled
        columns = {kind: [pair for pair in pairs if pair[1] == kind] for kind in kinds}
        over, note = "each in its own unit", _BEYOND
        if scaled:  # thresholds are multiples of the strength that is the unit
            over = f"in units of the strength that {COSTS[self.strengths.base]}"
            note = (
                "Means are geometric, over environments; a threshold beyond the ladder counts "
                f"as its end. {_SIDES}"
            )
        else:
            several = len(self.board.environments) > 1
            columns = {
                self._with_unit(kind) + f", {title_of(pair[0])}" * several: [pair]
                for kind, of_kind in columns.items()
                for pair in of_kind
            }
        rows = []
        for entry in order:
            by_pair = self.by_row[entry]
            of_columns = ({p: by_pair[p] for p in c if p in by_pair} for c in columns.values())
            means = (_mean(of_column, {}, self.strengths) for of_column in of_columns)
            texts = (mean.text(interval=self.intervals) if mean else "" for mean in means)
            rows.append([str(entry), *texts])
        title = f"Detection thresholds by anomaly, {over}"
        return Table(title, ["detector", *columns], rows, note=f"{_RULE} {note}")

    def _kinds(self, pairs: Iterable[Pair]) -> list[str]:
        kinds = {kind for _, kind in pairs}
        return [kind for kind in self.board.anomalies if kind in kinds]

    def _with_unit(self, kind: str) -> str:
        return f"{kind} ({self.units[kind]})" if kind in self.units else kind

    @property
    def _apart(self) -> bool:
        """True if equal strengths of two kinds cannot be compared."""
        kinds = {kind for _, kind in self.strengths.rungs}
        return not self.strengths.calibrated and len(kinds) > 1

    @property
    def _columns_note(self) -> str:
        return _APART if self._apart else _COLUMNS[self.strengths.base]

    def _by_strength(
        self, entries: Iterable[Setting], metric: str
    ) -> tuple[list[str], dict[Setting, list[str]]]:
        """Return names of columns, and a metric's means at each strength as texts."""
        records, strengths = self.board.records, self.strengths
        columns = {name: strengths.at(records, name) for name in strengths.names}
        if self._apart:
            columns = {
                f"{kind} {name}": of_kind
                for kind in self._kinds(strengths.rungs)
                for name in strengths.names
                if (of_kind := [r for r in columns[name] if r.anomaly == kind])
            }
        steps = [Board(of_column) for of_column in columns.values()]
        # A row may have no record at a strength.
        return [*columns], {
            e: [
                show_value(board.of(e, Column(metric)), metric) if e in board.entries else ""
                for board in steps
            ]
            for e in entries
        }


def _mean(
    by_pair: Mapping[Pair, DetectionThreshold],
    reference: Mapping[Pair, DetectionThreshold],
    strengths: Strengths,
) -> MeanThreshold | None:
    """Return the mean over the pairs of a reference, or over all, in units, without one."""
    pairs = [p for p in by_pair if p in reference] if reference else [*by_pair]
    scaled = strengths.scaled
    units = [reference[p] if reference else strengths.unit(p) if scaled else 1.0 for p in pairs]
    return geometric_mean([by_pair[p] for p in pairs], units) if pairs else None
