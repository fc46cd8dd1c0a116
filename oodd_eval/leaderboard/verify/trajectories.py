"""Compare an entry with the trajectories of the split that it names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import SplitError, UnknownNameError
from oodd_eval.leaderboard.entry import Entry
from oodd_eval.leaderboard.verify.cells import Records
from oodd_eval.leaderboard.verify.findings import Findings
from oodd_eval.leaderboard.verify.identities import SUFFIXES, contributions
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results.record import Record
from oodd_eval.scoring.unit import lengths_of, parts_of


@dataclass(frozen=True, slots=True)
class Facts:
    """What verification needs to know of one environment's trajectories.

    Attributes
    ----------
    sizes
        Numbers of trajectories: ``train``, ``calibration``, ``test``.
    rows
        Observations of each trajectory, by part: ``calibration``, ``test/nominal``, ``test/iid``.
    onsets
        By anomaly.
    """

    sizes: dict[str, int]
    rows: dict[str, list[int]]
    onsets: dict[str, NDArray[np.int64]]


def read_facts(split: Split, environments: Iterable[str]) -> dict[str, Facts]:
    """Read the facts of those environments that a split has; each is verified, which takes time."""
    found = {}
    for environment in dict.fromkeys(environments):
        if environment not in split.environments:
            continue
        data = split.environment(environment)
        try:
            found[environment] = Facts(
                sizes={
                    "train": len(data.train),
                    "calibration": len(data.calibration),
                    "test": len(data.twins),
                },
                rows=lengths_of(parts_of(data, data.anomalies), None),
                onsets={anomaly: data.anomalous(anomaly).onsets for anomaly in data.anomalies},
            )
        finally:
            data.close()
    return found


def find_split(entry: Entry, place: str | Path | None, findings: Findings) -> Split | None:
    """Open the split of an entry; None, with a note, when it is not on this machine.

    Parameters
    ----------
    place
        Name or path of the split; None looks where splits usually are.

    Raises
    ------
    OoddError
        When `place` is given and holds no split.
    """
    try:
        split = load_split(place or entry.split.partition("@")[0])
    except (SplitError, UnknownNameError):
        if place:
            raise
        findings.note(
            f"split {entry.split} is not on this machine: compared with no trajectory, nothing "
            "recomputed (name its place with --split)"
        )
        return None
    if split.digest != entry.split_digest:
        findings.note(
            f"split {split.name} here has digest {split.digest[:12]}, the entry's is "
            f"{entry.split_digest[:12]}: compared with no trajectory, nothing recomputed"
        )
        return None
    return split


def check_against_split(records: Records, facts: dict[str, Facts], findings: Findings) -> None:
    """Check counts, steps and remainders of records against the trajectories they are of."""
    for where, record in records.items():
        if record.environment not in facts:
            findings.refuse(
                where, "environment",
                f"is {record.environment!r}, but the split has {', '.join(facts) or 'none of it'}",
            )  # fmt: skip
        elif record.anomaly not in facts[record.environment].onsets:
            findings.refuse(where, "anomaly", f"is {record.anomaly!r}, not in the split")
        else:
            _check_record(record, facts[record.environment], findings, where)


def _check_record(record: Record, facts: Facts, findings: Findings, where: str) -> None:
    for name, size in facts.sizes.items():
        if record.counts[name] != size:
            findings.refuse(
                where, f"counts.{name}",
                f"is {record.counts[name]}, but the split has {size} trajectories",
            )  # fmt: skip
    if not record.ok or record.counts["test"] != facts.sizes["test"]:
        return
    onsets = facts.onsets[record.anomaly]
    remainders = np.array(facts.rows[f"test/{record.anomaly}"]) - onsets
    rows = {"far": onsets, "far_twin": np.array(facts.rows[TWINS])}
    sums = contributions(record)
    undefined = max(record.horizon, MAX_WARM_UP)
    for suffix in SUFFIXES:
        if f"missed{suffix}" not in sums:
            continue
        missed = sums[f"missed{suffix}"].numerator == 1
        censored = sums[f"delay_censored{suffix}"].numerator
        wrong = np.flatnonzero(np.where(missed, censored != remainders, censored >= remainders))
        if wrong.size:
            i = int(wrong[0])
            findings.refuse(
                where, f"per_trajectory.delay_censored{suffix}",
                f"trajectory {i} is {censored[i]:g}, but the split has {remainders[i]} "
                "observations from its onset on",
            )  # fmt: skip
        for name, steps in rows.items():
            _check_steps(
                sums[f"{name}{suffix}"].denominator, steps, undefined, findings, where,
                f"per_trajectory.{name}{suffix}",
            )  # fmt: skip


def _check_steps(
    scored: NDArray[np.float64], rows: NDArray[np.int64], undefined: int, findings: Findings,
    where: str, field: str,
) -> None:  # fmt: skip
    """Check that as many steps are scored as there are rows, but for a leading block."""
    wrong = np.flatnonzero((scored > rows) | (scored < np.maximum(rows - undefined, 0)))
    if wrong.size:
        i = int(wrong[0])
        findings.refuse(
            where, field,
            f"trajectory {i} has {scored[i]:g} scored steps, but the split {rows[i]} of which at "
            f"most {undefined} may be undefined",
        )  # fmt: skip
