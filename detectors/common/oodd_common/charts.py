"""The multivariate EWMA chart: exponentially weighted residuals and their Mahalanobis distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BLOCK: Final = 64
"""Rows that are multiplied by a matrix at once."""


def smooth(residuals: Floats, weights: Sequence[float]) -> Floats:
    r"""Return exponentially weighted residuals, scaled to the variance of a single residual.

    .. math:: z_n = (1 - \lambda) z_{n-1} + \lambda u_n, \quad z_0 = 0, \quad
              \tilde z_n = z_n \Big/ \sqrt{\tfrac{\lambda}{2 - \lambda} (1 - (1 - \lambda)^{2n})}

    The divisor is exact from the first step on: for residuals :math:`u` without autocorrelation
    :math:`\tilde z_n` has the covariance of :math:`u` at every n, so the start needs no warm-up.

    From (N, D), in the order of time, to (W, N, D) for W weights in (0, 1]. Small ones have a long
    memory, of about 1 / weight steps.

    Examples
    --------
    >>> smooth(np.array([[3.0], [3.0]]), [1.0])[0].tolist()
    [[3.0], [3.0]]
    """
    return Smoother(weights, residuals.shape[1])(residuals)


class Smoother:
    """`smooth` in parts: each call continues where the last one ended."""

    def __init__(self, weights: Sequence[float], sensors: int) -> None:
        self._weight = np.asarray(weights, dtype=np.float64)[:, None]  # (W, 1)
        self._keep = 1.0 - self._weight
        self._kept, self._settled = self._keep**2, self._weight / (2.0 - self._weight)
        self._z = np.zeros((len(weights), sensors))
        self._forgotten = np.ones((len(weights), 1))

    def __call__(self, residuals: Floats) -> Floats:
        """Return the next N scaled, weighted residuals, (W, N, D), from residuals (N, D)."""
        w, d = self._z.shape
        smoothed, forgotten = np.empty((w, len(residuals), d)), np.empty((w, len(residuals), 1))
        for t, u in enumerate(residuals):
            self._z = self._keep * self._z + self._weight * u
            # A running product, not a power: its first n factors are the same however many follow.
            self._forgotten = self._forgotten * self._kept
            smoothed[:, t], forgotten[:, t] = self._z, self._forgotten
        smoothed /= np.sqrt(self._settled[:, None] * (1.0 - forgotten))
        return smoothed


def limited(values: Floats, limit: float) -> Floats:
    """Return values from -limit to limit, in half of the time that `numpy.clip` takes for a row."""
    return np.minimum(np.maximum(values, -limit), limit)


def whitening(covariance: Floats, shrinkage: float) -> Floats:
    """Return the matrix M such that ``|x M|`` is the Mahalanobis length of the row x.

    The covariance is shrunk towards the identity, which bounds what a combination of sensors that
    hardly varies in nominal operation, or a constant sensor, can contribute. The shrinkage is the
    identity's share, in (0, 1].
    """
    shrunk = (1.0 - shrinkage) * covariance + shrinkage * np.eye(len(covariance))
    root: Floats = np.linalg.inv(np.linalg.cholesky(shrunk)).T
    return root


def distance(rows: Floats, root: Floats) -> Floats:
    """Return the Mahalanobis lengths of rows of shape (N, D), given `whitening`'s matrix."""
    whitened = product(rows, root)
    lengths: Floats = np.sqrt((whitened * whitened).sum(axis=1))
    return lengths


def product(rows: Floats, matrix: Floats, block: int = BLOCK) -> Floats:
    """Return ``rows @ matrix`` such that the bits of a row do not depend on how many follow it.

    A matrix product picks its order of summation by the shapes. Blocks of one fixed shape, the last
    one filled up with zeros, make the scores of a prefix the prefix of the scores exactly. A single
    row costs as much as a `block` of them: a small one is for large matrices and for streams.

    From (N, K) and (K, M) to (N, M).
    """
    (n, k), (_, m) = rows.shape, matrix.shape
    if n <= block:
        few = np.zeros((block, k))
        few[:n] = rows
        few_multiplied: Floats = np.matmul(few, matrix)[:n]
        return few_multiplied
    count = -(-n // block)
    filled = np.zeros((count * block, k))
    filled[:n] = rows
    multiplied: Floats = np.matmul(filled.reshape(count, block, k), matrix)
    return multiplied.reshape(count * block, m)[:n]


class Onset:
    """The row with which an anomaly would have begun: where a CUSUM of scores last left zero.

    Parameters
    ----------
    reference
        Score that a row must exceed to count as anomalous.
    first
        Number of the first row that has a score.

    Notes
    -----
    Source: Page, "Continuous inspection schemes", Biometrika 41 (1954).

    Examples
    --------
    >>> onset = Onset(reference=2.0, first=1)
    >>> [onset(score) for score in (0.0, 5.0, 1.0, 3.0, 0.0)]
    [1, 2, 2, 2, 2]
    """

    def __init__(self, reference: float, first: int) -> None:
        self._reference, self._sum, self._now, self._onset = reference, 0.0, first, first

    def __call__(self, score: float) -> int:
        """Return the onset as seen at the next row, of this score."""
        if self._sum <= 0:
            self._onset = self._now
        self._sum = max(0.0, self._sum + score - self._reference)
        self._now += 1
        return self._onset


def shares_of(parts: Floats) -> Floats:
    """Return shares of the sum of each row, (N, D), equal ones where the sum is 0.

    From contributions that are not negative.

    Examples
    --------
    >>> shares_of(np.array([[3.0, 1.0], [0.0, 0.0]])).tolist()
    [[0.75, 0.25], [0.5, 0.5]]
    """
    total = parts.sum(axis=1, keepdims=True)
    return np.where(total > 0, parts / np.where(total > 0, total, 1.0), 1.0 / parts.shape[1])
