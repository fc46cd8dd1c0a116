"""From the scores of a cell to its metrics with intervals, and to its record."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from oodd_eval.data.facts import ANOMALIES, PROTOCOL
from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import EnvironmentData, Split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.alarms import CALIBRATED, MIN_STEPS, TARGETS, calibrate
from oodd_eval.metrics.auc import (
    AlarmRule,
    Contribution,
    alarm_contributions,
    cell_contributions,
    pooled_metrics,
)
from oodd_eval.metrics.bootstrap import bootstrap_weights, interval
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.plugins.contract import Scores
from oodd_eval.plugins.discovery import Offer
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.record import NAN, Metric, Record
from oodd_eval.scoring.plan import Plan, Unit
from oodd_eval.scoring.unit import CALIBRATION, Scored, lengths_of, limited, parts_of

_weights = functools.lru_cache(maxsize=32)(bootstrap_weights)


@dataclass(frozen=True, slots=True)
class Rules:
    """The alarm rules of one fitted detector, made from its calibration scores.

    Attributes
    ----------
    standard
        With the paper's drift and threshold.
    calibrated
        By suffix, such as ``"at_1pct"``: the smallest threshold that keeps the false-alarm rate of
        the calibration trajectories at the target. Targets for which there are too few calibration
        steps are left out.
    """

    standard: AlarmRule
    calibrated: dict[str, AlarmRule]

    @classmethod
    def fit(cls, calibration: Sequence[Scores]) -> Rules:
        """Standardize and calibrate on the scores of nominal trajectories."""
        rule = AlarmRule(Standardization.fit(calibration))
        steps = sum(int(np.count_nonzero(~np.isnan(s))) for s in calibration)
        return cls(
            rule,
            {
                suffix: replace(rule, threshold=calibrate(calibration, rule, target))
                for suffix, target in TARGETS.items()
                if steps >= MIN_STEPS[suffix]
            },
        )


def cell_metrics(
    anomalous: Sequence[Scores],
    twins: Sequence[Scores],
    onsets: Sequence[int],
    rules: Rules,
    *,
    environment: str,
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell with their intervals.

    Parameters
    ----------
    anomalous, twins : sequences of n arrays
        Scores of the test trajectories and of their nominal twins, in the same order.
    onsets : sequence of n ints
    rules
        Of the same fitted detector.
    environment
        Cells of one environment share their bootstrap resamples, so that they can be compared.

    Returns
    -------
    metrics
        By name: those of `oodd_eval.metrics.auc.METRICS`, those under each calibrated rule, and the
        pooled ones, which have no interval: every resample would need their whole curve again.
    contributions
        Numerators and denominators of those that are ratios of sums.
    """
    found = cell_contributions(anomalous, twins, onsets, rules.standard)
    for suffix, rule in rules.calibrated.items():
        alarms = alarm_contributions(anomalous, twins, onsets, rule)
        found |= {f"{name}_{suffix}": alarms[name] for name in CALIBRATED}
    weights = _weights(len(anomalous), key=environment)
    metrics = {name: Metric(c.value, *interval(c, weights), n=c.n) for name, c in found.items()}
    thresholds = {f"threshold_{s}": Metric(r.threshold) for s, r in rules.calibrated.items()}
    defined = sum(not np.isnan(scores).all() for scores in anomalous)
    pooled = pooled_metrics(anomalous, onsets)
    return metrics | thresholds | {k: Metric(v, n=defined) for k, v in pooled.items()}, found


def make_records(
    plan: Plan,
    unit: Unit,
    offer: Offer,
    data: EnvironmentData,
    scored: Scored,
    provenance: Mapping[str, Any],
    *,
    plugin_source: str = "",
    scores: str = "",
) -> list[Record]:
    """Return the records of a unit's cells, in the order of its anomalies, whatever became of it.

    `provenance` is common to all of them.
    """
    cost = scored.file.cost
    blank = Record(
        detector=unit.detector,
        detector_version=offer.version,
        plugin=f"{offer.distribution}:{offer.plugin}",
        parameters={k: v for k, v in unit.parameters.items() if k != "device"},
        environment=unit.environment,
        anomaly="",
        group="",
        horizon=unit.horizon,
        seed=unit.seed,
        split=plan.split,
        split_digest=plan.split_digest,
        status=scored.status,  # type: ignore[arg-type]
        reason=scored.reason,
        protocol=PROTOCOL,
        plugin_source=plugin_source,
        overrides={k: v for k, v in unit.overrides.items() if k != "device"},
        inputs=offer.spec.inputs,
        limit=plan.limit,
        scores=scores,
        # A whole number, also when it was read back from a file of floats.
        steps_scored=int(cost["steps_scored"]) if "steps_scored" in cost else None,
        counts={
            "train": limited(len(data.train), plan.limit),
            "calibration": limited(len(data.calibration), plan.limit),
            "test": limited(len(data.twins), plan.limit),
        },
        seconds_fit=cost.get("seconds_fit", NAN),
        seconds_score=cost.get("seconds_score", NAN),
        peak_rss_mb=cost.get("peak_rss_mb", NAN),
        provenance=dict(provenance)
        | ({"device": unit.parameters["device"]} if "device" in unit.parameters else {}),
    )
    records = [replace(blank, anomaly=a, group=ANOMALIES[a].group) for a in unit.anomalies]
    if scored.status != "ok":
        return records
    try:
        rules = Rules.fit(scored.file.parts[CALIBRATION])
    except OverflowError:
        reason = "scores are too large: their sum over the calibration trajectories overflows"
        return [replace(record, status="invalid", reason=reason) for record in records]
    return [_with_metrics(record, data, scored.file, rules) for record in records]


def _with_metrics(record: Record, data: EnvironmentData, scores: ScoreFile, rules: Rules) -> Record:
    anomalous = scores.parts[f"test/{record.anomaly}"]
    metrics, contributions = cell_metrics(
        anomalous,
        scores.parts[TWINS],
        data.anomalous(record.anomaly).onsets[: len(anomalous)].tolist(),
        rules,
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
    rules: dict[str, Rules] = {}
    rescored = []
    try:
        for record in records:
            if record.split_digest != split.digest:
                raise ResultsError(
                    f"{record.cell} is of a split with digest {record.split_digest[:12]}, but "
                    f"split {split.name!r} here has {split.digest[:12]}: name the right one with "
                    "--split"
                )
            if not record.ok:
                rescored.append(record)
                continue
            if record.environment not in data:
                data[record.environment] = split.environment(record.environment)
            environment = data[record.environment]
            scores = stored_scores(record, results, environment)
            key = record.scores
            if key not in rules:
                rules[key] = Rules.fit(scores.parts[CALIBRATION])
            rescored.append(_with_metrics(record, environment, scores, rules[key]))
    finally:
        for environment in data.values():
            environment.close()
    return rescored


def stored_scores(record: Record, results: ResultsDirectory, data: EnvironmentData) -> ScoreFile:
    """Return the stored scores that a record was computed from.

    Raises
    ------
    ResultsError
        When there are none that fit the split.
    """
    key = record.scores
    sets = parts_of(data, (record.anomaly,))
    scores = results.scores(key, lengths_of(sets, record.limit)) if key else None
    if scores is None:
        raise ResultsError(
            f"{record.cell}: no scores that fit the split in {str(results.path)!r}, expected "
            f"scores/{key or '<key>'}.h5: run it again, or show the stored metrics with --stored"
        )
    return scores
