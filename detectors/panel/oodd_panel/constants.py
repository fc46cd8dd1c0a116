"""Charts of a forecast that knows what an episode keeps constant.

A payload, a gain or a wind moves a few numbers, and these move many coefficients together. So the
coefficients of an episode are their mean and a sum of few matrices, each times a constant of the
episode: fewer numbers to learn from its first rows than coefficients, and numbers in which a later
change can be looked for. Every sensor has charts of its own on a scale of its own, so that one
whose errors have heavy tails, a set point that jumps, hides nothing that the others show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, Smoother, limited, product
from oodd_common.windows import StandardEpisode, regressors

from oodd_eval import Trajectory
from oodd_eval.plugins.state import State, take
from oodd_panel.forecast import ROWS
from oodd_panel.voices import CHARTS, Voice

if TYPE_CHECKING:
    from oodd_panel.detector import PanelDetector

FOLDS: Final = 5
"""Parts of the nominal episodes, each judged by what was learnt from the others."""
CHARTED_EPISODES: Final = 30
"""Least episodes from which it is fitted: it judges by its largest value in each.

Of 20 episodes of 150 rows one that was left out had four times the largest statistic of the rest.
"""
CHARTED_ROWS: Final = 2500
"""Least transitions from which it is fitted."""
MOST_ROWS: Final = 200_000
"""Most rows, about, from which it is fitted, of evenly spread episodes: bounds time and memory."""
NOISY: Final = 0.2
"""Least share of sensors whose errors are noise, for charts: a linear forecast says all there is.

Worlds have .27 to .67, simulators without noise 0, and there networks forecast better.
"""
LAGS: Final = 6
"""Latest observations, and actions, that this forecast uses: noise of sensors is averaged out."""
RANKS: Final = (0, 4, 8)
"""Numbers of constants of an episode that are tried."""
LEAST_GAIN: Final = 0.005
"""Least gain in the mean logarithm of errors for which constants are learnt."""
PENALTIES: Final = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Penalties that are tried, a sensor, relative to the mean square of a standardized sensor."""
CONSTANTS_PENALTY: Final = 1e-3
"""Penalty of the matrices that belong to the constants."""
STEPS: Final = 12
"""Steps of expectation and maximization."""
LEAST_SCALE: Final = 1e-4
"""Least scale of an error, in training standard deviations."""
FOLLOWED: Final = 4.0
"""Scales to which an error is limited before the constants follow it."""
WILD: Final = 10.0
"""Limit of an error, in its scale, where ranks are compared."""
NOISE: Final = 3.5
"""Largest kurtosis of errors that count as noise; a normal distribution has 3."""
SIGNED: Final = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Weights of the newest error in the sums of errors."""
SIGNED_LIMIT: Final = 30.0
"""Limit of an error in these sums."""
SQUARED: Final = (0.3, 0.1, 0.03, 0.01)
"""Weights of the newest square in the sums of squared errors."""
SQUARED_LIMIT: Final = 12.0
"""Limit of an error in the sums of squares."""
MOVED: Final = (0.1, 0.03, 0.015)
"""Weights with which rows before the newest are forgotten in the tests of the constants."""
MOVED_LIMIT: Final = 6.0
"""Limit of an error in the tests of the constants."""


class ConstantsForecast(NamedTuple):
    """A fitted forecast.

    Attributes
    ----------
    coefficients
        Means of the coefficients over episodes, (K, D).
    matrices
        What a unit of each constant adds to the coefficients of `moving_of` regressors, (R, G, D);
        constants have mean 0 and variance 1 over training episodes.
    error_scale
        Standard deviations of errors, (D,).
    """

    coefficients: Floats
    matrices: Floats
    error_scale: Floats

    @classmethod
    def fit(cls, episodes: Sequence[StandardEpisode], horizon: int, rank: int) -> ConstantsForecast:
        """Fit to standardized episodes, with as many constants of an episode as `rank`.

        The constants are factors of a random-coefficients model (Laird & Ware 1982) whose
        covariance has that rank, found by expectation and maximization.
        """
        x = [regressors(e, horizon, LAGS) for e in episodes]
        y = [e.rows[horizon:] for e in episodes]
        coefficients, variance = _mean_coefficients(x, y)
        scale = np.maximum(np.sqrt(variance), LEAST_SCALE)
        means = [moving_of(part, y[0].shape[1]) for part in x]
        left = [b - a @ coefficients for a, b in zip(x, y, strict=True)]
        matrices = np.empty((0, means[0].shape[1], len(scale)))
        if rank:
            matrices, scale = _factors(means, left, scale, rank)
        return cls(coefficients, matrices, scale)


def moving_of(regressed: Floats, sensors: int) -> Floats:
    """Return the regressors whose coefficients an episode moves, (N, K) to (N, G).

    Mean over the lags and latest value of each sensor, those of each action, and 1.
    """
    n = len(regressed)
    actions = (regressed.shape[1] - 1) // LAGS - sensors
    parts, begin = [], 0
    for width in (sensors, actions):
        lags = [regressed[:, begin + i * width : begin + (i + 1) * width] for i in range(LAGS)]
        total = lags[0]
        for lag in lags[1:]:  # in a fixed order: the same bits for one row as for many
            total = total + lag
        parts += [total / LAGS, lags[0]]
        begin += LAGS * width
    return np.concatenate([*parts, np.ones((n, 1))], axis=1)


def _mean_coefficients(x: Sequence[Floats], y: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return coefficients, a penalty a sensor chosen on episodes left out, and error variances."""
    grams = [a.T @ a for a in x]
    crosses = [a.T @ b for a, b in zip(x, y, strict=True)]
    every = range(len(x))
    squares = np.zeros((len(PENALTIES), y[0].shape[1]))
    for i in range(5):
        rest = [j for j in every if j % 5 != i] or [*every]
        solved = _solved([grams[j] for j in rest], [crosses[j] for j in rest])
        rows = sum(len(x[j]) for j in rest)
        for k, penalty in enumerate(PENALTIES):
            coefficients = solved(penalty * rows)
            for j in every[i::5]:
                squares[k] += ((y[j] - x[j] @ coefficients) ** 2).sum(axis=0)
    rows = sum(map(len, x))
    best = squares.argmin(axis=0)
    solved = _solved(grams, crosses)
    candidates = np.stack([solved(penalty * rows) for penalty in PENALTIES])
    sensors = np.arange(len(best))
    return np.ascontiguousarray(candidates[best, :, sensors].T), squares.min(axis=0) / rows


def _solved(grams: Sequence[Floats], crosses: Sequence[Floats]) -> Callable[[float], Floats]:
    """Return what solves the ridge regression of summed moments with a penalty."""
    values, vectors = np.linalg.eigh(np.sum(grams, axis=0))
    values, cross = np.maximum(values, 0.0)[:, None], vectors.T @ np.sum(crosses, axis=0)

    def solve(penalty: float) -> Floats:
        solution: Floats = vectors @ (cross / (values + penalty))
        return solution

    return solve


def _factors(
    x: Sequence[Floats], y: Sequence[Floats], scale: Floats, rank: int
) -> tuple[Floats, Floats]:
    """Return matrices (R, G, D) and scales (D,) of what regressors x leave in y by episode."""
    grams = np.stack([a.T @ a for a in x])
    crosses = np.stack([a.T @ b for a, b in zip(x, y, strict=True)])
    rows, (episodes, g, d) = sum(map(len, x)), crosses.shape
    total = grams.sum(axis=0) / rows
    # The start: principal components of each episode's ridge coefficients, in units of forecasts.
    root = np.linalg.cholesky(total + 1e-6 * np.eye(g))
    loadings = [
        root.T @ np.linalg.solve(gram + (0.05 * len(a)) * total + 1e-3 * np.eye(g), cross) / scale
        for a, gram, cross in zip(x, grams, crosses, strict=True)
    ]
    _, sizes, axes = np.linalg.svd(np.reshape(loadings, (episodes, g * d)), full_matrices=False)
    start = axes[:rank] * sizes[:rank, None] / np.sqrt(episodes)
    rank = len(start)
    matrices = np.stack([np.linalg.solve(root.T, part.reshape(g, d)) * scale for part in start])
    squares = sum((b**2).sum(axis=0) for b in y)
    for _ in range(STEPS):
        weighted = matrices / scale**2
        flat = weighted.reshape(rank, g * d)
        means, seconds = np.empty((episodes, rank)), np.empty((episodes, rank, rank))
        for e in range(episodes):
            seen = np.matmul(grams[e], matrices).reshape(rank, g * d)
            covariance = np.linalg.inv(np.eye(rank) + flat @ seen.T)
            means[e] = covariance @ (flat @ crosses[e].ravel())
            seconds[e] = covariance + np.outer(means[e], means[e])
        gram = np.einsum("ekl,eab->kalb", seconds, grams).reshape(rank * g, rank * g)
        cross = np.einsum("ek,ead->kad", means, crosses)
        penalty = CONSTANTS_PENALTY * rows * np.eye(rank * g)
        matrices = np.linalg.solve(gram + penalty, cross.reshape(rank * g, d)).reshape(rank, g, d)
        explained = 2 * (matrices * cross).sum(axis=(0, 1))
        explained -= (
            matrices * (gram @ matrices.reshape(rank * g, d)).reshape(rank, g, d)
        ).sum(axis=(0, 1))  # fmt: skip
        scale = np.maximum(np.sqrt(np.maximum(squares - explained, 0.0) / rows), LEAST_SCALE)
        # Constants of unit variance.
        unit = np.linalg.cholesky(seconds.mean(axis=0))
        matrices = np.einsum("kl,kad->lad", unit, matrices)
    return matrices, scale


def chosen_rank(episodes: Sequence[StandardEpisode], horizon: int, learnt: int) -> int:
    """Return the number of constants whose forecasts of episodes left out err least.

    Judged by the mean logarithm of the sensors' errors after the rows that are learnt from.
    """
    losses = []
    for rank in RANKS:
        loss = 0.0
        for part in (0, 1):
            forecast = ConstantsForecast.fit(episodes[1 - part :: 2], horizon, rank)
            squares: list[Floats] = []
            for episode in episodes[part::2]:
                if len(episode.rows) - horizon <= learnt:
                    continue
                charts = EpisodeCharts(forecast, learnt)
                errors = charts.errors(
                    regressors(episode, horizon, LAGS), episode.rows[horizon:]
                )[learnt:]  # fmt: skip
                squares.append(np.clip(errors, -WILD, WILD) ** 2)
            if not squares:
                return 0
            size = np.sqrt(np.concatenate(squares).mean(axis=0)) * forecast.error_scale
            loss += float(np.log(np.maximum(size, LEAST_SCALE)).mean())
        losses.append(loss)
    best = int(np.argmin(losses))
    return RANKS[best] if losses[0] - losses[best] >= 2 * LEAST_GAIN else 0


class EpisodeCharts:
    """Charts of one episode, row by row: each call continues where the last one ended.

    Parameters
    ----------
    forecast
        The fitted forecast.
    learnt
        Errors from which the episode's constants are learnt. Later ones are only judged.
    """

    def __init__(self, forecast: ConstantsForecast, learnt: int) -> None:
        rank, g, d = forecast.matrices.shape
        self._forecast, self._left = forecast, learnt
        self._flat = (
            (forecast.matrices / forecast.error_scale).transpose(1, 0, 2).reshape(g, rank * d)
        )
        self._mean: Floats = np.zeros(rank)
        self._precision: Floats = np.eye(rank)
        self._covariance: Floats = np.eye(rank)
        self._signed, self._squared = Smoother(SIGNED, d), Smoother(SQUARED, d)
        self._keep = 1.0 - np.array(MOVED)[:, None]
        self._score = np.zeros((len(MOVED), rank))
        self._information = np.zeros((len(MOVED), rank, rank))
        self._spread = np.zeros((len(MOVED), rank, rank))
        self._moved = np.empty((0, len(MOVED)))

    def __call__(self, regressed: Floats, observed: Floats) -> Floats:
        """Return the charts of the next N rows, (N, C), from regressors and standardized rows.

        Of each sensor the absolute sums of errors with the weights `SIGNED` and the sums of
        squares with `SQUARED`; where there are constants, the tests of them with `MOVED`.
        """
        errors = self.errors(regressed, observed)
        n = len(errors)
        signed = self._signed(limited(errors, SIGNED_LIMIT))
        squared = self._squared(limited(errors, SQUARED_LIMIT) ** 2)
        parts = [np.abs(signed).swapaxes(0, 1), squared.swapaxes(0, 1)]
        return np.concatenate([*(part.reshape(n, -1) for part in parts), self._moved], axis=1)

    def errors(self, regressed: Floats, observed: Floats) -> Floats:
        """Return the errors of the next N rows on the scale that was expected, (N, D)."""
        forecast, rank = self._forecast, len(self._mean)
        errors = (observed - product(regressed, forecast.coefficients, ROWS)) / forecast.error_scale
        self._moved = np.zeros((len(errors), len(MOVED) if rank else 0))
        if rank:
            n, d = errors.shape
            directions = product(moving_of(regressed, d), self._flat, ROWS).reshape(n, rank, d)
            for t in range(n):
                self._step(directions[t], errors, t)
        return errors

    def _step(self, directions: Floats, errors: Floats, t: int) -> None:
        """Bring the errors of a row to scale in place, and learn the constants or test them."""
        left = errors[t] - self._mean @ directions
        size = np.sqrt(1.0 + (directions * (self._covariance @ directions)).sum(axis=0))
        errors[t] = left / size
        if self._left > 0:
            self._left -= 1
            self._precision = self._precision + directions @ directions.T
            self._covariance = np.asarray(np.linalg.inv(self._precision), np.float64)
            followed = limited(errors[t], FOLLOWED) * size
            self._mean = self._mean + self._covariance @ (directions @ followed)
            return
        # Had the constants moved by m, the sum of z e would be (sum of z z') m.
        keep, cube = self._keep, self._keep[:, :, None]
        seen = directions @ directions.T
        score = directions @ limited(left, MOVED_LIMIT)
        self._score = keep * self._score + score
        self._information = cube * self._information + seen
        self._spread = cube**2 * self._spread + seen
        uncertain = self._information @ self._covariance @ self._information
        total = self._spread + uncertain + 1e-6 * np.eye(len(score))
        moved = np.linalg.solve(total, self._score[:, :, None])[:, :, 0]
        self._moved[t] = np.sqrt(np.maximum((self._score * moved).sum(axis=1), 0.0))


def share_of_noise(charts: Sequence[Floats], sensors: int) -> float:
    """Return the share of sensors whose errors have nearly the kurtosis of normal ones."""
    sizes = np.concatenate([episode[:, :sensors] for episode in charts])  # the weight 1 of SIGNED
    squares, fourths = (sizes**2).mean(axis=0), (sizes**4).mean(axis=0)
    return float(np.mean((squares > 0) & (fourths < NOISE * squares**2)))


class LargestChart(NamedTuple):
    """The largest of the charts, each in units of its own largest value in a nominal episode.

    Attributes
    ----------
    mean, spread
        Mean and standard deviation over nominal episodes of each chart's largest value, (C,).
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def fit(cls, charts: Sequence[Floats]) -> LargestChart:
        """Learn from charts of nominal episodes."""
        largest = np.stack([episode.max(axis=0) for episode in charts])
        spread = largest.std(axis=0)
        return cls(largest.mean(axis=0), np.where(spread > 0, spread, 1.0))

    def __call__(self, charts: Floats) -> Floats:
        """Return the largest chart of each row, (N, C) to (N,)."""
        largest: Floats = ((charts - self.mean) / self.spread).max(axis=1)
        return largest

    def shares(self, charts: Floats, sensors: int) -> Floats:
        """Return the sensors' shares, (N, D), by the squares of their largest charts."""
        weights = len(SIGNED) + len(SQUARED)
        relative = (charts / np.where(self.mean > 0, self.mean, 1.0))[:, : weights * sensors]
        squares = relative.reshape(len(charts), weights, sensors).max(axis=1) ** 2
        total = squares.sum(axis=1, keepdims=True)
        shares: Floats = np.where(total > 0, squares / np.where(total > 0, total, 1.0), 1 / sensors)
        return shares


class ConstantsVoice(Voice):
    """Charts of an episode's constants, where there are episodes enough and noise."""

    name = CHARTS

    def __init__(self, panel: PanelDetector) -> None:
        self._panel = panel
        self.forecast_: ConstantsForecast
        self.largest_: LargestChart

    @property
    def rank(self) -> int:
        """Number of constants of an episode."""
        return len(self.forecast_.matrices)

    def fit(self, episodes: Sequence[Trajectory]) -> list[Floats]:
        """See `Voice`."""
        panel, h = self._panel, self._panel.horizon
        long = [e for e in map(panel.standardized, episodes) if len(e.rows) > h + LAGS]
        rows = sum(len(x.rows) - h for x in long)
        if len(long) < CHARTED_EPISODES or rows < CHARTED_ROWS or panel.basis_.size:
            return []
        long = long[:: min(-(-rows // MOST_ROWS), len(long) // CHARTED_EPISODES)]
        rank = chosen_rank(long, h, panel.learnt) if panel.varies_ else 0
        charts: list[Floats] = []
        for i in range(FOLDS):
            rest = [x for j, x in enumerate(long) if j % FOLDS != i]
            self.forecast_ = ConstantsForecast.fit(rest, h, rank)
            charts += [self._charts(x)[LAGS:] for x in long[i::FOLDS]]
        if share_of_noise(charts, long[0].rows.shape[1]) < NOISY:
            return []
        self.forecast_, self.largest_ = (
            ConstantsForecast.fit(long, h, rank),
            LargestChart.fit(charts),
        )
        return [self.largest_(x) for x in charts]

    def _charts(self, episode: StandardEpisode) -> Floats:
        """Return the charts of the rows h, ..., T of an episode."""
        h = self._panel.horizon
        charts = EpisodeCharts(self.forecast_, self._panel.learnt)
        return charts(regressors(episode, h, LAGS), episode.rows[h:])

    def rows(self, episode: Trajectory) -> Floats:
        """See `Voice`. The first rows lack some of those that the forecast uses: nothing there."""
        rows = self.largest_(self._charts(self._panel.standardized(episode)))
        rows[:LAGS] = -np.inf
        return rows

    def shares(self, episode: Trajectory) -> Floats:
        """See `Voice`."""
        charts = self._charts(self._panel.standardized(episode))
        return self.largest_.shares(charts, episode.observation_dim)

    def reset(self) -> None:
        """See `Voice`."""
        self._live = EpisodeCharts(self.forecast_, self._panel.learnt)
        self._latest: Floats = np.zeros((1, len(self.largest_.mean)))
        self._now = 0

    def update(self, _: NDArray[np.float32], __: NDArray[np.float32] | None) -> float:
        """See `Voice`."""
        t, self._now = self._now, self._now + 1
        if t < self._panel.horizon:
            return float("nan")
        self._latest = self._live(*self._panel.live(LAGS))
        quiet = t < self._panel.horizon + LAGS
        return -np.inf if quiet else float(self.largest_(self._latest)[0])

    def shares_last(self) -> Floats:
        """See `Voice`."""
        shares: Floats = self.largest_.shares(self._latest, len(self.forecast_.error_scale))[0]
        return shares

    def state(self) -> State:
        """See `Voice`."""
        return {**self.forecast_._asdict(), **self.largest_._asdict()}

    def restore(self, state: State) -> None:
        """See `Voice`."""
        sensors, actions = self._panel.widths_
        matrices = take(state, "matrices", (None, 2 * (sensors + actions) + 1, sensors))
        columns = (len(SIGNED) + len(SQUARED)) * sensors + (len(MOVED) if len(matrices) else 0)
        self.forecast_ = ConstantsForecast(
            take(state, "coefficients", (LAGS * (sensors + actions) + 1, sensors)),
            matrices,
            take(state, "error_scale", (sensors,), "+"),
        )
        self.largest_ = LargestChart(
            take(state, "mean", (columns,)), take(state, "spread", (columns,), "+")
        )
