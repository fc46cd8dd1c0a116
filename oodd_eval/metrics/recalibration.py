"""Alarms under resamples of the calibration episodes: how much of a figure they decide.

Mean and standard deviation of the scores, and the threshold, are those of the calibration episodes
that happened to be recorded. `Resampled` draws them anew, and gives every episode's alarms in all
draws at once. Draws depend on nothing but the environment and the number of episodes, so that all
detectors and anomalies share them.

A threshold is a high order statistic, often the largest value. The plain bootstrap of a maximum is
wrong for any number of episodes: no draw exceeds it, and in 63 % of the draws it is the same. So
drawn ranks are spread evenly (Segers, Sibuya & Tsukahara, J. Multivar. Anal. 155, 2017): an episode
of rank i among m, drawn with a number v uniform in [0, 1), has the level (i - 1 + v) / m. Levels
become values by a line through the order statistics on the scale ``-log(1 - level)``, on which they
lie at their expectations under an exponential tail (Rényi 1953); it goes on beyond the largest one
with the mean excess of the upper ones as its slope.

Where episodes are windows of several recordings, recordings are drawn. Each brings all its windows,
which share its place among the m: i and v count in shares of a recording.
"""

import functools
import math
import zlib
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.alarms import (
    AlarmKind,
    GuaranteedAlarm,
    halves,
    joined,
    no_promise,
    numbered,
    offered_levels,
    start_terms,
    window_weights,
)
from oodd_eval.metrics.auc import FAR_START
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD, UNIT, Standardization
from oodd_eval.metrics.faults import ParetoTail
from oodd_eval.metrics.unpaired import UnpairedScores, unpaired_alarms

DRAWS: Final = 64
"""Resamples of the calibration episodes: a standard deviation is then known to 9 %."""

Floats = NDArray[np.float64]

Draws = dict[str, Floats]
"""Values of metrics in every draw, by metric: shape (draws,), NaN where undefined."""

_STEEP: Final = 1e150  # units per score where scores do not vary: any rise is an alarm
_NEVER: Final = -1e300  # a score that takes any sum back to 0
_BLOCK: Final = 128  # episodes at a time
_ROUNDING: Final = 1e-9  # of an episode


class Drawn(NamedTuple):
    """Drawn episodes, and where each lies in the span of its rank: both of shape (draws, n).

    Episodes of even and of odd number are drawn apart, each within themselves.
    """

    episodes: NDArray[np.intp]
    spread: Floats

    def half(self, start: int) -> "Drawn":
        """Return the draws of every second episode, numbered among these."""
        return Drawn(self.episodes[:, start::2] // 2, self.spread[:, start::2])

    def of_windows(self, unit: NDArray[np.intp]) -> "Drawn":
        """Return the draws of the m windows of drawn recordings, whose numbers are their units.

        Rows are filled up with the number m.
        """
        counts, order = np.bincount(unit), np.argsort(unit, kind="stable")
        if len(counts) == len(unit):
            return self
        members = np.split(order, np.cumsum(counts)[:-1])
        length = counts[self.episodes].sum(axis=1).max()
        episodes, spread = np.full((DRAWS, length), len(unit)), np.zeros((DRAWS, length))
        for i, row in enumerate(self.episodes):
            windows = np.concatenate([members[k] for k in row])
            episodes[i, : len(windows)] = windows
            spread[i, : len(windows)] = np.repeat(self.spread[i], counts[row])
        return Drawn(episodes, spread)


@functools.lru_cache(maxsize=64)
def drawn(environment: str, n: int) -> Drawn:
    """Return the resamples of an environment's n calibration episodes."""
    rng = np.random.default_rng([zlib.crc32(f"calibration of {environment}".encode()), n])
    episodes = np.empty((DRAWS, n), np.intp)
    for start in (0, 1):
        size = len(range(start, n, 2))
        episodes[:, start::2] = 2 * rng.integers(max(size, 1), size=(DRAWS, size)) + start
    return Drawn(episodes, rng.random((DRAWS, n)))


class Standards(NamedTuple):
    """Means and standard deviations of the scores by draw: shape (draws,)."""

    mean: Floats
    std: Floats

    @classmethod
    def fit(cls, scores: Sequence[Floats], episodes: NDArray[np.intp]) -> "Standards":
        """Return those of all defined scores of the drawn episodes; NaN where there is none."""
        defined = [s[~np.isnan(s)] for s in scores]
        pooled = np.concatenate([np.zeros(0), *defined])
        if not pooled.size:
            return cls(*np.full((2, len(episodes)), np.nan))
        # Near most scores, so that equal ones have no spread. A power of two rounds nothing.
        centre = float(np.median(pooled))
        far = [s - centre for s in defined]
        largest = max(float(np.abs(x).max(initial=0.0)) for x in far)
        unit = math.ldexp(1.0, math.frexp(largest)[1] - 1) if largest else 1.0
        sums = np.array([[x.size, (x / unit).sum(), ((x / unit) ** 2).sum()] for x in far])
        size, first, second = sums[episodes].sum(axis=1).T
        size = np.where(size > 0, size, np.nan)
        variance = np.maximum(second / size - (first / size) ** 2, 0.0)
        ends = np.array([[s.min(initial=np.inf), s.max(initial=-np.inf)] for s in defined])
        low, high = ends[episodes, 0].min(axis=1), ends[episodes, 1].max(axis=1)
        equal = low == high
        mean = np.where(equal, low, centre + unit * (first / size))
        return cls(mean, np.where(equal, 0.0, unit * np.sqrt(variance)))

    def of_draw(self, i: int) -> Standardization:
        """Return those of one draw."""
        return Standardization(*(values[i].item() for values in self))

    @property
    def line(self) -> tuple[Floats, Floats]:
        """Slope and offset by draw: a score s enters the CUSUM as ``slope * s - offset``."""
        slope = np.where(self.std > 0, UNIT / np.where(self.std > 0, self.std, 1.0), _STEEP)
        return slope, slope * self.mean + DRIFT


def thresholds(
    largest: Floats, draws: Drawn, level: float, weights: Floats | None = None
) -> Floats:
    """Return the drawn thresholds of a level: shape (draws,).

    Parameters
    ----------
    largest
        Largest statistics of the m episodes, in every draw: shape (draws, m).
    draws
        Of these episodes.
    level
        Largest share of nominal episodes with an alarm.
    weights
        Of the episodes, see `oodd_eval.metrics.alarms.window_weights`; by default all 1.

    Returns
    -------
    float64 array
    """
    m = largest.shape[1]
    each = np.ones(m) if weights is None else weights
    order = np.argsort(largest, axis=1, kind="stable")
    ordered, ordered_weights = np.take_along_axis(largest, order, axis=1), each[order]
    total, up_to = round(each.sum()), np.cumsum(ordered_weights, axis=1)
    below = up_to - ordered_weights
    # An episode that fills up has no weight, and comes last.
    starts, drawn_weights = np.full((len(order), m + 1), float(total)), np.append(each, 0.0)
    np.put_along_axis(starts, order, below, axis=1)
    drawn_weights = drawn_weights[draws.episodes]
    levels = np.take_along_axis(starts, draws.episodes, axis=1) + draws.spread * drawn_weights
    levels /= total
    by_level = np.argsort(levels, axis=1, kind="stable")
    weighed = np.cumsum(np.take_along_axis(drawn_weights, by_level, axis=1), axis=1)
    # The last one drawn, where windows count and few of them were drawn.
    least = np.minimum((1 - level) * (weighed[:, -1:] + 1), weighed[:, -1:]) - _ROUNDING
    rank = (weighed < least).sum(axis=1)[:, None]
    at = np.take_along_axis(by_level, rank, axis=1)
    heights = -np.log1p(-np.take_along_axis(levels, at, axis=1)[:, 0])
    # Of exponential order statistics.
    expected = np.cumsum(ordered_weights / (total - below), axis=1)
    upper = max(math.isqrt(m), 1)
    base = ordered[:, m - 1 - upper] if upper < m else ordered[:, 0]
    excess = (ordered[:, m - upper :] - base[:, None]).mean(axis=1)
    # The line goes through the point below a height and the one above it.
    above = (expected < heights[:, None]).sum(axis=1).clip(1, max(m - 1, 1))
    row, last = np.arange(len(largest)), np.minimum(above, m - 1)
    low, high = ordered[row, above - 1], ordered[row, last]
    gap = expected[row, last] - expected[row, above - 1] if m > 1 else 1.0
    share = ((heights - expected[row, above - 1]) / gap).clip(0.0, 1.0)
    beyond = np.maximum(heights - expected[:, -1], 0.0)
    with np.errstate(invalid="ignore"):
        drawn_values: Floats = low + share * (high - low) + beyond * excess
    # Where statistics are infinite, there is no line between them.
    return np.where(np.isnan(drawn_values), high, drawn_values)


class PairedScores(NamedTuple):
    """Scores of the n anomalous episodes of a cell and of their twins, with onsets and effects."""

    anomalous: Sequence[Floats]
    twins: Sequence[Floats]
    onsets: Sequence[int]
    effects: Sequence[int]


@dataclass(frozen=True, slots=True, eq=False)
class Recalibration:
    """Standardizations and thresholds of a fitted detector in every draw.

    Attributes
    ----------
    standards
        Of all scores, for the paper's alarms.
    statistic
        Of every second episode, for the guaranteed alarms; None where their statistic is the score.
    thresholds
        Of the guaranteed alarms by suffix: shape (draws,).
    tails
        Of the statistic of the scores in every draw, see `Calibration`; empty where the stream does
        not count.
    """

    standards: Standards
    statistic: Standards | None
    thresholds: dict[str, Floats]
    tails: Sequence[ParetoTail] = ()

    @classmethod
    def fit(
        cls,
        scores: Sequence[Floats],
        alarm: AlarmKind,
        environment: str,
        recordings: Sequence[Hashable] | None = None,
        stream: Sequence[float] | None = None,
    ) -> "Recalibration":
        """Draw the calibration episodes of an environment, given their scores.

        Windows of several recordings are drawn by recording, those of one as if each were one.
        `stream` is as in `Calibration.fit`; a tail is that of all episodes in every draw.
        """
        n, numbers = len(scores), numbered(recordings, len(scores))
        count = len({*numbers.tolist()})
        unit = numbers if count > 1 else np.arange(n)
        draws = drawn(environment, int(unit.max(initial=-1)) + 1)
        windows: list[list[Floats]] = [[] for _ in draws.episodes[0]]
        for k, of_episode in zip(unit.tolist(), scores, strict=True):
            windows[k].append(of_episode)
        whole = [np.concatenate(of_unit) for of_unit in windows]
        standards, statistic, indices = Standards.fit(whole, draws.episodes), None, np.arange(n)
        if alarm == "cusum":
            standardizing, indices = halves(numbers)
            first = int(unit[standardizing[:1]].sum()) % 2
            statistic = Standards.fit(whole[first::2], draws.half(first).episodes)
            draws, unit = draws.half(1 - first), unit // 2
        levels, tails = offered_levels(n, alarm), list[ParetoTail]()
        largest = np.zeros((DRAWS, 0))
        if levels:
            largest = _largest([scores[i] for i in indices.tolist()], statistic)
            draws = draws.of_windows(unit[indices])
        if levels and stream is not None:
            tails = [ParetoTail.fit(of_draw) for of_draw in largest]
            faults = [stream[i] for i in indices.tolist()]
            largest = np.maximum(largest, [tail.value(faults) for tail in tails])
        weights = {
            suffix: None if no_promise(n, count, level, alarm) else window_weights(unit[indices])
            for suffix, level in levels.items()
        }
        return cls(
            standards,
            statistic,
            {s: thresholds(largest, draws, level, weights[s]) for s, level in levels.items()},
            tails,
        )

    def firsts(self, episodes: Sequence[Floats]) -> dict[str, Floats]:
        """Return rows of first guaranteed alarms by suffix, NaN without: (draws, episodes)."""
        shape = DRAWS, len(episodes)
        rows = {suffix: np.full(shape, np.nan) for suffix in self.thresholds}
        if self.statistic is None:
            for i, scores in enumerate(episodes):
                highest = np.maximum.accumulate(np.where(np.isnan(scores), -np.inf, scores))
                for suffix, threshold in self.thresholds.items():
                    first = np.searchsorted(highest, threshold, side="right")
                    rows[suffix][:, i] = np.where(first < len(scores), first, np.nan)
            return rows
        quiet = {suffix: np.ones(shape, dtype=bool) for suffix in self.thresholds}
        for t, sums in enumerate(_sums(_stacked(episodes), self.statistic)):
            for suffix, threshold in self.thresholds.items():
                alarms = (sums > threshold[:, None]) & quiet[suffix]
                if alarms.any():
                    rows[suffix][alarms] = t
                    quiet[suffix] ^= alarms
        return rows

    def alarms(self, episodes: Sequence[Floats]) -> NDArray[np.bool_]:
        """Return the paper's alarms: shape (rows, draws, episodes)."""
        matrix = _stacked(episodes)
        alarms = np.empty((len(matrix), DRAWS, len(episodes)), dtype=bool)
        for row, sums in zip(alarms, _sums(matrix, self.standards), strict=True):
            np.greater(sums, THRESHOLD, out=row)
            np.copyto(sums, 0.0, where=row)
        return alarms

    def of_cells(
        self, cells: Sequence[PairedScores | UnpairedScores], rate: float | None = None
    ) -> list[Draws]:
        """Return the metrics of alarms of cells in every draw, in the cells' order.

        Parameters
        ----------
        cells
            Of one environment; those with twins share them.
        rate
            Without twins, rows in a second, for alarms per hour; None leaves these out.

        Returns
        -------
        list of dict
            For each cell, values by metric: shape (draws,), NaN where undefined.
        """
        paired = [cell for cell in cells if isinstance(cell, PairedScores)]
        alone = [cell for cell in cells if isinstance(cell, UnpairedScores)]
        return self._paired(paired) if paired else [self._unpaired(cell, rate) for cell in alone]

    def _paired(self, cells: Sequence[PairedScores]) -> list[Draws]:
        values: list[Draws] = []
        parts = [cells[0].twins, *(cell.anomalous for cell in cells)]
        quiet: _Alarms | None = None
        for block in _blocks([len(part) for part in parts]):
            pooled = [scores for i in block for scores in parts[i]]
            alarms = _Alarms(pooled, self.firsts(pooled), self.alarms(pooled))
            stop = 0
            for i in block:
                start, stop = stop, stop + len(parts[i])
                loud = alarms.only(slice(start, stop))
                if quiet is None:
                    quiet = loud
                else:
                    values.append(_paired(loud, quiet, cells[i - 1]))
        return values

    def _unpaired(self, cell: UnpairedScores, rate: float | None) -> Draws:
        values: dict[str, list[float]] = {}
        for i in range(DRAWS if self.thresholds else 0):
            of_draw = cell.with_statistics(functools.partial(self._joint, i))
            for suffix, threshold in self.thresholds.items():
                rule = GuaranteedAlarm(None, float(threshold[i]))
                for name, terms in unpaired_alarms(of_draw, rule, rate).items():
                    values.setdefault(f"{name}_{suffix}", []).append(terms.value)
        return {name: np.array(of_draws) for name, of_draws in values.items()}

    def _joint(self, i: int, scores: Floats, stream: Floats) -> Floats:
        basis = None if self.statistic is None else self.statistic.of_draw(i)
        statistic = _QuickAlarm(basis, math.inf).statistic(scores)
        statistic = np.where(np.isnan(scores), np.nan, statistic)
        return joined(statistic, self.tails[i].value(stream)) if self.tails else statistic


@dataclass(frozen=True, slots=True)
class _QuickAlarm(GuaranteedAlarm):
    """A guaranteed alarm whose CUSUM is right up to rounding, and needs no loop over rows."""

    def statistic(self, scores: Floats) -> Floats:
        if self.standardization is None or not self.standardization.std > 0:
            return GuaranteedAlarm.statistic(self, scores)
        x = self.standardization(scores) - DRIFT
        sums = np.cumsum(np.where(np.isnan(x), 0.0, x))
        return sums - np.minimum(np.minimum.accumulate(sums), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Alarms:
    """Alarms of episodes in every draw, see `Recalibration.firsts` and `Recalibration.alarms`."""

    episodes: Sequence[Floats]
    firsts: dict[str, Floats]
    paper: NDArray[np.bool_]

    def only(self, columns: slice) -> "_Alarms":
        """Return those of some episodes."""
        firsts = {suffix: rows[:, columns] for suffix, rows in self.firsts.items()}
        return _Alarms(self.episodes[columns], firsts, self.paper[:, :, columns])

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Rows of each episode."""
        return np.array([len(scores) for scores in self.episodes], np.intp)

    def delays(self, onsets: NDArray[np.int64]) -> Floats:
        """Return rows from onsets to the paper's next alarm, NaN without."""
        late = self.paper & (np.arange(len(self.paper))[:, None, None] >= onsets)
        first = late.argmax(axis=0)
        any_late = np.take_along_axis(late, first[None], axis=0)[0]
        return np.where(any_late, first - onsets, np.nan)

    def rate(self, rows: Sequence[slice]) -> Floats:
        """Return the paper's alarms over defined steps in some rows of each episode."""
        alarms = sum(self.paper[r, :, i].sum(axis=0) for i, r in enumerate(rows))
        defined = sum(
            np.count_nonzero(~np.isnan(scores[r]))
            for scores, r in zip(self.episodes, rows, strict=True)
        )
        return np.full(DRAWS, np.nan) if not defined else np.asarray(alarms) / defined


def _paired(loud: _Alarms, quiet: _Alarms, cell: PairedScores) -> Draws:
    """Return the metrics of alarms of one cell in every draw."""
    onsets, effects = (np.array(rows, np.int64) for rows in (cell.onsets, cell.effects))
    delays = loud.delays(onsets)
    missed = np.isnan(delays)
    values = {
        "delay": delays,
        "delay_null": quiet.delays(onsets),
        "delay_censored": np.where(missed, loud.lengths - onsets, delays),
        "missed": missed.astype(np.float64),
    }
    ends = np.minimum(loud.lengths, quiet.lengths)
    for suffix, firsts in loud.firsts.items():
        nulls = quiet.firsts[suffix]
        values[f"false_episodes_{suffix}"] = ~np.isnan(nulls) * 1.0
        for name, of_cell in start_terms(firsts, loud.lengths, ends, effects).items():
            values[f"{name}_{suffix}"] = of_cell
        for name, of_null in start_terms(nulls, quiet.lengths, ends, effects).items():
            values[f"{name}_null_{suffix}"] = of_null
    means = {name: _means(terms) for name, terms in values.items()}
    means["far"] = loud.rate([slice(FAR_START, int(t)) for t in cell.onsets])
    means["far_twin"] = quiet.rate([slice(None)] * len(quiet.episodes))
    return means


def _means(terms: Floats) -> Floats:
    """Return the mean of the defined terms of each row; NaN without any."""
    defined = ~np.isnan(terms)
    count = defined.sum(axis=-1)
    total = np.where(defined, terms, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _blocks(sizes: Sequence[int]) -> Iterator[list[int]]:
    """Yield indices of consecutive parts that together are small."""
    block: list[int] = []
    for i, size in enumerate(sizes):
        if block and sum(sizes[k] for k in block) + size > _BLOCK:
            yield block
            block = []
        block.append(i)
    if block:
        yield block


def _largest(episodes: Sequence[Floats], statistic: Standards | None) -> Floats:
    """Return the largest statistic of each episode in every draw: shape (draws, episodes)."""
    if statistic is None:
        largest = [np.nanmax(s, initial=-np.inf) for s in episodes]
        return np.tile(np.array(largest), (DRAWS, 1))
    highest = np.zeros((DRAWS, len(episodes)))
    for sums in _sums(_stacked(episodes), statistic):
        np.maximum(highest, sums, out=highest)
    return highest


def _sums(matrix: Floats, standards: Standards) -> Iterator[Floats]:
    """Yield the CUSUM of every row in all draws, in an array that the caller may reset in part."""
    slope, offset = (line[:, None] for line in standards.line)
    total, x = np.zeros((2, len(slope), matrix.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for row in matrix:
            np.multiply(slope, row, out=x)
            x -= offset
            total += x
            np.fmax(total, 0.0, out=total)
            yield total


def _stacked(episodes: Sequence[Floats]) -> Floats:
    """Return scores as columns of a matrix, so low that no sum survives where there is none."""
    matrix = np.full((max(map(len, episodes), default=0), len(episodes)), _NEVER)
    for column, scores in zip(matrix.T, episodes, strict=True):
        column[: len(scores)] = np.where(np.isnan(scores), _NEVER, scores)
    return matrix
