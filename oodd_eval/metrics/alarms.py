"""Alarms with a guarantee: at most a chosen share of nominal episodes raises one.

The threshold is a rank among the calibration episodes' largest statistics (split conformal
prediction). A new nominal episode is exchangeable with them, so that its largest statistic exceeds
the k-th smallest of n with probability at most ``1 - k / (n + 1)``, whatever the distribution of
scores and however they depend on one another within an episode.

Windows of one recording are not exchangeable with those of another. They share the weight of one
episode, so that the promise holds for a window of a further recording (hierarchical conformal
prediction; Lee, Barber & Willett, arXiv 2306.06342).
"""

import math
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import UsageError
from oodd_eval.metrics.auc import AlarmRule, Contribution, mean_of
from oodd_eval.metrics.binomial import incomplete_beta
from oodd_eval.metrics.catalogue import FOUND_WITHIN, GUARANTEED, LEVELS
from oodd_eval.metrics.cusum import DRIFT, Standardization, cusum
from oodd_eval.metrics.faults import ParetoTail
from oodd_eval.names import counted

Floats = NDArray[np.float64]

AlarmKind = Literal["cusum", "score", "column", "flag"]
"""Statistic of the guaranteed alarms: the CUSUM of the scores, or the score itself, for a detector
that accumulates by itself, and for a recorded ``"column"``, which faults of sensors do not join. A
``"flag"`` is an alarm already: it has a threshold of its own, which promises nothing."""

STATISTICS: Final[tuple[AlarmKind, ...]] = ("cusum", "score")
RECORDED: Final[tuple[AlarmKind, ...]] = ("column", "flag")
FLAGGED: Final = 0.5
"""Threshold of a flag, which is 0 or 1."""

_ROUNDING: Final = 1e-9  # share of an episode that levels may be off: (n + 1) x 0.05 is whole


@dataclass(frozen=True, slots=True)
class GuaranteedAlarm:
    """A threshold of the statistic that at most a given share of nominal episodes exceeds.

    Parameters
    ----------
    standardization
        Of the scores, for their CUSUM; None where the score itself is the statistic.
    threshold
        An episode alarms at the first row whose statistic is larger.

    Examples
    --------
    >>> calibration = [np.array([0.0, peak]) for peak in range(1, 20)]
    >>> rule = GuaranteedAlarm.fit(calibration, 0.05, "score")
    >>> rule.threshold, rule.first(np.array([3.0, 19.0, 20.0])), rule.first(np.array([19.0]))
    (19.0, 2, None)
    """

    standardization: Standardization | None
    threshold: float

    @classmethod
    def fit(
        cls,
        calibration: Sequence[Floats],
        level: float,
        kind: AlarmKind = "cusum",
        confidence: float | None = None,
        recordings: Sequence[Hashable] | None = None,
    ) -> "GuaranteedAlarm":
        """Find the threshold on the scores of nominal episodes, kept apart from the fit.

        Parameters
        ----------
        calibration
            Scores by episode, in an order that has nothing to do with the scores.
        level
            Largest share of nominal episodes with an alarm, such as 0.05.
        kind
            ``"cusum"``: the CUSUM, without a new start after an alarm, of scores that the episodes
            number 0, 2, 4, ... standardize; the threshold is from the others. ``"score"``: the
            score itself, for a detector that accumulates by itself; the threshold is from all.
        confidence
            See `quantile_rank`.
        recordings
            See `Calibration.fit`.

        Returns
        -------
        GuaranteedAlarm

        Raises
        ------
        UsageError
            Where no statistic could exceed the threshold, because there are too few episodes for
            the level, or too many of them have an infinite statistic.
        """
        return Calibration.fit(calibration, kind, recordings).rule(level, confidence)

    def statistic(self, scores: Floats) -> Floats:
        """Return the statistic of an episode, row by row; minus infinity where there is none."""
        if self.standardization is None:
            return np.where(np.isnan(scores), -np.inf, scores)
        return cusum(self.standardization(scores), threshold=math.inf)[0]

    def largest(self, scores: Floats) -> float:
        """Return the largest statistic of an episode."""
        return float(self.statistic(scores).max(initial=-math.inf))

    def first(self, scores: Floats) -> int | None:
        """Return the row of an episode's first alarm; None without one."""
        above = self.statistic(scores) > self.threshold
        return int(above.argmax()) if above.any() else None


@dataclass(frozen=True, slots=True)
class Calibration:
    """Basis of thresholds: the largest statistics of nominal episodes.

    Parameters
    ----------
    kind
        The statistic.
    standardization
        As that of `GuaranteedAlarm`: from the first calibration, whatever joins it later.
    largest
        Largest statistic of each of the n episodes that the quantile is of, as recorded.
    episodes
        Number of all episodes, those that standardize the scores included.
    recordings
        Number of the recording that each of the n episodes is a window of.
    recording_count
        Number of all recordings, those that standardize the scores included.
    rolling
        Whether an episode counts `FADING` to the power of its age, the number of recordings after
        its own.
    tail
        Of the largest statistics of the scores alone, by which faults of the stream count as
        scores that are as rare; None where they do not count.

    Examples
    --------
    >>> calibration = Calibration.fit([np.array([peak]) for peak in range(1, 20)], "score")
    >>> calibration.rule(0.05).threshold, calibration.joined(25.0).rule(0.10).threshold
    (19.0, 25.0)
    """

    kind: AlarmKind
    standardization: Standardization | None
    largest: tuple[float, ...]
    episodes: int
    recordings: tuple[int, ...]
    recording_count: int
    rolling: bool = False
    tail: ParetoTail | None = None

    @classmethod
    def fit(
        cls,
        scores: Sequence[Floats],
        kind: AlarmKind = "cusum",
        recordings: Sequence[Hashable] | None = None,
        stream: Sequence[float] | None = None,
    ) -> "Calibration":
        """Take the scores of calibration episodes.

        Parameters
        ----------
        scores
            By episode.
        kind
            See `GuaranteedAlarm.fit`.
        recordings
            For each episode the recording that it is a window of; None where each is one. Windows
            of one recording have the weight of one episode together, and for a CUSUM the recordings
            number 0, 2, 4, ... standardize. Levels that recordings are too few for count windows.
        stream
            Largest surprise of the stream in each episode, see `StreamScale`; None where the
            statistic is of the scores alone.

        Returns
        -------
        Calibration
        """
        numbers = numbered(recordings, len(scores))
        standardization, tail, episodes = None, None, np.arange(len(scores))
        if kind == "cusum":
            standardizing, episodes = halves(numbers)
            standardization = Standardization.fit([scores[i] for i in standardizing.tolist()])
        unbounded = GuaranteedAlarm(standardization, math.inf)
        largest = np.array([unbounded.largest(scores[i]) for i in episodes.tolist()])
        if stream is not None:
            tail = ParetoTail.fit(largest)
            largest = np.maximum(largest, tail.value([stream[i] for i in episodes.tolist()]))
        count = len({*numbers.tolist()})
        counts = len(scores), tuple(numbers[episodes].tolist()), count
        return cls(kind, standardization, tuple(largest.tolist()), *counts, tail=tail)

    def joint(self, scores: Floats, stream: Floats) -> Floats:
        """Return the statistic of an episode by row, NaN where there is no score and no fault.

        Parameters
        ----------
        scores
            Of the episode.
        stream
            Surprise of the stream in its rows, 0 where nothing is unusual.
        """
        statistic = np.where(np.isnan(scores), np.nan, self.unbounded.statistic(scores))
        return statistic if self.tail is None else joined(statistic, self.tail.value(stream))

    @property
    def of_statistics(self) -> "Calibration":
        """The same for episodes whose statistic is handed over in place of scores."""
        return replace(self, standardization=None)

    @property
    def unbounded(self) -> GuaranteedAlarm:
        """The statistic, with a threshold that nothing exceeds."""
        return GuaranteedAlarm(self.standardization, math.inf)

    def joined(self, largest: float, recording: int | None = None) -> "Calibration":
        """Return a rolling calibration with a further nominal episode.

        Parameters
        ----------
        largest
            Its largest statistic.
        recording
            Number of the recording that it is a window of; by default it is one of its own.

        Returns
        -------
        Calibration
        """
        number = max(self.recordings, default=-1) + 1 if recording is None else recording
        return replace(
            self,
            largest=(*self.largest, largest),
            episodes=self.episodes + 1,
            recordings=(*self.recordings, number),
            recording_count=self.recording_count + (number not in self.recordings),
            rolling=True,
        )

    def no_promise(self, level: float, confidence: float | None = None) -> str:
        """Return why a threshold of a level promises nothing; empty where it does."""
        return no_promise(self.episodes, self.recording_count, level, self.kind, confidence)

    def threshold(self, level: float, confidence: float | None = None) -> float:
        """Return the threshold of a level; infinite where no number could promise it.

        It is the smallest statistic up to which the episodes have a share of at least ``1 - level``
        of all weights, to which the recording to come, whose statistic may be anything, adds 1:
        with one episode a recording a rank, see `quantile_rank`. A rolling calibration fades
        weights (Barber et al., "Conformal prediction beyond exchangeability", Ann. Statist. 51,
        2023). With a confidence it is the rank among the largest statistics of recordings.

        Parameters
        ----------
        level, confidence
            See `GuaranteedAlarm.fit`; a rolling calibration has no confidence.

        Returns
        -------
        float
        """
        if self.kind == "flag":
            return FLAGGED
        # Where recordings are too few for the level, their windows count, and nothing is promised.
        unit = np.arange(len(self.largest))
        if not self.no_promise(level, confidence):
            unit = np.unique(np.array(self.recordings, np.intp), return_inverse=True)[1]
        n = int(unit.max(initial=-1)) + 1
        if confidence is not None:
            tops = np.full(n, -math.inf)
            np.maximum.at(tops, unit, self.largest)
            rank = quantile_rank(n, level, confidence)
            return float(np.sort(tops)[rank - 1]) if rank <= n else math.inf
        ages = np.arange(n - 1, -1, -1.0)
        weights = FADING**ages if self.rolling else np.ones(n)
        order = np.argsort(self.largest, kind="stable")
        up_to = np.cumsum((weights[unit] * window_weights(unit))[order])
        enough = up_to >= (1 - level) * (weights.sum() + 1) - _ROUNDING
        return float(self.largest[order[enough.argmax()]]) if enough.any() else math.inf

    def rule(self, level: float, confidence: float | None = None) -> GuaranteedAlarm:
        """Return the alarm of a level.

        Parameters
        ----------
        level, confidence
            See `GuaranteedAlarm.fit`.

        Returns
        -------
        GuaranteedAlarm

        Raises
        ------
        UsageError
            Where no statistic could exceed the threshold.
        """
        threshold = self.threshold(level, confidence)
        if not math.isinf(threshold):
            return GuaranteedAlarm(self.standardization, threshold)
        subject = f"at most {100 * level:.3g} % of nominal episodes with an alarm"
        count = len({*self.recordings})
        if count < (n := least_rolling(level)) and self.rolling:
            no_number = "is more than any number can promise"
            needed = f"needs {n} episodes" if math.isfinite(n) else no_number
            raise UsageError(
                f"a rolling calibration {needed} at {100 * level:.3g} %, got {count}: "
                "keep the first calibration, or promise less"
            )
        if self.episodes < least_episodes(level, self.kind, confidence):
            raise UsageError(too_few(subject, self.episodes, level, self.kind, confidence))
        infinite = sum(map(math.isinf, self.largest))
        raise UsageError(
            f"{subject}: {infinite} of the {len(self.largest)} calibration episodes that the "
            "threshold is from have an infinite statistic, so that nothing could exceed it: "
            "calibrate with other episodes, or promise less"
        )


def joined(statistic: Floats, as_rare: Floats) -> Floats:
    """Return the larger of a statistic and the one that is as rare as the faults of the stream."""
    joint: Floats = np.where(np.isneginf(as_rare), statistic, np.fmax(statistic, as_rare))
    return joint


FADING: Final = 0.95
"""Weight of an episode of a rolling calibration against the one after it."""


def least_rolling(level: float) -> float:
    """Return how many episodes a rolling quantile takes; infinite where no number is enough.

    >>> least_rolling(0.10), least_rolling(0.05), least_rolling(0.01)
    (12, 59, inf)
    """
    # (1 - f^n) / (1 - f), the sum of weights, has to be 1 / level - 1.
    left = 1 - (1 / level - 1) * (1 - FADING)
    return math.ceil(math.log(left) / math.log(FADING) - _ROUNDING) if left > 0 else math.inf


def numbered(recordings: Sequence[Hashable] | None, episodes: int) -> NDArray[np.intp]:
    """Return the number of each episode's recording, in the order in which they begin.

    >>> numbered(["b", "a", "b"], 3).tolist(), numbered(None, 3).tolist()
    ([0, 1, 0], [0, 1, 2])
    """
    if recordings is None:
        return np.arange(episodes)
    if len(recordings) != episodes:
        raise UsageError(
            f"{len(recordings)} recordings of {episodes} episodes, expected one for each: the "
            "recording that it is a window of"
        )
    numbers = {recording: i for i, recording in enumerate(dict.fromkeys(recordings))}
    return np.array([numbers[recording] for recording in recordings], np.intp)


def window_weights(numbers: NDArray[np.intp]) -> Floats:
    """Return weights of episodes that sum to 1 over the windows of each recording.

    >>> window_weights(np.array([0, 1, 1])).tolist()
    [1.0, 0.5, 0.5]
    """
    _, unit, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    weights: Floats = 1 / counts[unit]
    return weights


def halves(numbers: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which episodes standardize the scores of a CUSUM, and which give its threshold.

    Recordings number 0, 2, 4, ... standardize, or the others where these would leave less than half
    of the windows for the threshold. Windows of a single recording alternate.

    Parameters
    ----------
    numbers
        Number of each episode's recording.

    Returns
    -------
    tuple
        Indices of episodes.

    Examples
    --------
    >>> [half.tolist() for half in halves(np.array([0, 0, 1, 1, 2]))]
    [[0, 1, 4], [2, 3]]
    """
    several = len({*numbers.tolist()}) > 1
    is_odd = (numbers if several else np.arange(len(numbers))) % 2 == 1
    if np.count_nonzero(is_odd) < len(numbers) // 2:
        is_odd = ~is_odd
    return np.flatnonzero(~is_odd), np.flatnonzero(is_odd)


def no_promise(
    windows: int, recordings: int, level: float, kind: AlarmKind, confidence: float | None = None
) -> str:
    """Say that windows of so few recordings, or flags, promise nothing; empty where they do.

    Parameters
    ----------
    windows, recordings
        Numbers of calibration episodes and of the recordings that they are windows of, those that
        standardize the scores included.
    level
        Largest share of nominal episodes with an alarm.
    kind, confidence
        See `GuaranteedAlarm.fit`.

    Returns
    -------
    str
        Empty, too, where each episode is one recording, which `too_few` is for.

    Examples
    --------
    >>> no_promise(38, 1, 0.10, "score")
    '38 windows of 1 recording: no promise at 10 %; 9 recordings would'
    >>> no_promise(38, 18, 0.10, "cusum"), no_promise(17, 17, 0.10, "cusum")
    ('', '')
    """
    if kind == "flag":
        return "a flag is an alarm already: figures are of its own operating point, at any level"
    least = least_episodes(level, kind, confidence)
    if recordings >= min(windows, least):
        return ""
    counts = f"{windows} windows of {counted(recordings, 'recording(s)')}"
    return f"{counts}: no promise at {100 * level:.3g} %; {least} recordings would"


def too_few(
    subject: str, episodes: int, level: float, kind: AlarmKind, confidence: float | None = None
) -> str:
    """Say how many calibration episodes a level takes, for this statistic and for the other.

    >>> too_few("alpha=0.05", 30, 0.05, "cusum").partition(":")[0]
    'alpha=0.05 takes 38 calibration episodes, got 30'
    """
    least_cusum, least_score = (
        least_episodes(level, statistic, confidence) for statistic in STATISTICS
    )
    return (
        f"{subject} takes {least_cusum if kind == 'cusum' else least_score} calibration episodes, "
        f"got {episodes}: {least_cusum} for a CUSUM of the scores, which half of them standardize, "
        f"{least_score} for the detector's own score as the "
        "statistic; "
        "record more, or promise less"
    )


def missing_level(episodes: int, level: float, kind: AlarmKind) -> str:
    """Say how many calibration episodes a level takes, and which weaker level these offer.

    Parameters
    ----------
    episodes
        All calibration episodes, those that standardize the scores included.
    level
        Largest share of nominal episodes with an alarm, which they are too few for.
    kind
        The statistic.

    Returns
    -------
    str
        A phrase, with the option of commands that shows the weaker level.

    Examples
    --------
    >>> missing_level(30, 0.05, "cusum")
    '30 calibration episodes; 38 needed at 5 %, or --level 10'
    >>> missing_level(17, 0.10, "cusum")
    '17 calibration episodes; 18 needed at 10 %'
    """
    weaker = [share for share in offered_levels(episodes, kind).values() if share > level]
    remedy = f", or --level {100 * min(weaker):g}" if weaker else ""
    needed = f"{least_episodes(level, kind)} needed at {100 * level:g} %"
    return f"{episodes} calibration episodes; {needed}{remedy}"


def rolling_rules(
    calibration: Calibration,
    nominal: Sequence[Floats],
    level: float,
    recordings: Sequence[int] | None = None,
) -> list[GuaranteedAlarm]:
    """Return the alarms of a rolling calibration, one for each nominal episode and one for after.

    Episode i is judged with the calibration and the i episodes before it, which were confirmed to
    be nominal, whether they alarmed or not.

    Parameters
    ----------
    calibration
        Of the episodes before all of these.
    nominal
        Scores of the m nominal episodes, in the order in which they were recorded.
    level
        Largest share of nominal episodes with an alarm.
    recordings
        Numbers of their recordings, on from those of the calibration; None where each is one.

    Returns
    -------
    list of GuaranteedAlarm
        m + 1 of them; the last is for what comes after all.

    Raises
    ------
    UsageError
        Where a threshold would be infinite.
    """
    rules = [calibration.rule(level)]
    numbers: Sequence[int | None] = recordings or [None] * len(nominal)
    for scores, recording in zip(nominal, numbers, strict=True):
        calibration = calibration.joined(calibration.unbounded.largest(scores), recording)
        rules.append(calibration.rule(level))
    return rules


def quantile_rank(n: int, level: float, confidence: float | None = None) -> int:
    """Return the rank, from 1, of the threshold among n largest statistics.

    It is the smallest k with ``1 - k / (n + 1) <= level``: on average over calibrations, no larger
    share of nominal episodes alarms. With a confidence, such as 0.9, it is the smallest k with
    which that holds in this share of the calibrations (Vovk, "Conditional validity of inductive
    conformal predictors", 2012). Above n no number of the n will do.

    >>> quantile_rank(19, 0.05), quantile_rank(18, 0.05), quantile_rank(20, 0.10)
    (19, 19, 19)
    >>> quantile_rank(45, 0.05, 0.9), quantile_rank(44, 0.05, 0.9)
    (45, 45)
    """
    if confidence is None:
        return n + 1 - math.floor((n + 1) * level + _ROUNDING)
    # Of n episodes at least k are quiet with this chance, if the share of alarms is the level.
    chances = (incomplete_beta(k, n + 1 - k, 1 - level) for k in range(1, n + 1))
    return next((k for k, p in enumerate(chances, 1) if p <= 1 - confidence + _ROUNDING), n + 1)


def least_episodes(level: float, kind: AlarmKind, confidence: float | None = None) -> int:
    """Return how many calibration episodes a level takes, those that standardize included.

    >>> least_episodes(0.05, "score"), least_episodes(0.05, "cusum")
    (19, 38)
    >>> least_episodes(0.05, "score", 0.9)
    45
    """
    if confidence is None:
        n = math.ceil(1 / level - _ROUNDING) - 1
    else:
        n = math.ceil(math.log(1 - confidence) / math.log(1 - level) - _ROUNDING)
    return 2 * n if kind == "cusum" else n


def offered_levels(episodes: int, kind: AlarmKind) -> dict[str, float]:
    """Return the levels, by suffix, that a number of calibration episodes is enough for.

    Parameters
    ----------
    episodes
        All of them, those that standardize the scores included.
    kind
        The statistic: for a CUSUM half of them standardize the scores.

    Returns
    -------
    dict
        Share of nominal episodes with an alarm by suffix, the largest first.

    Examples
    --------
    >>> list(offered_levels(40, "cusum")), list(offered_levels(40, "score"))
    (['at_10pct', 'at_5pct'], ['at_10pct', 'at_5pct'])
    >>> list(offered_levels(18, "cusum")), list(offered_levels(19, "score"))
    (['at_10pct'], ['at_10pct', 'at_5pct'])
    """
    if kind == "flag":
        return dict(LEVELS)
    n = episodes // 2 if kind == "cusum" else episodes
    return {suffix: level for suffix, level in LEVELS.items() if quantile_rank(n, level) <= n}


def guaranteed_contributions(
    anomalous: Sequence[Floats],
    twins: Sequence[Floats],
    effects: Sequence[int],
    rule: GuaranteedAlarm,
) -> dict[str, Contribution]:
    """Return the metrics of guaranteed alarms of one cell, in the order of the catalogue.

    Only the first alarm of an episode counts. Where it precedes the effect the episode is
    ``early`` and undefined in all that follows. The nulls are of the twins at their partners'
    effects; a twin that ended before its partner's effect is undefined there, too.
    ``found_within_k`` and its null count alarms in rows that both episodes have: an anomaly may
    prolong an episode, and whatever knows no more than the time would find it in the rows that the
    twin lacks.

    Parameters
    ----------
    anomalous, twins
        Scores of the n anomalous trajectories and of their nominal twins.
    effects
        The first row of each anomalous trajectory that differs from its twin.
    rule
        Made by `GuaranteedAlarm.fit`.

    Returns
    -------
    dict
        Contributions by name, without the suffix of a level.
    """
    loud, quiet = ([rule.first(scores) for scores in part] for part in (anomalous, twins))
    alarms = [float(first is not None) for first in quiet]
    contributions = {"false_episodes": mean_of(alarms)}
    lengths = [[len(scores) for scores in part] for part in (anomalous, twins)]
    ends = list(map(min, *lengths))
    nulls = from_starts(quiet, lengths[1], ends, effects)
    for name, contribution in from_starts(loud, lengths[0], ends, effects).items():
        contributions[name] = contribution
        contributions[f"{name}_null"] = nulls[name]
    return {name: contributions[name] for name in GUARANTEED if name in contributions}


def from_starts(
    firsts: Sequence[int | None],
    lengths: Sequence[int],
    ends: Sequence[int],
    effects: Sequence[int],
) -> dict[str, Contribution]:
    """Return the share of early episodes, and delays and shares of all others.

    Parameters
    ----------
    firsts
        The row of each episode's first alarm; None without one.
    lengths
        The number of rows of each episode.
    ends
        The number of rows that an episode and its partner both have.
    effects
        The row of each episode from which delays count.

    Returns
    -------
    dict
        Contributions by name, without the suffix of a level.
    """
    rows = np.array([math.nan if first is None else first for first in firsts], np.float64)
    ints = (np.asarray(values, np.int64) for values in (lengths, ends, effects))
    return {name: mean_of(terms) for name, terms in start_terms(rows, *ints).items()}


def start_terms(
    firsts: Floats, lengths: NDArray[np.int64], ends: NDArray[np.int64], effects: NDArray[np.int64]
) -> dict[str, Floats]:
    """Return the values of each episode, NaN where undefined, for `from_starts`.

    Parameters
    ----------
    firsts
        Rows of first alarms, NaN without: shape (..., n).
    lengths, ends, effects
        As those of `from_starts`: shape (n,).

    Returns
    -------
    dict
        Arrays of the shape of `firsts` by name, without the suffix of a level.
    """
    early, delays, missed = firsts < effects, firsts - effects, np.isnan(firsts)
    remainders = lengths - effects
    values = {
        "delay": delays,
        "missed": missed.astype(np.float64),
        "delay_censored": np.where(missed, remainders, delays),
    }
    for k in FOUND_WITHIN:
        seen = (firsts < ends) & (delays < k)
        values[f"found_within_{k}"] = np.where(effects < ends, seen, np.nan)
    defined = ~early & (remainders > 0)
    terms = {name: np.where(defined, value, np.nan) for name, value in values.items()}
    return {"early": early.astype(np.float64), **terms}


def attribution_contributions(
    anomalous: Sequence[Floats],
    explained: Sequence[NDArray[np.int32]],
    corrupted: Sequence[Collection[int]],
    effects: Sequence[int],
    rule: GuaranteedAlarm,
) -> dict[str, Contribution]:
    """Return what explanations of one cell are worth, in the order of the catalogue.

    An explanation is taken at the row of an episode's first alarm; without one, or where that
    precedes the effect, both metrics are undefined.

    Parameters
    ----------
    anomalous
        Scores of the n anomalous trajectories.
    explained
        For each, of shape (2, rows): the sensor that is named first at a row, and the onset; -1
        where nothing was explained.
    corrupted
        For each, the sensors that the anomaly corrupts: none where it is not of the sensors, which
        leaves ``sensor_named`` undefined.
    effects
        The first row of each trajectory that differs from its twin.
    rule
        Made by `GuaranteedAlarm.fit`.

    Returns
    -------
    dict
        Contributions by name, without the suffix of a level.
    """
    named, errors = np.full((2, len(anomalous)), np.nan)
    for i, (scores, effect) in enumerate(zip(anomalous, effects, strict=True)):
        first = rule.first(scores)
        sensor, onset = (-1, -1) if first is None else explained[i][:, first].tolist()
        if first is not None and first >= effect and onset >= 0:
            errors[i] = abs(onset - effect)
            if corrupted[i]:
                named[i] = sensor in corrupted[i]
    return {"sensor_named": mean_of(named), "onset_error": mean_of(errors, median=True)}


def naming_contributions(
    namings: NDArray[np.int8],
    faulty: NDArray[np.bool_],
    kinds: Sequence[Collection[int]],
    judged: NDArray[np.bool_],
) -> dict[str, Contribution]:
    """Return what the sets of parts that one cell's explanations name are worth.

    Precision and recall are pooled over episodes. They are undefined where no part is at fault.

    Parameters
    ----------
    namings
        Of shape (n, 3, 1 + P): number of the kind, -1 without one, and 1 for each named part; at
        the first alarm, 20 rows later, and of the readings that are largest at the alarm.
    faulty
        Parts at fault, of shape (n, P).
    kinds
        For each episode, numbers of the kinds that are right.
    judged
        Episodes with a first alarm from the effect on, of shape (n,).

    Returns
    -------
    dict
        Contributions by name, without the suffix of a level.
    """
    faulty = faulty & judged[:, None]
    total: Floats = faulty.sum(axis=1, dtype=np.float64)
    named = (namings[..., 1:] > 0) & (total > 0)[:, None, None]
    right: Floats = (named & faulty[:, None]).sum(axis=2, dtype=np.float64).T
    sizes: Floats = named.sum(axis=2, dtype=np.float64).T
    kind = namings[:, 0, 0].tolist()
    hits = np.array([number in of for number, of in zip(kind, kinds, strict=True)], np.float64)
    return {
        "named_precision": Contribution(right[0], sizes[0]),
        "named_recall": Contribution(right[0], total),
        "named_precision_20": Contribution(right[1], sizes[1]),
        "named_recall_20": Contribution(right[1], total),
        "named_chance": Contribution(sizes[0] * total / faulty.shape[1], sizes[0]),
        "named_largest": Contribution(right[2], total),
        "kind_named": mean_of(np.where(judged & (namings[:, 0, 0] >= 0), hits, np.nan)),
    }


class Monitor:
    """Alarms of one episode as its scores come in, beside a running robot.

    The statistic and the alarms are those of the whole episode, bit for bit: with an `AlarmRule`
    those of `cusum.cusum`, whose sum starts again after an alarm, with a `GuaranteedAlarm` its own,
    whose alarm lasts as long as the statistic is above the threshold. `statistic` is that after the
    last score, before the new start that an alarm of an `AlarmRule` brings.

    >>> from oodd_eval.metrics.cusum import Standardization
    >>> monitor = Monitor(AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.25, threshold=1))
    >>> [(monitor.update(score), monitor.statistic) for score in (0.5, 0.5, 2.0, 0.0)]
    [(False, 0.25), (False, 0.5), (True, 2.25), (False, 0.0)]
    """

    def __init__(self, rule: AlarmRule | GuaranteedAlarm) -> None:
        self.rule = rule
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self._carried = 0.0
        # A score that has not come yet is below every threshold.
        self.statistic = -math.inf if self.rule.standardization is None else 0.0

    def update(self, score: float) -> bool:
        """Take the next score, NaN where undefined; return whether it raises an alarm."""
        rule = self.rule
        if rule.standardization is None:
            self.statistic = -math.inf if math.isnan(score) else float(score)
            return self.statistic > rule.threshold
        drift = rule.drift if isinstance(rule, AlarmRule) else DRIFT
        x = float(rule.standardization(np.array([score]))[0]) - drift
        if math.isnan(x):
            self.statistic = 0.0
            return False
        self._carried = self.statistic = max(0.0, self._carried + x)
        alarm = self.statistic > rule.threshold
        if alarm and isinstance(rule, AlarmRule):
            self._carried = 0.0
        return alarm
