"""Recompute the metrics of records, and compare records with each other and with their split.

Every metric but the thresholds is a ratio of sums over test trajectories, and a record carries the
terms of both sums. So value, interval and number of trajectories are recomputed; the terms
themselves obey rules of their own (`terms`), which no scores can break.
"""

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS, TABLE1
from oodd_eval.data.parts import AnomalousSet, EnvironmentData, TrajectorySet
from oodd_eval.data.split import Split
from oodd_eval.leaderboard.entry import EntryInfo
from oodd_eval.leaderboard.verify.files import Findings, plain, shown
from oodd_eval.leaderboard.verify.terms import Sums, Wrong, delays_of, wrong_terms
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.alarms import offered_levels
from oodd_eval.metrics.auc import FAR_START
from oodd_eval.metrics.catalogue import FOUND_WITHIN, GUARANTEED, LEVELS, METRICS, split_name
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results.board import contribution
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.evaluate import metric_of
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Metric, Record

Records = Mapping[str, Record]  # records by where they stand
TOLERANCE: Final = 1e-12  # relative and absolute: processors take sums in different orders
MOST_ROWS: Final = 64  # rows of one entry; the paper's comparisons are some twenty


def same(first: float, second: float) -> bool:
    """Tell whether two values agree, both undefined included."""
    near = math.isclose(first, second, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return near or (math.isnan(first) and math.isnan(second))


def check_record(where: str, record: Record, findings: Findings) -> Sums | None:
    """Recompute all metrics of a record, and check the terms they are from and its other fields.

    Return its terms; None where they are not complete.
    """
    _check_fields(where, record, findings)
    if not record.ok or not _is_complete(where, record, findings):
        return None
    sums = {name: contribution(record, name) for name in record.per_trajectory}
    fresh = {name: metric_of(name, c, record.environment) for name, c in sums.items()}
    compare_metrics(where, record, fresh, "per_trajectory gives", findings)
    _refuse_terms(where, sums, wrong_terms(sums), findings)
    for name in (n for n in record.metrics if n not in sums):
        _check_threshold(where, name, record, findings)
    return sums


def _refuse_terms(where: str, sums: Sums, wrong: Wrong, findings: Findings) -> None:
    """Refuse the first trajectory that breaks a rule, of every rule that is broken."""
    for name, mask, expected in wrong:
        if mask.any():
            i = int(mask.argmax())
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
    levels = offered_levels(record.counts["calibration"], record.alarm)
    sums = {*METRICS, *(f"{name}_{suffix}" for suffix in levels for name in GUARANTEED)}
    single = {f"threshold_{suffix}" for suffix in levels}
    if catalogue.HEADLINE in levels and not record.metrics.keys().isdisjoint(catalogue.ATTRIBUTION):
        sums |= {*catalogue.ATTRIBUTION}  # of a detector that explains
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


def _check_threshold(where: str, name: str, record: Record, findings: Findings) -> None:
    """Check a threshold, which has no terms; one that no statistic exceeds is null."""
    metric = record.metrics[name]
    known = not math.isnan(metric.value) and record.alarm == "cusum"
    for end, holds, expected in (
        ("value", not known or metric.value >= 0, "at least 0, or null: the CUSUM is never below"),
        ("low", math.isnan(metric.low), "null: it has no interval"),
        ("high", math.isnan(metric.high), "null: it has no interval"),
        ("n", metric.n == 0, "0"),
    ):
        if not holds:
            message = f"is {getattr(metric, end)}, expected {expected}"
            findings.refuse(where, f"metrics.{name}.{end}", message)
    _, suffix = split_name(name)
    lower = list(LEVELS)[: list(LEVELS).index(suffix)]
    for other in lower[-1:]:
        least = record.value(f"threshold_{other}")
        if metric.value < least or math.isnan(least) > math.isnan(metric.value):
            message = f"is {metric.value}, expected at least that of a larger level, {least}"
            findings.refuse(where, f"metrics.{name}.value", message)


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
    for field in ("plugin", "detector_version", "plugin_source", "alarm", "deterministic"):
        yield field, detector, getattr(record, field), "a detector has one source in an entry"
    place = record.environment, record.anomaly
    yield "brief", place, record.brief, "both are of the same trajectories"
    yield "parameters", detector, sorted(record.parameters), "a detector has one set of parameters"
    for name, value in record.parameters.items():
        if name not in record.overrides:
            reason = "it has one default, and other values stand in overrides"
            yield f"parameters.{name}", detector, _exact(value), reason
    for name, count in record.counts.items():
        yield f"counts.{name}", record.environment, count, "both are of the same trajectories"
    fit = f"{record.cell.label} on {record.environment}"
    yield "scores", record.scores, fit, "a score file is of one fit"
    if not record.ok:
        return
    yield "scores", fit, record.scores, "both are of the same fit"
    terms = {name: own.tolist() for name, own in record.per_trajectory.items()}
    if record.deterministic:
        row = str(record.setting), *place
        yield "per_trajectory", row, terms, "its seed changes nothing"
    for name in ["far_twin", *(n for n in terms if n.startswith("false_episodes"))]:
        reason = "both are of the same fit on the same twins"
        yield f"per_trajectory.{name}", fit, terms.get(name), reason
    for name in catalogue.ATTRIBUTION:
        reason = "a detector explains all of its alarms or none"
        yield f"metrics.{name} is there", record.detector, name in record.metrics, reason
    for name in (n for n in record.metrics if n.startswith("threshold")):
        value = repr(record.value(name))
        yield f"metrics.{name}.value", fit, value, "both are of the same fit"


def _check_rows(records: Records, findings: Findings) -> None:
    """Check that no cell stands twice, every environment has all anomalies, and rows are few."""
    seen: dict[Any, str] = {}
    cells: dict[tuple[Setting, int], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for where, record in records.items():
        if (other := seen.setdefault(record.cell, where)) != where:
            findings.refuse(where, "cell", f"is there twice: it is that of {other} too")
        cells[record.setting, record.seed][record.environment].add(record.anomaly)
    if (rows := len({setting for setting, _ in cells})) > MOST_ROWS:
        findings.refuse(RECORDS, "rows", f"are {rows}, expected at most {MOST_ROWS} of one entry")
    for (setting, seed), environments in cells.items():
        label = setting.label(seed)
        for environment, present in environments.items():
            if missing := [a for a in TABLE1 if a not in present]:
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
    remainders: dict[tuple[str, str, str, int], NDArray[np.float64]] = {}
    # Misses first: a delay is compared with the remainder that they tell.
    for misses in (True, False):
        for where, own in sums.items():
            for start, missed, censored in delays_of(own):
                steps, defined = own[censored].numerator, own[censored].denominator == 1
                chosen = defined & ((own[missed].numerator == 1) == misses)
                cell = records[where].environment, records[where].anomaly, start, len(steps)
                known = remainders.setdefault(cell, np.full(len(steps), np.nan))
                if misses:
                    first = chosen & np.isnan(known)
                    known[first] = steps[first]
                wrong = chosen & ((steps != known) if misses else (steps >= known))
                expected = "the remainder of the episode, as in other misses, or less with an alarm"
                _refuse_terms(where, own, iter([(censored, wrong, expected)]), findings)


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
        ("train", data.train),
        ("calibration", data.calibration),
        ("test", data.twins),
    ):
        findings.expect(where, f"counts.{name}", len(part), record.counts[name], "as the split has")
    if sums is None or findings.count > before:
        return
    anomalous = data.anomalous(record.anomaly)
    findings.expect(where, "brief", anomalous.brief, record.brief, "as the split has")
    undefined = max(record.horizon, MAX_WARM_UP)
    _refuse_terms(where, sums, _wrong_here(sums, anomalous, data.twins, undefined), findings)


def _wrong_here(sums: Sums, anomalous: AnomalousSet, twins: TrajectorySet, undefined: int) -> Wrong:
    """Yield every rule for single trajectories of the split; so many first rows may lack scores."""
    ends = np.minimum(anomalous.lengths, twins.lengths) + 1
    remainders = {
        "onset": anomalous.lengths + 1 - anomalous.onsets,
        "effect": anomalous.lengths + 1 - anomalous.effects,
        "effect on the twin": twins.lengths + 1 - anomalous.effects,
    }
    for start, missed, censored in delays_of(sums):
        rest, defined = remainders[start], sums[censored].denominator == 1
        miss, steps = sums[missed].numerator == 1, sums[censored].numerator
        wrong = defined & np.where(miss, steps != rest, steps >= rest)
        expected = f"the number of observations from the {start} on, or less with an alarm"
        yield censored, wrong, expected
        if start != "onset":
            early = sums[missed.replace("missed", "early")].numerator == 1
            wrong = defined != (~early & (rest > 0))
            yield missed, wrong, f"a defined one if and only if no alarm precedes the {start}"
            yield from _wrong_found(sums, missed, ends - anomalous.effects)
    scored = sums["far"].denominator > 0
    wrong = scored & ((sums["auc_matched"].denominator == 1) != (ends > anomalous.effects))
    yield "auc_matched", wrong, "a defined one where both episodes have scores from the effect on"
    for name, rows, least in (
        ("far", np.maximum(anomalous.onsets - FAR_START, 0), undefined - FAR_START),
        ("far_twin", twins.lengths + 1, undefined),
    ):
        steps = sums[name].denominator
        wrong = (steps > rows) | (steps < rows - least)
        yield name, wrong, f"as many steps as rows, of which {least} may be undefined"


def _wrong_found(sums: Sums, missed: str, shared: NDArray[np.int64]) -> Wrong:
    """Yield the rules of what is found in the rows from the effect on that both episodes have."""
    delay = sums[missed.replace("missed", "delay")]
    defined = (sums[missed].denominator == 1) & (shared > 0)
    for k in FOUND_WITHIN:
        name = missed.replace("missed", f"found_within_{k}")
        within = (delay.denominator == 1) & (delay.numerator < np.minimum(k, shared))
        wrong = (sums[name].denominator == 1) != defined
        expected = f"defined where {missed} is and both episodes have rows from the effect on"
        yield name, wrong, expected
        wrong = defined & ((sums[name].numerator == 1) != within)
        yield name, wrong, f"1 for a delay below {k} in the rows that both episodes have"
