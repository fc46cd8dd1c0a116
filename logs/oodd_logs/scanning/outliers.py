"""Odd ones among many episodes, found by their largest statistics alone.

A rank among n others is never below 1 / (n + 1), so that a rank alone rejects nothing where all
episodes are tested against one another: the k-th smallest of n such p-values is k / n. Beyond the
median a p-value is therefore read from a tail, whose shape is assumed: how rare false discoveries
are then is known from simulations and is no guarantee. Ranks among episodes that are kept apart are
p-values whatever the distribution, and with enough of these nothing has to be assumed.

Windows of one recording count once: they have weights that sum to 1, and n is the number of
recordings.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

LEAST: Final = 8
"""Episodes from which on a tail can be estimated from the others."""
ENOUGH: Final = 20
"""Episodes from which on a tail finds what stands out."""
ODD_SHARE: Final = 0.2
"""Share of the others that may be odd, too, without a word in the tail: the largest of them."""
MOST_ODD: Final = 0.35
"""Share of the others that may be odd without hiding one another in a ranking."""
_ROUNDING: Final = 1e-9  # of an episode
_MOST: Final = 300.0  # surprise up to which statistics are told apart


@dataclass(frozen=True, slots=True)
class Tail:
    """The tail of the largest statistics of nominal episodes, beyond their median.

    Cube roots of statistics beyond the median are taken to exceed it by exponential amounts;
    whatever falls off faster, such as exponential or most log-normal statistics, has fewer large
    values than is said here. The mean of the amounts is estimated twice: from all episodes, and
    from all but the largest fifth, which counts as censored, so that odd episodes among the others
    do not hide one another. From either estimate the p-value of one more episode is exact, as the
    ratio of an exponential amount and a mean of r others has Fisher's distribution with 2 and 2 r
    degrees of freedom; the smaller one is doubled.

    Attributes
    ----------
    start
        The median.
    share
        Chance that a further episode lies beyond the median.
    estimates
        Mean of the amounts, and the number r of them that it is from.
    """

    start: float
    share: float
    estimates: tuple[tuple[float, float], ...]

    @classmethod
    def fit(cls, others: Floats, weights: Floats | None = None) -> "Tail | None":
        """Estimate the tail; None where there are too few episodes, or ties leave no spread.

        Parameters
        ----------
        others : float64 array of shape (n,)
            Largest statistic of each other episode.
        weights : float64 array of shape (n,), optional
            Of these, 1 for one episode a recording; by default all 1.

        Returns
        -------
        Tail or None
        """
        order = np.argsort(others, kind="stable")
        ordered = others[order]
        weighed = np.ones(len(others)) if weights is None else weights[order]
        n, up_to = round(weighed.sum()), np.cumsum(weighed)
        middle = int(np.searchsorted(up_to, (n + 1) // 2 - _ROUNDING)) + 1
        if n + 1 < LEAST or not math.isfinite(ordered[middle - 1]):
            return None
        start, below = float(ordered[middle - 1]), float(up_to[middle - 1])
        amounts, beyond = np.cbrt(ordered[middle:]) - np.cbrt(start), up_to[middle:] - below
        estimates = []
        for most in (n - below, math.floor((1 - ODD_SHARE) * n) - below):
            seen = int(np.searchsorted(beyond, most + _ROUNDING, side="right"))
            # Of a censored amount is known that it is at least the largest other.
            if seen and 0 < (largest := float(amounts[seen - 1])) < math.inf:
                r = float(beyond[seen - 1])
                total = float((weighed[middle:] * amounts)[:seen].sum()) + (n - below - r) * largest
                estimates.append((total / r, r))
        share = (n + 1 - below) / (n + 1)
        return cls(start, share, tuple(estimates)) if estimates else None

    def surprise(self, largest: ArrayLike) -> Floats:
        """Return ``-log p`` of values: how rarely a nominal episode's largest one is as large.

        Parameters
        ----------
        largest
            Statistics.

        Returns
        -------
        float64 array
            0 up to the median.
        """
        values = np.asarray(largest, np.float64)
        amounts = np.maximum(np.cbrt(values) - np.cbrt(self.start), 0.0)
        logs = [r * np.log1p(amounts / mean / r) for mean, r in self.estimates]
        best = np.max(logs, axis=0) - math.log(len(self.estimates) * self.share)
        return np.where(values > self.start, np.maximum(best, 0.0), 0.0)

    def value(self, surprise: ArrayLike) -> Floats:
        """Return the statistics with such a ``-log p``, minus infinity up to the median.

        Parameters
        ----------
        surprise
            Of any shape.

        Returns
        -------
        float64 array
        """
        values = np.asarray(surprise, np.float64)
        logs = np.clip(values + math.log(len(self.estimates) * self.share), 0.0, _MOST)
        amounts = [mean * r * np.expm1(logs / r) for mean, r in self.estimates]
        roots = np.cbrt(self.start) + np.min(amounts, axis=0)
        return np.where(values > -math.log(self.share), roots**3, -np.inf)


def surprise(value: float, others: Floats, weights: Floats | None = None) -> float:
    """Return ``-log p`` of a value: from the tail beyond the others' median, else from its rank.

    >>> round(math.exp(-surprise(3.0, np.array([1.0, 2.0, 3.0]))), 3)
    0.5
    """
    tail = Tail.fit(others, weights)
    if tail is None or value <= tail.start:
        return -math.log(rank_p(value, others, weights))
    return float(tail.surprise(value))


def mean_beyond(values: Floats, odd: float = ODD_SHARE) -> float:
    """Return by how much values exceed their median, with a share of the largest censored.

    Surprises of nominal episodes, which fall off exponentially, do so by 1.
    """
    ordered = np.sort(values)
    n, middle = len(ordered), (len(ordered) + 1) // 2
    above = ordered[middle:] - ordered[middle - 1 : middle]
    seen = max(1, math.floor((1 - odd) * n) - middle)
    return float(np.minimum(above, above[seen - 1 : seen].max(initial=0.0)).sum() / seen)


def rank_p(largest: float, others: Floats, weights: Floats | None = None) -> float:
    """Return the conformal p-value: a rank among the others, ties counted against the episode.

    >>> rank_p(3.0, np.array([1.0, 2.0, 3.0]))
    0.5
    """
    weighed = np.ones(len(others)) if weights is None else weights
    return float((1 + weighed[others >= largest].sum()) / (weighed.sum() + 1))


def rank_threshold(p: float, others: Floats, weights: Floats | None = None) -> float:
    """Return the least statistic whose rank among the others is a p-value of at most this.

    >>> others = np.array([1.0, 2.0, 3.0])
    >>> rank_p(rank_threshold(0.5, others), others), rank_p(2.0, others)
    (0.5, 0.75)
    """
    order = np.argsort(-others, kind="stable")
    from_top = np.cumsum(np.ones(len(others)) if weights is None else weights[order])
    most = p * (from_top[-1] + 1) - 1 + _ROUNDING
    above = int(np.searchsorted(from_top, most, side="right"))
    return float(np.nextafter(others[order][above], np.inf)) if most >= 0 else math.inf


def q_values(p: Floats) -> Floats:
    """Return Benjamini and Hochberg's q-values: the smallest rate at which each is rejected.

    >>> q_values(np.array([0.01, 0.4, 0.02])).round(3).tolist()
    [0.03, 0.4, 0.03]
    """
    n, order = len(p), np.argsort(p, kind="stable")
    scaled = p[order] * n / np.arange(1, n + 1)
    values = np.empty(n)
    values[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return values


def critical_p(p: Floats, fdr: float) -> float:
    """Return the largest p-value that is rejected, or would be if it were the only one."""
    return fdr * max(1, int(np.count_nonzero(q_values(p) <= fdr))) / len(p)
