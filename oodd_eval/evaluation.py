"""From the scores of a cell to its metrics with intervals, and to its record."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from oodd_eval.alarms import calibrate
from oodd_eval.benchmark import ANOMALIES, PROTOCOL
from oodd_eval.cusum import Standardization
from oodd_eval.detector import Scores
from oodd_eval.errors import ResultsError
from oodd_eval.intervals import bootstrap_weights, interval
from oodd_eval.metrics import AlarmRule, Contribution, alarm_contributions, cell_contributions
from oodd_eval.plan import Plan, Unit
from oodd_eval.plugins import Offer
from oodd_eval.records import NAN, Metric, Record
from oodd_eval.results import ResultsDirectory, ScoreFile
from oodd_eval.scoring import CALIBRATION, Scored, lengths_of, limited, parts_of
from oodd_eval.splits import EnvironmentData, Split
from oodd_eval.splits_format import TWINS

_LEVELS: Final = {"_at_1pct": (0.01, 0), "_at_01pct": (0.001, 100)}
"""Calibrated false-alarm rates by suffix, each with the calibration trajectories it takes."""

_CALIBRATED: Final = ("far", "far_twin", "delay", "delay_censored", "missed")

_weights = functools.lru_cache(maxsize=32)(bootstrap_weights)


def cell_metrics(
    calibration: Sequence[Scores],
    anomalous: Sequence[Scores],
    twins: Sequence[Scores],
    onsets: Sequence[int],
    *,
    environment: str,
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell with their intervals.

    Parameters
    ----------
    calibration : sequence of arrays
        Scores of the nominal trajectories that standardize and calibrate.
    anomalous, twins : sequences of n arrays
        Scores of the test trajectories and of their nominal twins, in the same order.
    onsets : sequence of n ints
    environment
        Cells of one environment share their bootstrap resamples, so that they can be compared.

    Returns
    -------
    metrics
        By name: those of `oodd_eval.metrics.METRICS`, then with suffix ``_at_1pct`` (and
        ``_at_01pct``, given at least 100 calibration trajectories) those under the threshold
        whose false-alarm rate on the calibration trajectories is at most 1 % (0.1 %).
    contributions
        Numerators and denominators of those that are ratios of sums.
    """
    standardization = Standardization.fit(calibration)
    rule = AlarmRule(standardization)
    found = cell_contributions(anomalous, twins, onsets, rule)
    thresholds: dict[str, float] = {}
    for suffix, (target, least) in _LEVELS.items():
        if len(calibration) < least:
            continue
        threshold = thresholds[suffix] = calibrate(calibration, rule, target=target)
        strict = replace(rule, threshold=threshold)
        alarms = alarm_contributions(anomalous, twins, onsets, strict)
        found |= {f"{name}{suffix}": alarms[name] for name in _CALIBRATED}
    weights = _weights(len(anomalous), key=environment)
    metrics = {name: Metric(c.value, *interval(c, weights), n=c.n) for name, c in found.items()} | {
        f"threshold{suffix}": Metric(value, n=len(calibration))
        for suffix, value in thresholds.items()
    }
    return metrics, found


def make_record(
    plan: Plan,
    unit: Unit,
    anomaly: str,
    offer: Offer,
    data: EnvironmentData,
    scored: Scored,
    provenance: dict[str, Any],
) -> Record:
    """Return the record of one cell of a unit, whatever became of it."""
    record = Record(
        cell=plan.cell(unit, anomaly),
        detector=unit.detector,
        detector_version=offer.version,
        plugin=f"{offer.distribution}:{offer.plugin}",
        parameters=dict(unit.parameters),
        environment=unit.environment,
        anomaly=anomaly,
        group=ANOMALIES[anomaly].group,
        horizon=unit.horizon,
        seed=unit.seed,
        split=plan.split,
        split_digest=plan.split_digest,
        status=scored.status,
        reason=scored.reason,
        protocol=PROTOCOL,
        counts={
            "train": limited(len(data.train), plan.limit),
            "calibration": limited(len(data.calibration), plan.limit),
            "test": limited(len(data.twins), plan.limit),
        },
        provenance={**provenance, "limit": plan.limit, "overrides": dict(unit.overrides)},
    )
    if not record.ok:
        return record
    cost = scored.file.cost
    record = replace(
        record,
        seconds_fit=cost.get("seconds_fit", NAN),
        seconds_score=cost.get("seconds_score", NAN),
        peak_rss_mb=cost.get("peak_rss_mb", NAN),
    )
    return with_metrics(record, data, scored.file)


def with_metrics(record: Record, data: EnvironmentData, scores: ScoreFile) -> Record:
    """Return a record with its metrics computed from scores."""
    anomalous = scores.parts[f"test/{record.anomaly}"]
    metrics, contributions = cell_metrics(
        calibration=scores.parts[CALIBRATION],
        anomalous=anomalous,
        twins=scores.parts[TWINS],
        onsets=data.anomalous(record.anomaly).onsets[: len(anomalous)].tolist(),
        environment=record.environment,
    )
    per_trajectory = {
        name: (c.numerator.tolist(), c.denominator.tolist()) for name, c in contributions.items()
    }
    return replace(record, metrics=metrics, per_trajectory=per_trajectory)


def rescore(records: Sequence[Record], results: ResultsDirectory, split: Split) -> list[Record]:
    """Recompute the metrics of records from the stored scores, without any detector.

    Raises
    ------
    ResultsError
        When the split is not the one that the records are of, or scores are missing.
    """
    data: dict[str, EnvironmentData] = {}
    try:
        return [_rescored(record, results, split, data) for record in records]
    finally:
        for environment in data.values():
            environment.close()


def _rescored(
    record: Record, results: ResultsDirectory, split: Split, data: dict[str, EnvironmentData]
) -> Record:
    if record.split_digest != split.digest:
        raise ResultsError(
            f"{record.cell} is of a split with digest {record.split_digest[:12]}, but split "
            f"{split.name!r} here has {split.digest[:12]}: name the right one with --split"
        )
    if not record.ok:
        return record
    if record.environment not in data:
        data[record.environment] = split.environment(record.environment)
    environment = data[record.environment]
    key = str(record.provenance.get("scores", ""))
    sets = parts_of(environment, (record.anomaly,))
    limit = record.provenance.get("limit")
    scores = results.scores(key, lengths_of(sets, limit)) if key else None
    if scores is None:
        raise ResultsError(
            f"{record.cell}: no scores that fit the split in {str(results.path)!r}, expected "
            f"scores/{key or '<key>'}.h5: run it again, or show the stored metrics with --stored"
        )
    return with_metrics(record, environment, scores)
