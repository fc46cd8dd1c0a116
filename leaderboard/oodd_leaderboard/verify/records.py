"""Check the form of records: each by itself, and all of an entry among each other.

Every metric with an interval is a ratio of sums over test trajectories, and a record carries the
terms of both sums. Boards use the terms, so the value has to be theirs.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import ANOMALIES, SPLITS
from oodd_eval.metrics.catalogue import NAMES, metric_info
from oodd_eval.metrics.ranking import Position
from oodd_eval.results.board import contribution, ranked_by
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.evaluate import early_difference
from oodd_eval.results.record import Record
from oodd_leaderboard.reported import EntryInfo
from oodd_leaderboard.verify.entry_files import Findings, plain, short

Records = Mapping[str, Record]  # records by their line: ``records.jsonl:3 (<cell>)``
TOLERANCE: Final = 1e-12  # relative and absolute: processors take sums in different orders
MOST_ROWS: Final = 64  # rows of one entry; the paper's comparisons are some twenty


def check_record(where: str, record: Record, findings: Findings) -> None:
    """Check that a record is whole, of its split, and has the values that its terms give."""
    before = findings.count
    for field, message in _complaints(record):
        findings.refuse(where, field, message)
    if not record.ok or findings.count > before:
        return
    for name in record.per_trajectory:
        stored, terms = record.metrics[name], contribution(record, name)
        for field in ("value", "n"):
            reported, computed = getattr(stored, field), getattr(terms, field)
            if not same(reported, computed):
                message = f"is {reported}, but per_trajectory gives {computed}"
                findings.refuse(where, f"metrics.{name}.{field}", message)
    if record.paired and "auc_before" not in record.metrics and (why := early_difference(record)):
        findings.refuse(where, "per_trajectory", why)


def _complaints(record: Record) -> Iterator[tuple[str, str]]:
    """Yield fields of a record and what is wrong with them."""
    # A record may lack any metric but that which boards rank by: it may be older than the metric.
    if record.paired and record.group != (group := ANOMALIES[record.anomaly].group):
        yield "group", f"is {short(record.group)}, expected {group}, that of {record.anomaly}"
    if record.split in SPLITS:
        sizes = {name: getattr(SPLITS[record.split], name, None) for name in record.counts}
        if record.counts != sizes:
            yield "counts", f"are {record.counts}, expected {sizes}, those of {record.split}"
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
            wrong = "has a numerator without a denominator, or no number"
            yield f"per_trajectory.{plain(name)}", f"{wrong}: expected finite ratios, or 0 / 0"
    for name, (step, _) in record.calibration_draws.coded.items():
        if name not in record.per_trajectory:
            yield f"calibration_draws.{plain(name)}", "is of no metric with terms"
            continue
        least, largest = metric_info(name).range
        # No draw is farther from the mean of all than the range, but for rounding to a step.
        if np.abs(record.calibration_draws[name]).max(initial=0.0) > largest - least + step:
            expected = f"expected changes of at most {largest - least:g}"
            yield f"calibration_draws.{name}", f"go beyond the range of the metric, {expected}"


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
    for location, record in records.items():
        for field in ("split", "split_digest", "protocol"):
            expected = getattr(entry, field)
            findings.expect(location, field, expected, getattr(record, field), "that of the entry")
        if (first := seen.setdefault(record.cell, location)) != location:
            findings.refuse(location, "cell", f"is there twice: it is that of {first} too")
        if cells and record.position not in cells:
            field = "anomaly" if record.environment in dict(cells) else "environment"
            cell = short("/".join(record.position))
            findings.refuse(location, field, f"{cell} is no cell of split {entry.split}")
        positions[record.cell.label].add(record.position)
    if (rows := len({record.setting for record in records.values()})) > MOST_ROWS:
        findings.refuse(RECORDS, "rows", f"are {rows}, expected at most {MOST_ROWS} of one entry")
    all_cells = set(cells) or set().union(*positions.values())
    environments = {environment for environment, _ in all_cells}
    for label, present in positions.items():
        evaluated = {environment for environment, _ in present}
        for environment in sorted(evaluated):
            if lacking := sorted(c for e, c in all_cells - present if e == environment):
                why = "an environment counts with all; run them, or leave out what is not complete"
                message = f"{environment} lacks {', '.join(lacking)}: {why}"
                findings.refuse(f"records of {label}", "anomaly", message)
        if absent := sorted(environments - evaluated):
            findings.notes.append(
                f"{label} is partial: {len(evaluated)} of {len(environments)} environments "
                f"(without {', '.join(absent)}), so it is listed, but not ranked"
            )
