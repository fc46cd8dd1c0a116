"""What the metrics of one record have to satisfy, whatever the scores were.

Every metric but the thresholds and the pooled ones is a ratio of sums over test trajectories, and a
record carries both sums' terms. So value, interval and number of trajectories can be recomputed,
and the terms themselves obey rules of their own: counts are whole, an AUC lies in [0, 1], a
trajectory is either missed or has a delay.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np

from oodd_eval.leaderboard.verify.findings import Findings
from oodd_eval.metrics.alarms import CALIBRATED, TARGETS
from oodd_eval.metrics.auc import METRICS, POOLED, Contribution
from oodd_eval.metrics.bootstrap import bootstrap_weights, interval
from oodd_eval.results.record import Metric, Record

TOLERANCE: Final = 1e-9
"""Relative and absolute: sums may be taken in another order on another processor."""

SUFFIXES: Final = ("", *(f"_{suffix}" for suffix in TARGETS))
"""Of the metrics under the standard alarm rule, and under each calibrated one."""

_weights = functools.lru_cache(maxsize=8)(bootstrap_weights)

Refuse = Callable[[str, str], None]
"""Takes the name of a field and what is wrong with it."""


def same(first: float, second: float) -> bool:
    """Whether two values agree, both undefined included."""
    if math.isnan(first) or math.isnan(second):
        return math.isnan(first) and math.isnan(second)
    return math.isclose(first, second, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def check_identities(record: Record, findings: Findings, where: str) -> None:
    """Check all metrics of a record that has any."""

    def refuse(field: str, message: str) -> None:
        findings.refuse(where, field, message)

    if not record.ok:
        return
    if not _check_presence(record, refuse):
        return
    sums = contributions(record)
    for name, contribution in sums.items():
        _check_terms(name, contribution, refuse)
        _check_recomputed(name, record, contribution, refuse)
    for name in record.metrics:
        _check_range(name, record.metrics[name], refuse)
    for suffix in SUFFIXES:
        if f"delay_censored{suffix}" in sums:
            _check_alarms(record, sums, suffix, refuse)
    _check_definedness(sums, refuse)
    for name in POOLED:
        _check_pooled(name, record.metrics[name], sums["far"], refuse)


def contributions(record: Record) -> dict[str, Contribution]:
    """Return numerators and denominators of a record's metrics as arrays."""
    return {
        name: Contribution(np.array(top, dtype=np.float64), np.array(bottom, dtype=np.float64))
        for name, (top, bottom) in record.per_trajectory.items()
    }


def _check_presence(record: Record, refuse: Refuse) -> bool:
    """Check that all metrics are there, each with the terms it is computed from."""
    sums = set(METRICS)
    plain = set(POOLED)
    for suffix in TARGETS:
        names = {f"{name}_{suffix}" for name in CALIBRATED}
        if any(name.endswith(f"_{suffix}") for name in record.metrics):
            sums |= names
            plain.add(f"threshold_{suffix}")
    found = True
    for part, present, expected in (
        ("metrics", record.metrics.keys(), sums | plain),
        ("per_trajectory", record.per_trajectory.keys(), sums),
    ):
        for name in sorted(expected - present):
            refuse(f"{part}.{name}", "is missing")
            found = False
        for name in sorted(present - expected):
            refuse(f"{part}.{ascii(name)[1:-1]:.60}", "is no metric that is expected here")
            found = False
    n = record.counts["test"]
    for name in sorted(sums & record.per_trajectory.keys()):
        if (length := len(record.per_trajectory[name][0])) != n:
            refuse(f"per_trajectory.{name}", f"is of {length} trajectories, but counts.test is {n}")
            found = False
    return found


def _kind(name: str) -> str:
    """Return a metric's name without the suffix of a calibrated alarm rule."""
    return next((name.removesuffix(s) for s in SUFFIXES[1:] if name.endswith(s)), name)


def _complaints(kind: str, top: float, bottom: float) -> Iterator[str]:
    """Yield what is wrong with one trajectory's numerator and denominator."""
    if kind in {"far", "far_twin"}:
        if bottom < 0 or bottom % 1:
            yield f"has the denominator {bottom}, expected a whole number of steps"
        elif not 0 <= top <= bottom or top % 1:
            yield f"has the numerator {top}, expected a whole number of alarms in {bottom:g} steps"
        return
    if bottom not in (0.0, 1.0):
        yield f"has the denominator {bottom}, expected 0 or 1"
    elif kind in {"missed", "delay_censored"} and bottom == 0:
        yield "has the denominator 0, expected 1: it is defined for every trajectory"
    elif bottom == 0 and top != 0:
        yield f"has the numerator {top}, expected 0 where the denominator is 0"
    elif kind.startswith("auc") and not 0 <= top <= 1:
        yield f"has the numerator {top}, expected an AUC within [0, 1]"
    elif kind == "missed" and top not in (0.0, 1.0):
        yield f"has the numerator {top}, expected 0 or 1"
    elif kind.startswith("delay") and (top < 0 or top % 1):
        yield f"has the numerator {top}, expected a whole number of steps"


def _check_terms(name: str, sums: Contribution, refuse: Refuse) -> None:
    kind = _kind(name)
    pairs = zip(sums.numerator.tolist(), sums.denominator.tolist(), strict=True)
    for i, (top, bottom) in enumerate(pairs):
        for complaint in _complaints(kind, top, bottom):
            refuse(f"per_trajectory.{name}", f"trajectory {i} {complaint}")


def _check_recomputed(name: str, record: Record, sums: Contribution, refuse: Refuse) -> None:
    """Compare value, n and interval with those that the terms give."""
    stored = record.metrics[name]
    if not same(stored.value, sums.value):
        refuse(f"metrics.{name}.value", f"is {stored.value}, but per_trajectory gives {sums.value}")
    if stored.n != sums.n:
        refuse(f"metrics.{name}.n", f"is {stored.n}, but per_trajectory gives {sums.n}")
    weights = _weights(len(sums.numerator), key=record.environment)
    low, high = interval(sums, weights)
    for end, stored_end, found in (("low", stored.low, low), ("high", stored.high, high)):
        if not same(stored_end, found):
            refuse(
                f"metrics.{name}.{end}",
                f"is {stored_end}, but the bootstrap of per_trajectory gives {found}",
            )


def _check_range(name: str, metric: Metric, refuse: Refuse) -> None:
    """Check bounds of value and interval, and that those are undefined which must be.

    A percentile interval need not hold the value, where resamples are skewed, so that only the
    order of its ends is demanded here; both are recomputed besides.
    """
    kind = _kind(name)
    most = math.inf if kind.startswith(("delay", "threshold")) else 1.0
    for end in ("value", "low", "high"):
        number = getattr(metric, end)
        # Sums of a rounded mean may leave [0, 1] by a rounding error.
        if not math.isnan(number) and not -TOLERANCE <= number <= most + TOLERANCE:
            expected = "at least 0" if most == math.inf else "within [0, 1]"
            refuse(f"metrics.{name}.{end}", f"is {number}, expected {expected}")
    if metric.low > metric.high:
        refuse(f"metrics.{name}.low", f"is {metric.low}, above high, {metric.high}")
    if kind.startswith("threshold") or name in POOLED:
        for end in ("low", "high"):
            if not math.isnan(getattr(metric, end)):
                refuse(f"metrics.{name}.{end}", "must be null: it has no interval")
    if kind.startswith("threshold"):
        if math.isnan(metric.value):
            refuse(f"metrics.{name}.value", "is null, expected the calibrated threshold")
        if metric.n:
            refuse(f"metrics.{name}.n", f"is {metric.n}, expected 0: it is of no test trajectory")


def _check_alarms(
    record: Record, sums: Mapping[str, Contribution], suffix: str, refuse: Refuse
) -> None:
    """Check what holds between delay, misses and false alarms under one alarm rule."""
    value = {n: record.value(f"{n}{suffix}") for n in ("delay", "delay_censored", "missed", "far")}
    missed, censored = sums[f"missed{suffix}"], sums[f"delay_censored{suffix}"]
    delay, far = sums[f"delay{suffix}"], sums[f"far{suffix}"]
    steps = float(far.denominator.sum())
    if not _is_whole(value["far"] * steps):
        refuse(
            f"metrics.far{suffix}.value",
            f"is {value['far']}: times its {steps:g} steps that is {value['far'] * steps:.6g}, "
            "no whole number of alarms",
        )
    n = len(missed.numerator)
    if not _is_whole(value["missed"] * n):
        refuse(
            f"metrics.missed{suffix}.value",
            f"is {value['missed']}: times n = {n} that is no whole number of trajectories",
        )
    least = (1 - value["missed"]) * value["delay"]
    if value["delay_censored"] < least - TOLERANCE * max(1.0, least):
        refuse(
            f"metrics.delay_censored{suffix}.value",
            f"is {value['delay_censored']}, expected at least (1 - missed) * delay = {least:.6g}",
        )
    late = delay.denominator == 1
    if (late == (missed.numerator == 1)).any():
        i = int(np.flatnonzero(late == (missed.numerator == 1))[0])
        refuse(
            f"per_trajectory.missed{suffix}",
            f"trajectory {i} is {'both' if late[i] else 'neither'} missed and alarmed",
        )
    if (wrong := np.flatnonzero(late & (censored.numerator != delay.numerator))).size:
        i = int(wrong[0])
        refuse(
            f"per_trajectory.delay_censored{suffix}",
            f"trajectory {i} is {censored.numerator[i]:g}, but its delay is {delay.numerator[i]:g}",
        )
    if (wrong := np.flatnonzero(~late & (censored.numerator < 1))).size:
        refuse(
            f"per_trajectory.delay_censored{suffix}",
            f"trajectory {int(wrong[0])} is {censored.numerator[wrong[0]]:g}, expected at least 1: "
            "it was missed, which counts the whole remainder of the episode",
        )


def _check_definedness(sums: Mapping[str, Contribution], refuse: Refuse) -> None:
    """Check that metrics are undefined together.

    Scores are defined from some step on, the same for a trajectory and its twin up to the onset:
    the AUCs exist where there are steps before the onset with scores, which `far` counts.
    """
    steps = sums["far"].denominator
    defined = steps > 0
    for name in ("auc", "auc_null"):
        if (wrong := np.flatnonzero((sums[name].denominator == 1) != defined)).size:
            i = int(wrong[0])
            refuse(
                f"per_trajectory.{name}",
                f"trajectory {i} is {'undefined' if defined[i] else 'defined'}, but far counts "
                f"{steps[i]:g} scored steps before the onset",
            )
    if (wrong := np.flatnonzero(defined & (sums["auc_matched"].denominator == 0))).size:
        refuse(
            "per_trajectory.auc_matched",
            f"trajectory {int(wrong[0])} is undefined, but there are scores from before the onset",
        )
    for name in ("far", "far_twin"):
        for suffix in SUFFIXES[1:]:
            other = sums.get(f"{name}{suffix}")
            if other is not None and (other.denominator != sums[name].denominator).any():
                refuse(
                    f"per_trajectory.{name}{suffix}",
                    f"counts other steps than {name}: the threshold does not change them",
                )


def _check_pooled(name: str, metric: Metric, far: Contribution, refuse: Refuse) -> None:
    """Check that a pooled metric is defined where there are scores on both sides of an onset."""
    if math.isnan(metric.value) != (far.denominator.sum() == 0):
        state = "null" if math.isnan(metric.value) else "defined"
        refuse(
            f"metrics.{name}.value",
            f"is {state}, but far counts {far.denominator.sum():g} scored steps before the onset",
        )
    if not far.n <= metric.n <= len(far.denominator):
        refuse(
            f"metrics.{name}.n",
            f"is {metric.n}, expected {far.n} to {len(far.denominator)} trajectories with scores",
        )


def _is_whole(value: float) -> bool:
    """Whether a count recovered from a rate is whole; an undefined one is, one without end not."""
    if not math.isfinite(value):
        return math.isnan(value)
    return abs(value - round(value)) <= 1e-6 * max(1.0, abs(value))
