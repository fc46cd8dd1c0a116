"""Check the fields of single records, before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, PROTOCOL
from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.verify import rules
from oodd_eval.leaderboard.verify.files import MB, parse_json, read_whole
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.results.record import SCHEMA, STATUSES, Record

MOST_RECORDS: Final = 20_000
MOST_LINE: Final = 4 * MB
MOST_TEST: Final = 2_000
"""Largest number of test trajectories: with more, recomputing the intervals takes too much room."""

_FIELDS: Final[Mapping[str, rules.Rule]] = {
    "schema": rules.one_of([SCHEMA]),
    "protocol": rules.one_of([PROTOCOL]),
    "cell": rules.text(500, least=1),
    "detector": rules.detector_name,
    "detector_version": rules.version,
    "plugin": rules.plugin_name,
    "parameters": rules.mapping,
    "environment": rules.one_of(ENVIRONMENTS),
    "anomaly": rules.one_of(ANOMALIES),
    "group": rules.one_of(GROUPS),
    "horizon": rules.whole(1, 100_000),
    "seed": rules.whole(0),
    "split": rules.split_name,
    "split_digest": rules.digest,
    "status": rules.one_of(STATUSES),
    "reason": rules.text(1000),
    "metrics": rules.mapping,
    "counts": rules.mapping,
    "per_trajectory": rules.mapping,
    "seconds_fit": rules.cost,
    "seconds_score": rules.cost,
    "peak_rss_mb": rules.cost,
    "provenance": rules.mapping,
}
_COUNTS: Final = {
    "train": rules.whole(1),
    "calibration": rules.whole(1),
    "test": rules.whole(1, MOST_TEST),
}
_METRIC: Final = {
    "value": rules.number_or_null,
    "low": rules.number_or_null,
    "high": rules.number_or_null,
    "n": rules.whole(0, MOST_TEST),
}
_PROVENANCE: Final[Mapping[str, rules.Rule]] = {
    "oodd_eval": rules.version,
    "numpy": rules.version,
    "python": rules.version,
    "plugin_source": rules.digest,
    "scores": rules.score_key,
    "limit": lambda value: "" if value is None else
        f"is {shown(value)}, expected null: an entry uses all trajectories of its split",
    "overrides": rules.mapping,
}  # fmt: skip
"""Fields of the provenance that every record has and something depends on."""

_OPTIONAL: Final[Mapping[str, rules.Rule]] = {
    "inputs": rules.one_of(["observations", "observations+actions"]),
    "steps_scored": rules.whole(0),
}
"""Fields of the provenance that are shown where they are there; all others are held to be plain."""


def read_records(directory: Path, name: str, findings: Findings) -> dict[str, Record]:
    """Read the records of an entry and check every field.

    Parameters
    ----------
    directory
        Of the entry.
    name
        Of the file: ``records.jsonl``, or its packed form.

    Returns
    -------
    The records whose fields are sound, by where they stand: ``records.jsonl:3 (<cell>)``.
    """
    try:
        content = read_whole(directory, name)
    except ResultsError as error:
        findings.refuse(name, "", str(error))
        return {}
    *lines, rest = content.split("\n")
    if rest:
        lines.append(rest)
        findings.refuse(
            f"{name}:{len(lines)}", "", "does not end with a new line: the file is cut off"
        )
    if not lines or len(lines) > MOST_RECORDS:
        findings.refuse(name, "", f"has {len(lines)} records, expected 1 to {MOST_RECORDS}")
        return {}
    found = {}
    for number, line in enumerate(lines, start=1):
        where = f"{name}:{number}"
        record = _read_record(line, where, findings)
        if record is not None:
            found[f"{where} ({record.cell})"] = record
    return found


def _read_record(line: str, where: str, findings: Findings) -> Record | None:
    if len(line) > MOST_LINE or not line.isprintable():
        reason = "control characters" if len(line) <= MOST_LINE else f"{len(line)} characters"
        findings.refuse(where, "", f"has {reason}, expected one record in plain JSON")
        return None
    try:
        plain = parse_json(line)
    except ResultsError as error:
        findings.refuse(where, "", str(error))
        return None
    if isinstance(plain, dict) and not rules.text(200)(plain.get("cell")):
        where += f" ({plain['cell']})"
    before = findings.count
    rules.check_fields(plain, _FIELDS, findings, where)
    if isinstance(plain, dict):
        _check_parts(plain, findings, where)
    if findings.count > before:
        return None
    record = Record.from_json(line, where)
    check_names(record, findings, where)
    return record


def _check_parts(plain: Mapping[str, Any], findings: Findings, where: str) -> None:
    """Check the fields of a record that are objects themselves."""

    def part(field: str) -> dict[str, Any]:
        return plain[field] if isinstance(plain.get(field), dict) else {}

    if "counts" in plain:
        rules.check_fields(plain["counts"], _COUNTS, findings, where, "counts.")
    for name, metric in part("metrics").items():
        rules.check_fields(metric, _METRIC, findings, where, f"metrics.{shown(name)[1:-1]}.")
    for name, pair in part("per_trajectory").items():
        if complaint := _pair(pair):
            findings.refuse(where, f"per_trajectory.{shown(name)[1:-1]}", complaint)
    for name, value in part("parameters").items():
        if complaint := rules.parameter_name(name) or rules.plain(value):
            findings.refuse(where, f"parameters.{shown(name)[1:-1]}", complaint)
    provenance = part("provenance")
    expected = {**_PROVENANCE, **{n: r for n, r in _OPTIONAL.items() if n in provenance}}
    known = {name: value for name, value in provenance.items() if name in expected}
    if provenance or "provenance" in plain:
        rules.check_fields(known, expected, findings, where, "provenance.")
    for name, value in provenance.items():
        if complaint := rules.name(name) or rules.plain(value):
            findings.refuse(where, f"provenance.{shown(name)[1:-1]}", complaint)


def _pair(pair: Any) -> str:
    """Complain of what is not two lists of numbers of equal length."""
    if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(p, list) for p in pair):
        return f"is {shown(pair)}, expected a list of numerators and one of denominators"
    if len(pair[0]) != len(pair[1]):
        return f"has {len(pair[0])} numerators and {len(pair[1])} denominators"
    for side, values in zip(("numerator", "denominator"), pair, strict=True):
        for i, value in enumerate(values):
            if complaint := rules.number(value):
                return f"{side} {i} {complaint}"
    return ""


def check_names(record: Record, findings: Findings, where: str) -> None:
    """Check that cell, group, overrides and status say the same as the other fields."""
    overrides = record.overrides
    for name, value in overrides.items():
        if name not in record.parameters or not _same(record.parameters[name], value):
            findings.refuse(
                where, f"provenance.overrides.{name}",
                f"is {shown(value)}, but parameters.{name} is "
                f"{shown(record.parameters.get(name))}",
            )  # fmt: skip
    group = ANOMALIES[record.anomaly].group
    if record.group != group:
        findings.refuse(
            where, "group", f"is {record.group!r}, but {record.anomaly} belongs to {group!r}"
        )
    if record.ok and record.reason:
        findings.refuse(where, "reason", "must be empty where status is 'ok'")
    if not record.ok and not record.reason:
        findings.refuse(where, "reason", f"is empty, but status is {record.status!r}: say why")
    for field, value in (("metrics", record.metrics), ("per_trajectory", record.per_trajectory)):
        if not record.ok and value:
            findings.refuse(where, field, f"must be empty where status is {record.status!r}")


def _same(first: Any, second: Any) -> bool:
    """Compare JSON values; 1, 1.0 and true are three things."""
    return type(first) is type(second) and bool(first == second)
