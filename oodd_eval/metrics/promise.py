"""Reasons to trust a promise on false alarms, or to doubt it, before anything has alarmed.

The promise holds for episodes that are exchangeable with those of the calibration: for as many as
the level takes, of a machine that does not drift, as long as those that are judged. Whether it
drifts is tested by permutations of the recorded order, without a detector. Windows of one recording
count once.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.alarms import (
    STATISTICS,
    AlarmKind,
    Calibration,
    least_episodes,
    no_promise,
    numbered,
    offered_levels,
    window_weights,
)
from oodd_eval.metrics.catalogue import HEADLINE, LEVELS

Floats = NDArray[np.float64]

PERMUTATIONS: Final = 999
"""Random orders that the recorded one is compared with."""

SIGNIFICANT: Final = 0.01
"""Largest p-value that is worth a warning."""

FEWEST: Final = 6
"""Episodes below which no order is remarkable: their 720 orders cannot give so small a p-value."""

_CHUNK: Final = 1 << 22  # numbers of permuted positions in memory at a time
_EQUAL: Final = 1e-12  # what rounding may take off a correlation


@dataclass(frozen=True, slots=True)
class PermutationTest:
    """The largest rank correlation between some quantities and positions, against chance.

    Attributes
    ----------
    statistic
        The largest absolute rank correlation; 0 where nothing varies.
    p
        Share of orders, the true one included, in which it is as large.
    column
        The quantity that has it; -1 where nothing varies.
    """

    statistic: float
    p: float
    column: int

    @property
    def significant(self) -> bool:
        """True where exchangeable episodes would rarely give this."""
        return self.p <= SIGNIFICANT


def drift_test(values: Floats) -> PermutationTest:
    """Test whether quantities of episodes follow the order of the episodes.

    Parameters
    ----------
    values : float64 array of shape (n, D)
        One row an episode, in the recorded order, such as the means of its sensors.

    Returns
    -------
    PermutationTest
        With p = 1 for fewer than 6 episodes.

    Examples
    --------
    >>> steady = np.random.default_rng(0).normal(size=(30, 3))
    >>> drift_test(steady).p > 0.05
    True
    >>> steady[:, 1] += 0.2 * np.arange(30)
    >>> drift_test(steady).p, drift_test(steady).column
    (0.001, 1)
    """
    return permutation_test(values, np.arange(len(values), dtype=np.float64))


def two_sample_test(first: Floats, second: Floats) -> PermutationTest:
    """Test whether quantities of episodes differ between two sets of episodes.

    Parameters
    ----------
    first, second : float64 arrays of shape (n, D) and (m, D)
        One row an episode.

    Returns
    -------
    PermutationTest
        Its correlation is with membership in the second set.
    """
    members = np.repeat([0.0, 1.0], [len(first), len(second)])
    return permutation_test(np.concatenate([first, second]), members)


def permutation_test(values: Floats, positions: Floats) -> PermutationTest:
    """Return the largest |Spearman rank correlation| of columns with positions, against chance.

    Equal values share their mean rank. The p-value is ``(1 + k) / (1 + N)``, with k of N random
    orders in which the largest correlation is as large; the draws depend on n alone.

    Parameters
    ----------
    values : float64 array of shape (n, D)
        Quantities of n episodes.
    positions : float64 array of shape (n,)
        Of the episodes.

    Returns
    -------
    PermutationTest
    """
    n = len(values)
    columns = np.apply_along_axis(_unit_ranks, 0, values) if values.size else np.zeros((n, 1))
    ranks = _unit_ranks(positions) if n else positions
    correlations = np.abs(ranks @ columns)
    column = int(correlations.argmax())
    statistic = float(correlations[column])
    if statistic <= _EQUAL:
        return PermutationTest(0.0, 1.0, -1)
    if n < FEWEST:
        return PermutationTest(statistic, 1.0, column)
    rng, larger, left = np.random.default_rng([n, PERMUTATIONS]), 0, PERMUTATIONS
    while left:
        size = min(left, max(1, _CHUNK // n))
        drawn = rng.permuted(np.tile(ranks, (size, 1)), axis=1)
        larger += int((np.abs(drawn @ columns).max(axis=1) >= statistic - _EQUAL).sum())
        left -= size
    return PermutationTest(min(statistic, 1.0), (1 + larger) / (1 + PERMUTATIONS), column)


def _unit_ranks(values: Floats) -> Floats:
    """Return ranks, equal values sharing their mean, with the mean 0 and length 1; or zeros."""
    _, groups, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks: Floats = (last - (counts - 1) / 2)[groups]
    ranks = ranks - ranks.mean()
    length = float(np.sqrt(ranks @ ranks))
    return ranks / length if length > 0 else np.zeros_like(ranks)


Subject = Literal["episodes", "drift", "difference", "length", "achieved"]

_REMEDY: Final = (
    "more episodes than promised may alarm; baseline rows, a rolling calibration, or calibration "
    "episodes of the days that are judged help"
)


@dataclass(frozen=True, slots=True)
class PromiseFinding:
    """One reason to trust or to doubt a promise.

    Attributes
    ----------
    subject
        ``"episodes"``: how many the levels take. ``"drift"``: whether episodes follow their order.
        ``"difference"`` and ``"length"``: whether calibration is like the nominal test episodes.
        ``"achieved"``: the share of alarms among calibration episodes themselves.
    text
        One sentence, for users.
    doubt
        Whether it puts the promise in doubt.
    p
        Chance of as much in exchangeable episodes; NaN where nothing was tested.
    sensor
        The sensor that shows it most; empty where it is none.
    """

    subject: Subject
    text: str
    doubt: bool
    p: float = math.nan
    sensor: str = ""

    def __str__(self) -> str:
        """Return the sentence."""
        return self.text


class EpisodeMeans(NamedTuple):
    """Of n episodes the mean of each of D sensors, and the number of rows that are judged.

    Attributes
    ----------
    means
        Float64 array of shape (n, D).
    lengths
        Int64 array of shape (n,).
    recordings
        For each episode the recording that it is a window of; None where each is one.
    """

    means: Floats
    lengths: NDArray[np.int64]
    recordings: Sequence[Hashable] | None = None

    @property
    def units(self) -> int:
        """Number of recordings."""
        return len(self.lengths) if self.recordings is None else len({*self.recordings})

    def by_recording(self) -> "EpisodeMeans":
        """Return the means of recordings.

        Returns
        -------
        EpisodeMeans
            Of each recording, whose windows count alike.
        """
        unit = numbered(self.recordings, len(self.lengths))
        share = (unit == np.arange(self.units)[:, None]) * window_weights(unit)
        return EpisodeMeans(share @ self.means, np.rint(share @ self.lengths).astype(np.int64))


NO_EPISODES: Final = EpisodeMeans(np.empty((0, 0)), np.empty(0, np.int64))


def promises(
    train: EpisodeMeans,
    calibration: EpisodeMeans,
    nominal: EpisodeMeans = NO_EPISODES,
    *,
    sensors: Sequence[str] = (),
    recorded: bool = True,
    kinds: Sequence[AlarmKind] = STATISTICS,
) -> list[PromiseFinding]:
    """Return what speaks for and against promises that are calibrated with these episodes.

    Parameters
    ----------
    train, calibration, nominal
        Nominal episodes: of training, of the calibration, and further ones that are to be judged.
    sensors
        Names of the sensors.
    recorded
        Whether training, calibration and the others follow one another as they were recorded.
    kinds
        Statistics that are to be thresholds of.

    Returns
    -------
    list of PromiseFinding
        The number of episodes first, then what was tested.
    """
    findings = [enough_episodes(len(calibration.lengths), kinds, calibration.units)]
    parts, noun = [train, calibration, nominal], "episodes"
    # Where recordings are too few for any level, figures count windows, and windows are compared.
    has_levels = any(offered_levels(calibration.units, kind) for kind in kinds)
    if has_levels and any(part.units < len(part.lengths) for part in parts):
        parts, noun = [part.by_recording() for part in parts], "recordings"
        train, calibration, nominal = parts
    if recorded:
        means = [part.means for part in parts if len(part.means)]
        every = np.concatenate(means) if means else NO_EPISODES.means
        findings.append(_drift(drift_test(every), len(every), noun, sensors))
    if len(calibration.means) and len(nominal.means):
        test = two_sample_test(calibration.means, nominal.means)
        findings.append(_difference(test, sensors))
        findings.append(_length(calibration.lengths, nominal.lengths))
    return findings


def enough_episodes(
    n: int, kinds: Sequence[AlarmKind] = STATISTICS, recordings: int | None = None
) -> PromiseFinding:
    """Tell which levels a number of calibration episodes is enough for.

    Parameters
    ----------
    n
        Number of calibration episodes.
    kinds
        Statistics.
    recordings
        Number of the recordings that these are windows of; by default as many.

    Returns
    -------
    PromiseFinding
        In doubt where the headline's level is out of reach.

    Examples
    --------
    >>> print(enough_episodes(30))
    30 calibration episodes: at 5 % 38 are needed for a CUSUM of the scores, 19 for a detector's \
own score
    >>> print(enough_episodes(38, ["score"], 1))
    38 windows of 1 recording: no promise at 10 %; 9 recordings would
    """
    units = n if recordings is None else recordings
    offered = [offered_levels(units, kind) for kind in kinds]
    missing = next((s for s in LEVELS if not all(s in levels for levels in offered)), None)
    doubt = not all(HEADLINE in levels for levels in offered)
    text = f"{n} {'calibration episodes' if units == n else 'windows'}: enough for all levels"
    if missing is not None:
        level = LEVELS[missing]
        least = {kind: least_episodes(level, kind) for kind in kinds}
        needed = [f"{number} {{}}for {_name(kind)}" for kind, number in least.items()]
        listed = ", ".join(needed).replace("{}", "are needed ", 1).replace("{}", "")
        text = f"{n} calibration episodes: at {100 * level:g} % {listed}"
        if units < n:
            first, *others = sorted((k for k in kinds if least[k] > units), key=least.__getitem__)
            text = no_promise(n, units, level, first)
            text += f" for {_name(first)}" * (len(others) + 1 < len(kinds))
            text += "".join(f" ({least[kind]} for {_name(kind)})" for kind in others)
    return PromiseFinding("episodes", text, doubt)


def _name(kind: AlarmKind) -> str:
    names = {"cusum": "a CUSUM of the scores", "column": "a recorded column"}
    return names.get(kind, "a detector's own score")


def achieved_share(
    calibration: Sequence[Floats],
    kind: AlarmKind,
    name: str = "",
    recordings: Sequence[Hashable] | None = None,
) -> PromiseFinding | None:
    """Tell how many later calibration episodes alarm at a threshold from the earlier ones.

    Parameters
    ----------
    calibration
        Scores by episode, as recorded.
    kind
        The statistic.
    name
        Of the detector.
    recordings
        What the episodes are windows of; where there are enough of them, each is taken whole.

    Returns
    -------
    PromiseFinding or None
        None where half of the episodes are too few for any level.
    """
    unit, noun = numbered(recordings, len(calibration)), "episodes"
    if (count := len({*unit.tolist()})) < len(unit) and offered_levels(count // 2, kind):
        order, starts = np.argsort(unit, kind="stable"), np.cumsum(np.bincount(unit))[:-1]
        windows = np.split(order, starts)
        calibration = [np.concatenate([calibration[i] for i in of_one]) for of_one in windows]
        noun = "recordings"
    half = len(calibration) // 2
    offered = offered_levels(half, kind)
    if not offered:
        return None
    level = next(iter(offered.values()))
    earlier = Calibration.fit(calibration[:half], kind)
    threshold = earlier.threshold(level)
    later = [earlier.unbounded.largest(scores) for scores in calibration[half:]]
    alarms = sum(statistic > threshold for statistic in later)
    n = len(earlier.largest)
    p = _beta_binomial_tail(alarms, len(later), math.floor((n + 1) * level + 1e-9), n)
    return PromiseFinding(
        "achieved",
        f"{name}{': ' if name else ''}{alarms} of the {len(later)} later calibration {noun} alarm"
        f" at the threshold that the {half} earlier ones give for {100 * level:g} % (p = {p:.2g})",
        p <= SIGNIFICANT,
        p,
    )


def _sensor(column: int, sensors: Sequence[str]) -> str:
    if column < 0:
        return ""
    return sensors[column] if column < len(sensors) else f"sensor {column}"


def _drift(test: PermutationTest, n: int, noun: str, sensors: Sequence[str]) -> PromiseFinding:
    sensor, figures = _sensor(test.column, sensors), _figures(test)
    text = f"no drift seen in {n} nominal {noun}: most in the mean of {sensor} ({figures})"
    if test.significant:
        text = (
            f"nominal {noun} drift: the mean of {sensor} follows the order of all {n} ({figures})"
            f", so that {_REMEDY}"
        )
    elif test.column < 0:
        text = f"no drift: no sensor's mean varies over {n} nominal {noun}"
    return PromiseFinding("drift", text, test.significant, test.p, sensor)


def _difference(test: PermutationTest, sensors: Sequence[str]) -> PromiseFinding:
    sensor, figures = _sensor(test.column, sensors), _figures(test)
    text = f"calibration is like the nominal test episodes ({figures})"
    if test.significant:
        text = (
            f"calibration differs from the nominal test episodes, most in the mean of {sensor} "
            f"({figures}), so that {_REMEDY}"
        )
    return PromiseFinding("difference", text, test.significant, test.p, sensor)


def _figures(test: PermutationTest) -> str:
    return f"rank correlation {test.statistic:.2f}, p = {test.p:.2g}"


def _length(
    calibration_lengths: NDArray[np.int64], nominal_lengths: NDArray[np.int64]
) -> PromiseFinding:
    test = two_sample_test(
        *(n[:, None].astype(np.float64) for n in (calibration_lengths, nominal_lengths))
    )
    rows = (
        f"{np.median(calibration_lengths):g} rows in the median, "
        f"nominal test episodes {np.median(nominal_lengths):g}"
    )
    shorter = test.significant and bool(calibration_lengths.mean() < nominal_lengths.mean())
    text = f"calibration episodes have {rows}"
    if shorter:
        text += f" (p = {test.p:.2g}): longer ones have more time to alarm than was promised for"
    return PromiseFinding("length", text, shorter, test.p)


def _beta_binomial_tail(least: int, trials: int, above: int, n: int) -> float:
    """Return the chance that at least so many of further episodes exceed n's (above)-th largest."""

    def orders(first: int, second: int) -> float:
        return math.lgamma(first + second + 1) - math.lgamma(first + 1) - math.lgamma(second + 1)

    # Of all orders of n + trials, those with k of the trials above that one.
    every = orders(n, trials)
    logs = [
        orders(above - 1, k) + orders(n - above, trials - k) - every
        for k in range(least, trials + 1)
    ]
    return math.fsum(map(math.exp, logs))
