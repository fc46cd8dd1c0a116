"""Coefficients of a probability of failure, from rows of episodes whose outcomes are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from oodd_common.charts import Floats, product

from oodd_eval.plugins.forecasting import CONSTANT

FREE: Final = 1e-6
"""Precision of the intercept, which is not shrunk but has to be determined."""

MOST_STEPS: Final = 100
LONGEST_STEP: Final = 4.0
"""Change of any row's log odds in one step of Newton's method, at most."""

CONVERGED: Final = 1e-9
"""Change of any coefficient below which a fit ends."""


class LogOdds(NamedTuple):
    """Log odds of failure that are linear in K features: ``((x - centre) / unit, 1) @ weights``."""

    centre: Floats  # (K,)
    unit: Floats  # (K,)
    weights: Floats  # (K + 1,), the intercept last

    def __call__(self, features: Floats) -> Floats:
        """Return probabilities of failure, from (N, K) to (N,).

        Those of a row do not depend on the rows that follow, to the last bit.
        """
        columns = standardized(features, self.centre, self.unit)
        return probabilities(product(columns, self.weights[:, None])[:, 0])


def probabilities(log_odds: Floats) -> Floats:
    """Return probabilities of log odds, however large.

    Examples
    --------
    >>> probabilities(np.array([-1e9, 0.0, 1e9])).tolist()
    [0.0, 0.5, 1.0]
    """
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def standardized(features: Floats, centre: Floats, unit: Floats) -> Floats:
    """Return features with mean and unit taken away, and a column of ones: (N, K) to (N, K + 1)."""
    return np.column_stack([(features - centre) / unit, np.ones(len(features))])


def weights_of(lengths: NDArray[np.int64], outcomes: Floats) -> Floats:
    """Return the weight of each row: those of an episode share one, each outcome has half of all.

    From the lengths and outcomes (0 or 1) of E episodes, both of which occur. The sum is E.

    Examples
    --------
    >>> weights_of(np.array([2, 1, 1]), np.array([1.0, 0.0, 0.0])).tolist()
    [0.75, 0.75, 0.75, 0.75]
    """
    count = len(outcomes)
    failed = outcomes.sum()
    each = np.where(outcomes > 0, count / 2 / failed, count / 2 / (count - failed))
    return np.repeat(each / lengths, lengths)


def following(values: NDArray[Any], last: NDArray[np.int64], end: ArrayLike) -> NDArray[Any]:
    """Return the values of the next rows, and `end` after the last row of each episode.

    Examples
    --------
    >>> following(np.array([0.1, 0.2, 0.3]), np.array([1, 2]), [1.0, 0.0]).tolist()
    [0.2, 1.0, 0.0]
    """
    shifted = np.roll(values, -1, axis=0)
    shifted[last] = end
    return shifted


def learn(episodes: Sequence[Floats], outcomes: Floats, ridge: float, *, temporal: bool) -> LogOdds:
    r"""Return the log odds that fit the outcomes, or the probabilities of the next rows.

    With p the probabilities of rows with features x, y the outcome of their episode and w
    `weights_of`, logistic regression solves

    .. math:: \sum_t w_t (p_t - q_t) x_t + \rho \beta = 0

    for :math:`q_t = y`. Temporal differences solve it for :math:`q_t = p_{t+1}`, and y after the
    last row. Both are solved by Newton's method, the second one from the solution of the first. If
    coefficients still change after 100 steps, the latest ones stand.

    Parameters
    ----------
    episodes : sequence of arrays of shape (N, K)
        Features of the rows of E episodes.
    outcomes : array of shape (E,)
        1 for a failure, else 0; both occur.
    ridge
        :math:`\rho`, of standardized features.
    temporal
        Whether targets are the probabilities of the next rows.

    Returns
    -------
    LogOdds
    """
    lengths = np.array([len(x) for x in episodes])
    w, last = weights_of(lengths, outcomes), np.cumsum(lengths) - 1
    rows, y = np.concatenate(episodes), np.repeat(outcomes, lengths)
    centre = np.average(rows, axis=0, weights=w)
    unit = np.sqrt(np.average((rows - centre) ** 2, axis=0, weights=w))
    unit = np.where(unit < CONSTANT, 1.0, unit)
    x = standardized(rows, centre, unit)
    precision = np.append(np.full(len(centre), ridge), FREE)
    beta = np.zeros(len(precision))
    weighted = (x * w[:, None]).T
    for bootstrapped in (False, True)[: 1 + temporal]:
        for _ in range(MOST_STEPS):
            p = probabilities(x @ beta)
            slopes = (p * (1 - p))[:, None] * x
            errors, changes = p - y, slopes
            if bootstrapped:
                errors = p - following(p, last, outcomes)
                changes = slopes - following(slopes, last, 0.0)
            gradient = weighted @ errors + precision * beta
            step = np.linalg.solve(weighted @ changes + np.diag(precision), gradient)
            beta = beta - step * min(1.0, LONGEST_STEP / max(abs(x @ step).max(), CONVERGED))
            if abs(step).max() < CONVERGED:
                break
    return LogOdds(centre, unit, beta)
