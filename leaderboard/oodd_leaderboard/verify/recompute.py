"""Recompute what an entry says: metrics from the terms of its records, and from its scores.

Every metric with an interval is a ratio of sums over test trajectories, and a record carries the
terms of both sums. So value, interval and number of trajectories are computed again from them. An
entry with score files has all scores; where the split is at hand, the terms follow from these.
Score files are read within the bounds of `oodd_eval.data.stored`.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import Bounds
from oodd_eval.data.facts import ANOMALIES, SPLITS
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.data.split import Split
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import ContractError, OoddError, ResultsError
from oodd_eval.metrics.catalogue import METRICS, NAMES, metric_info
from oodd_eval.metrics.ranking import Position
from oodd_eval.plugins import contract
from oodd_eval.results.board import contribution, defined_cells, ranked_by
from oodd_eval.results.directory import EXPLAINED, RECORDS, ResultsDirectory
from oodd_eval.results.evaluate import counts_of, early_difference, metric_of, rescore
from oodd_eval.results.record import CodedDraws, Metric, Record
from oodd_leaderboard.entry import SCORES, EntryInfo
from oodd_leaderboard.verify.files import Findings, plain, short

Records = Mapping[str, Record]  # records by their line: ``records.jsonl:3 (<cell>)``
TOLERANCE: Final = 1e-12  # relative and absolute: processors take sums in different orders
MOST_ROWS: Final = 64  # rows of one entry; the paper's comparisons are some twenty
BOUNDS: Final = Bounds(2**28, ResultsError, kinds="fi")  # of the arrays of a score file


def check_record(where: str, record: Record, findings: Findings) -> None:
    """Recompute all metrics of a record, and hold it to the definition of its split."""
    before = findings.count
    for field, message in _complaints(record):
        findings.refuse(where, field, message)
    if not record.ok or findings.count > before:
        return
    terms = {name: contribution(record, name) for name in record.per_trajectory}
    fresh = {name: metric_of(name, c, *record.position) for name, c in terms.items()}
    fresh |= {n: Metric(m.value) for n, m in record.metrics.items() if n not in fresh}
    compare_metrics(where, record, fresh, "per_trajectory gives", findings)
    if record.paired and "auc_before" not in record.metrics and (why := early_difference(record)):
        findings.refuse(where, "per_trajectory", why)


def _complaints(record: Record) -> Iterator[tuple[str, str]]:
    """Yield fields of a record and what is wrong with them.

    A record may lack any metric but that which boards rank by: it may be older than the metric.
    """
    if record.paired and record.group != (group := ANOMALIES[record.anomaly].group):
        yield "group", f"is {short(record.group)}, expected {group}, that of {record.anomaly}"
    if record.split in SPLITS:
        sizes = {name: getattr(SPLITS[record.split], name) for name in record.counts}
        if record.counts != sizes:
            yield "counts", f"are {record.counts}, expected {sizes}, those of {record.split}"
        if record.position not in defined_cells(record.split):
            yield "anomaly", f"is {short(str(record.condition))}, no condition of {record.split}"
    if not record.ok:
        if record.metrics or record.per_trajectory:
            yield "metrics", f"are there, expected none: status is {record.status}"
        return
    if record.paired and (ranking := ranked_by([record])[0]) not in record.metrics:
        yield f"metrics.{ranking}", "is missing: boards rank by it"
    other = "unpaired" if record.paired else "paired"
    for name, metric in record.metrics.items():
        if name not in NAMES or metric_info(name).cells == other:
            yield f"metrics.{plain(name)}", "is no metric of such a cell"
            return
        least, largest = metric_info(name).range
        if not (math.isnan(metric.value) or least <= metric.value <= largest):
            yield f"metrics.{name}.value", f"is {metric.value:g}, expected {least:g} to {largest:g}"
    with_terms = {name for name in record.metrics if metric_info(name).interval}
    for name in sorted(with_terms ^ record.per_trajectory.keys()):
        yield f"per_trajectory.{plain(name)}", "is there without its metric, or missing beside it"
    trajectories = record.counts["test"] + record.counts.get("nominal", 0)
    for name, terms in record.per_trajectory.items():
        top, bottom = terms
        if len(top) != trajectories:
            yield f"per_trajectory.{plain(name)}", f"has {len(top)} terms, expected {trajectories}"
        elif not np.isfinite(terms).all() or (bottom < 0).any() or top[bottom == 0].any():
            expected = "expected finite ratios, or 0 / 0"
            yield f"per_trajectory.{plain(name)}", f"holds something of nothing: {expected}"
    for name, (step, _) in record.calibration_draws.coded.items():
        if name not in record.per_trajectory:
            yield f"calibration_draws.{plain(name)}", "is of no metric with terms"
            continue
        least, largest = metric_info(name).range
        # No draw is farther from the mean of all than the range, but for rounding to a step.
        if np.abs(record.calibration_draws[name]).max(initial=0.0) > largest - least + step:
            expected = f"expected changes of at most {largest - least:g}"
            yield f"calibration_draws.{name}", f"go beyond the range of the metric, {expected}"


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


def check_together(
    entry: EntryInfo, records: Records, cells: Collection[Position], findings: Findings
) -> None:
    """Check that records are of the entry's split, each cell once, and of few rows.

    `cells` are those that the split has; without them, those that any row of the entry has. A row
    has all of an environment's cells, or none: then it is noted, as boards do not rank it.
    """
    seen: dict[Any, str] = {}
    positions: dict[str, set[Position]] = defaultdict(set)
    for where, record in records.items():
        for field in ("split", "split_digest", "protocol"):
            expected = getattr(entry, field)
            findings.expect(where, field, expected, getattr(record, field), "that of the entry")
        if (first := seen.setdefault(record.cell, where)) != where:
            findings.refuse(where, "cell", f"is there twice: it is that of {first} too")
        positions[record.cell.label].add(record.position)
    if (rows := len({record.setting for record in records.values()})) > MOST_ROWS:
        findings.refuse(RECORDS, "rows", f"are {rows}, expected at most {MOST_ROWS} of one entry")
    known = set(cells) or set().union(*positions.values())
    environments = {environment for environment, _ in known}
    for label, present in positions.items():
        evaluated = {environment for environment, _ in present}
        for environment in sorted(evaluated):
            if lacking := sorted(c for e, c in known - present if e == environment):
                why = "an environment counts with all; run them, or leave out what is not complete"
                message = f"{environment} lacks {', '.join(lacking)}: {why}"
                findings.refuse(f"records of {label}", "anomaly", message)
        if absent := sorted(environments - evaluated):
            findings.notes.append(
                f"{label} is partial: {len(evaluated)} of {len(environments)} environments "
                f"(without {', '.join(absent)}), so it is listed, but not ranked"
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
    for name in sorted(present ^ named.keys()):
        wrong = (
            "belongs to no record" if name in present else "is missing: an entry has all or none"
        )
        findings.refuse(name, "", wrong)
    sound: dict[str, Record] = {}
    for name in sorted(present & named.keys()):
        before, unit = findings.count, named[name]
        with findings.reading(name):
            _read_scores(directory / name, unit.values())
        if findings.count == before:
            sound |= unit
    return sound


def _read_scores(path: Path, unit: Collection[Record]) -> None:
    """Raise `ResultsError` unless a unit's scores can be read safely and honour the contract."""
    first = next(iter(unit))
    with closing(StoredFile(path, BOUNDS)) as file:
        for part in (CALIBRATION, TWINS, *(record.condition.part for record in unit)):
            arrays = file.part(part, ("scores", "offsets", *EXPLAINED))
            if missing := {"scores", "offsets"} - arrays.keys():
                raise ResultsError(f"{part} lacks {min(missing)}")
            scores, offsets = arrays["scores"], arrays["offsets"]
            most = max(first.counts.values())
            column = scores.ndim == offsets.ndim == 1 and offsets.dtype.kind == "i"
            if not column or len(offsets) > most + 1:
                raise ResultsError(
                    f"{part} has scores or offsets that are no column of numbers, or too many"
                )
            if scores.dtype != np.float64:
                raise ResultsError(f"{part}/scores are of {scores.dtype}, expected float64")
            for i, sequence in enumerate(np.split(scores, offsets[1:-1])):
                try:
                    contract.check_scores(
                        sequence,
                        len(sequence),
                        horizon=first.horizon,
                        warm_up=contract.MAX_WARM_UP,
                        detector=first.detector,
                        where=f"{part}/scores[{i}]",
                    )
                except ContractError as error:
                    raise ResultsError(str(error)) from None


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
        compare_metrics(where, record, _as_then(record, again), "the scores give", findings)
        if record.calibration_draws != again.calibration_draws.only(record.calibration_draws):
            findings.refuse(where, "calibration_draws", "differ from what the scores give")
        for name in sorted(record.metrics.keys() - again.metrics):
            findings.refuse(where, f"metrics.{name}", "cannot be computed from the scores")
        for name in sorted(record.per_trajectory.keys() & again.per_trajectory.keys()):
            stored, computed = (r.per_trajectory[name] for r in (record, again))
            if stored.shape != computed.shape or not all(map(same, stored.flat, computed.flat)):
                message = "differs from what the scores give"
                findings.refuse(where, f"per_trajectory.{name}", message)
    return findings.count == before


def _as_then(record: Record, again: Record) -> Mapping[str, Metric]:
    """Return metrics with intervals without calibration noise where a record is older than it."""
    if record.calibration_draws:
        return again.metrics
    plain = replace(again, calibration_draws=CodedDraws())
    terms = {name: contribution(plain, name) for name in plain.per_trajectory}
    return again.metrics | {n: metric_of(n, c, *plain.position) for n, c in terms.items()}
