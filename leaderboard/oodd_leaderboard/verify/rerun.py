"""A run of an entry's rows once more, on a split of seeds that are drawn after the entry was made.

The directory of a re-run is a results directory with the split that was built for it, ``split``,
and the order, ``rerun.json``. The order is written before anything is recorded, and names the
digest of each ``entry.json``: seeds that were drawn for some entries do not count for others.

A re-run uses the same code, by its digest, on a split of seeds that the submitter could not know,
so its numbers differ by chance: by the choice of test, calibration and training episodes. An entry
that is better than that, in any environment or on their mean, is refused.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from oodd_eval.metrics.bootstrap import (
    calibration_samples,
    drawn_cell,
    mean_over_cells,
    sample_cells,
)
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.names import counted
from oodd_eval.results.board import contribution, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_leaderboard.entry import Means, read_json
from oodd_leaderboard.verify.files import Findings

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
    "found_within_20_at_5pct",
)
"""Metrics that have to agree with those of a re-run."""

MOST_IN_ONE: Final = 4.0
MOST_ON_MEAN: Final = 3.0
"""Standard errors by which an entry may be better in one environment, and on the mean over them."""

MOST_CLAIMED: Final = 2.0
"""Largest ratio of an entry's standard error, which is the submitter's, to that of its re-run."""

_FIELDS: Final = (
    "detector_version",
    "plugin",
    "plugin_source",
    "status",
    "deterministic",
    "alarm",
    "inputs",
    "training",
)
"""Fields of a record that are the same in a re-run."""


@dataclass(frozen=True, slots=True)
class RerunOrder:
    """128 random bits drawn on a `day` (ISO 8601) for entries, by digests of ``entry.json``.

    `bits` are 32 hexadecimal digits.
    """

    entries: list[str]
    bits: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    day: str
    environments: list[str]
    schema: Literal[3] = 3  # version of the layout; others are refused

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}


def read_order(directory: Path) -> RerunOrder | None:
    """Return the order in a directory, None if it has none; `ResultsError` for a damaged one."""
    file = directory / ORDER
    if not file.exists():
        return None
    return read_json(RerunOrder, file, "is no order of a re-run, use another directory")


class RerunDifference(NamedTuple):
    """A metric of an entry and of its re-run in an environment, or with "" on the mean over them.

    `error` is the standard error of the difference, and `freedom` its degrees of freedom: two less
    than the test episodes of both sides.
    """

    metric: str
    environment: str
    entry: float
    rerun: float
    error: float
    freedom: int

    @property
    def z(self) -> float:
        """By how many standard errors the entry is better; negative where it is worse.

        Few episodes do not tell an error well. Their ratio has a t distribution, and `z` is about
        the quantile of the normal one that is as rare (Wallace, "Bounds on normal approximations to
        Student's and the chi-square distributions", 1959).
        """
        sign = -1 if metric_info(self.metric).better == "lower" else 1
        ratio = sign * (self.entry - self.rerun) / self.error
        n = self.freedom
        rare = (8 * n + 1) / (8 * n + 3) * math.sqrt(n * math.log1p(ratio * ratio / n))
        return math.copysign(rare, ratio)

    @property
    def refused(self) -> bool:
        """True where chance does not explain by how much the entry is better."""
        return self.z > (MOST_IN_ONE if self.environment else MOST_ON_MEAN)


@dataclass(frozen=True, slots=True)
class Rerun:
    """The result of a comparison with a re-run: what a grant says of it, and differences by row.

    It is `complete` when every row of the entry was run again in the order's environments.
    """

    how: str
    differences: dict[str, list[RerunDifference]]
    complete: bool

    @property
    def means(self) -> Means:
        """Means of the entry and of the re-run by row and metric, as a `Grant` has them."""
        return {
            row: {
                d.metric: (float(f"{d.entry:.6g}"), float(f"{d.rerun:.6g}"))
                for d in compared
                if not d.environment
            }
            for row, compared in self.differences.items()
        }

    @property
    def environments(self) -> list[str]:
        """Those in which a row was compared, in order."""
        compared = (d.environment for of_row in self.differences.values() for d in of_row)
        return [*dict.fromkeys(name for name in compared if name)]


def cell_of(record: Record) -> tuple[Setting, str, str, int]:
    """Return row, environment, condition and detector seed of a record."""
    return record.setting, *record.position, record.seed


_PARTS: Final[Mapping[str, Callable[[Record], object]]] = {
    "environments": lambda record: record.environment,
    "kinds of anomalies": lambda record: record.condition,
    "rows": lambda record: record.setting,
    "detector seeds": lambda record: record.seed,
    "cells": cell_of,
}


def compare_rerun(
    records: Mapping[str, Record], fresh: Sequence[Record], order: RerunOrder, findings: Findings
) -> Rerun:
    """Compare an entry's records, by where they stand, with those of its re-run.

    The re-run may be of fewer rows, environments and detector seeds; what it lacks is not compared,
    and said in words.
    """
    again = {cell_of(record): record for record in fresh}
    run = [record for record in records.values() if cell_of(record) in again]
    for where, record in records.items():
        if (other := again.get(cell_of(record))) is None:
            continue
        for name in _FIELDS:
            findings.expect(
                where, name, getattr(other, name), getattr(record, name), "as in the re-run"
            )
        for name in record.metrics.keys() & COMPARED if record.ok and other.ok else ():
            if math.isnan(record.value(name)) and not math.isnan(other.value(name)):
                findings.refuse(where, name, "is undefined, and defined in the re-run")
    compared = {}
    for row in dict.fromkeys(record.setting for record in run):
        # All detector seeds of the entry count, whether they were run again or not.
        ours = grouped((r for r in records.values() if r.setting == row), lambda r: r.environment)
        theirs = grouped(
            (again[cell_of(r)] for r in run if r.setting == row), lambda r: r.environment
        )
        compared[str(row)] = differences({name: (ours[name], theirs[name]) for name in theirs})
        for d in compared[str(row)]:
            if d.refused:
                findings.refuse(
                    "re-run",
                    f"{row} {d.metric} {d.environment or 'mean'}",
                    f"is {d.entry:.4g}, but {d.rerun:.4g} in the re-run: better by {d.z:.2g} "
                    "standard errors, which chance does not explain",
                )
    counts = [
        f"{len(set(map(part, run)))} of {len(set(map(part, records.values())))} {name}"
        for name, part in _PARTS.items()
    ]
    entries = counted(len(order.entries), "entr(y/ies)")
    seeds = f"seeds of 128 random bits, {order.bits}, drawn on {order.day} for {entries}"
    digests = ", ".join(sorted({record.split_digest[:12] for record in fresh})) or "none"
    how = f"{seeds} (split digest {digests}), row by row in a sandbox: {', '.join(counts)}"
    drawn = {cell_of(r)[:3] for r in records.values() if r.environment in order.environments}
    return Rerun(how, compared, drawn == {cell_of(r)[:3] for r in run})


def differences(
    sides: Mapping[str, tuple[Sequence[Record], Sequence[Record]]],
    metrics: Sequence[str] = COMPARED,
) -> list[RerunDifference]:
    """Return how a row's metrics differ from those of its re-run, by environment and on the mean.

    Parameters
    ----------
    sides
        By environment the row's records and those of its re-run. Conditions that only one of them
        has, or in which one leaves a metric undefined, are left out.
    metrics
        Names of those to compare.
    """
    compared = []
    for metric in metrics:
        parts = [
            difference
            for environment, (ours, theirs) in sides.items()
            for difference in _difference(environment, ours, theirs, metric)
        ]
        if parts:
            entry = math.fsum(p.entry for p in parts) / len(parts)
            rerun = math.fsum(p.rerun for p in parts) / len(parts)
            error = math.hypot(*(p.error for p in parts)) / len(parts)
            freedom = sum(p.freedom for p in parts)
            compared += [*parts, RerunDifference(metric, "", entry, rerun, error, freedom)]
    return compared


def _difference(
    environment: str, ours: Sequence[Record], theirs: Sequence[Record], metric: str
) -> Iterator[RerunDifference]:
    """Yield the difference in an environment, if there is a condition that both sides have."""
    defined = [
        [r for r in side if metric in r.per_trajectory and not math.isnan(r.value(metric))]
        for side in (ours, theirs)
    ]
    common = set.intersection(*({r.condition for r in side} for side in defined))
    if not common:
        return
    ours, theirs = ([r for r in side if r.condition in common] for side in defined)
    chance = max(
        _standard_error(theirs, metric), *(_one_episode(s, metric) for s in (ours, theirs))
    )
    claimed = min(max(_standard_error(ours, metric), chance), MOST_CLAIMED * chance)
    entry, rerun = (mean_over_cells((r.seed, r.value(metric)) for r in s) for s in (ours, theirs))
    error = math.hypot(claimed, chance)
    freedom = max(1, sum(_episodes(side, metric) - 1 for side in (ours, theirs)))
    yield RerunDifference(metric, environment, entry, rerun, error, freedom)


def _episodes(records: Sequence[Record], metric: str) -> int:
    """Return of how many test episodes a metric is."""
    return max(len(record.per_trajectory[metric][0]) for record in records)


def _one_episode(records: Sequence[Record], metric: str) -> float:
    """Return by how much one more episode that went as badly as any would change a mean.

    A share or an AUC changes by 1 over the number of episodes. No side is known better than that,
    also where all of its episodes are alike.
    """
    terms = [record.per_trajectory[metric] for record in records]
    worst = max(1.0, *(float(both[0].max(initial=0.0)) for both in terms))
    return worst / sum(float(both[1].sum()) for both in terms)


def _standard_error(records: Sequence[Record], metric: str) -> float:
    """Return the standard error of a row's mean in an environment.

    It is of test episodes, of detector seeds, and of calibration episodes where records say how
    these change the metric.
    """
    cells = [
        drawn_cell(r.environment, r.seed, contribution(r, metric), str(r.condition))
        for r in records
    ]
    n = _episodes(records, metric)
    of_test = float(np.nanstd(sample_cells(cells))) * math.sqrt(n / max(n - 1, 1))
    return math.hypot(of_test, float(calibration_samples(cells).std()))
