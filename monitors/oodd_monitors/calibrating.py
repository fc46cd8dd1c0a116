"""Calibration of a recorded score: its threshold, and what speaks for and against it.

The threshold is that of `oodd_eval.metrics.alarms`: a rank among the largest statistics of healthy
episodes, which at most the level of further healthy episodes exceed.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


class Detections(NamedTuple):
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


class ScoreGroup(NamedTuple):
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
        test = self.drift
        grouped = " Groups that follow one another look alike." if self.groups else ""
        drift = (
            "The score drifts: its largest values follow the order of the logs (rank correlation "
            f"{test.statistic:.2f}, p = {test.p:.2g}), so that more logs than promised may alarm. "
            f"Calibrate on logs of the days that are judged, or on the newest alone.{grouped}"
        )
        return (drift,) if test.significant else ()

    @property
    def share_interval(self) -> tuple[float, float] | None:
        """The true share of alarms at this threshold is in it for 95 % of such calibrations.

        With the k-th smallest of n it has the distribution Beta(n + 1 - k, k). Where several
        episodes have the statistic that is the threshold, only the upper end is known. None for
        windows of recordings, whose share has no such distribution.
        """
        if not self.whole:
            return None
        n, k = (
            len(self.calibration.largest),
            quantile_rank(len(self.calibration.largest), self.level),
        )
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
    kind: AlarmKind = "cusum" if alarm == "cusum" else "column"
    episodes = _checked(scores)
    numbers = numbered(recordings, len(episodes))
    _check_enough(numbers, level, alarm)
    smoothing = SMOOTHING if alarm == "ewma" else None
    smoothed = [_smoothed(values[~np.isnan(values)], smoothing) for values in episodes]
    fitted = Calibration.fit(smoothed, kind, numbers.tolist())
    statistics = (_statistic(s, fitted.unbounded, smoothing, hold) for s in episodes)
    largest = np.array([float(s.max(initial=-math.inf)) for s in statistics])
    part = halves(numbers)[1] if kind == "cusum" else np.arange(len(episodes))
    fitted = replace(fitted, largest=tuple(largest[part].tolist()))
    if math.isinf(threshold := fitted.threshold(level)):
        raise UsageError(_unbounded(fitted, hold, threshold))
    tops = np.full(numbers.max() + 1, -math.inf)
    np.maximum.at(tops, numbers, largest)
    calibration = ScoreCalibration(
        GuaranteedAlarm(fitted.standardization, threshold),
        alarm,
        hold,
        level,
        fitted,
        max(map(_longest_gap, episodes)),
        drift_test(tops[:, None]),
    )
    options: dict[str, Any] = {"alarm": alarm, "hold": hold}
    return replace(
        calibration,
        false_alarms=sum(calibration.first(s) is not None for s in healthy),
        healthy=len(healthy),
        detections=_detections(calibration, labelled, min(map(len, episodes))),
        groups=_groups(calibration, episodes, numbers, groups, options) if groups else {},
    )


def _checked(scores: Sequence[ArrayLike]) -> list[Floats]:
    """Return the scores of episodes as arrays; `UsageError` where they are no score."""
    episodes = [as_numbers(s, f"episode {i} of the scores: ") for i, s in enumerate(scores)]
    for i, values in enumerate(episodes):
        if values.ndim != 1:
            raise UsageError(f"episode {i} has scores of shape {values.shape}, expected one a row")
        if np.isnan(values).all():
            raise UsageError(f"episode {i} has no score: leave it out, or correct its log")
    pooled = np.concatenate([np.zeros(0), *episodes])
    values = np.unique(pooled[~np.isnan(pooled)]).tolist()
    if len(values) == 1:
        raise UsageError(
            f"the score is {values[0]:g} in all rows of all {len(episodes)} healthy logs, so that "
            "no threshold means anything: name a column that varies. An alarm that never was on "
            "has its operating point already: run --detector flag:NAME judges it"
        )
    if len(values) == 2:
        raise UsageError(
            f"the score has only the values {values[0]:g} and {values[1]:g}, as an alarm has, and "
            "no threshold is to be set: run --detector flag:NAME judges it as it is, or name the "
            "number that it is made of"
        )
    return episodes


def _check_enough(numbers: NDArray[np.intp], level: float, alarm: ScoreAlarm) -> None:
    """Raise `UsageError` where even windows of recordings are too few for a level."""
    n, whole = len(numbers), len({*numbers.tolist()}) == len(numbers)
    kind: AlarmKind = "cusum" if alarm == "cusum" else "score"
    least = least_episodes(level, kind)
    if n >= least:
        return
    few = counted(n, "healthy log(s)" if whole else "healthy window(s)")
    text = (
        f"{few}, too few for {100 * level:.3g} %: {_NAMES[alarm]} needs {least}, {least - n} more"
    )
    allowed = n // 2 if kind == "cusum" else n
    if kind == "cusum" and n >= least_episodes(level, "score"):
        text += "; --alarm threshold or ewma works with these"
    if allowed:
        percent = math.ceil(1000 / (allowed + 1) - 1e-9) / 10
        text += f"; these allow {percent:.3g} % (--level {percent:.3g})"
    raise UsageError(text)


_NAMES: Final[Mapping[str, str]] = {
    "threshold": "a threshold",
    "cusum": "a CUSUM, half of which scale it,",
    "ewma": "a weighted mean",
}


def _unbounded(fitted: Calibration, hold: int, threshold: float) -> str:
    """Say why a threshold is infinite."""
    infinite = sum(value == threshold for value in fitted.largest)
    cause = "an infinite score"
    if threshold < 0:
        cause = f"fewer than {hold} rows with a score (hold)"
    return (
        f"{infinite} of {counted(len(fitted.largest), 'healthy log(s)')} have {cause}, so that "
        "there is no threshold: leave them out, or choose a larger level"
    )


def _smoothed(scores: Floats, weight: float | None) -> Floats:
    """Return exponentially weighted means, from the first score on; without a weight the scores."""
    if weight is None or not len(scores):
        return scores
    mean, means = float(scores[0]), []
    for score in scores.tolist():
        mean += weight * (score - mean)
        means.append(mean)
    return np.array(means)


def _statistic(scores: Floats, rule: GuaranteedAlarm, smoothing: float | None, hold: int) -> Floats:
    """Return what alarms are of: the least of the last `hold` rows that have a score."""
    present = ~np.isnan(scores)
    values = rule.statistic(_smoothed(scores[present], smoothing))
    if hold > 1 and len(values):
        padded = np.concatenate([np.full(hold - 1, -math.inf), values])
        values = np.lib.stride_tricks.sliding_window_view(padded, hold).min(axis=1)
    statistic = np.full(len(scores), -math.inf)
    statistic[present] = values
    return statistic


def _longest_gap(scores: Floats) -> int:
    """Return the most rows without a score, one after another, before, between or after others."""
    present = np.flatnonzero(~np.isnan(scores))
    return int(np.diff(present, prepend=-1, append=len(scores)).max()) - 1


def _detections(
    calibration: ScoreCalibration, labelled: Sequence[LabelledScores], shortest: int
) -> list[Detections]:
    """Return what a threshold detects, by kind."""
    rows = []
    for kind in dict.fromkeys(episode.kind for episode in labelled):
        episodes = [episode for episode in labelled if episode.kind == kind]
        starts = [e.intervals[0][0] if e.intervals else -1 for e in episodes]
        firsts = [calibration.first(episode.scores) for episode in episodes]
        alarms = [(f, s) for f, s in zip(firsts, starts, strict=True) if f is not None]
        detected = [(first, start) for first, start in alarms if first >= start]
        delays = [first - start for first, start in detected if start >= 0]
        rows.append(
            Detections(
                kind,
                len(episodes),
                len(alarms) - len(detected),
                len(detected),
                len(episodes) - len(alarms),
                float(np.median(delays)) if delays else math.nan,
                sum(first < shortest for first, _ in detected),
            )
        )
    return rows


def _groups(
    pooled: ScoreCalibration,
    episodes: Sequence[Floats],
    numbers: NDArray[np.intp],
    groups: Sequence[str],
    options: Mapping[str, Any],
) -> dict[str, ScoreGroup]:
    """Return the thresholds of groups, and how many of their episodes exceed the pooled one."""
    if len(groups) != len(episodes):
        raise UsageError(f"{len(groups)} groups of {len(episodes)} episodes, expected one for each")
    result = {}
    for name in dict.fromkeys(groups):
        indices = [i for i, group in enumerate(groups) if group == name]
        scores = [episodes[i] for i in indices]
        recordings = numbers[indices].tolist()
        calibration, problem = None, ""
        try:
            calibration = calibrate(scores, pooled.level, recordings=recordings, **options)
        except UsageError as error:
            problem = str(error)
        above = sum(pooled.first(s) is not None for s in scores)
        result[name] = ScoreGroup(len(scores), above, calibration, problem)
    return result
