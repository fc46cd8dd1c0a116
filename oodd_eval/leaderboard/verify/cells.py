"""What has to hold between the records of an entry, and between them and ``entry.json``."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.leaderboard.entry import ENTRY, Entry
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.leaderboard.verify.identities import SUFFIXES, same
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.record import Record

Records = Mapping[str, Record]
"""Records by where they stand."""

Unit = tuple[str, int, int, str]
"""Detector, horizon, seed, parameters as JSON."""

MOST_ROWS: Final = 64
"""Detectors with their horizons and parameters; the paper's comparisons are some twenty."""

_SHARED: Final = ("far_twin", *(f"far_twin{suffix}" for suffix in SUFFIXES[1:]))
"""Metrics that a unit's cells share: they are of the twins alone."""


PLACE: Final = "device"
"""The parameter that says where a detector computes; it makes no other detector."""


def setting_of(record: Record) -> Unit:
    """Return what tells one row of a table from another, and its seed."""
    parameters = {k: v for k, v in record.parameters.items() if k != PLACE}
    return (
        record.detector, record.horizon, record.seed, json.dumps(parameters, sort_keys=True)
    )  # fmt: skip


def check_cells(entry: Entry, records: Records, findings: Findings) -> None:
    """Check an entry's records against each other and against ``entry.json``."""
    _check_common(entry, records, findings)
    _check_plugins(entry, records, findings)
    _check_environment(entry, records, findings)
    _check_complete(records, findings)
    _check_parameters(records, findings)
    _check_counts(records, findings)
    _check_shared(records, findings)
    _check_remainders(records, findings)


def _check_common(entry: Entry, records: Records, findings: Findings) -> None:
    for where, record in records.items():
        for field in ("split", "split_digest", "protocol"):
            if getattr(record, field) != getattr(entry, field):
                findings.refuse(
                    where, field,
                    f"is {shown(getattr(record, field))}, but the entry is of "
                    f"{shown(getattr(entry, field))}: an entry has one {field}",
                )  # fmt: skip
    found = sorted({record.detector for record in records.values()})
    if found != entry.detectors:
        findings.refuse(
            ENTRY, "detectors", f"is {shown(entry.detectors)}, but the records are of {found}"
        )


def _check_plugins(entry: Entry, records: Records, findings: Findings) -> None:
    """Check that each detector is from one plug-in of one version and source, as the entry says."""
    listed = {
        (f"{p['distribution']}:{p['plugin']}", p["version"], p["source_digest"])
        for p in entry.plugins
    }
    if len(listed) != len(entry.plugins):
        findings.refuse(ENTRY, "plugins", "names a plug-in twice")
    used: dict[str, tuple[str, str, str]] = {}
    for where, record in records.items():
        source = (record.plugin, record.detector_version, record.plugin_source)
        first = used.setdefault(record.detector, source)
        fields = ("plugin", "detector_version", "provenance.plugin_source")
        for field, value, expected in zip(fields, source, first, strict=True):
            if value != expected:
                findings.refuse(
                    where, field,
                    f"is {shown(value)}, but other records of {record.detector} have "
                    f"{shown(expected)}: a detector has one source in an entry",
                )  # fmt: skip
        if source == first and source not in listed:
            findings.refuse(
                ENTRY, "plugins",
                f"do not name {record.plugin} {record.detector_version} with source_digest "
                f"{source[2][:12]}, which {where} is from",
            )  # fmt: skip
            listed.add(source)
    for plugin, version, _ in sorted(listed - set(used.values())):
        findings.refuse(ENTRY, "plugins", f"name {plugin} {version}, which no record is from")


def _check_environment(entry: Entry, records: Records, findings: Findings) -> None:
    packages = entry.environment["packages"]
    for field, key, stated in (
        ("environment.python", "python", entry.environment["python"]),
        ("environment.packages.numpy", "numpy", packages.get("numpy")),
        ("environment.packages.oodd-eval", "oodd_eval", packages.get("oodd-eval")),
    ):
        recorded = joined(record.provenance[key] for record in records.values())
        if recorded != stated:
            findings.refuse(
                ENTRY, field, f"is {shown(stated)}, but the records were made with {recorded}"
            )


def joined(versions: Iterable[str]) -> str:
    """Return the versions that records name, usually one."""
    return "+".join(sorted(set(versions)))


def _check_complete(records: Records, findings: Findings) -> None:
    """Check that no cell stands twice, every environment has all anomalies, and rows are few."""
    seen: dict[tuple[Any, ...], str] = {}
    names: dict[str, str] = {}
    cells: dict[Unit, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for where, record in records.items():
        key = (*setting_of(record), record.environment, record.anomaly)
        first = seen.setdefault(key, where)
        second = names.setdefault(str(record.cell), where)
        if first != where or second != where:
            other = first if first != where else second
            findings.refuse(where, "cell", f"is there twice: it is that of {other} too")
        cells[setting_of(record)][record.environment].add(record.anomaly)
    rows = {(detector, horizon, parameters) for detector, horizon, _, parameters in cells}
    if len(rows) > MOST_ROWS:
        findings.refuse(
            RECORDS, "rows", f"are {len(rows)}, expected at most {MOST_ROWS} of one entry: every "
            "row is compared with every other"
        )  # fmt: skip
    for (detector, horizon, seed, _), environments in cells.items():
        row = f"{detector}[h={horizon},seed={seed}]"
        for environment, present in environments.items():
            if missing := [a for a in ANOMALIES if a not in present]:
                findings.refuse(
                    f"records of {row}", "anomaly",
                    f"{environment} lacks {', '.join(missing)}: an environment counts with all "
                    f"{len(ANOMALIES)} anomalies; run them, or leave out what is not complete",
                )  # fmt: skip
        if absent := [e for e in ENVIRONMENTS if e not in environments]:
            findings.note(
                f"{row} is partial: {len(environments)} of {len(ENVIRONMENTS)} environments "
                f"(without {', '.join(absent)}); where other rows have them it is listed, but not "
                "ranked"
            )


def _check_parameters(records: Records, findings: Findings) -> None:
    """Check that the parameters which are not overridden have one default each."""
    defaults: dict[tuple[str, str], Any] = {}
    names: dict[str, set[str]] = {}
    for where, record in records.items():
        expected = names.setdefault(record.detector, set(record.parameters))
        if set(record.parameters) != expected:
            findings.refuse(
                where, "parameters",
                f"are {sorted(record.parameters)}, but other records of {record.detector} have "
                f"{sorted(expected)}",
            )  # fmt: skip
            continue
        for name, value in record.parameters.items():
            if name in record.overrides:
                continue
            default = defaults.setdefault((record.detector, name), value)
            if value != default:
                findings.refuse(
                    where, f"parameters.{name}",
                    f"is {shown(value)}, but {shown(default)} in other records, and not among "
                    "provenance.overrides",
                )  # fmt: skip


def _check_counts(records: Records, findings: Findings) -> None:
    """Check the numbers of trajectories: those of the published split, or one set of numbers."""
    first: dict[str, dict[str, int]] = {}
    for where, record in records.items():
        if record.split in SPLITS:
            split = SPLITS[record.split]
            expected = {name: getattr(split, name) for name in record.counts}
        else:
            expected = first.setdefault(record.environment, record.counts)
        for name, count in record.counts.items():
            if count != expected[name]:
                findings.refuse(
                    where, f"counts.{name}",
                    f"is {count}, but split {record.split} has {expected[name]} trajectories",
                )  # fmt: skip


def _check_shared(records: Records, findings: Findings) -> None:
    """Check that the cells of one fit agree on what does not depend on the anomaly."""
    first: dict[tuple[Any, ...], tuple[str, Record]] = {}
    keys: dict[str, tuple[Any, ...]] = {}
    for where, record in records.items():
        unit = (*setting_of(record), record.environment)
        key = record.scores
        if keys.setdefault(key, unit) != unit:
            findings.refuse(
                where, "provenance.scores", f"is {key!r}, which another fit's records name too"
            )
        if not record.ok:
            continue
        other_where, other = first.setdefault(unit, (where, record))
        if key != other.scores:
            findings.refuse(
                where, "provenance.scores", f"is {key!r}, but another in {other_where}, which is "
                "of the same fit",
            )  # fmt: skip
        for name in _SHARED:
            if record.per_trajectory.get(name) != other.per_trajectory.get(name):
                findings.refuse(
                    where, f"per_trajectory.{name}",
                    f"differs from {other_where}: both are of the same fit on the same twins",
                )  # fmt: skip
        for suffix in SUFFIXES[1:]:
            name = f"threshold{suffix}"
            if not same(record.value(name), other.value(name)):
                findings.refuse(
                    where, f"metrics.{name}.value",
                    f"is {record.value(name)}, but {other.value(name)} in {other_where}, which is "
                    "of the same fit",
                )  # fmt: skip


def _check_remainders(records: Records, findings: Findings) -> None:
    """Check what a miss counts: the remainder of the episode, the same for every detector."""
    remainders: dict[tuple[str, str, int], tuple[float, str]] = {}
    late: list[tuple[tuple[str, str, int], float, str, str]] = []
    for where, record in records.items():
        for suffix in SUFFIXES if record.ok else ():
            censored = record.per_trajectory.get(f"delay_censored{suffix}", ([], []))[0]
            missed = record.per_trajectory.get(f"missed{suffix}", ([], []))[0]
            field = f"per_trajectory.delay_censored{suffix}"
            # Lengths were complained of elsewhere.
            for i, (steps, miss) in enumerate(zip(censored, missed, strict=False)):
                at = (record.environment, record.anomaly, i)
                if not miss:
                    late.append((at, steps, where, field))
                    continue
                known, place = remainders.setdefault(at, (steps, where))
                if known != steps:
                    findings.refuse(
                        where, field,
                        f"trajectory {i} is {steps:g}, but {known:g} in {place}: a miss counts the "
                        "remainder of the episode",
                    )  # fmt: skip
    for at, steps, where, field in late:
        if steps >= remainders.get(at, (np.inf, ""))[0]:
            findings.refuse(
                where, field,
                f"trajectory {at[2]} is {steps:g}, but only {remainders[at][0]:g} observations "
                f"are left from the onset on ({remainders[at][1]})",
            )  # fmt: skip
