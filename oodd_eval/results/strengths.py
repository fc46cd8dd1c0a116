"""From records at several strengths to detection thresholds and to curves over the strength.

A *pair* is an environment and a kind of anomaly. Its strengths are those at which there are
records that say their number, or whose strength is a rung of the benchmark's ladder.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.condition import PAPER, RUNGS, Rung, rungs_of
from oodd_eval.errors import SplitError, UnknownNameError
from oodd_eval.metrics.bootstrap import mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import FOUND_WITHIN, HEADLINE
from oodd_eval.metrics.threshold import DetectionThreshold
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

DETECTION: Final = f"found_within_{FOUND_WITHIN[-1]}_{HEADLINE}"
"""The metric whose share decides: found within 100 rows, where 5 % of nominal episodes alarm."""

UNIT: Final = "kept99"
"""The rung whose strength is the unit where the ladder's strengths of pairs are put together."""

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
        Whether all are rungs of the benchmark's ladder, which have a common unit: the strength that
        costs 1 % of the return. Others are in the unit of their kind of anomaly.
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
        rungs: dict[Pair, dict[str, Rung]] = {}
        for r in records:
            known = rungs.get(_pair(r), {})
            if r.strength and r.strength not in known and (rung := _rung_of(r)):
                rungs[_pair(r)] = known | {r.strength: rung}
        ordered = {
            pair: dict(sorted(by_name.items(), key=lambda item: item[1].strength))
            for pair, by_name in rungs.items()
        }
        numbers: dict[str, list[float]] = {}
        for name, rung in (item for by_name in ordered.values() for item in by_name.items()):
            numbers.setdefault(name, []).append(rung.strength)
        means = {name: float(np.mean(values)) for name, values in numbers.items()}
        names = sorted(means, key=lambda name: (_position(name), means[name]))
        return cls(ordered, tuple(names), calibrated=all(name in RUNGS for name in names))

    def unit(self, pair: Pair) -> float:
        """Return the strength of a pair that is 1 where several pairs are put together."""
        if not self.calibrated:
            return 1.0
        return {**_calibrated(*pair), **self.rungs[pair]}[UNIT].strength

    def chosen(self, name: str) -> dict[Pair, str]:
        """Return the strength of each pair that counts in the column of a name.

        A pair has no rung of its own for a level of the ladder where the strength of a weaker rung
        is nearest to it: its largest sensible strength costs less, or the policy fails between two
        near strengths. The next weaker rung stands in there. A pair without records at a strength
        of that name is left out.
        """
        chosen = {}
        for pair, rungs in self.rungs.items():
            weaker = [n for n in _calibrated(*pair) if _position(n) <= _position(name)]
            counted = weaker[-1] if name in RUNGS and weaker else name
            if counted in rungs:
                chosen[pair] = counted
        return chosen


def _calibrated(environment: str, anomaly: str) -> Mapping[str, Rung]:
    """Return the rungs of the benchmark's ladder; none for what is not calibrated."""
    try:
        return rungs_of(environment, anomaly)
    except (SplitError, UnknownNameError):
        return {}


def _rung_of(record: Record) -> Rung | None:
    """Return the strength of a record, None where its number is not known.

    What a rung of the ladder costs is known from the ladder, as is the number of those that older
    records lack.
    """
    rung = _calibrated(*_pair(record)).get(record.strength)
    if record.magnitude is None or (rung and rung.strength == record.magnitude):
        return rung
    return Rung(record.magnitude) if record.strength != PAPER else None


def _position(name: str) -> int:
    return RUNGS.index(name) if name in RUNGS else len(RUNGS)


def at_strength(records: Sequence[Record], name: str) -> list[Record]:
    """Return the records in the column of a strength, see `Strengths.chosen`."""
    chosen = Strengths.of(records).chosen(name)
    return [r for r in records if r.strength and r.strength == chosen.get(_pair(r))]


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
        detector seeds have a result at every strength of the pair.
    """
    rungs = Strengths.of(records).rungs
    cells: dict[Setting, dict[Pair, dict[tuple[int, str], Record]]] = {}
    for r in records:
        if r.strength in rungs.get(_pair(r), {}):
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
    whole = strengths and all(len(row) == len(strengths) for row in rows)
    if not whole or not all(r.ok and DETECTION in r.per_trajectory for row in rows for r in row):
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
            UNIT: strengths.unit(pair) if strengths.calibrated else math.nan,
        }
        for setting, pairs in thresholds(records).items()
        for pair, threshold in pairs.items()
    ]


class Point(NamedTuple):
    """One strength of a curve, as means over pairs.

    `strength` is the geometric mean in the units of `Strengths.unit`, `lost` the share of the
    return that the strength costs, NaN where that is not known.
    """

    strength: float
    lost: float
    value: float


def curve(records: Sequence[Record], metric: str) -> list[Point]:
    """Return a metric of one row along the strengths, the weakest first.

    Parameters
    ----------
    records
        Of one row.
    metric
        Name of a metric of the catalogue.
    """
    strengths, points = Strengths.of(records), []
    for name in strengths.names:
        chosen = strengths.chosen(name)
        cells = [r for r in records if r.ok and r.strength and r.strength == chosen.get(_pair(r))]
        rungs = {pair: strengths.rungs[pair][chosen[pair]] for pair in map(_pair, cells)}
        logs = [
            math.log(rung.strength / strengths.unit(pair))
            for pair, rung in rungs.items()
            if rung.strength > 0
        ]
        lost = nan_mean(1 - rung.kept for rung in rungs.values())
        value = mean_over_cells((r.seed, r.value(metric)) for r in cells)
        points.append(Point(math.exp(nan_mean(logs)), lost, value))
    return sorted(point for point in points if not math.isnan(point.value))


def _pair(record: Record) -> Pair:
    return record.environment, record.anomaly
