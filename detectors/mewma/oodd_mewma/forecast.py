"""Ridge vector autoregression: a linear forecast of an observation from the latest ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def regressors(observations: Floats, actions: Floats | None, *, order: int, horizon: int) -> Floats:
    """Return what the forecasts of ``o_f .. o_T`` may use, one row per forecast.

    f is the first time that has all regressors, ``horizon + order - 1``. The row of time t holds
    ``o_{t-h} .. o_{t-h-order+1}``, then the actions of the same times if there are any, then 1.

    From (T + 1, D) and (T, A) to (max(T + 1 - f, 0), order * (D + A) + 1).

    Examples
    --------
    >>> o = np.array([[1.0], [2.0], [3.0], [4.0]])
    >>> regressors(o, None, order=2, horizon=1).tolist()
    [[2.0, 1.0, 1.0], [3.0, 2.0, 1.0]]
    """
    newest = np.arange(order - 1, max(len(observations) - horizon, order - 1))
    times = newest[:, None] - np.arange(order)  # (N, order)
    n = len(newest)
    parts = [observations[times].reshape(n, order * observations.shape[1])]
    if actions is not None:
        parts.append(actions[times].reshape(n, order * actions.shape[1]))
    return np.concatenate([*parts, np.ones((n, 1))], axis=1)


@dataclass(frozen=True, slots=True)
class Moments:
    """Sums that decide a least-squares fit of Y by X; those of two sets of rows add up."""

    gram: Floats  # (K, K): X'X
    cross: Floats  # (K, D): X'Y

    @classmethod
    def of(cls, x: Floats, y: Floats) -> Moments:
        """Return the moments of regressors and targets with the same number of rows."""
        return cls(x.T @ x, x.T @ y)

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.gram + other.gram, self.cross + other.cross)

    def __sub__(self, other: Moments) -> Moments:
        return Moments(self.gram - other.gram, self.cross - other.cross)

    def solve(self, ridge: float) -> Floats:
        """Return the coefficients B that minimize mean |y - xB|^2 + ridge |B|^2.

        The last regressor is the constant and goes unpunished.
        """
        penalty = np.full(len(self.gram), ridge * self.gram[-1, -1])
        penalty[-1] = 0.0
        return np.asarray(np.linalg.solve(self.gram + np.diag(penalty), self.cross), np.float64)
