"""Ridge vector autoregression whose coefficients may differ from episode to episode.

A payload, a gain or a wind that is drawn anew for every episode moves the coefficients. How far
they move is learnt from the training episodes; from an episode's first rows follows, by Bayesian
linear regression, where they are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, limited, product
from oodd_common.windows import StandardEpisode, regressors

ORDER: Final = 3
"""Latest observations, and actions, that a forecast uses."""
RIDGES: Final = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Penalties that are tried, relative to the mean square of a standardized sensor."""
LEAST_SCALE: Final = 1e-3
"""Least scale of a residual, in training standard deviations: no forecast is trusted further."""
STEPS: Final = 8
"""Steps of expectation and maximization."""
SURPRISE: Final = 4.0
"""Scales to which an error is limited before an episode's coefficients follow it."""
WILD: Final = 10.0
"""Limit of an error, in training standard deviations, where penalties are compared."""
ROWS: Final = 8
"""Rows that are multiplied by a matrix at once: few, as a stream pays for all of them."""


class _Moments(NamedTuple):
    gram: Floats  # (K, K)
    cross: Floats  # (K, D)
    square: Floats  # (D, D)
    rows: int

    @classmethod
    def of(cls, episode: StandardEpisode, horizon: int) -> _Moments:
        x, y = regressors(episode, horizon, ORDER), episode.rows[horizon:]
        return cls(x.T @ x, x.T @ y, y.T @ y, len(x))


def _total(moments: Sequence[_Moments]) -> _Moments:
    gram, cross, square, rows = zip(*moments, strict=True)
    return _Moments(sum(gram), sum(cross), sum(square), sum(rows))


def _solve(moments: _Moments, ridge: float) -> Floats:
    # The last regressor is the constant and goes unpunished, but for what makes it solvable.
    penalty = np.full(len(moments.gram), max(ridge, 1e-9) * moments.rows)
    penalty[-1] = 1e-9 * moments.rows
    return np.asarray(np.linalg.solve(moments.gram + np.diag(penalty), moments.cross), np.float64)


def chosen_ridge(folds: Sequence[Sequence[StandardEpisode]], horizon: int) -> float:
    """Return the penalty whose forecasts of folds that were left out err least."""
    if len(folds) < 2:
        return RIDGES[len(RIDGES) // 2]
    moments = [[_Moments.of(x, horizon) for x in fold] for fold in folds]
    errors = np.zeros(len(RIDGES))
    for i, fold in enumerate(folds):
        rest = _total([m for j, fold_moments in enumerate(moments) if j != i for m in fold_moments])
        solved = [_solve(rest, ridge) for ridge in RIDGES]
        for x in fold:
            regressed = regressors(x, horizon, ORDER)
            for r, coefficients in enumerate(solved):
                error = np.clip(x.rows[horizon:] - regressed @ coefficients, -WILD, WILD)
                errors[r] += (error**2).sum()
    return RIDGES[int(errors.argmin())]


class LinearForecast(NamedTuple):
    """A fitted forecast.

    Attributes
    ----------
    coefficients
        Means of the coefficients over episodes, (K, D).
    scale
        Standard deviations of the errors, (D,).
    prior
        Covariance of an episode's coefficients, in units of the variance of an error, (K, K); of
        shape (0, 0) where they are the same in all episodes.
    """

    coefficients: Floats
    scale: Floats
    prior: Floats

    @classmethod
    def fit(
        cls, episodes: Sequence[StandardEpisode], horizon: int, ridge: float, *, varies: bool
    ) -> LinearForecast:
        """Fit to standardized episodes; with coefficients of each episode where these vary.

        The mean, the covariance of coefficients and that of errors are found by expectation and
        maximization (Laird & Ware, "Random-effects models for longitudinal data", 1982).
        """
        moments = [_Moments.of(x, horizon) for x in episodes]
        total = _total(moments)
        mean = _solve(total, ridge)
        noise = _errors(total, mean) / total.rows
        prior = np.empty((0, 0))
        if varies:
            k, d = mean.shape
            prior = 1e-3 * np.eye(k)
            for _ in range(STEPS):
                precision = np.linalg.inv(prior + 1e-10 * np.eye(k))
                weight = np.linalg.inv(noise + 1e-9 * np.eye(d))
                covariances = [np.linalg.inv(m.gram + precision) for m in moments]
                own_means = [
                    c @ (m.cross + precision @ mean)
                    for c, m in zip(covariances, moments, strict=True)
                ]
                mean = np.mean(own_means, axis=0)
                squares = sum(_errors(m, b) for m, b in zip(moments, own_means, strict=True))
                noise = np.asarray(squares) / total.rows
                spread = sum((b - mean) @ weight @ (b - mean).T for b in own_means)
                prior = (spread + d * sum(covariances)) / (len(moments) * d)
        variance = np.maximum(np.diag(noise), 0.0)
        return cls(mean, np.maximum(np.sqrt(variance), LEAST_SCALE), prior)

    def __call__(self, regressed: Floats) -> Floats:
        """Return forecasts with the mean coefficients: (N, K) to (N, D)."""
        return product(regressed, self.coefficients, ROWS)


def _errors(moments: _Moments, coefficients: Floats) -> Floats:
    """Return the sums of products of errors, (D, D)."""
    explained = coefficients.T @ moments.cross
    return (
        moments.square
        - explained
        - explained.T
        + coefficients.T @ moments.gram @ coefficients
    )  # fmt: skip


class EpisodeLearner:
    """The coefficients of one episode, learnt from its first rows.

    Parameters
    ----------
    forecast
        The fitted forecast.
    rows
        Number of errors from which is learnt. Later ones are only judged: what changes then is a
        change.
    """

    def __init__(self, forecast: LinearForecast, rows: int) -> None:
        self._forecast = forecast
        self.coefficients, self._covariance = forecast.coefficients, forecast.prior
        self._left = rows if len(forecast.prior) else 0

    def __call__(self, regressed: Floats, observed: Floats) -> Floats:
        """Return the next N errors on the scale that was expected, (N, D).

        From regressors (N, K) and standardized rows (N, D).
        """
        errors = np.empty(observed.shape)
        first = min(self._left, len(errors))
        for t in range(first):
            errors[t] = self._step(regressed[t], observed[t])
        self._left -= first
        x = regressed[first:]
        error = observed[first:] - product(x, self.coefficients, ROWS)
        variance = 1.0
        if len(self._covariance):
            spread = product(x, self._covariance, ROWS) * x
            variance = 1.0 + spread.sum(axis=1, keepdims=True)
        errors[first:] = error / (self._forecast.scale * np.sqrt(variance))
        return errors

    def _step(self, x: NDArray[np.float64], observed: NDArray[np.float64]) -> Floats:
        spread = self._covariance @ x
        variance = 1.0 + float(x @ spread)
        scale = self._forecast.scale * np.sqrt(variance)
        error: Floats = (observed - x @ self.coefficients) / scale
        gain = spread / variance
        self.coefficients = self.coefficients + np.outer(gain, limited(error, SURPRISE) * scale)
        self._covariance = self._covariance - np.outer(gain, spread)
        return error
