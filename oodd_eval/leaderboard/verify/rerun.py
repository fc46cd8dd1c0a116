"""A run of an entry's rows once more, on a split of seeds that are drawn after the entry was made.

The directory of a re-run is a results directory with the split that was built for it, ``split``,
and the order, ``rerun.json``. The order is written before anything is recorded, and names the
digest of ``entry.json``: seeds that were drawn for one entry do not count for another.

A re-run uses the same code, by its digest, on a split of seeds that the submitter could not know,
so its numbers differ by chance. How much chance explains is estimated from environments: each has a
fit, a calibration and episodes of its own. An entry that is better by more than that is refused.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np

from oodd_eval.data.facts import TABLE1
from oodd_eval.data.split import published_digests
from oodd_eval.leaderboard.entry import Means, read_json
from oodd_eval.leaderboard.verify.files import Findings
from oodd_eval.leaderboard.verify.recompute import Records
from oodd_eval.metrics.auc import Floats
from oodd_eval.metrics.binomial import t_quantile
from oodd_eval.metrics.bootstrap import DrawnCells, drawn_cell, mean_interval, nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import contribution, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

ORDER: Final = "rerun.json"
SPLIT_DIRECTORY: Final = "split"  # directory of the split, in that of the re-run

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
class RerunOrder:
    """Seeds drawn on a `day` (ISO 8601) for an entry, given by the digest of its ``entry.json``.

    `sandbox` is False as soon as one worker was a plain one.
    """

    entry: str
    seed_base: int
    day: str
    environments: list[str]
    sandbox: bool
    schema: Literal[1] = 1  # version of the layout; others are refused

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    def __str__(self) -> str:
        """Return what a grant says of it."""
        where = "in a sandbox" if self.sandbox else "without a sandbox"
        return f"seed base {self.seed_base} drawn on {self.day} for this entry, {where}"


def read_order(directory: Path) -> RerunOrder | None:
    """Return the order in a directory, None if it has none; `ResultsError` for a damaged one."""
    file = directory / ORDER
    if not file.exists():
        return None
    return read_json(RerunOrder, file, "is no order of a re-run, use another directory")


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


_CellKey = tuple[Setting, str, str]  # row, environment, condition


def compare_rerun(
    records: Records, fresh: Sequence[Record], findings: Findings, order: RerunOrder | None = None
) -> Rerun:
    """Compare an entry's records with those of the verifier's own run on a split of fresh seeds.

    The run may be of fewer environments and detector seeds, and have more than the entry's rows.
    """
    before = findings.count
    again, source = _usable(records, fresh, findings)
    ours = grouped(records.values(), _cell_of)
    pairs = {key: (cells, again[key]) for key, cells in ours.items() if key in again}
    lines, means = [], Means()
    for row in dict.fromkeys(row for row, _, _ in ours):
        of_row = {(env, a): pair for (r, env, a), pair in pairs.items() if r == row}
        whole = {env for env, _ in of_row if all((env, a) in of_row for a in TABLE1)}
        if len(whole) < LEAST:
            why = f"was run again with all anomalies in {len(whole)} environments, expected {LEAST}"
            findings.refuse("re-run", str(row), why)
            continue
        cells = sum(key[0] == row for key in ours)
        compared = list(_differences(str(row), of_row, findings))
        means[str(row)] = {metric: pair for metric, pair, _ in compared}
        differences = [text for *_, text in compared if text]
        lines.append("; ".join([f"{row}: {len(of_row)} of {cells} cells run again", *differences]))
    for where, record in records.items():
        for other in again.get(_cell_of(record), ())[:1]:
            for field in _FIELDS:
                new, old = getattr(other, field), getattr(record, field)
                findings.expect(where, field, new, old, "as in the re-run")
    drawn = str(order or "by the verifier's word")
    how = f"{source}, {drawn}, {len(pairs)} of {len(ours)} cells"
    return Rerun(how, lines, findings.count == before, means)


def _cell_of(record: Record) -> _CellKey:
    return record.setting, *record.position


def _usable(
    records: Records, fresh: Sequence[Record], findings: Findings
) -> tuple[Mapping[_CellKey, list[Record]], str]:
    """Return the records of a re-run by row and cell, and its split in words; none if unusable."""
    first = next(iter(records.values()))
    known = {first.split_digest, *published_digests().values()}
    usable = [r for r in fresh if r.protocol == first.protocol and r.limit is None]
    splits = {r.split_digest: r.split for r in usable}
    if len(splits) != 1 or known & splits.keys():
        names = ", ".join(sorted(splits.values())) or "none without --limit"
        expected = "results on one whole split of seeds that nobody could know before"
        findings.refuse("re-run", "split", f"is {names}, expected {expected} (data build)")
        return {}, "nothing"
    ((digest, name),) = splits.items()
    again = grouped(usable, _cell_of)
    for record in records.values():
        for other in again.get(_cell_of(record), ()):
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
            by_side = [
                [
                    drawn_cell(environment, r.seed, contribution(r, metric), str(r.condition))
                    for r in side
                    if r.ok and metric in r.per_trajectory
                ]
                for side in sides
            ]
            both = [nan_mean(value for cell in side for value in cell.values) for side in by_side]
            if not any(map(math.isnan, both)):
                pairs.setdefault(environment, []).append(both)
                for all_of_side, of_cell in zip(drawn, by_side, strict=True):
                    all_of_side.extend(of_cell)
        means = np.array([np.mean(both, axis=0) for both in pairs.values()]).reshape(-1, 2)
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
