"""A permutation test of drift: nominal episodes against their recorded order, without a detector.

A promise on false alarms holds for episodes that are exchangeable with those of the calibration.
Machines drift, and then it breaks.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
