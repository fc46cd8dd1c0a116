"""From the scores of a cell to its metrics with intervals, and to its record."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.parts import CALIBRATION, TWINS, EnvironmentData, lengths_of, parts_of
from oodd_eval.data.split import Split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ResultsError
from oodd_eval.metrics import alarms
from oodd_eval.metrics.alarms import AlarmKind, GuaranteedAlarm
from oodd_eval.metrics.auc import AlarmRule, Contribution, cell_contributions
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import HEADLINE, metric_info
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.plugins.contract import Scores
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, Metric, Record


@dataclass(frozen=True, slots=True)
class Rules:
    """The alarm rules of one fitted detector, made from its calibration scores.

    `paper` has the paper's drift and threshold. `guaranteed` are rules by suffix, such as
    ``"at_5pct"``, that raise an alarm in at most that share of nominal episodes; levels that need
    more calibration episodes are left out.
    """

    paper: AlarmRule
    guaranteed: dict[str, GuaranteedAlarm]

    @classmethod
    def fit(cls, calibration: Sequence[Scores], alarm: AlarmKind = "cusum") -> "Rules":
        """Standardize and find thresholds on the scores of nominal trajectories."""
        levels = alarms.offered_levels(len(calibration), alarm)
        rules = GuaranteedAlarm.fits(calibration, list(levels.values()), alarm)
        paper = AlarmRule(Standardization.fit(calibration))
        return cls(paper, dict(zip(levels, rules, strict=True)))


def cell_metrics(
    anomalous: Sequence[Scores],
    twins: Sequence[Scores],
    onsets: Sequence[int],
    effects: Sequence[int],
    rules: Rules,
    *,
    environment: str,
    explained: Sequence[NDArray[np.int32]] = (),
    corrupted: Sequence[Collection[int]] = (),
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell with their intervals; attribution where it is explained."""
    contributions = cell_contributions(anomalous, twins, onsets, effects, rules.paper)
    thresholds = {}
    for suffix, rule in rules.guaranteed.items():
        of_level = alarms.guaranteed_contributions(anomalous, twins, effects, rule)
        contributions |= {f"{name}_{suffix}": c for name, c in of_level.items()}
        # JSON has no infinity: a threshold that no statistic exceeds is written as undefined.
        finite = math.isfinite(rule.threshold)
        thresholds[f"threshold_{suffix}"] = Metric(rule.threshold if finite else NAN)
    if explained and (headline := rules.guaranteed.get(HEADLINE)):
        named = alarms.attribution_contributions(anomalous, explained, corrupted, effects, headline)
        contributions |= {f"{name}_{HEADLINE}": c for name, c in named.items()}
    metrics = {name: metric_of(name, c, environment) for name, c in contributions.items()}
    return metrics | thresholds, contributions


def metric_of(name: str, contribution: Contribution, environment: str) -> Metric:
    """Return a metric of a cell with its interval, from its terms."""
    cell = drawn_cell(environment, 0, contribution)
    ends = mean_interval([cell], kind=metric_info(name).interval)
    return Metric(contribution.value, *ends, n=contribution.n)


def evaluated(records: Sequence[Record], scores: ScoreFile, data: EnvironmentData) -> list[Record]:
    """Return the records of a unit with metrics; ``invalid`` if scores cannot be standardized."""
    try:
        rules = Rules.fit(scores.parts[CALIBRATION], records[0].alarm)
    except OverflowError:
        reason = "scores are too large: their sum over the calibration trajectories overflows"
        return [replace(record, status="invalid", reason=reason) for record in records]
    if records[0].alarm == "score" and math.isnan(rules.paper.standardization.mean):
        # Any score would be an alarm.
        reason = "no score of the calibration trajectories is defined, so there is no threshold"
        return [replace(record, status="invalid", reason=reason) for record in records]
    return [_with_metrics(record, data, scores, rules) for record in records]


def _with_metrics(record: Record, data: EnvironmentData, scores: ScoreFile, rules: Rules) -> Record:
    anomalous, known = scores.parts[record.condition.part], data.anomalous(record.condition)
    starts, effects = (r[: len(anomalous)].tolist() for r in (known.onsets, known.effects))
    explained = scores.explained.get(record.condition.part, [])
    metrics, contributions = cell_metrics(
        anomalous,
        scores.parts[TWINS],
        starts,
        effects,
        rules,
        environment=record.environment,
        explained=explained,
        corrupted=[p.get("sensors", ()) for p in known.parameters] if explained else (),
    )
    per_trajectory = {
        name: np.array([c.numerator, c.denominator]) for name, c in contributions.items()
    }
    return replace(record, metrics=metrics, per_trajectory=per_trajectory, brief=bool(known.brief))


def rescore(records: Sequence[Record], results: ResultsDirectory, split: Split) -> list[Record]:
    """Recompute the metrics of records from the stored scores, without any detector."""
    units: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        must_be_of(split, record)
        if record.ok:
            units.setdefault((record.environment, record.scores), []).append(record)
    fresh: dict[tuple[str, ...], Record] = {}
    with split.opened() as environment:
        for (name, _), unit in units.items():
            data = environment(name)
            again = evaluated(unit, stored_scores(unit, results, data), data)
            fresh |= {record.identity: record for record in again}
    return [fresh.get(record.identity, record) for record in records]


def must_be_of(split: Split, record: Record) -> None:
    """Raise `ResultsError` for a record of another split."""
    if record.split_digest != split.digest:
        raise ResultsError(
            f"{record.cell} is of a split with digest {record.split_digest[:12]}, but split "
            f"{split.name!r} here has {split.digest[:12]}: name the right one with --split"
        )


def stored_scores(
    records: Sequence[Record], results: ResultsDirectory, data: EnvironmentData
) -> ScoreFile:
    """Return the stored scores that the records of one unit were computed from."""
    first = records[0]
    lengths = lengths_of(parts_of(data, [r.condition for r in records]), first.limit)
    scores = results.scores(first.scores, lengths) if first.scores else None
    if scores is None:
        raise ResultsError(
            f"{first.cell}: no scores that fit the split in {str(results.path)!r}, expected "
            f"scores/{first.scores or '<key>'}.h5: run it again, or show the stored metrics with "
            "--stored"
        )
    return scores


Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredEpisode:
    """An anomalous episode beside its nominal twin, with the scores of both.

    Attributes
    ----------
    cell, index
        The cell, and the index of the episode among the cell's.
    scores, twin_scores
        One for each observation, NaN where undefined.
    trajectory, twin
        The episodes, of T + 1 observations each.
    onset, effect
        The row from which the anomaly is in force, and the first that differs from the twin's.
    sensors
        Names of the sensors, in the order of columns.
    rule
        The guaranteed alarm at 5 %; None where there are too few calibration episodes for it.
    """

    cell: Cell
    index: int
    scores: Floats
    twin_scores: Floats
    trajectory: Trajectory
    twin: Trajectory
    onset: int
    effect: int
    sensors: tuple[str, ...]
    rule: GuaranteedAlarm | None

    @property
    def alarm(self) -> int | None:
        """The row of the first alarm; None without one."""
        return self.rule.first(self.scores) if self.rule else None

    def delay(self, *, of_twin: bool = False) -> float:
        """Return the number of rows from the effect to the first alarm.

        Parameters
        ----------
        of_twin
            Whether the alarm is one of the twin, which is a false one.

        Returns
        -------
        float
            Infinite without an alarm; NaN where that precedes the effect, or no row follows it.
        """
        scores = self.twin_scores if of_twin else self.scores
        first = self.rule.first(scores) if self.rule else None
        if self.rule is None or len(scores) <= self.effect:
            return math.nan
        if first is None:
            return math.inf
        return first - self.effect if first >= self.effect else math.nan

    def __repr__(self) -> str:
        """Return what happened when: the arrays would fill screens."""
        return (
            f"ScoredEpisode({self.cell}, index={self.index}, rows={len(self.scores)}, "
            f"onset={self.onset}, effect={self.effect}, alarm={self.alarm})"
        )
