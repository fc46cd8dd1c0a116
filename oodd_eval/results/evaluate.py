"""From the scores of a cell to its metrics with intervals, and to its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from oodd_eval.data.parts import CALIBRATION, TWINS, EnvironmentData, lengths_of, parts_of
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.alarms import MIN_STEPS, calibrate
from oodd_eval.metrics.auc import (
    AlarmRule,
    Contribution,
    alarm_contributions,
    cell_contributions,
    pooled_metrics,
)
from oodd_eval.metrics.bootstrap import interval, shared_weights
from oodd_eval.metrics.catalogue import CALIBRATED, TARGETS
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.plugins.contract import Scores
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.record import Metric, Record


@dataclass(frozen=True, slots=True)
class Rules:
    """The alarm rules of one fitted detector, made from its calibration scores.

    `standard` has the paper's drift and threshold. `calibrated` are rules by suffix, such as
    ``"at_1pct"``, with the smallest threshold that keeps the calibration trajectories' false-alarm
    rate at the target; targets with too few calibration steps are left out.
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
    anomalous: Sequence[Scores], twins: Sequence[Scores], onsets: Sequence[int], rules: Rules, *,
    environment: str,
) -> tuple[dict[str, Metric], dict[str, Contribution]]:  # fmt: skip
    """Compute all metrics of one cell with their intervals."""
    found = cell_contributions(anomalous, twins, onsets, rules.standard)
    for suffix, rule in rules.calibrated.items():
        alarms = alarm_contributions(anomalous, twins, onsets, rule)
        found |= {f"{name}_{suffix}": alarms[name] for name in CALIBRATED}
    weights = shared_weights(environment, len(anomalous))
    metrics = {name: Metric(c.value, *interval(c, weights), n=c.n) for name, c in found.items()}
    thresholds = {f"threshold_{s}": Metric(r.threshold) for s, r in rules.calibrated.items()}
    defined = sum(not np.isnan(scores).all() for scores in anomalous)
    pooled = pooled_metrics(anomalous, onsets)
    return metrics | thresholds | {k: Metric(v, n=defined) for k, v in pooled.items()}, found


def evaluated(records: Sequence[Record], scores: ScoreFile, data: EnvironmentData) -> list[Record]:
    """Return the records of one unit's cells with their metrics, computed from its scores.

    Cells whose scores cannot be standardized become ``invalid``.
    """
    try:
        rules = Rules.fit(scores.parts[CALIBRATION])
    except OverflowError:
        reason = "scores are too large: their sum over the calibration trajectories overflows"
        return [replace(record, status="invalid", reason=reason) for record in records]
    return [_with_metrics(record, data, scores, rules) for record in records]


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
    """Recompute the metrics of records from the stored scores, without any detector."""
    units: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.split_digest != split.digest:
            raise ResultsError(
                f"{record.cell} is of a split with digest {record.split_digest[:12]}, but split "
                f"{split.name!r} here has {split.digest[:12]}: name the right one with --split"
            )
        if record.ok:
            units.setdefault((record.environment, record.scores), []).append(record)
    fresh: dict[tuple[str, ...], Record] = {}
    data: dict[str, EnvironmentData] = {}
    try:
        for (environment, _), own in units.items():
            if environment not in data:
                data[environment] = split.environment(environment)
            scores = stored_scores(own, results, data[environment])
            fresh |= {r.identity: r for r in evaluated(own, scores, data[environment])}
    finally:
        for opened in data.values():
            opened.close()
    return [fresh.get(record.identity, record) for record in records]


def stored_scores(
    records: Sequence[Record], results: ResultsDirectory, data: EnvironmentData
) -> ScoreFile:
    """Return the stored scores that the records of one unit were computed from."""
    first = records[0]
    lengths = lengths_of(parts_of(data, [r.anomaly for r in records]), first.limit)
    scores = results.scores(first.scores, lengths) if first.scores else None
    if scores is None:
        raise ResultsError(
            f"{first.cell}: no scores that fit the split in {str(results.path)!r}, expected "
            f"scores/{first.scores or '<key>'}.h5: run it again, or show the stored metrics with "
            "--stored"
        )
    return scores
