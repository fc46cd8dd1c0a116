"""Detection thresholds: the weakest strength of an anomaly that is found in half of the episodes.

An anomaly is recorded at several strengths, the rungs of a ladder. The share of episodes in which a
detector finds it is made monotone (isotonic regression), and the strength at which it reaches one
half is read off between rungs, in the logarithm of the strength. Where the weakest rung is found
often enough already, or the strongest is not, the threshold is *censored*: known to lie below or
above the ladder.

Resamples draw test episodes as `metrics.bootstrap` does, so that thresholds of several detectors
are paired; detector seeds are fixed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.bootstrap import LEVEL, shared_weights

Floats = NDArray[np.float64]

HALF: Final = 0.5
"""Share of the episodes in which an anomaly at the threshold is found."""

_NOTHING: Final = 1e-9  # weight of a rung without episodes: it takes the share of the rung below
_ROUNDING: Final = 1e-8  # what such weights may take off a share


def crossing(shares: Floats, strengths: Floats) -> Floats:
    """Return the logarithm of the strength at which shares reach one half: shape (...).

    `shares` of episodes do not decrease along the K rungs: shape (K, ...); nor do `strengths`,
    which are positive: shape (K,). Between rungs it is linear in the logarithm. It is minus
    infinity where the weakest rung has one half already, infinity where the strongest has less.

    >>> np.exp(crossing(np.array([[0.0], [0.25], [0.75]]), np.array([1.0, 4.0, 16.0]))).round(9)
    array([8.])
    """
    logs = np.log(strengths)
    few = (shares < HALF - _ROUNDING).sum(axis=0)
    above = np.minimum(np.maximum(few, 1), len(logs) - 1)
    below = np.maximum(above - 1, 0)
    low, high = (np.take_along_axis(shares, k[None], axis=0)[0] for k in (below, above))
    part = np.clip((HALF - low) / np.maximum(high - low, _ROUNDING), 0.0, 1.0)
    between = logs[below] + part * (logs[above] - logs[below])
    return np.where(few == 0, -np.inf, np.where(few == len(logs), np.inf, between))


@dataclass(frozen=True, slots=True, eq=False)
class DetectionThreshold:
    """The threshold of a detector for one anomaly in one environment, made by `of`.

    `weakest` and `strongest` are the ends of its ladder. `logs` are logarithms of the threshold, of
    the episodes as they are first and then of every resample: shape (1 + R,). Minus infinity is
    below the ladder, infinity above it; the first is NaN where no episode counts.
    """

    weakest: float
    strongest: float
    logs: Floats

    @classmethod
    def of(
        cls, environment: str, strengths: Sequence[float], detected: Floats, counted: Floats
    ) -> "DetectionThreshold":
        """Estimate the threshold; those of one environment are resampled with the same episodes.

        Parameters
        ----------
        environment
            Its name.
        strengths
            Strengths of the K rungs: positive, none smaller than the one before.
        detected
            1 where a detector seed found an episode's anomaly in time, else 0: shape (detector
            seeds, K, episodes). An episode is of the same test seed on every rung.
        counted
            0 for an episode that does not count, such as one with an early alarm, else 1: the same
            shape.

        Raises
        ------
        ValueError
            For other strengths.
        """
        ends = np.asarray(strengths, dtype=np.float64)
        if len(ends) != detected.shape[1] or not (ends > 0).all() or (np.diff(ends) < 0).any():
            raise ValueError(
                f"strengths {ends.tolist()} of {detected.shape[1]} rungs: expected as many "
                "positive numbers, the weakest first"
            )
        drawn_found, drawn_total = (_drawn(environment, terms) for terms in (detected, counted))
        empty = drawn_total == 0
        totals = np.where(empty, _NOTHING, drawn_total)
        shares = drawn_found / totals
        # Most resamples rise by themselves, and stay what they are.
        falling = empty.any(axis=0) | (shares[1:] < shares[:-1]).any(axis=0)
        shares[:, falling] = isotonic(drawn_found[:, falling], totals[:, falling])
        logs = crossing(shares, ends)
        if empty[:, 0].all():
            logs[0] = np.nan
        return cls(float(ends[0]), float(ends[-1]), logs)

    @property
    def value(self) -> float:
        """The threshold: 0 below the ladder, infinity above it, NaN where no episode counts."""
        return float(np.exp(self.logs[0]))

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval, whose ends are 0 or infinity where they are beyond the ladder."""
        low, high = _ends(self.logs)
        return math.exp(low), math.exp(high)

    @property
    def beyond(self) -> int:
        """-1 where it is below the ladder, 1 where it is above it, else 0."""
        return int(np.sign(self.logs[0])) if np.isinf(self.logs[0]) else 0

    @property
    def within(self) -> Floats:
        """`logs`, those beyond the ladder replaced by the end that they are beyond."""
        return np.clip(self.logs, math.log(self.weakest), math.log(self.strongest))

    def text(self, value: float) -> str:
        """Return a threshold, or an end of its interval, as printed.

        >>> threshold = DetectionThreshold(0.5, 8.0, np.zeros(1))
        >>> [threshold.text(x) for x in (0.0, 2.34567, math.inf)]
        ['≤0.5', '2.35', '>8']
        """
        if value == 0:
            return f"≤{self.weakest:.3g}"
        return f">{self.strongest:.3g}" if math.isinf(value) else f"{value:.3g}"


class MeanThreshold(NamedTuple):
    """The geometric mean of thresholds, each over a unit of its own, with its 95 % interval.

    `below` and `above` of its `pairs` of environment and anomaly are censored, and count as the
    end of the ladder that they are beyond. `side` says what that makes of the mean: ``"≤"`` where
    the true one is at most this, ``">"`` where it is more, ``"~"`` where it may be either.
    """

    value: float
    low: float
    high: float
    pairs: int
    below: int
    above: int
    side: str

    def text(self, *, interval: bool = True) -> str:
        """Return the mean as printed.

        >>> MeanThreshold(0.5, 0.25, 1.0, pairs=7, below=1, above=0, side="≤").text()
        '≤0.5 [0.25, 1]'
        """
        ends = f" [{self.low:.3g}, {self.high:.3g}]" if interval else ""
        return f"{self.side}{self.value:.3g}{ends}"


def geometric_mean(
    thresholds: Sequence[DetectionThreshold], units: Sequence[DetectionThreshold | float]
) -> MeanThreshold:
    """Return the geometric mean of the ratios of thresholds, at least one, to units.

    Units are as many strengths, or thresholds of another detector at the same places, whose
    resamples are then paired with these.
    """
    ratios, censored, sides = [], [], set()
    for threshold, unit in zip(thresholds, units, strict=True):
        other = unit.within if isinstance(unit, DetectionThreshold) else math.log(unit)
        ratios.append(threshold.within - other)
        censored.append(threshold.beyond)
        if unit is not threshold:
            sides |= {threshold.beyond, -unit.beyond if isinstance(unit, DetectionThreshold) else 0}
    logs = np.mean(ratios, axis=0)
    low, high = _ends(logs)
    return MeanThreshold(
        math.exp(logs[0]),
        math.exp(low),
        math.exp(high),
        len(ratios),
        censored.count(-1),
        censored.count(1),
        "~" if {-1, 1} <= sides else "≤" * (-1 in sides) + ">" * (1 in sides),
    )


def _drawn(environment: str, terms: Floats) -> Floats:
    """Return sums of terms (seeds, K, n) over all, then over each resample: (K, 1 + R)."""
    # The terms are 0 and 1, so that their sums are exact in any order. Detector seeds are fixed.
    total = terms.sum(axis=0)
    weights = shared_weights(environment, total.shape[1])
    return np.concatenate([total.sum(axis=1)[:, None], total @ weights.T], axis=1)


def _ends(logs: Floats) -> tuple[float, float]:
    """Return the percentiles of resamples, which may be infinite, next beyond the level."""
    # The interval contains the value itself, which comes first.
    ordered = np.sort(logs[1:])
    last = len(ordered) - 1
    low = ordered[math.floor((1 - LEVEL) / 2 * last)]
    high = ordered[math.ceil((1 + LEVEL) / 2 * last)]
    return min(float(low), float(logs[0])), max(float(high), float(logs[0]))


def isotonic(counts: Floats, total: Floats) -> Floats:
    """Return the non-decreasing shares that are nearest to `counts` / `total`, weighted by `total`.

    Least squares; the min-max formula of isotonic regression (Barlow et al. 1972), for many columns
    at once. Shapes are (K, ...), by rung; no total may be 0. At rung k it is the largest, over the
    rungs i up to k, of the smallest pooled share of i to j, over the rungs j from k on. That is
    what pooling adjacent violators gives.

    >>> isotonic(np.array([1.0, 3.0, 1.0, 4.0]), np.array([4.0, 4.0, 4.0, 4.0])).tolist()
    [0.25, 0.5, 0.5, 1.0]
    """
    shares = np.full_like(counts, -np.inf)
    for i in range(len(shares)):
        pooled = counts[i:].cumsum(axis=0) / total[i:].cumsum(axis=0)
        smallest = np.minimum.accumulate(pooled[::-1], axis=0)[::-1]
        np.maximum(shares[i:], smallest, out=shares[i:])
    return shares
