"""From records at several strengths to detection thresholds and to curves over the strength.

A *place* is an environment with a kind of anomaly. Its ladder are the strengths of
`oodd_eval.data.ladder` at which there are records; records at other strengths are left out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.ladder import RUNGS, Rung, rungs_of
from oodd_eval.errors import SplitError, UnknownNameError
from oodd_eval.metrics.bootstrap import mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import FOUND_WITHIN, HEADLINE
from oodd_eval.metrics.threshold import DetectionThreshold
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

FOUND: Final = f"found_within_{FOUND_WITHIN[-1]}_{HEADLINE}"
"""The metric whose share decides: found within 100 rows, where 5 % of nominal episodes alarm."""

UNIT: Final = "kept99"
"""The rung whose strength is the unit where strengths of several places are put together."""

Place = tuple[str, str]
Thresholds = dict[Setting, dict[Place, DetectionThreshold]]


def ladders(records: Iterable[Record]) -> dict[Place, dict[str, Rung]]:
    """Return the rungs by name, the weakest first, at which there are records of each place."""
    names: dict[Place, set[str]] = {}
    for r in records:
        if r.strength:
            names.setdefault((r.environment, r.anomaly), set()).add(r.strength)
    found = {}
    for place, own in names.items():
        try:
            known = rungs_of(*place)
        except (SplitError, UnknownNameError):  # nothing is calibrated: a place of somebody's own
            continue
        order = sorted(own & known.keys(), key=lambda name: known[name].strength)
        if order:
            found[place] = {name: known[name] for name in order}
    return found


def unit(place: Place) -> float:
    """Return the strength that costs 1 % of the return."""
    return rungs_of(*place)[UNIT].strength


def rung_names(records: Iterable[Record]) -> list[str]:
    """Return the names of all rungs with records, the weakest first."""
    return _names(ladders(records))


def _names(found: Mapping[Place, Mapping[str, Rung]]) -> list[str]:
    known = {name for rungs in found.values() for name in rungs}
    return [name for name in RUNGS if name in known]


def at_rung(records: Sequence[Record], name: str) -> list[Record]:
    """Return the records at a rung, or in places without it at the next weaker one.

    A place has no rung of its own for a level where the strength of a weaker rung is nearest to it:
    its largest sensible strength costs less, or the policy fails between two near strengths.
    """
    chosen = {place: _nearest(rungs_of(*place), name) for place in ladders(records)}
    return [r for r in records if r.strength and r.strength == chosen.get(_place(r))]


def _nearest(rungs: Iterable[str], name: str) -> str:
    """Return the rung of a place, or its next weaker one; the name itself where there is none."""
    known = [n for n in rungs if RUNGS.index(n) <= RUNGS.index(name)]
    return known[-1] if known else name


def thresholds(records: Sequence[Record]) -> Thresholds:
    """Return the detection thresholds of each row that has records at strengths, by place.

    A row has a threshold where all its detector seeds have a result at every rung of the place.
    """
    rungs = ladders(records)
    cells: dict[Setting, dict[Place, dict[tuple[int, str], Record]]] = {}
    for r in records:
        if r.strength in rungs.get(_place(r), {}):
            places = cells.setdefault(r.setting, {})
            places.setdefault(_place(r), {})[r.seed, r.strength] = r
    return {
        setting: {
            place: threshold
            for place, own in places.items()
            if (threshold := _threshold(place, own, rungs[place]))
        }
        for setting, places in cells.items()
    }


def _threshold(
    place: Place, cells: Mapping[tuple[int, str], Record], rungs: Mapping[str, Rung]
) -> DetectionThreshold | None:
    seeds = sorted({seed for seed, _ in cells})
    found = [[cells[seed, n] for n in rungs if (seed, n) in cells] for seed in seeds]
    whole = all(len(row) == len(rungs) for row in found)
    if not whole or not all(r.ok and FOUND in r.per_trajectory for row in found for r in row):
        return None
    terms = np.array([[r.per_trajectory[FOUND] for r in row] for row in found])
    strengths = [rung.strength for rung in rungs.values()]
    own = DetectionThreshold.of(place[0], strengths, terms[:, :, 0], terms[:, :, 1])
    return None if math.isnan(own.value) else own


def threshold_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return a flat mapping for each threshold: what it is of, its value, and its ladder."""
    return [
        {
            "row": str(setting),
            "environment": place[0],
            "anomaly": place[1],
            "threshold": own.value,
            "low": own.interval[0],
            "high": own.interval[1],
            "weakest": own.weakest,
            "strongest": own.strongest,
            UNIT: unit(place),
        }
        for setting, places in thresholds(records).items()
        for place, own in places.items()
    ]


class Point(NamedTuple):
    """One rung of a curve, as means over places.

    `strength` is the geometric mean in units of the strength that costs 1 % of the return, `lost`
    the share of the return that the rung costs, NaN where that is not known.
    """

    strength: float
    lost: float
    value: float


def curve(records: Sequence[Record], metric: str) -> list[Point]:
    """Return a metric of one row along the ladder, the weakest rung first."""
    found = []
    own_rungs = ladders(records)
    known = {place: rungs_of(*place) for place in own_rungs}
    for name in _names(own_rungs):
        chosen = {place: _nearest(rungs, name) for place, rungs in known.items()}
        own = [r for r in records if r.ok and r.strength and r.strength == chosen.get(_place(r))]
        rungs = {place: known[place][chosen[place]] for place in dict.fromkeys(map(_place, own))}
        logs = (math.log(rung.strength / known[p][UNIT].strength) for p, rung in rungs.items())
        lost = nan_mean(1 - rung.kept for rung in rungs.values())
        value = mean_over_cells((r.seed, r.value(metric)) for r in own)
        found.append(Point(math.exp(nan_mean(logs)), lost, value))
    return sorted(point for point in found if not math.isnan(point.value))


def _place(record: Record) -> Place:
    return record.environment, record.anomaly
