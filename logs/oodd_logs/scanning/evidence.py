"""Evidence about one episode: of a detector, of the stream, and of its figures as a whole.

Each has a surprise, ``-log p``. What is odd by chance is shared out among them, so that the
smallest p-value over its share is one, too. A ranking promises nothing and needs no tail: it goes
by how far an episode is beyond the median of the others, in units of the middle ones.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.alarms import joined, numbered, window_weights
from oodd_eval.metrics.faults import KINDS, StreamScale
from oodd_eval.plugins.explanations import Explanation
from oodd_logs.episodes import Episode
from oodd_logs.marks import runs_of
from oodd_logs.scanning.episode_faults import EpisodeFault
from oodd_logs.scanning.figures import Figure
from oodd_logs.scanning.outliers import ENOUGH, LEAST, MOST_ODD, Tail, mean_beyond, surprise

Floats = NDArray[np.float64]

_NAMED: Final = 2  # sensors in a reason

SHARES: Final = (0.5, 0.1, 0.4)
"""Of score, stream and figures in what is odd by chance."""
SCORE, STREAM, FIGURES = map(math.log, SHARES)


class Peers(NamedTuple):
    """Numbers of the episodes that one is compared with, and their weights."""

    numbers: list[int]
    weights: Floats

    @classmethod
    def of(cls, episodes: Sequence[Episode], i: int, among: Sequence[int]) -> "Peers":
        """Return others of the same task and of other recordings, where these suffice.

        Windows of a recording count once, unless recordings are too few to judge by.
        """
        candidates = [j for j in among if j != i]
        same = [j for j in candidates if episodes[j].task == episodes[i].task]
        peers = same if len(same) + 1 >= LEAST else candidates
        others = [j for j in peers if episodes[j].recording != episodes[i].recording]
        recordings = numbered([episodes[j].recording for j in others], len(others))
        if len({*recordings.tolist()}) + 1 < LEAST:
            others, recordings = peers, np.arange(len(peers))
        return cls(others, window_weights(recordings))

    @property
    def units(self) -> int:
        """Number of recordings, or of windows that count as such."""
        return round(float(self.weights.sum()))


class Readings(NamedTuple):
    """Readings of an episode, and the scale of their faults."""

    scale: StreamScale
    rows: NDArray[Any]
    judged: NDArray[Any] | None

    @classmethod
    def of(cls, scale: StreamScale, rows: NDArray[Any], judged: NDArray[Any] | None) -> "Readings":
        """Take readings: a sensor that stays where it is largest or least is at an end, too."""
        limits = scale.limits
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # sensors without a reading
            low = np.fmax(limits.low, np.nanmin(rows, axis=0))
            high = np.fmin(limits.high, np.nanmax(rows, axis=0))
        return cls(replace(scale, limits=replace(limits, low=low, high=high)), rows, judged)

    @property
    def surprise(self) -> Floats:
        """The surprise of every row, in which being at an end of a range or beyond is none."""
        # A beam that meets nothing and a hand that is closed stay there; how far a sensor is from
        # its range is among the figures of the episode.
        is_muted = np.isin(KINDS, ["saturated", "out of range"])
        start = np.where(is_muted, np.inf, self.scale.tails.start)
        muted = replace(self.scale, tails=self.scale.tails._replace(start=start))
        return muted.surprise(self.rows, self.judged)

    def faults(self, least: float, names: Sequence[str]) -> list[EpisodeFault]:
        """Return faults that are at least as surprising."""
        named = self.scale.faults(self.rows, self.judged, least)
        return [
            EpisodeFault(names[d] if d >= 0 else "observation", fault, row)
            for d, fault, row in named
        ]


class Finding(NamedTuple):
    """Rows and sensors of what is odd.

    Attributes
    ----------
    row, since
        The first row above the threshold, or the one with most evidence; and the one with which
        that began. None for what is missing.
    intervals
        Rows [start, stop) above the threshold.
    sensors
        Share of each sensor in the evidence at that row, by name, the largest first.
    reason
        What is oddest, in a clause.
    """

    row: int | None
    since: int | None
    intervals: tuple[tuple[int, int], ...]
    sensors: Mapping[str, float]
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeEvidence:
    """What speaks for one episode's being odd.

    Attributes
    ----------
    episode, scores
        As recorded, and by row.
    statistic
        Of the scores by row; minus infinity or NaN where there is none.
    explanation
        Of the detector; None where it gives none.
    faults
        That are listed in any case.
    trajectory, baseline
        What a detector sees, and how many of its first rows readings are compared with.
    readings, stream
        For faults of the stream, and their surprise by row; none where a watchdog judged.
    figure
        The farthest of the episode as a whole; None where a watchdog judged.
    """

    episode: Episode
    scores: Floats
    statistic: Floats
    explanation: Explanation | None
    faults: tuple[EpisodeFault, ...]
    trajectory: Trajectory
    baseline: int = 0
    readings: Readings | None = None
    stream: Floats = field(default_factory=lambda: np.zeros(1))
    figure: Figure | None = None

    @property
    def largest(self) -> float:
        """The largest statistic of the scores."""
        return float(np.nanmax(self.statistic, initial=-math.inf))

    @property
    def values(self) -> Floats:
        """Readings and their steps, (2, R, D), for what a detector does not explain."""
        rows = self.trajectory.observations.astype(np.float64)
        if self.baseline:
            rows -= rows[: self.baseline].mean(axis=0)
        return np.stack([rows, np.diff(rows, axis=0, prepend=rows[:1])])

    @property
    def sums(self) -> Floats:
        """Number, sum and sum of squares of readings and of steps, (3, 2, D)."""
        values = self.values
        sums: Floats = np.stack([np.ones_like(values), values, values**2]).sum(axis=2)
        return sums

    def joint(self, tail: Tail | None, most: float) -> Floats:
        """Return the statistic in which faults of the stream count as what is as rare.

        Parameters
        ----------
        tail
            Of the other episodes' statistics.
        most
            Surprise of the most surprising fault, with its share.
        """
        if tail is None or self.readings is None:
            return self.statistic
        stream = np.minimum(self.stream + STREAM, most)
        return joined(self.statistic, tail.value(stream - SCORE))

    def blame(
        self, usual: float, interval: tuple[int, int], other_sums: Floats
    ) -> tuple[int, Floats]:
        """Return the row with which an excursion began, and the share of each sensor in it, (D,).

        Parameters
        ----------
        usual
            Statistic that it is above from there on.
        interval
            Rows of the excursion.
        other_sums
            Of the other episodes together.
        """
        row, stop = interval
        if self.explanation is not None and self.explanation.onsets[row] >= 0:
            return int(self.explanation.onsets[row]), self.explanation.shares[row]
        quiet = np.flatnonzero(self.statistic[:row] <= usual)
        since = int(quiet[-1]) + 1 if len(quiet) else 0
        n, total, squares = other_sums[:, :, None]
        # A single episode has no others.
        mean = total / np.maximum(n, 1.0)
        std = np.sqrt(np.maximum(squares / np.maximum(n, 1.0) - mean**2, 0.0))
        least = 1e-6 * np.maximum(1.0, np.abs(mean))
        # Readings, or their steps if these are farther from those of the others.
        deviations = (np.abs(self.values - mean) / np.maximum(std, least)).max(axis=0)
        of_excursion = (deviations[since:stop] ** 2).mean(axis=0)
        return since, of_excursion / (of_excursion.sum() or 1.0)

    def listed(self, least: float, names: Sequence[str]) -> tuple[EpisodeFault, ...]:
        """Return faults that have such a surprise with their share, and those listed in any case.

        Parameters
        ----------
        least
            The surprise.
        names
            Of the sensors.
        """
        if self.readings is None:
            return self.faults
        broken = {fault.what for fault in self.faults if fault.fault == "broken"}
        faults = self.readings.faults(least - STREAM, names)
        # A broken number is what is missing.
        return (*(f for f in faults if f.what not in broken or f.fault != "missing"), *self.faults)

    def finding(
        self,
        surprises: Floats,
        joint: Floats,
        limits: tuple[float, float],
        other_sums: Floats,
        faults: Sequence[EpisodeFault],
        names: Sequence[str],
    ) -> Finding:
        """Return where the episode is odd, and why.

        Parameters
        ----------
        surprises
            Surprise of score, stream and figures.
        joint
            See `joint`.
        limits
            Statistic from which on it is odd, infinite where it is not; and what is usual.
        other_sums
            Of the other episodes together.
        faults
            Of the stream.
        names
            Of the sensors.
        """
        threshold, usual = limits
        statistic = np.where(np.isnan(joint), -np.inf, joint)
        top = int(statistic.argmax())
        reason, by_figure = "", self.figure is not None and surprises[2] >= surprises[:2].max()
        is_odd = threshold < math.inf or math.isnan(threshold)
        if by_figure and self.figure is not None:
            _, d, row, figure, value = self.figure
            reason = f"{figure} {names[d]} {value}"
            if not (is_odd and statistic[top] >= threshold):
                intervals = ((row, row + 1),) if is_odd and row is not None else ()
                return Finding(row, row, intervals, {names[d]: 1.0}, reason)
        # Rounding of the threshold may leave nothing but the largest statistic.
        above = runs_of(statistic >= np.fmin(threshold, statistic[top])) if is_odd else []
        interval = above[0] if above else (top, top + 1)
        since, values = self.blame(usual, interval, other_sums)
        causes = [f for f in faults if f.fault not in {"gap", "broken"} and f.row <= interval[0]]
        if causes and (
            self.readings is None or statistic[interval[0]] > self.statistic[interval[0]]
        ):
            cause = min(causes, key=lambda fault: fault.row)
            reason = reason or f"{cause.fault} {cause.what} from row {cause.row}"
            if self.readings is not None:
                since, faulty = cause.row, {fault.what for fault in causes}
                shares = np.array([float(name in faulty) for name in names])
                values = shares / shares.sum() if shares.any() else values
        order = np.argsort(-np.nan_to_num(values), kind="stable").tolist()
        sensors = {names[d]: float(values[d]) for d in order}
        first = [name for name, share in sensors.items() if share >= 1 / len(names)][:_NAMED]
        reason = (
            reason or f"{' and '.join(first) or 'the episode'} unlike the others from row {since}"
        )
        return Finding(interval[0], since, tuple(above), sensors, reason)


def evidence_of(
    largest: Floats, stream: Floats, distances: Floats, peers: Sequence[Peers]
) -> tuple[Floats, Floats]:
    """Return surprise and place value of score, stream and figures of each episode.

    Parameters
    ----------
    largest, stream, distances
        Largest statistic of the scores, largest surprise of the stream, distance of figures: (N,).
    peers
        Of each episode.

    Returns
    -------
    surprises : array of shape (N, 3)
        Each with its share.
    excesses : array of shape (N, 3)
        By which episodes are ranked.
    """
    surprises, excesses = np.empty((2, len(largest), 3))
    # Figures of real episodes have heavier tails than statistics of detectors.
    roots = np.sqrt(distances)
    for i, (others, weights) in enumerate(peers):
        # How long a fault lasts does not say how rare it is, where few episodes have none.
        n = round(float(weights.sum())) + 1
        usual = float(stream[i]) / max(1.0, mean_beyond(stream[others]))
        faults = min(usual, math.inf if n >= ENOUGH else math.log(n))
        tails = [surprise(float(x[i]), x[others], weights) for x in (largest, roots)]
        surprises[i] = tails[0], faults, tails[1]
        beyond = []
        for x in (largest, distances):
            unit = mean_beyond(x[others], MOST_ODD) or mean_beyond(x[others], 0.0)
            with np.errstate(invalid="ignore"):  # infinite ones
                beyond.append((x[i] - np.median(x[others])) / unit if unit > 0 else 0.0)
        excesses[i] = beyond[0], faults, beyond[1]
    shares = np.log(SHARES)
    return surprises + shares, np.nan_to_num(excesses, nan=0.0) + shares
