"""Compare an entry with the results of a run that its verifier made.

On the entry's own split a run again gives the same numbers, or nearly so where training depends on
the processor. On a split of fresh seeds it gives other numbers of the same kind: there two means
may differ by what their intervals allow. Either way the code must be the same, by its digest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.leaderboard.verify.cells import Records
from oodd_eval.leaderboard.verify.curves_check import Row, row_of
from oodd_eval.leaderboard.verify.findings import Findings
from oodd_eval.leaderboard.verify.identities import contributions, same
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import bootstrap_weights, mean_interval, mean_value
from oodd_eval.results.record import Record

TOLERANCES: Final[Mapping[str, tuple[float, float]]] = {
    "auc_matched": (0.02, 0.0),
    "auc": (0.02, 0.0),
    "far_twin": (0.02, 0.0),
    "missed": (0.05, 0.0),
    "delay_censored": (1.0, 0.1),
}
"""By how much means over a row's cells may differ: a number, and a share of the entry's value.

Training on another processor goes another way from some rounding on, and ends like training with
another seed does."""


@dataclass(frozen=True, slots=True)
class Rerun:
    """What a comparison with a run again came to.

    Attributes
    ----------
    how
        On what it was run again and with what result, in one line.
    lines
        The same, a line for every row.
    confirmed
        Whether every row was run again in some environment, and all agrees.
    """

    how: str
    lines: list[str]
    confirmed: bool


Pair = tuple[str, Record, Record]
"""Where a record of the entry stands, the record, and that of the run again."""


def compare_rerun(records: Records, fresh: Sequence[Record], findings: Findings) -> Rerun:
    """Compare an entry's records with those of the verifier's own run.

    Parameters
    ----------
    records
        Of the entry, verified.
    fresh
        Of the run again, on the same split or on one of fresh seeds; possibly of fewer
        environments, and with more than the entry's cells.
    findings
        Receives what does not agree.
    """
    before = findings.count
    pairs, where = _pairs(records, fresh, findings)
    cells = Counter(row_of(r) for r in records.values())
    labels = {row_of(r): _label(r) for r in records.values()}
    rows: dict[Row, list[Pair]] = {row: [] for row in cells}
    for pair in pairs:
        rows[row_of(pair[1])].append(pair)
    lines = []
    for row, own in rows.items():
        if not _has_an_environment(own):
            findings.refuse(
                "re-run", labels[row], "is not there with all anomalies of an environment: run it "
                "again in one at least",
            )  # fmt: skip
            continue
        differences = list(_differences(labels[row], own, where, findings))
        equal = sum(_equal(r, again) for _, r, again in own)
        lines.append(
            f"{labels[row]}: {len(own)} of {cells[row]} cells run again, {equal} with the same "
            "numbers" + "".join(f"; {text}" for text in differences)
        )
    for field in ("detector_version", "plugin", "provenance.plugin_source", "status"):
        _compare_field(field, pairs, findings)
    confirmed = findings.count == before
    equal = sum(_equal(r, again) for _, r, again in pairs)
    how = f"{where}, {len(pairs)} of {len(records)} cells, {equal} with the same numbers"
    return Rerun(how, lines, confirmed)


def _pairs(records: Records, fresh: Sequence[Record], findings: Findings) -> tuple[list[Pair], str]:
    """Return the cells that both have, and on what; of fresh seeds, whatever the detector's seed.

    Results on the entry's own split count alone where there are any.
    """
    first = next(iter(records.values()))
    usable = [r for r in fresh if r.protocol == first.protocol and r.limit is None]
    own = [r for r in usable if r.split_digest == first.split_digest]
    digests = {r.split_digest: r.split for r in own or usable}
    if len(digests) != 1:
        found = ", ".join(sorted(digests.values())) or "none without --limit"
        findings.refuse("re-run", "split", f"is {found}, expected results on one whole split")
        return [], "nothing"
    ((digest, name),) = digests.items()
    again = {_cell(r, seeds=bool(own)): r for r in own or usable}
    pairs = [
        (where, record, again[key])
        for where, record in records.items()
        if (key := _cell(record, seeds=bool(own))) in again
    ]
    where = "the same split" if own else f"fresh seeds (split {name}, digest {digest[:12]})"
    for _, record, other in pairs:
        sizes = record.counts if own else {k: record.counts[k] for k in ("train", "calibration")}
        if any(other.counts.get(k) != n for k, n in sizes.items()):
            findings.refuse(
                "re-run", "counts",
                f"are {other.counts} in {other.cell}, expected those of the entry, {sizes}",
            )  # fmt: skip
            return [], where
    return pairs, where


def _cell(record: Record, *, seeds: bool) -> tuple[object, ...]:
    key = (*row_of(record), record.environment, record.anomaly)
    return (*key, record.seed) if seeds else key


def _has_an_environment(pairs: Iterable[Pair]) -> bool:
    found: dict[str, set[str]] = {}
    for _, record, _ in pairs:
        found.setdefault(record.environment, set()).add(record.anomaly)
    return any(anomalies == set(ANOMALIES) for anomalies in found.values())


def _differences(
    label: str, pairs: Sequence[Pair], where: str, findings: Findings
) -> Iterator[str]:
    """Compare means over the cells of a row; yield each as text where it is not the same."""
    both = [(r, again) for _, r, again in pairs if r.ok and again.ok]
    for metric, (least, share) in TOLERANCES.items() if both else ():
        sides = [[contributions(pair[i])[metric] for pair in both] for i in (0, 1)]
        values = [mean_value(side) for side in sides]
        if same(*values):
            continue
        yield f"{metric} {values[1]:.4g} for {values[0]:.4g}"
        allowed = least + share * abs(values[0])
        if where != "the same split":
            allowed += sum(_half(side, [p[0] for p in both]) for side in sides)
        if not abs(values[1] - values[0]) <= allowed:
            findings.refuse(
                "re-run", f"{label} {metric}",
                f"is {values[1]:.4g}, but {values[0]:.4g} in the entry: expected at most "
                f"{allowed:.2g} between them",
            )  # fmt: skip


def _half(side: Sequence[Contribution], records: Sequence[Record]) -> float:
    """Return half the width of a mean's 95 % interval."""
    weights = [
        bootstrap_weights(len(c.numerator), key=r.environment)
        for c, r in zip(side, records, strict=True)
    ]
    low, high = mean_interval(side, weights)
    return float(np.nan_to_num(high - low)) / 2


def _equal(record: Record, again: Record) -> bool:
    if record.metrics.keys() != again.metrics.keys():
        return False
    return all(same(record.value(name), again.value(name)) for name in record.metrics)


def _compare_field(field: str, pairs: Iterable[Pair], findings: Findings) -> None:
    """Refuse the first record that has another value of a field in the run again."""
    for where, record, again in pairs:
        mine, other = (
            r.plugin_source if "." in field else getattr(r, field) for r in (record, again)
        )
        if mine != other:
            findings.refuse(
                where, field, f"is {mine!s:.40}, but {other!s:.40} in the run again"
            )  # fmt: skip
            return


def _label(record: Record) -> str:
    """Return a row's name: that of its cells without the seed."""
    settings = [f"h={record.horizon}"]
    settings += [f"{k}={v}" for k, v in record.overrides.items()]
    return f"{record.detector}[{','.join(settings)}]"
