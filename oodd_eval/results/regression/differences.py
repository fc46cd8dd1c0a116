"""The comparison: every figure of a reference against the same figure now."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.results.record import NAN
from oodd_eval.results.regression.figures import Conditions, Figures, FigureSet
from oodd_eval.results.regression.tolerance import KNOWN, Tolerance, strict_tolerances

By = Literal["cell", "group", "mean"]

Verdict = Literal[
    "same", "within", "better", "worse", "undefined", "failed", "missing", "recovered", "new"
]

MEANINGS: Final[dict[Verdict, str]] = {
    "same": "no difference",
    "within": "a difference within the tolerance",
    "better": "beyond the tolerance, to the better side",
    "worse": "beyond the tolerance, to the worse side",
    "undefined": "a number on one side only",
    "failed": "the cell fails now",
    "missing": "the cell is not there now",
    "recovered": "the cell failed in the reference",
    "new": "the cell is not in the reference",
}
"""What a comparison of one figure can come to."""

RESOLUTION: Final = 1e-6
"""Differences up to this are none: a reference file has six decimals."""


class NothingInCommonError(ResultsError):
    """Two sets of figures of which no two can be compared."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One figure now against the reference.

    Attributes
    ----------
    split, place, detector
        Parts of the cell's id, such as ``"mini"``, ``"hopper/iid"`` and ``"rf[h=1,seed=0]"``; the
        place of a mean is ``"hopper/sensor"`` or ``"mean"``.
    tolerance
        Of the metric.
    reference, now
        NaN where undefined, or where there is no such figure.
    verdict
        A key of `MEANINGS`.
    fails
        Whether the comparison fails for it.
    reason
        More about it, possibly empty.
    """

    split: str
    place: str
    detector: str
    tolerance: Tolerance
    reference: float
    now: float
    verdict: Verdict
    fails: bool = False
    reason: str = ""

    @property
    def metric(self) -> str:
        """Name of the metric."""
        return self.tolerance.metric

    @property
    def change(self) -> float:
        """Now minus reference."""
        return self.now - self.reference


@dataclass(frozen=True, slots=True)
class Comparison:
    """All differences, in the order of the reference, and what was not compared.

    Attributes
    ----------
    differences
        One per cell (or mean) and metric; new cells stand last.
    by
        What a figure is: of a cell, or a mean over an anomaly group or over all cells.
    two_sided
        Whether improvements beyond the tolerance fail.
    conditions
        Split, protocol and limit of what was compared.
    notes
        Sentences about what was left out.
    """

    differences: list[Difference]
    by: By
    two_sided: bool
    conditions: list[Conditions]
    notes: list[str] = field(default_factory=list)

    @property
    def failures(self) -> list[Difference]:
        """Return the differences for which the comparison fails."""
        return [d for d in self.differences if d.fails]


def compare(
    now: FigureSet,
    reference: FigureSet,
    tolerances: Sequence[Tolerance] = (),
    *,
    by: By = "cell",
    two_sided: bool = False,
) -> Comparison:
    """Compare figures with a reference.

    Parameters
    ----------
    now, reference
        What to compare with what.
    tolerances
        One for each metric to compare; none means all metrics of the reference that have a worse
        side, with tolerance 0.
    by
        ``"cell"``; ``"group"``: means over the anomalies of a group in one environment; or
        ``"mean"``: over all cells of a detector. Means are over the cells of the reference.
    two_sided
        Whether a metric that is better by more than the tolerance fails as well.

    Raises
    ------
    NothingInCommonError
        When no cell is in both under the same split digest, protocol and limit.
    UsageError
        When a metric is not in the reference.

    Notes
    -----
    A cell of the reference that is missing now, or fails now, fails the comparison; one that failed
    in the reference already does not. A number against NaN is a difference that no tolerance
    covers; NaN against NaN is none. Only cells under equal conditions are compared.
    """
    theirs = {c.key: cells for c, cells in now.boards.items()}
    common = [c for c in reference.boards if c.key in theirs]
    _require_common(now, reference, common)
    # Of a reference in which every cell failed, nothing can be asked but whether they still do.
    known = reference.metrics() or KNOWN
    for tolerance in tolerances:
        if tolerance.metric not in known:
            raise UsageError(
                f"metric {tolerance.metric!r} is not in {reference.where}, expected one of "
                f"{', '.join(known)}: write the reference again, or leave the metric out"
            )
    used = list(tolerances) or strict_tolerances(m for m in KNOWN if m in known)
    differences: list[Difference] = []
    new: list[Difference] = []
    for conditions in common:
        cells, own = reference.boards[conditions], theirs[conditions.key]
        for place, ids in _units(cells, by).items():
            pairs = [(cells[i], own.get(i)) for i in ids]
            differences += _compare_unit(place, pairs, used, two_sided=two_sided)
        for cell in own.keys() - cells.keys():
            new += [Difference(*_parts(cell), t, NAN, own[cell].metrics.get(t.metric, NAN), "new")
                    for t in used]  # fmt: skip
    new.sort(key=lambda d: (d.split, d.detector, d.place))
    notes = [
        f"Not compared: {c.text}, which is only in {one.where}."
        for one, other in ((reference, now), (now, reference))
        for c in one.boards
        if c.key not in {o.key for o in other.boards}
    ]
    return Comparison([*differences, *new], by, two_sided, common, notes)


def _require_common(now: FigureSet, reference: FigureSet, common: Sequence[Conditions]) -> None:
    for one in (reference, now):
        if not any(one.boards.values()):
            raise NothingInCommonError(f"nothing in common: no cell is selected in {one.where}")
    if not common:
        raise NothingInCommonError(
            "nothing in common: results of different splits, protocols or limits are not "
            f"compared; {reference.where} has {'; '.join(c.text for c in reference.boards)}; "
            f"{now.where} has {'; '.join(c.text for c in now.boards)}"
        )
    theirs = {c.key: cells for c, cells in now.boards.items()}
    if not any(reference.boards[c].keys() & theirs[c.key].keys() for c in common):
        raise NothingInCommonError(
            f"nothing in common: no cell of {reference.where} (such as {_example(reference)}) is "
            f"in {now.where} (which has {_example(now)})"
        )


def _example(figures: FigureSet) -> str:
    return next(cell for cells in figures.boards.values() for cell in cells)


def _parts(cell: str) -> tuple[str, str, str]:
    """Return split, environment/anomaly and detector of a cell id."""
    left, _, detector = cell.partition("::")
    split, *place = left.rsplit("/", 2)
    return split, "/".join(place), detector


def _units(cells: Mapping[str, Figures], by: By) -> dict[tuple[str, str, str], list[str]]:
    """Sort cell ids into what is compared as one figure."""
    units: dict[tuple[str, str, str], list[str]] = {}
    for cell in cells:
        split, place, detector = _parts(cell)
        if by == "mean":
            place = "mean"
        elif by == "group":
            environment, _, anomaly = place.rpartition("/")
            group = ANOMALIES[anomaly].group if anomaly in ANOMALIES else anomaly
            place = f"{environment}/{group}"
        units.setdefault((split, place, detector), []).append(cell)
    return units


def _compare_unit(
    place: tuple[str, str, str],
    pairs: Sequence[tuple[Figures, Figures | None]],
    tolerances: Sequence[Tolerance],
    *,
    two_sided: bool,
) -> list[Difference]:
    """Compare one cell, or the mean over several, in every metric."""
    present = [(r, n) for r, n in pairs if n is not None]
    failed = [n for r, n in present if r.ok and not n.ok]
    both = [(r, n) for r, n in present if r.ok and n.ok]

    def whole(verdict: Verdict, reason: str, *, fails: bool = False) -> list[Difference]:
        """Return the same verdict for all metrics."""
        return [
            Difference(
                *place, t, _mean([r.metrics.get(t.metric, NAN) for r, _ in pairs]), NAN,
                verdict, fails, reason,
            )
            for t in tolerances
        ]  # fmt: skip

    of = f"{{}} of {len(pairs)} cells: " if len(pairs) > 1 else ""
    if lost := len(pairs) - len(present):
        return whole("missing", of.format(lost) + "not there now", fails=True)
    if failed:
        why = f"{failed[0].status}: {failed[0].reason}" if failed[0].reason else failed[0].status
        return whole("failed", of.format(len(failed)) + why, fails=True)
    if not both:
        recovered = [r.status for r, n in present if n.ok]
        if not recovered:
            return whole("same", f"fails in both: {present[0][1].status}")
        return whole("recovered", f"was {recovered[0]}", fails=two_sided)
    return [_compare_metric(place, both, t, two_sided=two_sided) for t in tolerances]


def _compare_metric(
    place: tuple[str, str, str],
    both: Sequence[tuple[Figures, Figures]],
    tolerance: Tolerance,
    *,
    two_sided: bool,
) -> Difference:
    values = [
        (r.metrics.get(tolerance.metric, NAN), n.metrics.get(tolerance.metric, NAN))
        for r, n in both
    ]
    reference, now = _mean([r for r, _ in values]), _mean([n for _, n in values])
    turned = [(r, n) for r, n in values if math.isnan(r) != math.isnan(n)]
    if turned:
        where = "reference" if math.isnan(turned[0][0]) else "results"
        of = f" in {len(turned)} of {len(both)} cells" if len(both) > 1 else ""
        reason = f"no value in the {where}{of}"
        return Difference(*place, tolerance, reference, now, "undefined", True, reason)
    change = 0.0 if math.isnan(reference) else now - reference
    if abs(change) <= RESOLUTION:
        return Difference(*place, tolerance, reference, now, "same")
    if abs(change) <= tolerance.allowed(reference) + RESOLUTION:
        return Difference(*place, tolerance, reference, now, "within")
    worse = tolerance.worse in ("±", "+" if change > 0 else "-")
    verdict: Verdict = "worse" if worse else "better"
    return Difference(*place, tolerance, reference, now, verdict, worse or two_sided)


def _mean(values: Sequence[float]) -> float:
    """Mean over the values that are not NaN."""
    defined = [v for v in values if not math.isnan(v)]
    return math.fsum(defined) / len(defined) if defined else NAN
