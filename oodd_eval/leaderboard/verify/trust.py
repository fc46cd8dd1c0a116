"""The verdict on an entry, and its level of trust: compared with a run again, and granted.

On the entry's own split a run again gives the same numbers, or nearly so where training depends on
the processor. On a split of fresh seeds it gives other numbers of the same kind: there two means
may differ by what their intervals allow. Either way the code must be the same, by its digest.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from oodd_eval.data.facts import TABLE1
from oodd_eval.data.files import write_text
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.entry import ENTRY, TRUST, EntryInfo, Trust
from oodd_eval.leaderboard.verify.files import Findings
from oodd_eval.leaderboard.verify.formats import RerunBy, complaint
from oodd_eval.leaderboard.verify.records import Records, same
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval, nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.identity import Cell, Setting
from oodd_eval.results.record import Record
from oodd_eval.results.tables.board import contribution

TOLERANCES: Final[Mapping[str, tuple[float, float]]] = {
    "auc_matched": (0.02, 0.0),
    "auc": (0.02, 0.0),
    "far_twin": (0.02, 0.0),
    "missed": (0.05, 0.0),
    "delay_censored": (1.0, 0.1),
    "false_episodes_at_5pct": (0.05, 0.0),
    "delay_censored_at_5pct": (1.0, 0.1),
}
"""Allowed difference of a mean over a row's cells: a number, and a share of the entry's value.

Training on another processor goes another way from some rounding on, and ends like training with
another seed does."""

_FIELDS: Final = ("detector_version", "plugin", "plugin_source", "status", "deterministic", "alarm",
                  "inputs")  # fmt: skip
"""Fields of a record that a run again has, too, on whatever seeds."""

SAME_SPLIT: Final = "the same split"


@dataclass(frozen=True, slots=True)
class Rerun:
    """The result of a comparison with a run again, in one line and in a line for every row.

    It is confirmed when every row was run again in some environment, and all agrees.
    """

    how: str
    lines: list[str]
    confirmed: bool


@dataclass(frozen=True, slots=True)
class EntryVerdict:
    """The result of verifying one entry.

    `entry` is None when ``entry.json`` is not sound; `records` are the sound ones, by where they
    stand; `rescored` says that every metric was recomputed from the scores and agrees.
    """

    name: str
    findings: Findings
    records: Records
    entry: EntryInfo | None = None
    rescored: bool = False
    rerun: Rerun | None = None

    @property
    def ok(self) -> bool:
        """True if no problem was found."""
        return not self.findings.count

    @property
    def reached(self) -> Trust | None:
        """The level of trust that was established here; None for an entry that is refused."""
        if not self.ok:
            return None
        if self.rerun is not None and self.rerun.confirmed:
            return "re-run"
        return "re-scored" if self.rescored else "reported"


_Pair = tuple[str, Record, Record]  # place of an entry's record, the record, and the new one


def compare_rerun(records: Records, fresh: Sequence[Record], findings: Findings) -> Rerun:
    """Compare an entry's records with those of the verifier's own run, on its split or another.

    The run may be of fewer environments, and have more than the entry's cells.
    """
    before = findings.count
    pairs, place = _pairs(records, fresh, findings)
    cells = Counter(record.setting for record in records.values())
    rows: dict[Setting, list[_Pair]] = {setting: [] for setting in cells}
    for pair in pairs:
        rows[pair[1].setting].append(pair)
    lines = []
    for setting, own in rows.items():
        present = {(record.environment, record.anomaly) for _, record, _ in own}
        if not any(all((e, a) in present for a in TABLE1) for e, _ in present):
            why = "all anomalies of an environment: run it again in one at least"
            findings.refuse("re-run", str(setting), f"is not there with {why}")
            continue
        done = f"{setting}: {len(own)} of {cells[setting]} cells run again, {_equal(own)}"
        differences = _differences(str(setting), own, place != SAME_SPLIT, findings)
        lines.append("; ".join([done, *differences]))
    for where, record, again in pairs:
        for field in _FIELDS:
            other = getattr(again, field)
            findings.expect(where, field, other, getattr(record, field), "as in the run again")
    how = f"{place}, {len(pairs)} of {len(records)} cells, {_equal(pairs)}"
    return Rerun(how, lines, confirmed=findings.count == before)


def _equal(pairs: Iterable[_Pair]) -> str:
    """Say how many pairs have the same values."""
    values = [[{n: m.value for n, m in r.metrics.items()} for r in pair[1:]] for pair in pairs]
    equal = sum(a.keys() == b.keys() and all(same(a[n], b[n]) for n in a) for a, b in values)
    return f"{equal} with the same numbers"


def _pairs(
    records: Records, fresh: Sequence[Record], findings: Findings
) -> tuple[list[_Pair], str]:
    """Return the cells that both have, and on what; of fresh seeds, whatever the detector's seed.

    Results on the entry's own split count alone where there are any.
    """
    first = next(iter(records.values()))
    usable = [r for r in fresh if r.protocol == first.protocol and r.limit is None]
    own = [r for r in usable if r.split_digest == first.split_digest]
    splits = {r.split_digest: r.split for r in own or usable}
    if len(splits) != 1:
        found = ", ".join(sorted(splits.values())) or "none without --limit"
        findings.refuse("re-run", "split", f"is {found}, expected results on one whole split")
        return [], "nothing"
    ((digest, name),) = splits.items()

    def key(record: Record) -> Cell:
        return replace(record.cell, split="", seed=record.seed if own else 0)

    again = {key(r): r for r in own or usable}
    pairs = [(w, r, again[key(r)]) for w, r in records.items() if key(r) in again]
    place = SAME_SPLIT if own else f"fresh seeds (split {name}, digest {digest[:12]})"
    for _, record, other in pairs:
        counts = record.counts
        if any(other.counts.get(p) != counts[p] for p in counts if own or p != "test"):
            message = f"are {other.counts} in {other.cell}, expected those of the entry, {counts}"
            findings.refuse("re-run", "counts", message)
            return [], place
    return pairs, place


def _differences(
    label: str, pairs: Sequence[_Pair], other_seeds: bool, findings: Findings
) -> Iterator[str]:
    """Compare means over the cells of a row; yield each as text where it is not the same."""
    both = [records for _, *records in pairs if all(record.ok for record in records)]
    for metric, (least, share) in TOLERANCES.items():
        if not both or any(metric not in r.per_trajectory for side in both for r in side):
            continue
        sides = [
            [drawn_cell(record.environment, 0, contribution(record, metric)) for record in side]
            for side in zip(*both, strict=True)
        ]
        mine, other = (nan_mean(cell.contribution.value for cell in side) for side in sides)
        if same(mine, other):
            continue
        yield f"{metric} {other:.4g} for {mine:.4g}"
        allowed = least + share * abs(mine)
        for side in sides if other_seeds else ():
            low, high = mean_interval(side, kind=metric_info(metric).interval)
            allowed += float(np.nan_to_num(high - low)) / 2
        if not abs(other - mine) <= allowed:
            message = f"is {other:.4g}, but {mine:.4g} in the entry: expected at most {allowed:.2g}"
            findings.refuse("re-run", f"{label} {metric}", f"{message} between them")


def grant(directory: Path, verdict: EntryVerdict, by: str) -> EntryInfo:
    """Raise an entry's level of trust to the one that its verification by somebody established."""
    if message := complaint(RerunBy, by):
        raise UsageError(f"--grant {message}")
    entry, level = verdict.entry, verdict.reached
    if entry is None or level is None:
        raise UsageError(f"--grant: {verdict.name} is refused, so nothing is granted")
    if TRUST.index(level) <= TRUST.index(entry.trust):
        raise UsageError(
            f"--grant: {verdict.name} has trust {entry.trust!r}, and what was established here is "
            f"{level!r}: more needs its scores (re-scored) or a run of yours (--rerun)"
        )
    rerun = None
    if level == "re-run" and verdict.rerun is not None:
        rerun = {"by": by, "how": f"{verdict.rerun.how}, {datetime.now(UTC).date().isoformat()}"}
    granted = replace(entry, trust=level, rerun=rerun)
    write_text(directory / ENTRY, granted.to_json())
    return granted
