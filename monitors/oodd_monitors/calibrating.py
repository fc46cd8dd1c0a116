"""Calibration of a recorded score: its threshold, and what speaks for and against it.

The threshold is that of `oodd_eval.metrics.alarms`: a rank among the largest statistics of healthy
episodes, which at most the level of further healthy episodes exceed.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from oodd_live.scores import longest_gap

from oodd_eval.arrays import as_numbers
from oodd_eval.errors import UsageError
from oodd_eval.metrics.alarms import (
    AlarmKind,
    Calibration,
    GuaranteedAlarm,
    halves,
    least_episodes,
    numbered,
    quantile_rank,
)
from oodd_eval.metrics.binomial import clopper_pearson
from oodd_eval.metrics.promise import PermutationTest, drift_test
from oodd_eval.names import check_known, counted, whole_number

Floats = NDArray[np.float64]
ScoreAlarm = Literal["threshold", "cusum", "ewma", "score"]
"""Statistic of a score's alarm; ``"score"`` is the harness's word for ``"threshold"``."""

SMOOTHING: Final = 0.2
"""Weight of the newest score in the weighted mean of `"ewma"` (Roberts, Technometrics 1, 1959)."""


class LabelledScores(NamedTuple):
    """Scores of an episode that is anomalous, or that failed.

    Attributes
    ----------
    scores
        As those of healthy episodes.
    intervals
        Rows [start, stop) that are anomalous; a start of -1 is not known. Empty for an episode that
        is known by its outcome alone.
    kind
        Name of the anomaly.
    """

    scores: ArrayLike
    intervals: Sequence[tuple[int, int]] = ()
    kind: str = "anomalous"


@dataclass(frozen=True, slots=True)
class Detections:
    """What a threshold detects of the episodes of one kind.

    Attributes
    ----------
    kind
        Name of the anomaly.
    episodes
        Their number.
    early
        How many alarm before their anomaly begins, which is no detection.
    detected
        How many alarm from there on, or at all, where that row is not known.
    missed
        How many never alarm.
    delay
        Median of the rows from the beginning to the first alarm; NaN where none is known.
    in_time
        How many of the detected alarm in rows that every healthy episode has: longer episodes have
        more time to alarm.
    """

    kind: str
    episodes: int
    early: int
    detected: int
    missed: int
    delay: float
    in_time: int


@dataclass(frozen=True, slots=True)
class ScoreGroup:
    """Healthy episodes of one group, such as an airframe or a task.

    Attributes
    ----------
    episodes
        Their number.
    above
        How many of them exceed the threshold that is pooled over all groups.
    calibration
        Of these episodes alone; None where they are too few.
    problem
        Why there is none; empty otherwise.
    """

    episodes: int
    above: int
    calibration: "ScoreCalibration | None"
    problem: str


@dataclass(frozen=True, slots=True, eq=False)
class ScoreCalibration:
    """A threshold of a recorded score, made by `calibrate`.

    Attributes
    ----------
    rule
        The alarm of scores as they are, or as `smoothing` leaves them: standardization of their
        CUSUM, and the threshold.
    alarm
        Its statistic: ``"threshold"``, ``"cusum"`` or ``"ewma"``.
    hold
        Rows with a score, one after another, in which the statistic has to be above the threshold.
    level
        Largest share of healthy episodes with an alarm.
    calibration
        Largest statistics of the episodes that the threshold is from.
    longest_gap
        Rows without a score, one after another, in healthy episodes at most.
    drift
        Whether the largest statistics follow the order of the recordings.
    false_alarms
        How many of `healthy` further healthy episodes alarm.
    healthy
        Number of further healthy episodes.
    detections
        What it detects, by kind.
    groups
        What each group has alone, and what pooling does to it.
    """

    rule: GuaranteedAlarm
    alarm: ScoreAlarm
    hold: int
    level: float
    calibration: Calibration
    longest_gap: int
    drift: PermutationTest
    false_alarms: int = 0
    healthy: int = 0
    detections: Sequence[Detections] = ()
    groups: Mapping[str, ScoreGroup] = field(default_factory=dict)

    @property
    def threshold(self) -> float:
        """The score, CUSUM or weighted mean above which an episode alarms."""
        return self.rule.threshold

    @property
    def smoothing(self) -> float | None:
        """Weight of the newest score in the weighted mean; None where scores are as they are."""
        return SMOOTHING if self.alarm == "ewma" else None

    @property
    def whole(self) -> bool:
        """Whether each episode is one recording, and no window of one."""
        return self.calibration.recording_count == self.calibration.episodes

    @property
    def units(self) -> int:
        """Number of recordings that the threshold is from: for a CUSUM the other half scales it."""
        return len({*self.calibration.recordings})

    @property
    def needed(self) -> int:
        """How many more healthy recordings the level needs; 0 where it is promised."""
        least = least_episodes(self.level, self.calibration.kind)
        return max(0, least - self.calibration.recording_count)

    @property
    def promise(self) -> str:
        """The promise on false alarms as a sentence."""
        if text := self.calibration.no_promise(self.level):
            return text
        noun = "further healthy logs" if self.whole else "windows of further healthy logs"
        return f"at most {100 * self.level:.3g} % of {noun} alarm"

    @property
    def notes(self) -> tuple[str, ...]:
        """What puts the promise in doubt, in sentences."""
        figures = f"rank correlation {self.drift.statistic:.2f}, p = {self.drift.p:.2g}"
        text = f"The largest values follow the order of the logs ({figures}): newer logs may alarm"
        text += " more often than promised. Calibrate on logs like those that are judged."
        return (text,) if self.drift.significant else ()

    @property
    def share_interval(self) -> tuple[float, float] | None:
        """The true share of alarms at this threshold is in it for 95 % of such calibrations.

        With the k-th smallest of n it has the distribution Beta(n + 1 - k, k). Where several
        episodes have the statistic that is the threshold, only the upper end is known. None for
        windows of recordings, whose share has no such distribution.
        """
        if not self.whole:
            return None
        n = len(self.calibration.largest)
        k = quantile_rank(n, self.level)
        tied = self.calibration.largest.count(self.threshold) > 1
        return 0.0 if tied else clopper_pearson(n + 1 - k, n)[0], clopper_pearson(n - k, n)[1]

    @property
    def sweep(self) -> tuple[float, float]:
        """The threshold of a sweep until no healthy log alarms, and the share that it lets alarm.

        That share of further healthy recordings exceeds the largest statistic of n: 1 / (n + 1),
        and less only where equal statistics are possible.
        """
        return max(self.calibration.largest), 1 / (self.units + 1)

    def statistic(self, scores: ArrayLike) -> Floats:
        """Return the statistic of an episode, row by row; minus infinity where there is none.

        Parameters
        ----------
        scores
            Of the episode, NaN where there is none: such rows change nothing.

        Returns
        -------
        float64 array
            An alarm begins where it is above the threshold.
        """
        return _statistic(as_numbers(scores), self.rule, self.smoothing, self.hold)

    def first(self, scores: ArrayLike) -> int | None:
        """Return the row of an episode's first alarm; None without one.

        Parameters
        ----------
        scores
            Of the episode.

        Returns
        -------
        int or None
        """
        above = self.statistic(scores) > self.threshold
        return int(above.argmax()) if above.any() else None


def calibrate(
    scores: Sequence[ArrayLike],
    level: float = 0.05,
    *,
    alarm: ScoreAlarm = "threshold",
    hold: int = 1,
    recordings: Sequence[Hashable] | None = None,
    labelled: Sequence[LabelledScores] = (),
    healthy: Sequence[ArrayLike] = (),
    groups: Sequence[str] | None = None,
) -> ScoreCalibration:
    """Find the threshold of a score on healthy episodes.

    Parameters
    ----------
    scores
        One array of shape (T + 1,) for each healthy episode, in the order in which they were
        recorded; NaN where the score is undefined. Larger is less usual.
    level
        Largest share of healthy episodes with an alarm.
    alarm
        Statistic of the alarm: the score itself (``"threshold"``), its CUSUM, which half of the
        episodes standardize, or its exponentially weighted mean, in which the newest score has the
        weight 0.2.
    hold
        Rows with a score, one after another, in which the statistic has to be above the threshold.
    recordings
        For each episode the recording that it is a window of; None where each is one. Windows of
        one recording count once.
    labelled
        Anomalous or failed episodes, to tell what the threshold detects.
    healthy
        Further healthy episodes, which the threshold is not from.
    groups
        For each episode its group, such as an airframe: each gets a threshold of its own.

    Returns
    -------
    ScoreCalibration
        Of all episodes, with its `groups`.

    Raises
    ------
    UsageError
        When the episodes are too few for the level, or an argument is wrong.
    TrajectoryError
        When something among the scores is no number.

    Examples
    --------
    >>> flights = [[0.1, peak, 0.2] for peak in range(1, 20)]
    >>> calibration = calibrate(flights, 0.05, labelled=[LabelledScores([0, 0, 25, 1], [(1, 4)])])
    >>> calibration.threshold, calibration.promise
    (19.0, 'at most 5 % of further healthy logs alarm')
    >>> calibration.sweep, calibration.detections[0].delay
    ((19.0, 0.05), 1.0)
    """
    if not 0 < level < 1:
        raise UsageError(f"level={level!r}, expected a share between 0 and 1, such as 0.05")
    check_known("alarm", get_args(ScoreAlarm), alarm)
    hold = whole_number(hold, least=1)
    alarm = "threshold" if alarm == "score" else alarm
    episodes = _checked(scores, hold)
    numbers = numbered(recordings, len(episodes))
    _check_enough(numbers, level, alarm)
    fitted = Calibration.fit(episodes, _kind(alarm), numbers.tolist())
    smoothing = SMOOTHING if alarm == "ewma" else None
    statistics = (_statistic(s, fitted.unbounded, smoothing, hold) for s in episodes)
    largest = np.array([s.max(initial=-math.inf) for s in statistics])
    part = halves(numbers)[1] if alarm == "cusum" else slice(None)
    fitted = replace(fitted, largest=tuple(largest[part].tolist()))
    tops = np.full((fitted.recording_count, 1), -math.inf)
    np.maximum.at(tops[:, 0], numbers, largest)
    rule, gap, drift = fitted.rule(level), max(map(longest_gap, episodes)), drift_test(tops)
    calibration = ScoreCalibration(rule, alarm, hold, level, fitted, gap, drift)
    return replace(
        calibration,
        false_alarms=sum(calibration.first(s) is not None for s in healthy),
        healthy=len(healthy),
        detections=_detections(calibration, labelled, min(map(len, episodes))),
        groups=_groups(calibration, episodes, numbers, groups) if groups else {},
    )


def _checked(scores: Sequence[ArrayLike], hold: int) -> list[Floats]:
    """Return the scores of episodes as arrays; `UsageError` where they are no score."""
    episodes = [as_numbers(s, f"episode {i} of the scores: ") for i, s in enumerate(scores)]
    for i, s in enumerate(episodes):
        if s.ndim != 1 or np.count_nonzero(~np.isnan(s)) < hold:
            expected = f"a number a row, in {hold} rows at least (hold): leave it out"
            raise UsageError(f"episode {i} has scores of shape {s.shape}, expected {expected}")
    pooled = np.concatenate([np.zeros(0), *episodes])
    values = [f"{value:g}" for value in np.unique(pooled[~np.isnan(pooled)])]
    if 0 < len(values) < 3:
        raise UsageError(
            f"the score is {' or '.join(values)} in all rows of {len(episodes)} healthy logs: name "
            "a column that varies. If it is an alarm already, it needs no threshold, and "
            "`oodd-eval run --detector flag:NAME` judges it"
        )
    return episodes


def _check_enough(numbers: NDArray[np.intp], level: float, alarm: ScoreAlarm) -> None:
    """Raise `UsageError` where even windows of recordings are too few for a level."""
    n, least = len(numbers), least_episodes(level, _kind(alarm))
    if n >= least:
        return
    noun = "log" if len({*numbers.tolist()}) == n else "window"
    text = f"{counted(n, f'healthy {noun}(s)')}, too few for {100 * level:.3g} %: "
    text += f"the alarm {alarm} needs {least}, {least - n} more"
    text += "; threshold and ewma do not" * (n >= least_episodes(level, "column"))
    if allowed := n // 2 if alarm == "cusum" else n:
        percent = f"{math.ceil(1000 / (allowed + 1) - 1e-9) / 10:.3g}"
        text += f"; these allow {percent} % (--level {percent})"
    raise UsageError(text)


def _kind(alarm: ScoreAlarm) -> AlarmKind:
    return "cusum" if alarm == "cusum" else "column"


def _statistic(scores: Floats, rule: GuaranteedAlarm, smoothing: float | None, hold: int) -> Floats:
    """Return what alarms are of: the least of the last `hold` rows that have a score."""
    present, statistic = ~np.isnan(scores), np.full(len(scores), -math.inf)
    values = scores[present]
    if smoothing:
        means = accumulate(values.tolist(), lambda mean, s: mean + smoothing * (s - mean))
        values = np.fromiter(means, np.float64)
    padded = np.concatenate([np.full(hold - 1, -math.inf), rule.statistic(values)])
    if len(values):
        statistic[present] = np.lib.stride_tricks.sliding_window_view(padded, hold).min(axis=1)
    return statistic


def _detections(
    calibration: ScoreCalibration, labelled: Sequence[LabelledScores], shortest: int
) -> list[Detections]:
    """Return what a threshold detects, by kind."""
    rows = []
    for kind in dict.fromkeys(episode.kind for episode in labelled):
        episodes = [episode for episode in labelled if episode.kind == kind]
        starts = [e.intervals[0][0] if e.intervals else -1 for e in episodes]
        pairs = zip(map(calibration.first, [e.scores for e in episodes]), starts, strict=True)
        alarms = [(first, start) for first, start in pairs if first is not None]
        detected = [(first, start) for first, start in alarms if first >= start]
        delays = [first - start for first, start in detected if start >= 0]
        delay = float(np.median(delays)) if delays else math.nan
        in_time = sum(first < shortest for first, _ in detected)
        n, early = len(episodes), len(alarms) - len(detected)
        rows.append(Detections(kind, n, early, len(detected), n - len(alarms), delay, in_time))
    return rows


def _groups(
    pooled: ScoreCalibration,
    episodes: Sequence[Floats],
    numbers: NDArray[np.intp],
    groups: Sequence[str],
) -> dict[str, ScoreGroup]:
    """Return the thresholds of groups, and how many of their episodes exceed the pooled one."""
    if len(groups) != len(episodes):
        raise UsageError(f"{len(groups)} groups of {len(episodes)} episodes, expected one for each")
    result, (level, alarm, hold) = {}, (pooled.level, pooled.alarm, pooled.hold)
    for name in dict.fromkeys(groups):
        members = [i for i, group in enumerate(groups) if group == name]
        scores, of_group = [episodes[i] for i in members], numbers[members].tolist()
        calibration, problem = None, ""
        try:
            calibration = calibrate(scores, level, alarm=alarm, hold=hold, recordings=of_group)
        except UsageError as error:
            problem = str(error)
        above = sum(pooled.first(s) is not None for s in scores)
        result[name] = ScoreGroup(len(scores), above, calibration, problem)
    return result
