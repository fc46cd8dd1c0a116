"""Recompute the metrics and curves of an entry from its scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import Split
from oodd_eval.errors import OoddError, ResultsError
from oodd_eval.leaderboard.entry import CURVES, SCORES
from oodd_eval.leaderboard.verify.cells import Records
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.leaderboard.verify.identities import same
from oodd_eval.leaderboard.verify.trajectories import Facts
from oodd_eval.results.curves import make_curves
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.record import Record
from oodd_eval.scoring.unit import CALIBRATION

ROUNDED: Final = {"rel_tol": 0.01, "abs_tol": 2e-5}
"""Tolerance of curves, which are rounded to three digits and five decimals."""


def check_rescored(
    records: Records, directory: Path, split: Split, facts: Mapping[str, Facts], findings: Findings
) -> bool:
    """Recompute the metrics of records from the entry's scores and compare.

    Returns
    -------
    Whether all could be recomputed and agree.
    """
    before = findings.count
    results = ResultsDirectory(directory)
    fitting = _fitting(records, results, facts, findings)
    try:
        fresh = rescore(list(fitting.values()), results, split)
    except (OoddError, ArithmeticError) as error:
        findings.refuse(SCORES, "", f"cannot be scored again: {error}")
        return False
    for (where, record), again in zip(fitting.items(), fresh, strict=True):
        _compare(record, again, findings, where)
    return findings.count == before


def _fitting(
    records: Records, results: ResultsDirectory, facts: Mapping[str, Facts], findings: Findings
) -> dict[str, Record]:
    """Return the records whose scores have the lengths of the split's trajectories."""
    fitting: dict[str, Record] = {}
    for where, record in records.items():
        rows = facts[record.environment].rows if record.environment in facts else {}
        parts = (CALIBRATION, TWINS, f"test/{record.anomaly}")
        if not all(part in rows for part in parts):
            continue  # Complained of already.
        key = record.scores
        if results.scores(key, {part: rows[part] for part in parts}) is None:
            findings.refuse(
                f"{SCORES}/{key}.h5", parts[-1],
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
    drawn = {unit["cell"] for unit in curves["units"]}
    try:
        fresh = make_curves(
            [r for r in records if str(r.cell) in drawn], ResultsDirectory(directory), split
        )  # fmt: skip
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
