"""Recompute what an entry says: metrics from the terms of its records, and from its scores.

Every metric with an interval is a ratio of sums over test trajectories, and a record carries the
terms of both sums. So value, interval and number of trajectories are computed again from them. An
entry with score files has all scores; where the split is at hand, the terms follow from these.

Score files are read within the bounds of `oodd_eval.data.stored`. They may hold the parts of one
unit, each with scores, offsets and, where the detector explains them, explanations.
"""

import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import Bounds
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS, TABLE1
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.data.split import Split
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import OoddError, ResultsError
from oodd_eval.leaderboard.entry import CURVES, SCORES, EntryInfo
from oodd_eval.leaderboard.verify.files import Findings, find_text, parse_json, plain, short
from oodd_eval.metrics.alarms import offered_levels
from oodd_eval.metrics.catalogue import (
    ALARM_RANKING,
    HEADLINE,
    METRICS,
    NAMES,
    RANKING,
    metric_info,
)
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results import curve_file
from oodd_eval.results.board import contribution, grouped
from oodd_eval.results.directory import EXPLAINED, RECORDS, ResultsDirectory
from oodd_eval.results.evaluate import counts_of, metric_of, rescore
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Metric, Record

Records = Mapping[str, Record]  # records by their line: ``records.jsonl:3 (<cell>)``
TOLERANCE: Final = 1e-12  # relative and absolute: processors take sums in different orders
MOST_ROWS: Final = 64  # rows of one entry; the paper's comparisons are some twenty
BOUNDS: Final = Bounds(2**28, ResultsError, kinds="fi")  # of the arrays of a score file

PARTS: Final = (CALIBRATION, TWINS, *(f"test/{anomaly}" for anomaly in TABLE1))
"""Groups of a score file of the benchmark's environments."""

_DTYPES: Final = {"scores": np.dtype(np.float64), "offsets": np.dtype(np.int64)}
_EXPLAINED: Final = dict.fromkeys(EXPLAINED, np.dtype(np.int32))  # of anomalous parts, if at all

Complaints = Iterator[tuple[str, str]]  # fields and what is wrong with them


def check_record(where: str, record: Record, findings: Findings) -> None:
    """Recompute all metrics of a record, and check its other fields against each other."""
    _check_fields(where, record, findings)
    if not record.ok:
        return
    before = findings.count
    for field, message in _metric_complaints(record):
        findings.refuse(where, field, message)
    if findings.count == before:
        terms = {name: contribution(record, name) for name in record.per_trajectory}
        fresh = {name: metric_of(name, c, *record.position) for name, c in terms.items()}
        fresh |= {n: Metric(m.value) for n, m in record.metrics.items() if n not in fresh}
        compare_metrics(where, record, fresh, "per_trajectory gives", findings)


def _check_fields(where: str, record: Record, findings: Findings) -> None:
    """Refuse fields of a record that contradict its other fields, or the split of its name."""
    for name, value in record.overrides.items():
        expected, why = _exact(record.parameters.get(name)), f"as parameters.{name}"
        findings.expect(where, f"overrides.{name}", expected, _exact(value), why)
    if record.paired:
        group = ANOMALIES[record.anomaly].group
        findings.expect(where, "group", group, record.group, f"that of {record.anomaly}")
    if record.ok == bool(record.reason):
        message = f"is {short(record.reason)}, expected one if and only if status is not 'ok'"
        findings.refuse(where, "reason", message)
    for field in ("metrics", "per_trajectory") if not record.ok else ():
        findings.expect(where, field, {}, getattr(record, field), f"status is {record.status}")
    definition = SPLITS.get(record.split)
    if definition is None:
        return
    for name, count in record.counts.items():
        expected = getattr(definition, name)
        findings.expect(where, f"counts.{name}", expected, count, f"that of {record.split}")
    if definition.suite == "table1" and (record.anomaly not in TABLE1 or record.strength):
        message = f"is {short(record.condition)}, expected one of {', '.join(TABLE1)}"
        findings.refuse(where, "anomaly" if record.anomaly not in TABLE1 else "strength", message)


def _metric_complaints(record: Record) -> Complaints:
    """Yield metrics that a record cannot have or lacks, and terms that no scores can give.

    A record may lack any metric but those that boards rank by: it may be older than the metric.
    """
    levels = offered_levels(record.counts["calibration"], record.alarm)
    possible = {*METRICS, *(name for name in NAMES if name.endswith(tuple(levels)))}
    other = "unpaired" if record.paired else "paired"
    possible = {name for name in possible if metric_info(name).cells != other}
    needed = {RANKING, ALARM_RANKING} if HEADLINE in levels else {RANKING}
    for name in sorted(needed - record.metrics.keys()) if record.paired else ():
        yield f"metrics.{name}", "is missing: boards rank by it"
    for name in sorted(record.metrics.keys() - possible):
        yield f"metrics.{plain(name)}", "is no metric that is expected here"
    with_terms = {n for n in possible & record.metrics.keys() if metric_info(n).interval}
    for name in sorted(with_terms - record.per_trajectory.keys()):
        yield f"per_trajectory.{name}", "is missing"
    for name in sorted(record.per_trajectory.keys() - with_terms):
        yield f"per_trajectory.{plain(name)}", "is of no metric with terms that the record has"
    for name in () if record.paired else sorted(with_terms):
        (least, largest), value = metric_info(name).range, record.metrics[name].value
        if not math.isnan(value) and not least <= value <= largest:
            yield f"metrics.{name}.value", f"is {value:g}, expected {least:g} to {largest:g}"
    for name in sorted(with_terms & record.per_trajectory.keys()):
        numerators, denominators = record.per_trajectory[name]
        # An AUC of two samples has terms beyond its range.
        least, largest = metric_info(name).range if record.paired else (-math.inf, math.inf)
        trajectories = record.counts["test"] + record.counts.get("nominal", 0)
        if len(numerators) != trajectories:
            expected = f"expected {trajectories} by counts"
            yield f"per_trajectory.{name}", f"is of {len(numerators)} trajectories, {expected}"
            continue
        with np.errstate(invalid="ignore"):  # infinity times a denominator of 0
            outside = (denominators > 0) & (
                (numerators < least * denominators) | (numerators > largest * denominators)
            )
        wrong = (denominators < 0) | ((denominators == 0) & (numerators != 0)) | outside
        if wrong.any():
            i = int(wrong.argmax())
            terms = f"{numerators[i]:g} / {denominators[i]:g}"
            expected = f"a ratio from {least:g} to {largest:g}, or 0 / 0"
            yield f"per_trajectory.{name}", f"trajectory {i} is {terms}, expected {expected}"


def compare_metrics(
    where: str, record: Record, fresh: Mapping[str, Metric], source: str, findings: Findings
) -> None:
    """Refuse those metrics of a record that differ from recomputed ones."""
    for name in (n for n in record.metrics if n in fresh):
        for end in ("value", "low", "high", "n"):
            stored, computed = getattr(record.metrics[name], end), getattr(fresh[name], end)
            if not same(stored, computed):
                message = f"is {stored}, but {source} {computed}"
                findings.refuse(where, f"metrics.{name}.{end}", message)


def same(first: float, second: float) -> bool:
    """Tell whether two values agree, both undefined included."""
    near = math.isclose(first, second, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return near or (math.isnan(first) and math.isnan(second))


def _exact(value: Any) -> str:
    """Return a JSON value as text; 1, 1.0 and true are three things."""
    return json.dumps(value, sort_keys=True)


def check_together(entry: EntryInfo, records: Records, findings: Findings) -> None:
    """Check that records are of the entry's split, each cell once, with all anomalies, and few.

    Without the split the anomalies of environments without twins are those that any row here has.
    """
    seen: dict[Any, str] = {}
    cells: dict[tuple[Setting, int], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for where, record in records.items():
        for field in ("split", "split_digest", "protocol"):
            expected = getattr(entry, field)
            findings.expect(where, field, expected, getattr(record, field), "that of the entry")
        if (first := seen.setdefault(record.cell, where)) != where:
            findings.refuse(where, "cell", f"is there twice: it is that of {first} too")
        cells[record.setting, record.seed][record.environment].add(record.anomaly)
    if (rows := len({setting for setting, _ in cells})) > MOST_ROWS:
        findings.refuse(RECORDS, "rows", f"are {rows}, expected at most {MOST_ROWS} of one entry")
    expected_of: dict[str, Collection[str]] = dict.fromkeys(ENVIRONMENTS, TABLE1)
    if not all(record.paired for record in records.values()):
        by_environment = grouped(records.values(), lambda r: r.environment)
        expected_of = {e: {r.anomaly: e for r in rows} for e, rows in by_environment.items()}
    for (setting, seed), environments in cells.items():
        label = setting.label(seed)
        for environment, present in environments.items():
            if missing := [a for a in expected_of[environment] if a not in present]:
                why = "an environment counts with all; run them, or leave out what is not complete"
                message = f"{environment} lacks {', '.join(missing)}: {why}"
                findings.refuse(f"records of {label}", "anomaly", message)
        if absent := [e for e in expected_of if e not in environments]:
            partial = f"{len(environments)} of {len(expected_of)} environments"
            findings.notes.append(
                f"{label} is partial: {partial} (without {', '.join(absent)}); where other rows "
                "have them it is listed, but not ranked"
            )


def check_against_split(records: Records, split: Split, findings: Findings) -> None:
    """Check that the split has the cells of records, of as many trajectories."""
    for environment in sorted({record.environment for record in records.values()}):
        of_environment = {w: r for w, r in records.items() if r.environment == environment}
        if environment not in split.environments:
            names = ", ".join(split.environments)
            for where in of_environment:
                findings.refuse(where, "environment", f"is {environment!r}, the split has {names}")
            continue
        with closing(split.environment(environment)) as data:
            conditions = split.conditions(environment)
            counts = {condition: counts_of(data, condition, None) for condition in conditions}
            paired = data.paired
        for where, record in of_environment.items():
            findings.expect(where, "paired", paired, record.paired, "as the split has")
            if record.condition not in counts:
                names = ", ".join(map(str, counts))
                message = f"is '{record.condition}', the split has {names}"
                findings.refuse(where, "anomaly", message)
                continue
            expected = counts[record.condition]
            findings.expect(where, "counts", expected, record.counts, "as the split has")
            if not paired:
                group = split.groups.get(record.anomaly, "")
                findings.expect(where, "group", group, record.group, "as the split has")


def check_scores(
    directory: Path, files: Collection[str], records: Records, findings: Findings
) -> Records:
    """Check an entry's score files; return the records whose scores are there and sound."""
    present = {name for name in files if name.startswith(f"{SCORES}/")}
    named: dict[str, dict[str, Record]] = {}
    for where, record in records.items() if present else ():
        if record.ok:
            named.setdefault(f"{SCORES}/{record.scores}.h5", {})[where] = record
    for name in sorted(present - named.keys()):
        findings.refuse(name, "", "belongs to no record: the field scores of none names it")
    sound: dict[str, Record] = {}
    for name, unit in named.items():
        where, record = next(iter(unit.items()))
        before = findings.count
        if name not in present:
            message = f"names {name}, which is absent: an entry has all scores or none"
            findings.refuse(where, "scores", message)
            continue
        with findings.reading(name):
            for field, message in _complaints(directory / name, unit.values()):
                findings.refuse(name, field, message)
        if findings.count == before:
            sound |= unit
    return sound


def _complaints(path: Path, unit: Collection[Record]) -> Complaints:
    """Yield what is wrong with a unit's scores; `ResultsError` where they cannot be read safely."""
    first = next(iter(unit))
    expected = {*PARTS}
    if not first.paired:
        expected = {CALIBRATION, TWINS, *(record.condition.part for record in unit)}
    with closing(StoredFile(path, BOUNDS)) as file:
        parts = {*file.groups()} - {"test"} | {f"test/{name}" for name in file.groups("test")}
        for part in sorted(parts ^ expected):
            yield plain(part), "is no part of a score file" if part in parts else "is missing"
        for part in sorted(parts & expected):
            yield from _part(file.part(part), part, first.horizon)


def _part(datasets: Mapping[str, Any], part: str, horizon: int) -> Complaints:
    explains = part not in (CALIBRATION, TWINS) and not datasets.keys().isdisjoint(_EXPLAINED)
    dtypes = _DTYPES | _EXPLAINED if explains else _DTYPES
    complaints = [
        (f"{part}/{plain(name)}", "is no dataset of this format")
        for name in sorted(datasets.keys() - dtypes)
    ]
    for name, dtype in dtypes.items():
        data = datasets.get(name)
        if data is None:
            complaints.append((f"{part}/{name}", "is missing"))
        elif data.dtype != dtype or len(data.shape) != 1 or not len(data):
            message = f"is {data.dtype} of shape {data.shape}, expected some {dtype} in a column"
            complaints.append((f"{part}/{name}", message))
    yield from complaints
    if complaints:
        return
    scores, offsets = datasets["scores"], datasets["offsets"]
    if offsets[0] != 0 or (np.diff(offsets) < 1).any() or offsets[-1] != len(scores):
        yield f"{part}/offsets", f"do not rise from 0 to {len(scores)}, the number of scores"
        return
    for name in (name for name in EXPLAINED if explains):
        values = datasets[name]
        if len(values) != len(scores) or ((values < 0) != np.isnan(scores)).any():
            yield f"{part}/{name}", "is not of all rows with a score, and negative for the others"
    most = max(horizon, MAX_WARM_UP)
    for i, sequence in enumerate(np.split(scores, offsets[1:-1])):
        undefined = np.isnan(sequence)
        start = len(sequence) if undefined.all() else int(np.argmin(undefined))
        if start > most or not np.isfinite(sequence[start:]).all():
            message = f"expected at most {most} undefined steps and then finite scores"
            yield f"{part}/scores", f"trajectory {i} is {plain(str(sequence))}, {message}"
            return


def check_rescored(records: Records, directory: Path, split: Split, findings: Findings) -> bool:
    """Recompute metrics from the entry's scores; return whether all could be, and agree.

    A metric that the record lacks, as one that is older than the metric, is no problem.
    """
    before = findings.count
    try:
        requested = {name for name in METRICS if metric_info(name).request}
        rows = any(requested & record.metrics.keys() for record in records.values())
        results = ResultsDirectory(directory)
        fresh = rescore(list(records.values()), results, split, row_metrics=rows)
    except (OoddError, ArithmeticError) as error:
        findings.refuse(SCORES, "", f"cannot be scored again: {error}")
        return False
    for (where, record), again in zip(records.items(), fresh, strict=True):
        compare_metrics(where, record, again.metrics, "the scores give", findings)
        for name in sorted(record.metrics.keys() - again.metrics):
            findings.refuse(where, f"metrics.{name}", "cannot be computed from the scores")
        for name in sorted(record.per_trajectory.keys() & again.per_trajectory.keys()):
            stored, computed = (r.per_trajectory[name] for r in (record, again))
            if stored.shape != computed.shape or not all(map(same, stored.flat, computed.flat)):
                message = "differs from what the scores give"
                findings.refuse(where, f"per_trajectory.{name}", message)
    return findings.count == before


def check_curves(contents: Mapping[str, bytes], records: Records, findings: Findings) -> None:
    """Check that an entry's curves have their format and are of cells of its records."""
    name, text = find_text(contents, CURVES, findings)
    if not name:
        return
    units: list[Any] = []
    with findings.reading(name):
        units = curve_file.check_curves(parse_json(text), name)["units"]
    cells = {str(record.cell): record for record in records.values() if record.ok}
    for i, unit in enumerate(units):
        record = cells.get(unit["cell"])
        if record is None:
            message = f"is {short(unit['cell'])}, which no record is of"
            findings.refuse(name, f"units[{i}].cell", message)
            continue
        for field, value in curve_file.identity(record).items():
            findings.expect(name, f"units[{i}].{field}", value, unit[field], "as in its record")
        if unit["example"]["index"] >= record.counts["test"]:
            findings.refuse(name, f"units[{i}].example.index", "is no test trajectory")
