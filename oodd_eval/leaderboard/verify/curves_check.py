"""Check ``curves.json`` against the records, and choose which curves an entry has.

Curves illustrate; they are large, and one fit's picture is as good as another's. So an entry may
have them for some of its rows alone, but nobody may choose the cells or the seed that look best:
curves are of all cells of a fit setting, and of a row's first seed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.entry import CURVES
from oodd_eval.leaderboard.verify.cells import Records, Unit, setting_of
from oodd_eval.leaderboard.verify.files import parse_json, read_whole
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.results.curve_file import check_curves
from oodd_eval.results.record import Record

Extent = Literal["rows", "detectors", "none"]

EXTENTS: Final[tuple[Extent, ...]] = ("rows", "detectors", "none")
"""Curves of every row, of each detector's first row, or none."""

Row = tuple[str, int, str]
"""Detector, horizon, parameters as JSON."""


def row_of(record: Record) -> Row:
    """Return the row of a table that a record belongs to, whatever its seed."""
    detector, horizon, _, parameters = setting_of(record)
    return detector, horizon, parameters


def first_seeds(records: Iterable[Record]) -> dict[Row, int]:
    """Return the lowest seed of each row that has an evaluated cell."""
    found: dict[Row, int] = {}
    for record in records:
        if record.ok:
            row = row_of(record)
            found[row] = min(found.get(row, record.seed), record.seed)
    return found


def with_curves(records: Sequence[Record], extent: Extent) -> list[Record]:
    """Return the records that curves are made of.

    Parameters
    ----------
    records
        Of an entry.
    extent
        ``"rows"``: every row; ``"detectors"``: of each detector the row with the fewest parameters
        that are not defaults, and of these the one with the shortest horizon; ``"none"``.
    """
    seeds = first_seeds(records)
    if extent == "none":
        return []
    if extent == "detectors":
        simplest: dict[str, tuple[int, Row]] = {}
        for record in records:
            if (row := row_of(record)) in seeds:
                own = len(record.overrides), row
                simplest[record.detector] = min(simplest.get(record.detector, own), own)
        chosen = {row for _, row in simplest.values()}
        seeds = {row: seed for row, seed in seeds.items() if row in chosen}
    return [r for r in records if r.ok and seeds.get(row_of(r)) == r.seed]


def read_curves(
    directory: Path, name: str, records: Records, findings: Findings
) -> dict[str, Any] | None:
    """Read and check the curves of an entry; None when they are not sound.

    Parameters
    ----------
    directory
        Of the entry.
    name
        Of the file: ``curves.json``, or its packed form.
    """
    before = findings.count
    try:
        plain = parse_json(read_whole(directory, name))
    except ResultsError as error:
        findings.refuse(name, "", str(error))
        return None
    try:
        curves = check_curves(plain, CURVES)
    except ResultsError as error:
        # Its messages begin with the place: "curves.json: units[0].seed is False, ...".
        place, _, message = str(error).removeprefix(f"{CURVES}: ").partition(" ")
        findings.refuse(name, place.removeprefix(CURVES).rstrip(":"), message)
        return None
    _check_units(curves["units"], name, records, findings)
    return curves if findings.count == before else None


def _check_units(
    units: Sequence[Mapping[str, Any]], name: str, records: Records, findings: Findings
) -> None:
    known = {str(record.cell): record for record in records.values() if record.ok}
    drawn: set[Unit] = set()
    for i, unit in enumerate(units):
        record = known.pop(unit["cell"], None)
        if record is None:
            findings.refuse(
                name, f"units[{i}].cell", f"is {shown(unit['cell'])}, which no record is of"
            )
            continue
        drawn.add(setting_of(record))
        for field, value in _identity(record).items():
            if unit[field] != value:
                findings.refuse(
                    name, f"units[{i}].{field}",
                    f"is {shown(unit[field])}, but {shown(value)} in the record of its cell",
                )  # fmt: skip
        if unit["example"]["index"] >= record.counts["test"]:
            findings.refuse(name, f"units[{i}].example.index", "is no test trajectory")
    for cell, record in known.items():
        if setting_of(record) in drawn:
            findings.refuse(
                name, "units",
                f"lack {cell}: a row has curves of all its evaluated cells, or of none",
            )  # fmt: skip
    first = first_seeds(records.values())
    for detector, horizon, seed, parameters in sorted(drawn):
        if seed != (expected := first[detector, horizon, parameters]):
            findings.refuse(
                name, "units",
                f"are of {detector}[h={horizon},seed={seed}], but a row's curves are of its first "
                f"seed, {expected}",
            )  # fmt: skip


def _identity(record: Record) -> dict[str, Any]:
    names = ("detector", "horizon", "seed", "environment", "anomaly")
    return {
        **{name: getattr(record, name) for name in names},
        "overrides": record.overrides,
    }
