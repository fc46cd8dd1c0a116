"""Compare an entry with the split it names, and recompute its metrics from its scores."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.curves import make_curves
from oodd_eval.detector import MAX_WARM_UP
from oodd_eval.errors import OoddError, ResultsError, SplitError, UnknownNameError
from oodd_eval.evaluation import rescore
from oodd_eval.records import Record
from oodd_eval.results import ResultsDirectory
from oodd_eval.scoring import lengths_of, parts_of
from oodd_eval.splits import EnvironmentData, Split, load_split
from oodd_eval.submission.cells import Records
from oodd_eval.submission.findings import Findings, shown
from oodd_eval.submission.format import CURVES, SCORES, Entry
from oodd_eval.submission.identities import SUFFIXES, contributions, same

ROUNDED: Final = {"rel_tol": 0.01, "abs_tol": 2e-5}
"""Tolerance of curves, which are rounded to three digits and five decimals."""


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


def check_against_split(records: Records, split: Split, findings: Findings) -> None:
    """Check counts, steps and remainders of records against the trajectories they are of."""
    by_environment: dict[str, dict[str, Record]] = defaultdict(dict)
    for where, record in records.items():
        by_environment[record.environment][where] = record
    for environment, own in by_environment.items():
        if environment not in split.environments:
            findings.refuse(
                next(iter(own)), "environment",
                f"is {environment!r}, but split {split.name} has {', '.join(split.environments)}",
            )  # fmt: skip
            continue
        data = split.environment(environment)
        try:
            for where, record in own.items():
                _check_record(record, data, findings, where)
        finally:
            data.close()


def _check_record(record: Record, data: EnvironmentData, findings: Findings, where: str) -> None:
    sizes = {"train": data.train, "calibration": data.calibration, "test": data.twins}
    for name, trajectories in sizes.items():
        if record.counts[name] != len(trajectories):
            findings.refuse(
                where, f"counts.{name}",
                f"is {record.counts[name]}, but the split has {len(trajectories)} trajectories",
            )  # fmt: skip
    if record.anomaly not in data.anomalies:
        findings.refuse(where, "anomaly", f"{record.anomaly} is not in this split")
        return
    if not record.ok or record.counts["test"] != len(data.twins):
        return
    anomalous = data.anomalous(record.anomaly)
    onsets = anomalous.onsets
    remainders = anomalous.lengths + 1 - onsets
    rows = {"far": onsets, "far_twin": data.twins.lengths + 1}
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


def check_rescored(records: Records, directory: Path, split: Split, findings: Findings) -> bool:
    """Recompute the metrics of records from the entry's scores and compare.

    Returns
    -------
    Whether all could be recomputed and agree.
    """
    before = findings.count
    results = ResultsDirectory(directory)
    fitting = _fitting(records, results, split, findings)
    try:
        fresh = rescore(list(fitting.values()), results, split)
    except (OoddError, ArithmeticError) as error:
        findings.refuse(SCORES, "", f"cannot be scored again: {error}")
        return False
    for (where, record), again in zip(fitting.items(), fresh, strict=True):
        _compare(record, again, findings, where)
    return findings.count == before


def _fitting(
    records: Records, results: ResultsDirectory, split: Split, findings: Findings
) -> dict[str, Record]:
    """Return the records whose scores have the lengths of the split's trajectories."""
    fitting: dict[str, Record] = {}
    lengths: dict[tuple[str, str], dict[str, list[int]]] = {}
    for environment in {record.environment for record in records.values()}:
        if environment not in split.environments:
            continue
        data = split.environment(environment)
        for anomaly in data.anomalies:
            lengths[environment, anomaly] = lengths_of(parts_of(data, (anomaly,)), None)
        data.close()
    for where, record in records.items():
        expected = lengths.get((record.environment, record.anomaly))
        key = str(record.provenance["scores"])
        if expected is None:
            continue
        if results.scores(key, expected) is None:
            findings.refuse(
                f"{SCORES}/{key}.h5", f"test/{record.anomaly}",
                "does not fit the split: its trajectories, those of calibration or of the twins "
                "have other lengths",
            )  # fmt: skip
        else:
            fitting[where] = record
    return fitting


def _compare(record: Record, again: Record, findings: Findings, where: str) -> None:
    for name in sorted(record.metrics.keys() ^ again.metrics.keys()):
        state = "missing" if name in again.metrics else "not to be had"
        findings.refuse(where, f"metrics.{name}", f"is {state}: the scores say otherwise")
    for name in sorted(record.metrics.keys() & again.metrics.keys()):
        for end in ("value", "low", "high", "n"):
            stored = getattr(record.metrics[name], end)
            found = getattr(again.metrics[name], end)
            if not same(stored, found):
                findings.refuse(
                    where, f"metrics.{name}.{end}", f"is {stored}, but the scores give {found}"
                )
    for name in sorted(record.per_trajectory.keys() & again.per_trajectory.keys()):
        sides = zip(
            ("numerator", "denominator"),
            record.per_trajectory[name], again.per_trajectory[name], strict=True,
        )  # fmt: skip
        for side, stored_all, found_all in sides:
            for i, (stored, found) in enumerate(zip(stored_all, found_all, strict=False)):
                if not same(stored, found):
                    findings.refuse(
                        where, f"per_trajectory.{name}",
                        f"{side} {i} is {stored}, but the scores give {found}",
                    )  # fmt: skip


def check_recomputed_curves(
    curves: Mapping[str, Any], records: Sequence[Record], directory: Path, split: Split,
    findings: Findings,
) -> None:  # fmt: skip
    """Recompute an entry's curves from its scores and compare."""
    try:
        fresh = make_curves(records, ResultsDirectory(directory), split)
    except ResultsError as error:
        findings.refuse(CURVES, "", f"cannot be computed again: {error}")
        return
    again = {unit["cell"]: unit for unit in fresh["units"]}
    for i, unit in enumerate(curves["units"]):
        if unit["cell"] in again and (path := _difference(unit, again[unit["cell"]])):
            findings.refuse(
                f"{CURVES} ({unit['cell']})", f"units[{i}]{path[0]}",
                f"is {shown(path[1])}, but the scores give {shown(path[2])}",
            )  # fmt: skip


def _difference(stored: Any, found: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """Return the first place where two JSON values differ by more than rounding, and both."""
    if isinstance(stored, dict) and isinstance(found, dict) and stored.keys() == found.keys():
        pairs = ((f".{k}", stored[k], found[k]) for k in stored)
    elif isinstance(stored, list) and isinstance(found, list) and len(stored) == len(found):
        pairs = ((f"[{i}]", *both) for i, both in enumerate(zip(stored, found, strict=True)))
    elif isinstance(stored, float | int) and isinstance(found, float | int):
        close = math.isclose(stored, found, **ROUNDED)
        return None if close else (path, stored, found)
    else:
        return None if stored == found else (path, stored, found)
    return next(filter(None, (_difference(a, b, path + step) for step, a, b in pairs)), None)
