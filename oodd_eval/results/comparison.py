"""Regression checks: every figure of some results with the same figure of a reference.

A tolerance is written ``METRIC:[+-]NUMBER[%]``. The sign says which way is worse: ``auc:-0.01``
fails where the AUC fell by more than 0.01, ``delay:+10%`` where the delay rose by more than 10 % of
the reference. Without a sign the metric's own worse side is meant; both for one that has none.

A reference is a file of records, such as ``records.jsonl``, without what no comparison needs:
intervals, values of single trajectories and costs. So it is small, and a change of it can be read.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from oodd_eval.data.condition import in_suite_order
from oodd_eval.data.facts import ENVIRONMENTS, in_order
from oodd_eval.data.files import packed, write_bytes
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import NAMES, metric_info
from oodd_eval.names import Predicate, check_known, counted
from oodd_eval.results.board import Conditions
from oodd_eval.results.directory import ResultsDirectory, read_records
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, Metric, Record

By = Literal["cell", "group", "mean"]
Side = Literal["+", "-", "±"]
_Unit = tuple[str, str, str]  # split, scope and detector of a difference

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
"""Possible results of the comparison of one figure."""

RESOLUTION: Final = 1e-6  # smaller differences are none: processors order sums differently


class NothingInCommonError(ResultsError):
    """Two sets of records of which no two can be compared."""


@dataclass(frozen=True, slots=True)
class RecordSet:
    """Records by conditions and cell, and where they are from, as messages name it."""

    where: str
    boards: dict[Conditions, dict[Cell, Record]]

    @classmethod
    def of(cls, records: Iterable[Record], where: str = "records") -> "RecordSet":
        """Arrange records for comparison; of several of one cell, the last one counts."""
        boards: dict[Conditions, dict[Cell, Record]] = {}
        for r in records:
            boards.setdefault(Conditions.of(r), {})[r.cell] = r
        return cls(where, boards)

    @property
    def records(self) -> list[Record]:
        """All records."""
        return [record for cells in self.boards.values() for record in cells.values()]

    def selected(self, passes: Predicate) -> "RecordSet":
        """Return the records of those cells only whose text passes."""
        return RecordSet.of((r for r in self.records if passes(str(r.cell))), self.where)

    def metrics(self) -> list[str]:
        """Return the names of all metrics that occur, in their order."""
        return list(dict.fromkeys(name for r in self.records for name in r.metrics))


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The largest change to the worse side: in the metric's unit, or in percent of the reference.

    `worse` is ``"+"`` where a rise is worse, ``"-"`` where a fall is, ``"±"`` where either is.
    """

    metric: str
    worse: Side
    amount: float
    percent: bool = False

    @property
    def text(self) -> str:
        """Sign and number, such as ``-0.01`` or ``+10%``."""
        return f"{self.worse}{self.amount:g}{'%' if self.percent else ''}"

    def allowed(self, reference: float) -> float:
        """Return the largest change that passes, in the metric's unit."""
        return self.amount / 100 * abs(reference) if self.percent else self.amount


def worse_side(metric: str) -> Side:
    """Return the direction in which a metric gets worse; "±" for those that have none.

    Those are null values, the placebo, thresholds, and metrics that this version does not know.
    """
    sides: dict[str, Side] = {"higher": "-", "lower": "+", "": "±"}
    return sides[metric_info(metric).better] if metric in NAMES else "±"


def parse_tolerance(text: str, known: Collection[str] = NAMES) -> Tolerance:
    """Read a tolerance for one of the known metrics, such as ``delay:+10%``.

    UsageError: no such metric, another form, or a sign that is the metric's better side.
    """
    match = re.fullmatch(r"([^:\s]+):([+-]?)(\d+(?:\.\d*)?|\.\d+)(%?)", text.strip())
    if not match:
        raise UsageError(
            f"tolerance {text!r}, expected METRIC:[+-]NUMBER[%] such as 'auc:-0.01' (fell by more "
            "than 0.01) or 'delay:+10%' (rose by more than 10 %)"
        )
    metric, sign, number, percent = match.groups()
    check_known("metric", known, metric)
    worse = worse_side(metric)
    if sign and worse not in (sign, "±"):
        better = "higher" if worse == "-" else "lower"
        raise UsageError(
            f"tolerance {text!r}: of {metric}, {better} is better, so the sign that counts as "
            f"worse is {worse!r}: write '{metric}:{worse}{number}{percent}', and --two-sided to "
            "have improvements fail too"
        )
    side: Side = "+" if sign == "+" else "-" if sign == "-" else worse
    return Tolerance(metric, side, float(number), bool(percent))


def parse_tolerances(texts: Sequence[str], known: Collection[str] = NAMES) -> list[Tolerance]:
    """Read several tolerances as `parse_tolerance`; UsageError: two of one metric."""
    tolerances: dict[str, Tolerance] = {}
    for tolerance in (parse_tolerance(text, known) for text in texts):
        if tolerances.setdefault(tolerance.metric, tolerance) is not tolerance:
            raise UsageError(f"two tolerances for {tolerance.metric}, expected one")
    return list(tolerances.values())


@dataclass(frozen=True, slots=True)
class Difference:
    """One figure now against the reference, NaN where undefined or where there is no such figure.

    The scope is such as ``"hopper/iid"``, of a mean ``"hopper/sensor"`` or ``"mean"``. `outside`
    says that the figure is missing with its whole environment or detector.
    """

    split: str
    scope: str
    detector: str
    tolerance: Tolerance
    reference: float
    now: float
    verdict: Verdict
    fails: bool = False
    reason: str = ""
    outside: bool = False

    def __str__(self) -> str:
        return f"{self.split}/{self.scope}::{self.detector}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """All differences in the order of the reference, new cells last, and under which conditions.

    The notes say what was left out, or is missing as a whole.
    """

    differences: list[Difference]
    by: By
    conditions: list[Conditions]
    notes: list[str]

    @property
    def failures(self) -> list[Difference]:
        """Return the differences for which the comparison fails."""
        return [d for d in self.differences if d.fails]


def compare(
    now: RecordSet,
    reference: RecordSet,
    tolerances: Sequence[Tolerance] = (),
    *,
    by: By = "cell",
    two_sided: bool = False,
) -> Comparison:
    """Compare records with a reference, cells under equal conditions only.

    Means are over the reference's cells: of a group of anomalies in one environment, or all of a
    detector. Without tolerances, all metrics of the reference that have a worse side are compared,
    with tolerance 0. If `two_sided`, what is better by more than the tolerance fails as well.

    A cell of the reference that is missing now, or fails now, fails the comparison; one that failed
    in the reference already does not. A number against NaN is a difference that no tolerance
    covers; NaN against NaN is none.
    """
    common = [c for c in reference.boards if c in now.boards]
    _require_common(now, reference, common)
    # Of a reference in which every cell failed, nothing can be asked but whether they still do.
    metric_names = reference.metrics() or NAMES
    for tolerance in tolerances:
        if tolerance.metric not in metric_names:
            raise UsageError(
                f"metric {tolerance.metric!r} is not in {reference.where}, expected one of "
                f"{', '.join(metric_names)}: write the reference again, or leave the metric out"
            )
    sided = [m for m in NAMES if m in metric_names and worse_side(m) != "±"]
    used = list(tolerances) or [Tolerance(m, worse_side(m), 0.0) for m in sided]
    differences: list[Difference] = []
    new: list[Difference] = []
    notes = []
    for conditions in common:
        expected, present = reference.boards[conditions], now.boards[conditions]
        # Of these environments, or of these settings and seeds, nothing is there now.
        envs, rows = {c.environment for c in present}, {(c.setting, c.seed) for c in present}
        inside = {c for c in expected if c.environment in envs and (c.setting, c.seed) in rows}
        if outside := expected.keys() - inside:
            notes.append(
                f"Missing in {now.where}: {counted(len(outside), 'cell(s)')} of the reference "
                f"(split {conditions.split}; "
                f"environments {_listed(c.environment for c in outside)}; "
                f"detectors {_listed(c.setting.detector for c in outside)}), whose environment or "
                "detector was not run at all. Choose cells to compare with -k."
            )
        for unit, cells in _units(expected, by).items():
            pairs = [(expected[cell], present.get(cell)) for cell in cells]
            compared = _compare_unit(unit, pairs, used, two_sided=two_sided)
            differences += [replace(d, outside=outside >= {*cells}) for d in compared]
        for cell in present.keys() - expected.keys():
            values = [(t, present[cell].value(t.metric)) for t in used]
            new += [Difference(*_parts(cell), t, NAN, value, "new") for t, value in values]
    new.sort(key=lambda d: (d.split, d.detector, d.scope))
    for records, counterpart in ((reference, now), (now, reference)):
        alone = (c for c in records.boards if c not in counterpart.boards)
        notes += [f"Not compared: {c}, which is only in {records.where}." for c in alone]
    return Comparison([*differences, *new], by, common, notes)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(set(names)))


def _require_common(now: RecordSet, reference: RecordSet, common: Sequence[Conditions]) -> None:
    if empty := [records.where for records in (reference, now) if not records.boards]:
        why = f"no cell is selected in {empty[0]}"
    elif not common:
        has = (f"{r.where} has {'; '.join(map(str, r.boards))}" for r in (reference, now))
        why = f"results of different splits, protocols or limits are not compared; {'; '.join(has)}"
    elif not any(reference.boards[c].keys() & now.boards[c].keys() for c in common):
        expected, present = (str(records.records[0].cell) for records in (reference, now))
        which = f"(such as {expected}) is in {now.where} (which has {present})"
        why = f"no cell of {reference.where} {which}"
    else:
        return
    raise NothingInCommonError(f"nothing in common: {why}")


def _parts(cell: Cell) -> _Unit:
    return cell.split, f"{cell.environment}/{cell.condition}", cell.label


def _units(cells: Mapping[Cell, Record], by: By) -> dict[_Unit, list[Cell]]:
    """Sort cells into what is compared as one figure."""
    units: dict[_Unit, list[Cell]] = {}
    for cell, record in cells.items():
        split, scope, detector = _parts(cell)
        scopes = {"cell": scope, "group": f"{cell.environment}/{record.group}", "mean": "mean"}
        units.setdefault((split, scopes[by], detector), []).append(cell)
    return units


def _compare_unit(
    unit: _Unit,
    pairs: Sequence[tuple[Record, Record | None]],
    tolerances: Sequence[Tolerance],
    *,
    two_sided: bool,
) -> list[Difference]:
    """Compare one cell, or the mean over several, in every metric."""
    present = [(r, n) for r, n in pairs if n is not None]
    failed = [n for r, n in present if r.ok and not n.ok]
    both = [(r, n) for r, n in present if r.ok and n.ok]
    recovered = [r.status for r, n in present if n.ok and not r.ok]
    of = f"{{}} of {len(pairs)} cells: " if len(pairs) > 1 else ""
    verdict: Verdict = "same"
    if lost := len(pairs) - len(present):
        verdict, reason, fails = "missing", of.format(lost) + "not there now", True
    elif failed:
        why = ": ".join(filter(None, (failed[0].status, failed[0].reason)))
        verdict, reason, fails = "failed", of.format(len(failed)) + why, True
    elif both:
        return [_compare_metric(unit, both, t, two_sided=two_sided) for t in tolerances]
    elif recovered:
        verdict, reason, fails = "recovered", f"was {recovered[0]}", two_sided
    else:
        reason, fails = f"fails in both: {present[0][1].status}", False
    means = {t: nan_mean(r.value(t.metric) for r, _ in pairs) for t in tolerances}
    return [Difference(*unit, t, means[t], NAN, verdict, fails, reason) for t in tolerances]


def _compare_metric(
    unit: _Unit, both: Sequence[tuple[Record, Record]], tolerance: Tolerance, *, two_sided: bool
) -> Difference:
    values = [(r.value(tolerance.metric), n.value(tolerance.metric)) for r, n in both]
    reference, now = nan_mean(r for r, _ in values), nan_mean(n for _, n in values)
    figure = *unit, tolerance, reference, now
    if turned := [r for r, n in values if math.isnan(r) != math.isnan(n)]:
        undefined_in = "reference" if math.isnan(turned[0]) else "results"
        of = f" in {len(turned)} of {len(both)} cells" if len(both) > 1 else ""
        return Difference(*figure, "undefined", True, f"no value in the {undefined_in}{of}")
    change = 0.0 if math.isnan(reference) else now - reference
    if abs(change) <= RESOLUTION:
        return Difference(*figure, "same")
    if abs(change) <= tolerance.allowed(reference) + RESOLUTION:
        return Difference(*figure, "within")
    worse = tolerance.worse in ("±", "+" if change > 0 else "-")
    return Difference(*figure, "worse" if worse else "better", worse or two_sided)


def read_record_set(path: Path | str) -> RecordSet:
    """Read the records of a results directory or of a file, such as a reference."""
    path = Path(path)
    if not path.exists():
        raise ResultsError(
            f"no results or reference at {str(path)!r}: expected a results directory, or a file of "
            "records (*.jsonl) such as oodd-eval compare --write-reference writes"
        )
    records = ResultsDirectory(path).records() if path.is_dir() else read_records(path)
    return RecordSet.of(records, str(path))


def write_reference(
    records: Iterable[Record], path: Path | str, *, keep: Collection[str] = ()
) -> None:
    """Write a file of records to compare with later: values, without intervals and costs.

    Records stand in the order of the benchmark, whatever the order in which cells ran. Metrics to
    `keep` are the only ones then, with their terms to six digits, from which intervals can be made
    again; a record need not have all of them. A name that ends in ``.gz`` gets a compressed file.
    """
    records = list(records)
    environments = in_order((r.environment for r in records), ENVIRONMENTS)
    conditions = in_suite_order(r.condition for r in records)

    def order(r: Record) -> tuple[str, str, int, int, str]:
        position = environments.index(r.environment), conditions.index(r.condition)
        return r.split, r.split_digest, *position, str(r.cell)

    versions, lines = ("oodd_eval", "python", "numpy"), []
    for r in sorted(records, key=order):
        kept_metrics = {name: m for name, m in r.metrics.items() if name in keep or not keep}
        metrics = {name: Metric(m.value, n=m.n) for name, m in kept_metrics.items()}
        terms = {name: r.per_trajectory[name].round(6) for name in keep if name in r.per_trajectory}
        kept = replace(
            r,
            metrics=metrics,
            per_trajectory=terms,
            calibration_draws=r.calibration_draws.only(terms),
            scores="",
            seconds_fit=NAN,
            seconds_score=NAN,
            steps_scored=None,
            peak_rss_mb=NAN,
            provenance={k: v for k, v in r.provenance.items() if k in versions},
        )
        lines.append(kept.to_json() + "\n")
    content = "".join(lines).encode()
    write_bytes(Path(path), packed(Path(path), content))
