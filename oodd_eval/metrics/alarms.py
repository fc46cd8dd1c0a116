"""Alarms with a guarantee: at most a chosen share of nominal episodes raises one.

The threshold is a rank among the calibration episodes' largest statistics (split conformal
prediction). A new nominal episode is exchangeable with them, so that its largest statistic exceeds
the k-th smallest of n with probability at most ``1 - k / (n + 1)``, whatever the distribution of
scores and however they depend on one another within an episode.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import AlarmRule, Contribution, mean_of
from oodd_eval.metrics.binomial import incomplete_beta
from oodd_eval.metrics.catalogue import FOUND_WITHIN, GUARANTEED, LEVELS
from oodd_eval.metrics.cusum import DRIFT, Standardization, cusum

Floats = NDArray[np.float64]

AlarmKind = Literal["cusum", "score"]
"""Statistic of the guaranteed alarms: the CUSUM of the scores, or the score itself."""

_ROUNDING: Final = 1e-9  # share of an episode that levels may be off: (n + 1) x 0.05 is whole


@dataclass(frozen=True, slots=True)
class GuaranteedAlarm:
    """A threshold of the statistic that at most a given share of nominal episodes exceeds.

    Parameters
    ----------
    standardization
        Of the scores, for the CUSUM; None where the score itself is the statistic.
    threshold
        An episode alarms at the first row whose statistic is larger; infinite where no number of
        episodes could promise the level.

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

        Returns
        -------
        GuaranteedAlarm
            Its threshold is infinite where there are too few episodes for the level.
        """
        return cls.fits(calibration, [level], kind, confidence)[0]

    @classmethod
    def fits(
        cls,
        calibration: Sequence[Floats],
        levels: Sequence[float],
        kind: AlarmKind = "cusum",
        confidence: float | None = None,
    ) -> "list[GuaranteedAlarm]":
        """Find the thresholds of several levels as `fit` does, each episode's statistic once."""
        unbounded, episodes = cls(None, math.inf), calibration
        if kind == "cusum":
            unbounded = cls(Standardization.fit(calibration[0::2]), math.inf)
            episodes = calibration[1::2]
        largest = np.sort([unbounded.largest(scores) for scores in episodes])
        ranks = [quantile_rank(len(largest), level, confidence) for level in levels]
        return [
            cls(
                unbounded.standardization,
                float(largest[rank - 1]) if rank <= len(largest) else math.inf,
            )
            for rank in ranks
        ]

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
        The statistic: with the CUSUM half of them standardize the scores.

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
    nulls = _from_effect(quiet, lengths[1], ends, effects)
    for name, contribution in _from_effect(loud, lengths[0], ends, effects).items():
        contributions[name] = contribution
        contributions[f"{name}_null"] = nulls[name]
    return {name: contributions[name] for name in GUARANTEED}


def _from_effect(
    firsts: Sequence[int | None],
    lengths: Sequence[int],
    ends: Sequence[int],
    effects: Sequence[int],
) -> dict[str, Contribution]:
    """Return the share of early episodes, and delays and shares of all others.

    `ends` are the numbers of rows that an episode and its partner both have.
    """
    nothing = math.nan
    early, delays, missed, censored = [], [], [], []
    within: dict[int, list[float]] = {k: [] for k in FOUND_WITHIN}
    for first, length, end, effect in zip(firsts, lengths, ends, map(int, effects), strict=True):
        before = first is not None and first < effect
        delay = nothing if first is None else float(first - effect)
        remainder = length - effect
        defined = not before and remainder > 0
        early.append(float(before))
        delays.append(delay if defined else nothing)
        missed.append(float(first is None) if defined else nothing)
        censored.append((remainder if first is None else delay) if defined else nothing)
        for k, shares in within.items():
            seen = first is not None and first < end and delay < k
            shares.append(float(seen) if defined and effect < end else nothing)
    values = {"early": early, "delay": delays, "missed": missed, "delay_censored": censored}
    values |= {f"found_within_{k}": shares for k, shares in within.items()}
    return {name: mean_of(terms) for name, terms in values.items()}


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
        For each, of shape (2, rows): the sensor that is named first at a row, and the onset.
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
        if first is not None and first >= effect:
            sensor, onset = explained[i][:, first].tolist()
            errors[i] = abs(onset - effect)
            if corrupted[i]:
                named[i] = sensor in corrupted[i]
    return {"sensor_named": mean_of(named), "onset_error": mean_of(errors, median=True)}


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
