"""From the scores of a cell to its metrics with intervals, and to its record.

Cells without twins have metrics of their own, see `oodd_eval.metrics.unpaired`.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.baseline import CONSTANT, Baseline
from oodd_eval.data.condition import NOMINAL, Condition
from oodd_eval.data.facts import LogFacts
from oodd_eval.data.parts import CALIBRATION, TWINS, EnvironmentData, Interval, lengths_of, parts_of
from oodd_eval.data.split import Split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, ResultsError, UsageError
from oodd_eval.metrics import alarms, unpaired
from oodd_eval.metrics.alarms import AlarmKind, Calibration, GuaranteedAlarm
from oodd_eval.metrics.auc import AlarmRule, Contribution, auc_before, cell_contributions
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import HEADLINE, LEVELS, NAMED_AFTER, metric_info
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.faults import StreamScale, readings
from oodd_eval.metrics.recalibration import Draws, PairedScores, Recalibration
from oodd_eval.metrics.unpaired import UnpairedScores
from oodd_eval.plugins.contract import ROLLOUT_TOLERANCE, TOLERANCE, Scores
from oodd_eval.plugins.explanations import KINDS, Named
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, CodedDraws, Metric, Record


@dataclass(frozen=True, slots=True)
class Rules:
    """The alarm rules of one fitted detector, made from its calibration scores.

    `paper` has the paper's drift and threshold. `guaranteed` are rules by suffix, such as
    ``"at_5pct"``, that raise an alarm in at most that share of nominal episodes; levels that need
    more calibration episodes are left out; without twins they are of what `calibration` joins. With
    a rolling calibration they are those after all nominal test episodes, and `earlier` are those of
    each of these.
    """

    paper: AlarmRule
    guaranteed: dict[str, GuaranteedAlarm]
    calibration: Calibration
    earlier: dict[str, list[GuaranteedAlarm]] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        calibration: Sequence[Scores],
        alarm: AlarmKind = "cusum",
        joining: Sequence[Scores] | None = None,
        recordings: Mapping[str, Sequence[int]] = MappingProxyType({}),
        stream: Mapping[str, Sequence[Scores]] = MappingProxyType({}),
    ) -> "Rules":
        """Standardize and find thresholds on the scores of nominal trajectories.

        `joining` are those of nominal test episodes that join a rolling calibration, `recordings`
        those of a record, `stream` the surprise of the stream by part, without twins.
        """
        levels = alarms.offered_levels(len(calibration), alarm)
        fitted = Calibration.fit(
            calibration, alarm, recordings.get(CALIBRATION), largest_of(stream)
        )
        basis = fitted.of_statistics if stream else fitted
        # A run goes on with a threshold that nothing exceeds, and counts what it misses.
        guaranteed = {
            suffix: replace(basis.unbounded, threshold=fitted.threshold(level))
            for suffix, level in levels.items()
        }
        paper = AlarmRule(Standardization.fit(calibration))
        if joining is None:
            return cls(paper, guaranteed, fitted)
        if stream:
            joining = [*map(fitted.joint, joining, stream[TWINS])]
        earlier: dict[str, list[GuaranteedAlarm]] = {}
        for suffix, level in levels.items():
            with contextlib.suppress(UsageError):  # too few for this level
                further = recordings.get("nominal")
                earlier[suffix] = alarms.rolling_rules(basis, joining, level, further)
        last = {suffix: rules.pop() for suffix, rules in earlier.items()}
        return cls(paper, last, fitted, earlier)

    def thresholds(self) -> dict[str, Metric]:
        """Return the thresholds of all levels as metrics.

        JSON has no infinity: a threshold that no statistic exceeds is written as undefined.
        """
        values = {f"threshold_{s}": rule.threshold for s, rule in self.guaranteed.items()}
        return {name: Metric(t if math.isfinite(t) else NAN) for name, t in values.items()}


def first_alarms(
    parts: Mapping[str, Sequence[Scores]], alarm: AlarmKind
) -> dict[str, list[int | None]]:
    """Return where explanations are compared with the truth: rows by anomalous part.

    These are of the first guaranteed alarms at the headline's level; None without one, and where
    calibration episodes are too few.

    Parameters
    ----------
    parts
        Scores of a unit whose episodes have twins, by part.
    alarm
        Statistic of the guaranteed alarms.
    """
    rule = Rules.fit(parts[CALIBRATION], alarm).guaranteed.get(HEADLINE)
    tests = {part: of_part for part, of_part in parts.items() if part not in (CALIBRATION, TWINS)}
    return {part: [rule.first(x) if rule else None for x in xs] for part, xs in tests.items()}


def with_explanations(
    parts: dict[str, list[Scores]],
    asked: Iterable[tuple[tuple[str, int], int, Trajectory, object]],
    data: EnvironmentData,
    train: Sequence[Trajectory],
) -> ScoreFile:
    """Return scores of a unit beside explanations, which came back unchecked.

    Parameters
    ----------
    parts
        Scores of episodes with twins, by part.
    asked
        Part and number of an episode, which of `NAMED_AFTER` is meant, the rows until then, and
        what came back.
    data
        The environment.
    train
        Training episodes, by which readings are standardized to find the largest.

    Returns
    -------
    ScoreFile

    Raises
    ------
    ContractError
        When something came back that is no explanation.
    """
    tests = {part: rows for part, rows in parts.items() if part not in (CALIBRATION, TWINS)}
    first = {part: [np.full((2, len(x)), -1, np.int32) for x in xs] for part, xs in tests.items()}
    shape = 1 + len(NAMED_AFTER), 1 + len(data.sensors) + len(data.actions)
    namings = {part: np.zeros((len(xs), *shape), np.int8) for part, xs in tests.items()}
    nominal = np.concatenate([x.observations for x in train]).astype(np.float64)
    mean, std = nominal.mean(axis=0), nominal.std(axis=0)
    for (part, i), later, x, array in asked:
        named = check_named(array, x, f"{data.id}/{part}[{i}]")
        namings[part][i, later, : len(named) - 2] = named[2:]
        if not later:
            first[part][i][:, len(x) - 1] = named[:2]
            # A sensor that stood still has the scale 1, as detectors see it.
            distances = np.abs(x.observations[-1] - mean) / np.where(std < CONSTANT, 1.0, std)
            largest = np.argsort(-distances, kind="stable")
            namings[part][i, -1, 1 + largest[: named[3:].sum()]] = 1
    return ScoreFile(parts, {}, first, namings=namings)


def check_named(array: object, trajectory: Trajectory, where: str) -> Named:
    """Return what came from a worker for the last row of an episode; else `ContractError`."""
    rows, sensors = trajectory.observations.shape
    form = np.dtype(np.int32), (3 + sensors + trajectory.action_dim,)
    if not isinstance(array, np.ndarray) or (array.dtype, array.shape) != form:
        raise ContractError(f"no explanation came back for {where}")
    sensor, onset, kind, *named = array.tolist()
    if kind not in range(-1, len(KINDS)) or not {*named} <= {0, 1}:
        raise ContractError(f"no naming came back for {where}")
    if not (0 <= sensor < sensors and 0 <= onset < rows):
        raise ContractError(
            f"explain names sensor {sensor} and onset {onset} at t = {rows - 1} of {where}, where "
            f"the score is defined: expected one of {sensors} sensors, and a row up to t"
        )
    return array


def largest_of(stream: Mapping[str, Sequence[Scores]]) -> list[float] | None:
    """Return the largest surprise of the stream in each calibration episode; None without any."""
    return [float(rows.max()) for rows in stream[CALIBRATION]] if stream else None


def with_stream(
    scores: ScoreFile,
    data: EnvironmentData,
    conditions: Sequence[Condition],
    limit: int | None,
    alarm: AlarmKind,
) -> ScoreFile:
    """Return scores of a unit with the surprise of the stream, which counts without twins.

    A monitor's recorded number is judged as it is.
    """
    if alarm in alarms.RECORDED:
        return replace(scores, stream={})
    if data.paired or len(scores.stream) == len(scores.parts):
        return scores
    return replace(scores, stream=stream_of(data, conditions, limit))


def stream_of(
    data: EnvironmentData, conditions: Iterable[Condition], limit: int | None
) -> dict[str, list[Scores]]:
    """Return the surprise of the stream by part and episode, see `oodd_eval.metrics.faults`.

    Parameters
    ----------
    data
        An environment without twins.
    conditions
        Whose parts are scored.
    limit
        Episodes of each part that are used; None for all.
    """
    train, calibration = islice(data.train, limit), islice(data.calibration, limit)
    base = Baseline.fit(islice(data.train, limit), data.baseline) if data.baseline else None
    scale = StreamScale.of_episodes(train, calibration, base)
    return {
        part: [
            (scale.without(i) if part == CALIBRATION else scale).surprise(*readings(x, base))
            for i, x in enumerate(islice(episodes, limit))
        ]
        for part, episodes in parts_of(data, conditions).items()
    }


def cell_metrics(
    cell: PairedScores | UnpairedScores,
    rules: Rules,
    *,
    environment: str,
    condition: str = "",
    rate: float | None = None,
    rows: bool = False,
    supervised: bool = False,
    attribution: Callable[[GuaranteedAlarm], dict[str, Contribution]] = lambda _: {},
    draws: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> tuple[dict[str, Metric], dict[str, Contribution]]:
    """Compute all metrics of one cell with their intervals, and their terms.

    Parameters
    ----------
    cell
        The scores. The condition `NOMINAL` has nominal episodes alone, and false alarms.
    rules
        Made from the calibration scores.
    environment, condition
        What test episodes are resampled by; cells with twins share theirs, without a condition.
    rate
        Without twins, rows in a second; None leaves out alarms per hour.
    rows
        Without twins, whether metrics of rows are computed, too.
    supervised
        Without twins, whether the detector learns from failures.
    attribution
        Returns what explanations are worth at the alarms of the headline's level.
    draws
        Deviations of metrics in resamples of the calibration episodes.
    """
    levels = rules.guaranteed
    terms: dict[str, Contribution] = {}
    if isinstance(cell, PairedScores):
        terms |= cell_contributions(*cell, rules.paper)
    elif condition != str(NOMINAL):
        terms |= unpaired.separability(cell, rules.calibration.unbounded, supervised=supervised)
    judged = cell
    if isinstance(cell, UnpairedScores) and rules.calibration.tail is not None:
        judged = cell.with_statistics(rules.calibration.joint)
    if isinstance(cell, UnpairedScores) and isinstance(judged, UnpairedScores) and rows:
        # The headline, or the nearest level that is offered.
        usual = list(levels)[: [*LEVELS].index(HEADLINE) + 1][-1:]
        rule_of_rows = levels[usual[0]] if usual else None
        terms |= unpaired.row_metrics(cell, rule_of_rows, judged.anomalous)
    for suffix, rule in levels.items():
        of_level = (
            alarms.guaranteed_contributions(judged.anomalous, judged.twins, judged.effects, rule)
            if isinstance(judged, PairedScores)
            else unpaired.unpaired_alarms(judged, rule, rate, rules.earlier.get(suffix, ()))
        )
        terms |= {f"{name}_{suffix}": c for name, c in of_level.items()}
    if HEADLINE in levels:
        terms |= {f"{name}_{HEADLINE}": c for name, c in attribution(levels[HEADLINE]).items()}
    terms |= {name: replace(terms[name], deviations=draws[name]) for name in terms if name in draws}
    if isinstance(cell, UnpairedScores):
        terms = {name: replace(c, recordings=cell.recordings) for name, c in terms.items()}
    metrics = {name: metric_of(name, c, environment, condition) for name, c in terms.items()}
    return metrics | rules.thresholds(), terms


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
    before they differ, see `check_before_effect`.
    """
    if not records[0].paired:
        conditions, first = [r.condition for r in records], records[0]
        scores = with_stream(scores, data, conditions, first.limit, first.alarm)
    try:
        joining = scores.parts[TWINS] if records[0].rolling else None
        records = [replace(r, recordings=_recordings(r, scores.parts, data)) for r in records]
        numbers = records[0].recordings
        calibration = scores.parts[CALIBRATION]
        rules = Rules.fit(calibration, records[0].alarm, joining, numbers, scores.stream)
    except OverflowError:
        return _invalid(
            records, "scores are too large: their sum over the calibration trajectories overflows"
        )
    if records[0].alarm != "cusum" and math.isnan(rules.paper.standardization.mean):
        # Any score would be an alarm.
        return _invalid(
            records, "no score of the calibration trajectories is defined, so there is no threshold"
        )
    cells = [cell_scores(record, scores.parts, data, scores.stream) for record in records]
    draws = _calibration_draws(records[0], cells, scores, data)
    measured = [
        _with_metrics(
            replace(record, calibration_draws=CodedDraws.of(of_cell)),
            cell,
            data,
            scores,
            rules,
            rows=row_metrics,
        )
        for record, cell, of_cell in zip(records, cells, draws, strict=True)
    ]
    if data.logs is None and (reason := _foresight(measured, cells, scores, streamed=streamed)):
        return _invalid(records, reason)
    few = _too_few_to_roll(len(scores.parts[CALIBRATION]), records[0], rules)
    return [replace(r, note=few) if r.rolling else r for r in measured]


def _recordings(
    record: Record, parts: Mapping[str, Sequence[Scores]], data: EnvironmentData
) -> dict[str, tuple[int, ...]]:
    """Return the recordings of a cell's episodes by part; empty where each episode is one."""
    names = {CALIBRATION: CALIBRATION, "nominal": TWINS, "test": record.condition.part}
    labels: dict[str, Sequence[str]] = {}
    for name, part in names.items():
        if part in parts and part not in map(names.get, labels):
            labels[name] = (data.recordings(part) or ())[: len(parts[part])]
    if all(len({*of_part}) == len(of_part) for of_part in labels.values()):
        return {}
    every = [label for of_part in labels.values() for label in of_part]
    numbers = iter(alarms.numbered(every, len(every)).tolist())
    return {name: tuple(islice(numbers, len(of_part))) for name, of_part in labels.items()}


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
    measured: Sequence[Record],
    cells: Sequence[PairedScores | UnpairedScores],
    scores: ScoreFile,
    *,
    streamed: bool,
) -> str:
    """Return how the scores of a unit tell an episode from its twin too early; empty if not."""
    first, pairs = measured[0], zip(measured, cells, strict=True)
    effects = {r.condition.part: c.effects for r, c in pairs if isinstance(c, PairedScores)}
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


_MEANING: Final = "it uses what comes later, or what it keeps of other episodes"


def check_before_effect(
    parts: Mapping[str, Sequence[Scores]],
    effects: Mapping[str, Sequence[int]],
    *,
    environment: str,
    detector: str,
    horizon: int = 1,
    streamed: bool = False,
) -> None:
    """Raise `ContractError` when scores before the effect are not those of the twin.

    Both episodes are equal, bit for bit, up to the effect, the first row that differs. Whoever
    scores their rows before it differently has seen what comes after, or remembers what else was
    scored.

    Parameters
    ----------
    parts
        Scores of a unit whose episodes have twins, by part.
    effects
        The first row of each episode that differs from its twin's, by anomalous part.
    environment, detector
        Names for the message.
    horizon
        Prediction horizon: forecasts that feed on themselves multiply what rounding leaves.
    streamed
        True where rows were scored one by one. Then scores agree bit for bit, else up to the
        tolerance of batches, see `difference`.
    """
    tolerance = 0.0 if streamed else TOLERANCE if horizon == 1 else ROLLOUT_TOLERANCE
    for part, rows in effects.items():
        pairs = zip(parts[part], parts[TWINS], rows, strict=True)
        for i, (scores, twin, effect) in enumerate(pairs):
            if problem := difference(scores[:effect], twin, tolerance):
                raise ContractError(
                    f"detector {detector!r} is not causal: scores of {environment}/{part}[{i}] are "
                    f"not those of its twin before t = {effect}, where they begin to differ: "
                    f"{problem}; {_MEANING} (`oodd-eval check {detector} -k prefix`)"
                )


def difference(scores: Scores, whole: Scores, tolerance: float = 0.0) -> str:
    """Return where scores of first rows differ from the `whole` episode's; empty if nowhere.

    The tolerance is relative to how far scores vary around the score: to its distance from the
    k-th nearest other score of the episode, k being a tenth of all. So neither a constant that is
    added to scores, nor a single enormous one, nor a step hides a difference. Where a tenth of all
    scores are equal, they have to be equal here, too.
    """
    expected = whole[: len(scores)]
    # Scores near the largest float overflow here; another check finds that they are too large.
    with np.errstate(invalid="ignore", over="ignore"):
        same = (scores == expected) | (np.isnan(scores) & np.isnan(expected))
        if tolerance and not same.all():
            finite = whole[np.isfinite(whole)]
            k = max(1, len(finite) // 10)
            for row in np.flatnonzero(~same) if len(finite) > k else ():
                # The nearest one is the score itself.
                spread = np.partition(np.abs(finite - expected[row]), k)[k]
                same[row] = abs(scores[row] - expected[row]) <= tolerance * spread
    if same.all():
        return ""
    t = int(np.flatnonzero(~same)[0])
    digits = 10 if f"{scores[t]:.10g}" != f"{expected[t]:.10g}" else 17
    return f"at t = {t} it is {scores[t]:.{digits}g} instead of {expected[t]:.{digits}g}"


def early_difference(record: Record) -> str:
    """Return which episode of a cell has an alarm before the effect, and its twin none; or neither.

    Parameters
    ----------
    record
        Of a cell with twins.

    Returns
    -------
    str
        One sentence about the first such episode, or a twin with the alarm; empty if none.
    """
    for level in LEVELS:
        names = f"early_{level}", f"early_null_{level}"
        if not all(name in record.per_trajectory for name in names):
            continue
        early, null = (record.per_trajectory[name] for name in names)
        differs = np.flatnonzero((early != null).any(axis=0))
        if len(differs):
            i = int(differs[0])
            return (
                f"detector {record.detector!r} is not causal: {names[0]} of {record.environment}/"
                f"{record.condition.part}[{i}] is {early[0, i]:g}, and {names[1]}, of its twin in "
                f"the same rows, {null[0, i]:g}: {_MEANING}"
            )
    return ""


def _calibration_draws(
    first: Record,
    cells: Sequence[PairedScores | UnpairedScores],
    scores: ScoreFile,
    data: EnvironmentData,
) -> list[Draws]:
    """Return what calibration does to the alarms of each cell of a unit."""
    # A rolling calibration is not resampled: its episodes have an order. A flag needs none.
    if first.rolling or first.alarm == "flag":
        return [{} for _ in cells]
    calibration, numbers = scores.parts[CALIBRATION], first.recordings.get(CALIBRATION)
    largest = largest_of(scores.stream)
    again = Recalibration.fit(calibration, first.alarm, first.environment, numbers, largest)
    return again.of_cells(cells, data.logs.rate if data.logs else None)


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


def _with_metrics(
    record: Record,
    cell: PairedScores | UnpairedScores,
    data: EnvironmentData,
    scores: ScoreFile,
    rules: Rules,
    *,
    rows: bool,
) -> Record:
    settings: dict[str, Any] = {
        "environment": record.environment,
        "draws": record.calibration_draws,
        "rate": data.logs.rate if data.logs else None,
        "supervised": record.training == "failures",
    }
    if isinstance(cell, UnpairedScores):
        condition = str(record.condition)
        metrics, terms = cell_metrics(cell, rules, condition=condition, rows=rows, **settings)
        return replace(record, metrics=metrics, per_trajectory=_terms(terms))
    episodes, note = data.anomalous(record.condition), ""
    attribution = partial(_attribution, record, cell, data, scores)
    metrics, terms = cell_metrics(cell, rules, attribution=attribution, **settings)
    if data.logs is not None:
        before = auc_before(*cell[:3])
        terms["auc_before"] = before
        metrics["auc_before"] = metric_of("auc_before", before, record.environment)
        if note := _distrusted(before.value):
            for name in NEED_TWINS:
                del metrics[name], terms[name]
    brief = bool(episodes.brief)
    return replace(record, metrics=metrics, per_trajectory=_terms(terms), brief=brief, note=note)


def _attribution(
    record: Record,
    cell: PairedScores,
    data: EnvironmentData,
    scores: ScoreFile,
    rule: GuaranteedAlarm,
) -> dict[str, Contribution]:
    """Return what explanations of a cell are worth at its first alarms; nothing without any."""
    part = record.condition.part
    if not (explained := scores.explained.get(part)):
        return {}
    drawn = data.anomalous(record.condition).parameters[: len(explained)]
    corrupted = [p.get("sensors", ()) for p in drawn]
    terms = alarms.attribution_contributions(
        cell.anomalous, explained, corrupted, cell.effects, rule
    )
    if (namings := scores.namings.get(part)) is None:
        return terms
    faults = [_fault(p, record.group, len(data.sensors)) for p in drawn]
    faulty = [[j in parts for j in range(namings.shape[2] - 1)] for parts, _ in faults]
    kinds = [kinds for _, kinds in faults]
    judged = terms["onset_error"].denominator > 0
    return terms | alarms.naming_contributions(namings, np.array(faulty), kinds, judged)


def _fault(drawn: Mapping[str, Any], group: str, sensors: int) -> tuple[list[int], list[int]]:
    """Return the parts at fault, actuators behind sensors, and numbers of the kinds it may be."""
    parts, kinds = [*drawn.get("sensors", ())], ["body", "environment"]
    if isinstance(actuator := drawn.get("actuator"), int):
        parts.append(sensors + actuator)
    if group == "sensor" or "actuator" in drawn:
        kinds = ["sensor" if group == "sensor" else "actuator"]
    return parts, [*map(KINDS.index, kinds)]


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


def cell_scores(
    record: Record,
    parts: Mapping[str, Sequence[Scores]],
    data: EnvironmentData,
    stream: Mapping[str, Sequence[Scores]] = MappingProxyType({}),
) -> PairedScores | UnpairedScores:
    """Return the scores of a cell with what is known of its episodes.

    Parameters
    ----------
    record
        Of the cell.
    parts
        Scores of its unit by part.
    data
        The environment.
    stream
        Surprise of the stream by part, where it counts.
    """
    nominal, facts = parts[TWINS], data.logs or LogFacts()
    if data.paired:
        anomalous, episodes = parts[record.condition.part], data.anomalous(record.condition)
        rows = (rows[: len(anomalous)].tolist() for rows in (episodes.onsets, episodes.effects))
        return PairedScores(anomalous, nominal, *rows)
    tasks = data.twins.tasks[: len(nominal)]
    of_terms, seen = record.recordings_of_terms, stream.get(TWINS, ())
    cell = UnpairedScores(nominal, [], [], tasks, [], facts.clock, of_terms, seen)
    if record.condition == NOMINAL:
        return cell
    anomalous, labelled = parts[record.condition.part], data.labelled(record.condition)
    n = len(anomalous)
    intervals, tasks = labelled.intervals[:n], labelled.tasks[:n]
    seen = stream.get(record.condition.part, ())
    return replace(cell, anomalous=anomalous, intervals=intervals, tasks=tasks, stream=seen)


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
    statistics
        Without a twin, what alarms are of by row; None where they are of the scores.
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
    statistics: Floats | None = None

    @property
    def judged(self) -> Floats:
        """The statistic that alarms watch, by row."""
        return self.scores if self.statistics is None else self.statistics

    @property
    def alarm(self) -> int | None:
        """The row of the first alarm; None without one."""
        return self.rule.first(self.judged) if self.rule else None

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
        scores = self.twin_scores if of_twin else self.judged
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
