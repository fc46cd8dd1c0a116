"""The verdict on an entry, its comparison with a re-run, and the grant of a level of trust.

A re-run uses the same code, by its digest, on a split of seeds that the submitter could not know,
so its numbers differ by chance. How much chance explains is estimated from environments: each has a
fit, a calibration and episodes of its own. An entry that is better by more than that is refused.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from oodd_eval.data.facts import TABLE1
from oodd_eval.data.split import published_digests
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.entry import EntryInfo
from oodd_eval.leaderboard.grants import TRUST, Grant, Means, Trust, read_grants, write_grants
from oodd_eval.leaderboard.rerun import RerunOrder
from oodd_eval.leaderboard.verify.files import Findings
from oodd_eval.leaderboard.verify.formats import GrantedBy, complaint
from oodd_eval.leaderboard.verify.records import Records
from oodd_eval.metrics.auc import Floats
from oodd_eval.metrics.binomial import t_quantile
from oodd_eval.metrics.bootstrap import DrawnCells, drawn_cell, mean_interval, nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import contribution, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

COMPARED: Final = (
    "auc_matched",
    "auc",
    "far_twin",
    "missed",
    "delay_censored",
    "false_episodes_at_5pct",
    "delay_censored_at_5pct",
)
"""Metrics whose means over a row's cells have to agree with those of a re-run."""

LEVEL: Final = 0.05
"""Chance that an honest row is refused: of all `COMPARED` together (Bonferroni)."""

_NORMAL: Final = 1.96  # half widths of a 95 % interval in standard errors

LEAST: Final = 3
"""Environments in which a row has to be run again, so that a difference has an interval."""

_FIELDS: Final = (
    "detector_version",
    "plugin",
    "plugin_source",
    "status",
    "deterministic",
    "alarm",
    "inputs",
)
"""Fields of a record that are the same in a re-run."""


@dataclass(frozen=True, slots=True)
class Rerun:
    """The result of a comparison with a re-run, in one line and in a line for every row.

    It is confirmed when every row was run again in `LEAST` environments, and all agrees. `means`
    are those of a `Grant`.
    """

    how: str
    lines: list[str]
    confirmed: bool
    means: Means


@dataclass(frozen=True, slots=True)
class EntryVerdict:
    """The result of verifying one entry.

    `entry` is None when ``entry.json`` is not sound, `digest` is that of its bytes; `records` are
    the sound ones, by where they stand; `rescored` says that every metric was recomputed from the
    scores and agrees; `grant` is what maintainers have granted to just this entry.
    """

    name: str
    findings: Findings
    records: Records
    entry: EntryInfo | None = None
    rescored: bool = False
    rerun: Rerun | None = None
    digest: str = ""
    grant: Grant | None = None

    @property
    def ok(self) -> bool:
        """True if no problem was found."""
        return not self.findings.count

    @property
    def trust(self) -> Trust:
        """The level of trust that was granted."""
        return self.grant.trust if self.grant else "reported"

    @property
    def reached(self) -> Trust | None:
        """The level of trust that was established here; None for an entry that is refused."""
        if not self.ok:
            return None
        if self.rerun is not None and self.rerun.confirmed:
            return "re-run"
        return "re-scored" if self.rescored else "reported"


_Place = tuple[Setting, str, str]  # row, environment, condition


def compare_rerun(
    records: Records, fresh: Sequence[Record], findings: Findings, order: RerunOrder | None = None
) -> Rerun:
    """Compare an entry's records with those of the verifier's own run on a split of fresh seeds.

    The run may be of fewer environments and detector seeds, and have more than the entry's rows.
    """
    before = findings.count
    again, place = _usable(records, fresh, findings)
    ours = grouped(records.values(), _place)
    both = {key: (own, again[key]) for key, own in ours.items() if key in again}
    lines, means = [], Means()
    for row in dict.fromkeys(row for row, _, _ in ours):
        own = {(env, condition): pair for (r, env, condition), pair in both.items() if r == row}
        whole = {env for env, _ in own if all((env, a) in own for a in TABLE1)}
        if len(whole) < LEAST:
            why = f"was run again with all anomalies in {len(whole)} environments, expected {LEAST}"
            findings.refuse("re-run", str(row), why)
            continue
        cells = sum(key[0] == row for key in ours)
        told = list(_differences(str(row), own, findings))
        means[str(row)] = {metric: pair for metric, pair, _ in told}
        differences = [text for *_, text in told if text]
        lines.append("; ".join([f"{row}: {len(own)} of {cells} cells run again", *differences]))
    for where, record in records.items():
        for other in again.get(_place(record), ())[:1]:
            for field in _FIELDS:
                new, old = getattr(other, field), getattr(record, field)
                findings.expect(where, field, new, old, "as in the re-run")
    drawn = str(order or "by the verifier's word")
    how = f"{place}, {drawn}, {len(both)} of {len(ours)} cells"
    return Rerun(how, lines, findings.count == before, means)


def _place(record: Record) -> _Place:
    return record.setting, *record.place


def _usable(
    records: Records, fresh: Sequence[Record], findings: Findings
) -> tuple[Mapping[_Place, list[Record]], str]:
    """Return the records of a re-run by place, and its split in words; none if unusable."""
    first = next(iter(records.values()))
    known = {first.split_digest, *published_digests().values()}
    usable = [r for r in fresh if r.protocol == first.protocol and r.limit is None]
    splits = {r.split_digest: r.split for r in usable}
    if len(splits) != 1 or known & splits.keys():
        found = ", ".join(sorted(splits.values())) or "none without --limit"
        expected = "results on one whole split of seeds that nobody could know before"
        findings.refuse("re-run", "split", f"is {found}, expected {expected} (data build)")
        return {}, "nothing"
    ((digest, name),) = splits.items()
    again = grouped(usable, _place)
    for record in records.values():
        for other in again.get(_place(record), ()):
            for part in ("train", "calibration"):
                if other.counts.get(part) != record.counts.get(part):
                    message = f"are {other.counts} in {other.cell}, expected {record.counts}"
                    findings.refuse("re-run", "counts", f"{message} but for test seeds")
                    return {}, "nothing"
    return again, f"fresh seeds (split {name}, digest {digest[:12]})"


def _differences(
    label: str,
    cells: Mapping[tuple[str, str], tuple[list[Record], list[Record]]],
    findings: Findings,
) -> Iterator[tuple[str, tuple[float, float], str]]:
    """Compare means over paired cells of a row; refuse what chance does not explain.

    Yields metric, the entry's mean and the re-run's, and the difference as text where there is one.
    """
    for metric in COMPARED:
        drawn: tuple[list[DrawnCells], list[DrawnCells]] = ([], [])
        pairs: dict[str, list[list[float]]] = {}
        for (environment, _), sides in cells.items():
            own = [
                [
                    drawn_cell(environment, r.seed, contribution(r, metric))
                    for r in side
                    if r.ok and metric in r.per_trajectory
                ]
                for side in sides
            ]
            both = [nan_mean(value for cell in side for value in cell.values) for side in own]
            if not any(map(math.isnan, both)):
                pairs.setdefault(environment, []).append(both)
                for all_of_side, one in zip(drawn, own, strict=True):
                    all_of_side.extend(one)
        means = np.array([np.mean(own, axis=0) for own in pairs.values()]).reshape(-1, 2)
        change = means[:, 0] - means[:, 1]
        if len(change) < 2:
            continue
        info, (mine, other) = metric_info(metric), means.mean(axis=0)
        pair = float(f"{mine:.6g}"), float(f"{other:.6g}")
        if not change.any():
            yield metric, pair, ""
            continue
        ends = [mean_interval(side, kind=info.interval) for side in drawn]
        episodes = math.hypot(
            *(float(np.nan_to_num(high - low)) / 2 / _NORMAL for low, high in ends)
        )
        wide = by_chance(change, episodes)
        environment = list(pairs)[int(np.argmax(np.abs(change)))]
        most = f"most in {environment}, by {np.max(np.abs(change)):.2g}"
        yield metric, pair, f"{metric} {other:.4g} for {mine:.4g} ({most})"
        if (mine - other) * (-1 if info.better == "lower" else 1) > wide:
            message = f"is {other:.4g}, but {mine:.4g} in the entry: chance explains {wide:.2g}"
            findings.refuse("re-run", f"{label} {metric}", f"{message}, not the whole difference")


def by_chance(change: Floats, episodes: float = 0.0) -> float:
    """Return by how much the mean of an honest row may be better than that of its re-run.

    Half of Student's interval of the mean of paired differences `change`, one an environment, on
    one side, at the level that keeps all of `COMPARED` together to `LEVEL`. Few environments may by
    chance differ by nearly the same: the standard error is at least that which the choice of
    `episodes` alone gives.
    """
    n = len(change)
    error = max(float(change.std(ddof=1)) / math.sqrt(n), episodes)
    return t_quantile(1 - LEVEL / len(COMPARED), n - 1) * error


def grant(directory: Path, verdict: EntryVerdict, by: str) -> Grant:
    """Grant an entry the level of trust that its verification by somebody established."""
    if message := complaint(GrantedBy, by):
        raise UsageError(f"--grant {message}")
    level = verdict.reached
    if level is None:
        raise UsageError(f"--grant: {verdict.name} is refused, so nothing is granted")
    if level == "reported" or TRUST.index(level) <= TRUST.index(verdict.trust):
        raise UsageError(
            f"--grant: {verdict.name} has trust {verdict.trust!r}, and what was established here "
            f"is {level!r}: more needs its scores (re-scored) or a run of yours (--rerun)"
        )
    how, means = "every metric recomputed from its scores", Means()
    if verdict.rerun:
        how, means = verdict.rerun.how, verdict.rerun.means
    day = datetime.now(UTC).date().isoformat()
    granted = Grant(verdict.digest, level, by, day, how, means)
    results = directory.absolute().parent
    write_grants(results, read_grants(results) | {verdict.name: granted})
    return granted
