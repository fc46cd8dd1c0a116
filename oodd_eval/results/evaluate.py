"""From the scores of a cell to its metrics with intervals, and to its record.

Cells without twins have metrics of their own, see `oodd_eval.metrics.unpaired`.
"""

import contextlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.condition import NOMINAL, Condition
from oodd_eval.data.facts import LogFacts
from oodd_eval.data.parts import CALIBRATION, TWINS, EnvironmentData, Interval, lengths_of, parts_of
from oodd_eval.data.split import Split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, ResultsError, UsageError
from oodd_eval.metrics import alarms, recalibration, unpaired
from oodd_eval.metrics.alarms import AlarmKind, Calibration, GuaranteedAlarm
from oodd_eval.metrics.auc import AlarmRule, Contribution, auc_before, cell_contributions
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import HEADLINE, LEVELS, metric_info
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.recalibration import Recalibration
from oodd_eval.metrics.unpaired import UnpairedScores
from oodd_eval.plugins.contract import Scores
from oodd_eval.results.causality import check_before_effect, early_difference
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.draws import CodedDraws
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, Metric, Record


@dataclass(frozen=True, slots=True)
class Rules:
    """The alarm rules of one fitted detector, made from its calibration scores.

    `paper` has the paper's drift and threshold. `guaranteed` are rules by suffix, such as
    ``"at_5pct"``, that raise an alarm in at most that share of nominal episodes; levels that need
    more calibration episodes are left out. `statistic` is theirs, with a threshold that nothing
    exceeds. With a rolling calibration they are those after all nominal test episodes, and
    `earlier` are those of each of these.
    """

    paper: AlarmRule
    guaranteed: dict[str, GuaranteedAlarm]
    statistic: GuaranteedAlarm
    earlier: dict[str, list[GuaranteedAlarm]] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        calibration: Sequence[Scores],
        alarm: AlarmKind = "cusum",
        joining: Sequence[Scores] | None = None,
    ) -> "Rules":
        """Standardize and find thresholds on the scores of nominal trajectories.

        `joining` are those of nominal test episodes that join a rolling calibration.
        """
        levels = alarms.offered_levels(len(calibration), alarm)
        known = Calibration.fit(calibration, alarm)
        # A run goes on with a threshold that nothing exceeds, and counts what it misses.
        guaranteed = {
            suffix: replace(known.unbounded, threshold=known.threshold(level))
            for suffix, level in levels.items()
        }
        paper = AlarmRule(Standardization.fit(calibration))
        if joining is None:
            return cls(paper, guaranteed, known.unbounded)
        earlier: dict[str, list[GuaranteedAlarm]] = {}
        for suffix, level in levels.items():
            with contextlib.suppress(UsageError):  # too few for this level
                earlier[suffix] = alarms.rolling_rules(known, joining, level)
        last = {suffix: rules.pop() for suffix, rules in earlier.items()}
        return cls(paper, last, known.unbounded, earlier)

    def thresholds(self) -> dict[str, Metric]:
        """Return the thresholds of all levels as metrics.

        JSON has no infinity: a threshold that no statistic exceeds is written as undefined.
        """
        values = {f"threshold_{s}": rule.threshold for s, rule in self.guaranteed.items()}
        return {name: Metric(t if math.isfinite(t) else NAN) for name, t in values.items()}


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
    draws: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell with their intervals; attribution where it is explained.

    `draws` are the deviations of metrics in resamples of the calibration episodes.
    """
    contributions = cell_contributions(anomalous, twins, onsets, effects, rules.paper)
    for suffix, rule in rules.guaranteed.items():
        of_level = alarms.guaranteed_contributions(anomalous, twins, effects, rule)
        contributions |= {f"{name}_{suffix}": c for name, c in of_level.items()}
    if explained and (headline := rules.guaranteed.get(HEADLINE)):
        named = alarms.attribution_contributions(anomalous, explained, corrupted, effects, headline)
        contributions |= {f"{name}_{HEADLINE}": c for name, c in named.items()}
    contributions = _with_deviations(contributions, draws)
    metrics = {name: metric_of(name, c, environment) for name, c in contributions.items()}
    return metrics | rules.thresholds(), contributions


def unpaired_metrics(
    cell: UnpairedScores,
    rules: Rules,
    *,
    environment: str,
    condition: Condition,
    rate: float | None = None,
    rows: bool = False,
    draws: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell without twins, those of rows if asked for.

    `draws` are the deviations of metrics in resamples of the calibration episodes.
    Under the condition `NOMINAL` there are nominal episodes alone, and metrics of false alarms.
    """
    contributions = {} if condition == NOMINAL else unpaired.separability(cell, rules.statistic)
    if rows:
        # The headline, or the nearest level that is offered.
        usual = list(rules.guaranteed)[: [*LEVELS].index(HEADLINE) + 1][-1:]
        contributions |= unpaired.row_metrics(cell, rules.guaranteed[usual[0]] if usual else None)
    for suffix, rule in rules.guaranteed.items():
        of_level = unpaired.unpaired_alarms(cell, rule, rate, rules.earlier.get(suffix, ()))
        contributions |= {f"{name}_{suffix}": c for name, c in of_level.items()}
    contributions = _with_deviations(contributions, draws)
    metrics = {
        name: metric_of(name, c, environment, str(condition)) for name, c in contributions.items()
    }
    return metrics | rules.thresholds(), contributions


def _with_deviations(
    contributions: Mapping[str, Contribution], draws: Mapping[str, NDArray[np.float64]]
) -> dict[str, Contribution]:
    return {
        name: replace(c, deviations=draws[name]) if name in draws else c
        for name, c in contributions.items()
    }


def metric_of(
    name: str, contribution: Contribution, environment: str, condition: str = ""
) -> Metric:
    """Return a metric of a cell with its interval, from its terms."""
    cell = drawn_cell(environment, 0, contribution, condition)
    ends = mean_interval([cell], kind=metric_info(name).interval)
    return Metric(contribution.value, *ends, n=contribution.n)


def evaluated(
    records: Sequence[Record],
    scores: ScoreFile,
    data: EnvironmentData,
    *,
    row_metrics: bool = False,
    streamed: bool = False,
) -> list[Record]:
    """Return the records of a unit with metrics.

    They are ``invalid`` where scores cannot be standardized, or tell an episode from its twin
    before they differ (`oodd_eval.results.causality`).
    """
    try:
        joining = scores.parts[TWINS] if records[0].rolling else None
        rules = Rules.fit(scores.parts[CALIBRATION], records[0].alarm, joining)
    except OverflowError:
        return _invalid(
            records, "scores are too large: their sum over the calibration trajectories overflows"
        )
    if records[0].alarm == "score" and math.isnan(rules.paper.standardization.mean):
        # Any score would be an alarm.
        return _invalid(
            records, "no score of the calibration trajectories is defined, so there is no threshold"
        )
    draws = _calibration_draws(records, scores, data)
    measure = _with_metrics if data.paired else partial(_without_twins, rows=row_metrics)
    measured = [
        measure(replace(record, calibration_draws=CodedDraws.of(of_cell)), data, scores, rules)
        for record, of_cell in zip(records, draws, strict=True)
    ]
    if data.logs is None and (reason := _foresight(measured, data, scores, streamed=streamed)):
        return _invalid(records, reason)
    few = _too_few_to_roll(len(scores.parts[CALIBRATION]), records[0], rules)
    return [replace(r, note=few) if r.rolling else r for r in measured]


def _invalid(records: Sequence[Record], reason: str) -> list[Record]:
    return [
        replace(
            r,
            status="invalid",
            reason=reason,
            metrics={},
            per_trajectory={},
            calibration_draws=CodedDraws(),
        )
        for r in records
    ]


def _foresight(
    measured: Sequence[Record], data: EnvironmentData, scores: ScoreFile, *, streamed: bool
) -> str:
    """Return how the scores of a unit tell an episode from its twin too early; empty if not."""
    effects = {
        record.condition.part: data.anomalous(record.condition)
        .effects[: len(scores.parts[TWINS])]
        .tolist()
        for record in measured
    }
    first = measured[0]
    try:
        check_before_effect(
            scores.parts,
            effects,
            environment=first.environment,
            detector=first.detector,
            horizon=first.horizon,
            streamed=streamed,
        )
    except ContractError as error:
        return str(error)
    return next(filter(None, map(early_difference, measured)), "")


def _calibration_draws(
    records: Sequence[Record], scores: ScoreFile, data: EnvironmentData
) -> list[recalibration.Draws]:
    """Return what calibration does to the alarms of each cell of a unit.

    A rolling calibration is not resampled: its episodes have an order.
    """
    first, twins = records[0], scores.parts[TWINS]
    if first.rolling:
        return [{} for _ in records]
    again = Recalibration.fit(scores.parts[CALIBRATION], first.alarm, first.environment)
    if data.paired:
        cells = []
        for record in records:
            anomalous, known = scores.parts[record.condition.part], data.anomalous(record.condition)
            starts, effects = (r[: len(anomalous)] for r in (known.onsets, known.effects))
            cells.append(recalibration.PairedScores(anomalous, starts, effects))
        return again.paired(twins, cells)
    rate = data.logs.rate if data.logs else None
    return [again.unpaired(unpaired_scores(r, scores.parts, data), rate) for r in records]


def _too_few_to_roll(episodes: int, record: Record, rules: Rules) -> str:
    """Return which levels a rolling calibration lacks; empty if none."""
    offered = alarms.offered_levels(episodes, record.alarm) if record.rolling else {}
    missing = [level for suffix, level in offered.items() if suffix not in rules.guaranteed]
    return "; ".join(
        f"guaranteed alarms at {100 * level:g} % are left out: a rolling calibration takes "
        f"{alarms.least_rolling(level):g} episodes that the threshold is from"
        for level in missing
    )


def counts_of(data: EnvironmentData, condition: Condition, limit: int | None) -> dict[str, int]:
    """Return the numbers of trajectories that a cell uses, by part."""
    twins = "test" if data.paired else "nominal"
    parts = {"train": data.train, "calibration": data.calibration, twins: data.twins}
    if not data.paired and condition != NOMINAL:
        parts["test"] = data.labelled(condition)
    counts = {name: len(part.lengths[:limit]) for name, part in parts.items()}
    return counts if data.paired else {**counts, "test": counts.get("test", 0)}


def _with_metrics(record: Record, data: EnvironmentData, scores: ScoreFile, rules: Rules) -> Record:
    anomalous, known = scores.parts[record.condition.part], data.anomalous(record.condition)
    twins = scores.parts[TWINS]
    starts, effects = (r[: len(anomalous)].tolist() for r in (known.onsets, known.effects))
    explained = scores.explained.get(record.condition.part, [])
    metrics, contributions = cell_metrics(
        anomalous,
        twins,
        starts,
        effects,
        rules,
        environment=record.environment,
        explained=explained,
        corrupted=[p.get("sensors", ()) for p in known.parameters] if explained else (),
        draws=record.calibration_draws,
    )
    note = ""
    if data.logs is not None:
        before = auc_before(anomalous, twins, starts)
        contributions["auc_before"] = before
        metrics["auc_before"] = metric_of("auc_before", before, record.environment)
        if note := _distrusted(before.value):
            for name in NEED_TWINS:
                del metrics[name], contributions[name]
    return replace(
        record,
        metrics=metrics,
        per_trajectory=_terms(contributions),
        brief=bool(known.brief),
        note=note,
    )


LIKE: Final = (0.4, 0.6)
"""AUC before the onset, in the mean, up to which imported twins are taken for such."""

NEED_TWINS: Final = ("auc_matched", "auc_unpaired", "auc_smoothed")
"""Metrics that mean nothing where twins are none."""


def _distrusted(before: float) -> str:
    """Return why metrics that need twins are withheld; empty if they are not."""
    if not before < LIKE[0] and not before > LIKE[1]:
        return ""
    return (
        f"{', '.join(NEED_TWINS)} are withheld: the episodes differ from their twins before the "
        f"onset already (auc_before {before:.3f}, expected {LIKE[0]:g} to {LIKE[1]:g}), so they "
        "are no twins; import the episodes without twins"
    )


def unpaired_scores(
    record: Record, parts: Mapping[str, Sequence[Scores]], data: EnvironmentData
) -> UnpairedScores:
    """Return the scores of a cell without twins, with what is known of its episodes.

    Parameters
    ----------
    record
        Of the cell.
    parts
        Scores of its unit by part.
    data
        The environment.
    """
    nominal, facts = parts[TWINS], data.logs or LogFacts()
    cell = UnpairedScores(nominal, [], [], data.twins.tasks[: len(nominal)], [], facts.clock)
    if record.condition == NOMINAL:
        return cell
    anomalous, known = parts[record.condition.part], data.labelled(record.condition)
    n = len(anomalous)
    return replace(cell, anomalous=anomalous, intervals=known.intervals[:n], tasks=known.tasks[:n])


def _without_twins(
    record: Record, data: EnvironmentData, scores: ScoreFile, rules: Rules, *, rows: bool
) -> Record:
    metrics, contributions = unpaired_metrics(
        unpaired_scores(record, scores.parts, data),
        rules,
        environment=record.environment,
        condition=record.condition,
        rate=data.logs.rate if data.logs else None,
        rows=rows,
        draws=record.calibration_draws,
    )
    return replace(record, metrics=metrics, per_trajectory=_terms(contributions))


def _terms(contributions: Mapping[str, Contribution]) -> dict[str, NDArray[np.float64]]:
    return {name: np.array([c.numerator, c.denominator]) for name, c in contributions.items()}


def rescore(
    records: Sequence[Record], results: ResultsDirectory, split: Split, *, row_metrics: bool = False
) -> list[Record]:
    """Recompute the metrics of records from the stored scores, without any detector."""
    units: dict[tuple[str, str, bool], list[Record]] = {}
    for record in records:
        must_be_of(split, record)
        if record.ok:
            key = record.environment, record.scores, record.rolling
            units.setdefault(key, []).append(record)
    fresh: dict[tuple[str, ...], Record] = {}
    with split.opened() as environment:
        for (name, _, _), unit in units.items():
            data = environment(name)
            kept = stored_scores(unit, results, data)
            again = evaluated(unit, kept, data, row_metrics=row_metrics)
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
    """An anomalous episode with its scores, beside its nominal twin where there is one.

    Attributes
    ----------
    cell, index
        The cell, and the index of the episode among the cell's.
    scores, twin_scores
        One for each observation, NaN where undefined; None for a twin that there is not.
    trajectory, twin
        The episodes, of T + 1 observations each.
    onset, effect
        The row from which the anomaly is in force, and the first that differs from the twin's.
        Without a twin both are the start of the first interval, None where that is not known.
    sensors
        Names of the sensors, in the order of columns.
    rule
        The guaranteed alarm at a `level`; None where there are too few calibration episodes for it.
    intervals
        Without a twin, the rows [start, stop) that are anomalous; a start of -1 is not known.
    nominal
        Without a twin, mean and spread of each sensor in nominal test episodes: shape (2, D).
    level
        The largest share of nominal episodes with an alarm: 0.05, or without twins 0.1 where that
        is the strictest that is offered.
    """

    cell: Cell
    index: int
    scores: Floats
    twin_scores: Floats | None
    trajectory: Trajectory
    twin: Trajectory | None
    onset: int | None
    effect: int | None
    sensors: tuple[str, ...]
    rule: GuaranteedAlarm | None
    intervals: tuple[Interval, ...] = ()
    nominal: Floats | None = None
    level: float = LEVELS[HEADLINE]

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
            Infinite without an alarm; NaN where that precedes the effect, or no row follows it,
            and without a twin or a known start.
        """
        scores = self.twin_scores if of_twin else self.scores
        if self.rule is None or scores is None or self.effect is None or len(scores) <= self.effect:
            return math.nan
        first = self.rule.first(scores)
        if first is None:
            return math.inf
        return first - self.effect if first >= self.effect else math.nan

    def __repr__(self) -> str:
        """Return what happened when: the arrays would fill screens."""
        return (
            f"ScoredEpisode({self.cell}, index={self.index}, rows={len(self.scores)}, "
            f"onset={self.onset}, effect={self.effect}, alarm={self.alarm})"
        )
