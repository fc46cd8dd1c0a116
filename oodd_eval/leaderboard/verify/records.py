"""Recompute the metrics of records, and compare records with each other and with their split.

Every metric but the thresholds and the pooled ones is a ratio of sums over test trajectories, and a
record carries the terms of both sums. So value, interval and number of trajectories are recomputed;
the terms themselves obey rules of their own, which no scores can break.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import Split
from oodd_eval.leaderboard.entry import EntryInfo, place_of
from oodd_eval.leaderboard.verify.files import Findings, plain, shown
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import cell_samples, percentiles
from oodd_eval.metrics.catalogue import CALIBRATED, POOLED, RATIOS, TARGETS
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Metric, Record

Records = Mapping[str, Record]
"""Records by where they stand."""

Sums = Mapping[str, Contribution]
"""Numerators and denominators of a record by metric."""

Mask = NDArray[np.bool_]
"""Trajectories in which something is wrong."""

TOLERANCE: Final = 1e-12
"""Relative and absolute: sums may be taken in another order on another processor."""

SUFFIXES: Final = ("", *(f"_{suffix}" for suffix in TARGETS))
"""Of the metrics under the standard alarm rule, and under each calibrated one."""

MOST_ROWS: Final = 64
"""Rows of one entry; the paper's comparisons are some twenty."""

_RATES: Final = {"far", "far_twin"}
_MEANS: Final = set(RATIOS) - _RATES
_AUCS: Final = {name for name in RATIOS if name.startswith("auc")}

_TERMS: Final[tuple[tuple[set[str], Callable[[Any, Any], Mask], str], ...]] = (
    (_RATES, lambda _, n: (n < 0) | (n % 1 != 0), "a whole number of steps as denominator"),
    (_RATES, lambda k, n: (k < 0) | (k > n) | (k % 1 != 0), "a whole number of alarms in them"),
    (_MEANS, lambda _, n: (n != 0) & (n != 1), "the denominator 0 or 1"),
    (_MEANS, lambda k, n: (n == 0) & (k != 0), "the numerator 0 where the denominator is 0"),
    ({"missed", "delay_censored"}, lambda _, n: n == 0, "the denominator 1: it is always defined"),
    (_AUCS, lambda k, _: (k < 0) | (k > 1), "an AUC within [0, 1]"),
    ({"missed"}, lambda k, _: (k != 0) & (k != 1), "the numerator 0 or 1"),
    (_MEANS - _AUCS - {"missed"}, lambda k, _: (k < 0) | (k % 1 != 0), "a whole number of steps"),
)
"""Metrics, their impossible numerators and denominators, and what is expected instead."""


def _found(own: Sums) -> Mask:
    return np.equal(own["delay"].denominator, 1)


# Scores are defined from some step on, the same for a trajectory and its twin up to the onset.
_RELATIONS: Final[tuple[tuple[str, Callable[[Sums, Sums], Mask], str], ...]] = (
    ("missed", lambda own, _: (own["missed"].numerator == 1) == _found(own),
     "a trajectory either missed or with a delay"),
    ("delay_censored",
     lambda own, _: _found(own) & (own["delay_censored"].numerator != own["delay"].numerator),
     "its delay"),
    ("delay_censored", lambda own, _: ~_found(own) & (own["delay_censored"].numerator < 1),
     "at least 1: a miss counts the remainder of the episode"),
    *((name, lambda own, plain, name=name: own[name].denominator != plain[name].denominator,
       f"the steps of {name}, which no threshold changes") for name in sorted(_RATES)),
    *((name, lambda own, _, name=name: (own[name].denominator == 1) != (own["far"].denominator > 0),
       "a defined one where far counts steps before the onset") for name in ("auc", "auc_null")),
    ("auc_matched",
     lambda own, _: (own["far"].denominator > 0) & (own["auc_matched"].denominator == 0),
     "a defined one where there are scores before the onset"),
)  # fmt: skip
"""Metrics, where they contradict others of one alarm rule or the plain ones, and what is expected
instead."""


def same(first: float, second: float) -> bool:
    """Tell whether two values agree, both undefined included."""
    if math.isnan(first) or math.isnan(second):
        return math.isnan(first) and math.isnan(second)
    return math.isclose(first, second, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def contributions(record: Record) -> dict[str, Contribution]:
    """Return numerators and denominators of a record's metrics as arrays."""
    return {
        name: Contribution(np.array(top, dtype=np.float64), np.array(bottom, dtype=np.float64))
        for name, (top, bottom) in record.per_trajectory.items()
    }


def recomputed(environment: str, sums: Contribution) -> Metric:
    """Return a metric with its interval, from its terms."""
    return Metric(sums.value, *percentiles(cell_samples(environment, sums)), n=sums.n)


def check_record(where: str, record: Record, findings: Findings) -> Sums | None:
    """Recompute all metrics of a record, and check the terms they are from and its other fields.

    Return its terms; None where they are not complete.
    """
    _check_fields(where, record, findings)
    if not record.ok or not _is_complete(where, record, findings):
        return None
    sums = contributions(record)
    fresh = {name: recomputed(record.environment, c) for name, c in sums.items()}
    compare_metrics(where, record, fresh, "per_trajectory gives", findings)
    for suffix in SUFFIXES:
        own = {kind: sums[kind + suffix] for kind in RATIOS if kind + suffix in sums}
        wrong = [
            (kind, mask(c.numerator, c.denominator), expected)
            for kind, c in own.items()
            for kinds, mask, expected in _TERMS
            if kind in kinds
        ]
        wrong += [(kind, mask(own, sums), text) for kind, mask, text in _RELATIONS if kind in own]
        for kind, mask, expected in wrong:
            _refuse_terms(where, kind + suffix, sums, mask, expected, findings)
    for name in (n for n in record.metrics if n not in sums):
        _check_single(where, name, record.metrics[name], sums["far"], findings)
    return sums


def _refuse_terms(
    where: str, name: str, sums: Sums, wrong: Mask, expected: str, findings: Findings
) -> None:
    """Refuse the first wrong trajectory of a metric, if any."""
    for i in np.flatnonzero(wrong)[:1]:
        terms = f"{sums[name].numerator[i]:g} / {sums[name].denominator[i]:g}"
        message = f"trajectory {i} is {terms}, expected {expected}"
        findings.refuse(where, f"per_trajectory.{name}", message)


def compare_metrics(
    where: str, record: Record, fresh: Mapping[str, Metric], source: str, findings: Findings
) -> None:
    """Refuse those metrics of a record that differ from recomputed ones."""
    for name in (n for n in record.metrics if n in fresh):
        for end in ("value", "low", "high", "n"):
            stored, found = getattr(record.metrics[name], end), getattr(fresh[name], end)
            if not same(stored, found):
                message = f"is {stored}, but {source} {found}"
                findings.refuse(where, f"metrics.{name}.{end}", message)


def _check_fields(where: str, record: Record, findings: Findings) -> None:
    """Refuse fields of a record that contradict its other fields."""
    for name, value in record.overrides.items():
        stated, why = _exact(record.parameters.get(name)), f"as parameters.{name}"
        findings.expect(where, f"overrides.{name}", stated, _exact(value), why)
    group = ANOMALIES[record.anomaly].group
    findings.expect(where, "group", group, record.group, f"that of {record.anomaly}")
    if record.ok == bool(record.reason):
        message = f"is {shown(record.reason)}, expected one if and only if status is not 'ok'"
        findings.refuse(where, "reason", message)
    for field in ("metrics", "per_trajectory") if not record.ok else ():
        findings.expect(where, field, {}, getattr(record, field), f"status is {record.status}")
    for name, count in record.counts.items():
        expected = getattr(SPLITS.get(record.split), name, count)
        findings.expect(where, f"counts.{name}", expected, count, f"that of {record.split}")


def _is_complete(where: str, record: Record, findings: Findings) -> bool:
    """Check that all metrics are there, each with a term for every trajectory."""
    before = findings.count
    sums, single = set(RATIOS), set(POOLED)
    for suffix in TARGETS:
        if any(name.endswith(f"_{suffix}") for name in record.metrics):
            sums |= {f"{name}_{suffix}" for name in CALIBRATED}
            single.add(f"threshold_{suffix}")
    for part, expected in (("metrics", sums | single), ("per_trajectory", sums)):
        present = getattr(record, part).keys()
        for name in sorted(expected - present):
            findings.refuse(where, f"{part}.{name}", "is missing")
        for name in sorted(present - expected):
            findings.refuse(where, f"{part}.{plain(name)}", "is no metric that is expected here")
    for name in sorted(sums & record.per_trajectory.keys()):
        length, n = len(record.per_trajectory[name][0]), record.counts["test"]
        if length != n:
            message = f"is of {length} trajectories, expected counts.test, {n}"
            findings.refuse(where, f"per_trajectory.{name}", message)
    return findings.count == before


def _check_single(
    where: str, name: str, metric: Metric, far: Contribution, findings: Findings
) -> None:
    """Check a threshold or a pooled metric, which have no terms.

    Pooled metrics are defined where there are scores on both sides of an onset.
    """
    threshold = name.startswith("threshold")
    undefined = not threshold and far.denominator.sum() == 0
    most = math.inf if threshold else 1.0 + TOLERANCE
    least_n, most_n = (0, 0) if threshold else (far.n, len(far.denominator))
    for end, holds, expected in (
        ("value", undefined == math.isnan(metric.value),
         "a number where far counts scored steps before the onset, else null"),
        ("value", math.isnan(metric.value) or 0 <= metric.value <= most, f"0 to {most:.0f}"),
        ("low", math.isnan(metric.low), "null: it has no interval"),
        ("high", math.isnan(metric.high), "null: it has no interval"),
        ("n", least_n <= metric.n <= most_n, f"{least_n} to {most_n} trajectories"),
    ):  # fmt: skip
        if not holds:
            message = f"is {getattr(metric, end)}, expected {expected}"
            findings.refuse(where, f"metrics.{name}.{end}", message)


# -- records with each other ----------------------------------------------------------------------


def check_together(
    entry: EntryInfo, records: Records, sums: Mapping[str, Sums], findings: Findings
) -> None:
    """Check the records of an entry against each other and against ``entry.json``."""
    _check_rows(records, findings)
    first: dict[tuple[str, Any], tuple[Any, str]] = {}
    for where, record in records.items():
        for field in ("split", "split_digest", "protocol"):
            expected = getattr(entry, field)
            findings.expect(where, field, expected, getattr(record, field), "that of the entry")
        for field, key, value, reason in _agreements(record):
            expected, place = first.setdefault((field, key), (value, where))
            findings.expect(where, field, expected, value, f"as in {place}, since {reason}")
    _check_misses(records, sums, findings)


def _exact(value: Any) -> str:
    """Return a JSON value as text; 1, 1.0 and true are three things."""
    return json.dumps(value, sort_keys=True)


def _agreements(record: Record) -> Iterator[tuple[str, Any, Any, str]]:
    """Yield fields, what they are of, and their values: equal in all records that share these."""
    detector = record.detector
    for field in ("plugin", "detector_version", "plugin_source"):
        yield field, detector, getattr(record, field), "a detector has one source in an entry"
    yield "parameters", detector, sorted(record.parameters), "a detector has one set of parameters"
    for name, value in record.parameters.items():
        if name not in record.overrides:
            reason = "it has one default, and other values stand in overrides"
            yield f"parameters.{name}", detector, _exact(value), reason
    for name, count in record.counts.items():
        yield f"counts.{name}", record.environment, count, "both are of the same trajectories"
    fit = f"{record.label} on {record.environment}"
    yield "scores", record.scores, fit, "a score file is of one fit"
    if not record.ok:
        return
    yield "scores", fit, record.scores, "both are of the same fit"
    for suffix in SUFFIXES:
        name = f"far_twin{suffix}"
        twins = record.per_trajectory.get(name)
        yield f"per_trajectory.{name}", fit, twins, "both are of the same fit on the same twins"
        if suffix:
            value = repr(record.value(f"threshold{suffix}"))
            yield f"metrics.threshold{suffix}.value", fit, value, "both are of the same fit"


def _check_rows(records: Records, findings: Findings) -> None:
    """Check that no cell stands twice, every environment has all anomalies, and rows are few."""
    seen: dict[Any, str] = {}
    cells: dict[tuple[Setting, int], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for where, record in records.items():
        if (other := seen.setdefault(place_of(record), where)) != where:
            findings.refuse(where, "cell", f"is there twice: it is that of {other} too")
        cells[record.setting, record.seed][record.environment].add(record.anomaly)
    if (rows := len({setting for setting, _ in cells})) > MOST_ROWS:
        findings.refuse(RECORDS, "rows", f"are {rows}, expected at most {MOST_ROWS} of one entry")
    for (setting, seed), environments in cells.items():
        label = setting.label(seed)
        for environment, present in environments.items():
            if missing := [a for a in ANOMALIES if a not in present]:
                why = "an environment counts with all; run them, or leave out what is not complete"
                message = f"{environment} lacks {', '.join(missing)}: {why}"
                findings.refuse(f"records of {label}", "anomaly", message)
        if absent := [e for e in ENVIRONMENTS if e not in environments]:
            partial = f"{len(environments)} of {len(ENVIRONMENTS)} environments"
            findings.notes.append(
                f"{label} is partial: {partial} (without {', '.join(absent)}); where other rows "
                "have them it is listed, but not ranked"
            )


def _check_misses(records: Records, sums: Mapping[str, Sums], findings: Findings) -> None:
    """Check that a miss counts the remainder of the episode, the same for every detector."""
    remainders: dict[tuple[str, str, int], NDArray[np.float64]] = {}
    # Misses first: a delay is compared with the remainder that they tell.
    for misses in (True, False):
        for where, own in sums.items():
            for suffix in (s for s in SUFFIXES if f"missed{s}" in own):
                steps = own[f"delay_censored{suffix}"].numerator
                chosen = (own[f"missed{suffix}"].numerator == 1) == misses
                cell = records[where].environment, records[where].anomaly, len(steps)
                known = remainders.setdefault(cell, np.full(len(steps), np.nan))
                if misses:
                    first = chosen & np.isnan(known)
                    known[first] = steps[first]
                wrong = chosen & ((steps != known) if misses else (steps >= known))
                expected = "the remainder of the episode, as in other misses, or less with an alarm"
                _refuse_terms(where, f"delay_censored{suffix}", own, wrong, expected, findings)


# -- records and their split ----------------------------------------------------------------------


def check_against_split(
    records: Records, sums: Mapping[str, Sums], split: Split, findings: Findings
) -> None:
    """Check counts, steps and remainders of records against the trajectories they are of."""
    for environment in sorted({record.environment for record in records.values()}):
        own = {w: r for w, r in records.items() if r.environment == environment}
        if environment not in split.environments:
            known = ", ".join(split.environments)
            for where in own:
                findings.refuse(where, "environment", f"is {environment!r}, the split has {known}")
            continue
        with closing(split.environment(environment)) as data:
            for where, record in own.items():
                _check_trajectories(where, record, sums.get(where), data, findings)


def _check_trajectories(
    where: str, record: Record, sums: Sums | None, data: EnvironmentData, findings: Findings
) -> None:
    if record.anomaly not in data.anomalies:
        message = f"is {record.anomaly!r}, the split has {', '.join(data.anomalies)}"
        findings.refuse(where, "anomaly", message)
        return
    before = findings.count
    for name, part in (
        ("train", data.train), ("calibration", data.calibration), ("test", data.twins),
    ):  # fmt: skip
        findings.expect(where, f"counts.{name}", len(part), record.counts[name], "as the split has")
    if sums is None or findings.count > before:
        return
    anomalous = data.anomalous(record.anomaly)
    remainders = anomalous.lengths + 1 - anomalous.onsets
    undefined = max(record.horizon, MAX_WARM_UP)
    for suffix in (s for s in SUFFIXES if f"missed{s}" in sums):
        missed = sums[f"missed{suffix}"].numerator == 1
        censored = sums[name := f"delay_censored{suffix}"].numerator
        wrong = np.where(missed, censored != remainders, censored >= remainders)
        expected = "the number of observations from its onset on, or less with an alarm"
        _refuse_terms(where, name, sums, wrong, expected, findings)
        for kind, rows in (("far", anomalous.onsets), ("far_twin", data.twins.lengths + 1)):
            steps = sums[name := f"{kind}{suffix}"].denominator
            wrong = (steps > rows) | (steps < rows - undefined)
            expected = f"as many steps as rows, of which {undefined} may be undefined"
            _refuse_terms(where, name, sums, wrong, expected, findings)
