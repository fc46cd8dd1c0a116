"""A linear forecast whose heads learn the episode, and the evidence that a head has changed.

After ARCADE (Yadav, Das, Song, Kaski and Pan 2025, arXiv 2512.14331).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import StandardEpisode, regressors

from oodd_eval.errors import TrajectoryError
from oodd_rivals.networks import NetworkRival, Shapes, Weights, settings
from oodd_rivals.parameters import ArcadeParameters

FOLDS: Final = 5
"""Parts of the training episodes, each judged by what was learnt from the others."""
LARGEST: Final = 30.0
"""Limit of a standardized reading, and of an error in sums."""
AVERAGED: Final = 6
"""Latest rows whose mean is a feature: noise of sensors is averaged out."""
MOST_INPUTS: Final = 64
"""Most sensors and commands: the cost of a fit grows with the cube of their number."""
PENALTIES: Final = np.logspace(-7, -1, 7)
"""Penalties that are tried, relative to the mean square of a standardized sensor."""
ROUNDS: Final = 3
"""Times that the prior of heads is estimated, and between them the coefficients given it."""
STEPS: Final = 6
"""Steps of expectation and maximization in a round."""
LEAST_UNIT: Final = 1e-4
"""Least scale of an error, in training standard deviations."""
LEARNT: Final = 60
"""Rows of an episode that are learnt at once; later ones are learnt so many rows late."""
FOLLOWED: Final = 4.0
"""Deviations to which an error is limited before a head follows it."""
SQUARED: Final = 12.0
"""Limit of an error in sums of squares."""
MEMORY: Final = np.array([1.0, 0.3, 0.1, 0.03, 0.01])[:, None, None]
"""Weights of the newest row in sums of errors and of their squares."""
CHANGED: Final = np.array([0.1, 0.03, 0.015])[:, None, None, None]
"""Weights of the newest row in the evidence for a change."""
CHARTS: Final = 2 * len(MEMORY) + len(CHANGED)
"""Charts of a sensor."""
SMALLEST: Final = 1e-3
"""Least chart: a smaller one counts as so large."""
LEAST_SPREAD: Final = 0.03
"""Least deviation of the logarithms of charts' largest values over episodes."""


class Pair(NamedTuple):
    """Inputs (N, K) and rows (N, D) of an episode's forecasts."""

    inputs: Floats
    rows: Floats


class Arcade(NetworkRival):
    r"""Errors of a forecast a part of which is the episode's own, and evidence that it changed.

    .. math:: o_{t,d} = b_d^\top x_t + w_d^\top \phi_t + \sigma_d \varepsilon_{t,d}, \qquad
              w_d \sim \mathcal N(0, M_d^\top M_d), \qquad s_t = \max_c \frac{c_t - \mu_c}{\rho_c}

    with :math:`x_t` the latest rows and commands, :math:`\phi_t` their means and the newest of
    them. The prior of the heads :math:`w_d`, of low rank, is learnt from training episodes;
    within an episode heads have their posterior in closed form. The charts c of a sensor are
    logarithms of exponentially weighted errors and squared errors, over their predictive
    deviations, and of the evidence that its head has changed; :math:`\mu_c, \rho_c` are mean and
    deviation of a chart's largest value in a training episode of which nothing was learnt. Higher
    means more anomalous; undefined (NaN) for t < h.

    Parameters
    ----------
    name, seed, horizon
        See `NetworkRival`. Nothing is random. The forecast is fitted to the horizon directly.
    parameters
        See `ArcadeParameters`.
    """

    kind: ClassVar[str] = "arcade/1"

    def __init__(self, name: str, parameters: ArcadeParameters, *, seed: int, horizon: int) -> None:
        lags = parameters.lags
        super().__init__(name, seed=seed, horizon=horizon, actions=True, window=lags)
        self.parameters = parameters
        self.seed = 0  # of the order of episodes, and so of the folds

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        heads, pairs = self._new_heads(self.weights_), self._pairs(rows)
        judged = zip(*pairs, self._moved(observations), strict=True)
        return np.array([self._judged(heads, *row) for row in judged])

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._live: EpisodeHeads | None = None

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        self._live = self._live or self._new_heads(self.weights_)
        commands = np.zeros((self.window, len(self.action_scale_.mean)))
        if before := list(self._commands)[self.lag - 1 :]:
            commands[: len(before)] = self._standard_action(np.stack(before))
        latest = np.concatenate([self._standard_rows(window).ravel(), commands.ravel(), [1.0]])
        row = self._standard_rows(now[None])[0]
        moved = float(self._moved(now[None])[0])
        return self._judged(self._live, _limited(latest), _limited(row), moved)

    def _judged(self, heads: EpisodeHeads, inputs: Floats, row: Floats, moved: float) -> float:
        w = self.weights_
        errors = (row - inputs @ w["forecast"]) / w["unit"]
        charts = heads(features(inputs[None], len(row), self.window), errors)
        if not charts.any():  # the first rows, which nothing is known of
            return self.surprise_ if moved else 0.0
        charts = (np.log(np.maximum(charts, SMALLEST)) - w["typical"]) / w["calibration"]
        largest = charts.max(initial=-LARGEST)
        return float(max(largest, self.surprise_) if moved else largest)

    def _pairs(self, episode: Floats) -> Pair:
        """Return inputs and rows of forecasts, from `_standard` rows."""
        v, h = len(self.varying_), self.horizon
        rows = _limited(episode[:, :v])
        standard = StandardEpisode(rows, _limited(episode[:-1, v:]))
        return Pair(regressors(standard, h, self.window), rows[h:])

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        if training[0].shape[1] > MOST_INPUTS:
            raise TrajectoryError(
                f"detector {self.name!r} was given {training[0].shape[1]} sensors and commands, "
                f"expected at most {MOST_INPUTS}: use panel-a"
            )
        episodes = [*training, *held_out] if len(training) > 1 else training
        pairs = [self._pairs(episode) for episode in episodes]
        plain, refined = (self._judged_fit(pairs, rounds) for rounds in (1, ROUNDS))
        # Each sensor has the coefficients that make rows of episodes left out likelier.
        losses = np.stack([plain.pop("loss"), refined.pop("loss")])
        better, self.loss_ = losses[1] < losses[0], float(losses.min(axis=0).sum())
        self.weights_ = {
            name: np.where(np.tile(better, w.shape[1] // max(len(better), 1)), refined[name], w)
            for name, w in plain.items()
        }

    def _judged_fit(self, pairs: Sequence[Pair], rounds: int) -> Weights:
        """Return weights, and as `loss` each sensor's mean -log density in episodes left out."""
        rank = self.parameters.rank
        sizes, losses = [], []
        for i in range(min(FOLDS, len(pairs))):
            others = [pair for j, pair in enumerate(pairs) if j % FOLDS != i]
            fit = fitted(others or pairs, self.window, rank, rounds)
            for charts, surprise in self._side_by_side(fit, pairs[i::FOLDS]):
                sizes.append(charts.max(axis=0, initial=SMALLEST))
                losses.append(surprise.mean(axis=0))
        largest = np.log(sizes)
        return fitted(pairs, self.window, rank, rounds) | {
            "typical": largest.mean(axis=0, keepdims=True),
            "calibration": np.maximum(largest.std(axis=0, keepdims=True), LEAST_SPREAD),
            "loss": np.mean(losses, axis=0),
        }

    def _side_by_side(self, fit: Weights, pairs: Sequence[Pair]) -> list[tuple[Floats, Floats]]:
        """Return charts (N, C) and -log densities (N, D) of episodes, judged side by side."""
        rows = max(len(pair.rows) for pair in pairs)
        last = [np.minimum(np.arange(rows), len(pair.rows) - 1) for pair in pairs]
        inputs = np.stack([p.inputs[at] for p, at in zip(pairs, last, strict=True)])
        errors = np.stack([p.rows[at] for p, at in zip(pairs, last, strict=True)])
        errors = (errors - inputs @ fit["forecast"]) / fit["unit"]
        heads, charts, surprises = self._new_heads(fit, len(pairs)), [], []
        for x, error in zip(inputs.swapaxes(0, 1), errors.swapaxes(0, 1), strict=True):
            charts.append(heads(features(x, error.shape[1], self.window), error))
            surprises.append(heads.surprise + np.log(fit["unit"]))
        both = np.stack(charts, axis=1), np.stack(surprises, axis=1)
        return [(c[: len(p.rows)], s[: len(p.rows)]) for c, s, p in zip(*both, pairs, strict=True)]

    def _new_heads(self, fit: Weights, episodes: int = 1) -> EpisodeHeads:
        return EpisodeHeads(fit["heads"], fit["unit"].shape[1], episodes, self.window)

    def _fitted_with(self) -> dict[str, Any]:
        return settings(self.parameters, "lags", "rank") | {"horizon": self.horizon}

    def _shapes(self, sensors: int, commands: int) -> Shapes:
        inputs, rank = sensors + commands, self.parameters.rank
        return {
            "forecast": (self.window * inputs + 1, sensors),
            "heads": (2 * inputs + 1, rank * sensors),
            "unit": (1, sensors),
            "typical": (1, CHARTS * sensors),
            "calibration": (1, CHARTS * sensors),
        }


class EpisodeHeads:
    """The heads of episodes side by side, row by row, and the charts of their errors.

    Parameters
    ----------
    prior
        What a unit of each direction adds to a head, (G, R D).
    sensors
        Their number, D.
    episodes
        Their number, E.
    skipped
        Rows at the beginning that lack some of the inputs: nothing is learnt, charts are 0.
    """

    surprise: Floats
    """Minus log density of the latest errors, but for a constant, (E, D)."""

    def __init__(self, prior: Floats, sensors: int, episodes: int, skipped: int) -> None:
        rank = prior.shape[1] // max(sensors, 1)
        self._prior, self._shape, self._row = prior, (episodes, rank, sensors), -skipped
        self._mean = np.zeros((episodes, sensors, rank))
        self._covariance = np.zeros((episodes, sensors, rank, rank)) + np.eye(rank)
        self._sums = np.zeros((2, len(MEMORY), episodes, sensors))
        self._kept = np.ones(MEMORY.shape)
        self._slope = np.zeros((len(CHANGED), episodes, sensors, rank))
        self._seen, self._noise = np.zeros((2, *self._slope.shape, rank))
        self._late: deque[tuple[Floats, Floats]] = deque()

    def __call__(self, features: Floats, errors: Floats) -> Floats:
        """Return the charts (E, C D) of the next errors (E, D), from features (E, G)."""
        z = (features @ self._prior).reshape(self._shape).swapaxes(1, 2)
        left, size, _ = self._left(z, errors)
        unit = left / size
        self.surprise = 0.5 * np.clip(unit, -SQUARED, SQUARED) ** 2 + np.log(size)
        self._row += 1
        if self._row <= 0:
            return np.zeros((len(errors), CHARTS * errors.shape[1]))
        counted = np.clip(unit, -LARGEST, LARGEST), np.clip(unit, -SQUARED, SQUARED) ** 2
        self._sums += MEMORY * (np.stack(counted)[:, None] - self._sums)
        self._kept = self._kept * (1.0 - MEMORY) ** 2
        signed, squares = self._sums / np.sqrt(MEMORY / (2.0 - MEMORY) * (1.0 - self._kept))
        changed = self._changed(z, left)
        self._late.append((z, errors))
        if self._row <= LEARNT or len(self._late) > LEARNT:
            self._learn(*self._late.popleft())
        charts = np.concatenate([np.abs(signed), np.sqrt(squares), changed])
        return charts.swapaxes(0, 1).reshape(len(errors), -1)

    def _left(self, z: Floats, errors: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what heads leave of errors, its predictive deviation, and covariance times z."""
        spread = (self._covariance @ z[..., None])[..., 0]
        size = np.sqrt(1.0 + (z * spread).sum(axis=2))
        return errors - (self._mean * z).sum(axis=2), size, spread

    def _learn(self, z: Floats, errors: Floats) -> None:
        left, size, spread = self._left(z, errors)
        followed = np.clip(left, -FOLLOWED * size, FOLLOWED * size) / size**2
        self._mean = self._mean + spread * followed[..., None]
        gain = spread / size[..., None]
        self._covariance = self._covariance - gain[..., None] * gain[..., None, :]

    def _changed(self, z: Floats, left: Floats) -> Floats:
        """Return the evidence that heads have changed about 1 / weight rows ago, (W, E, D).

        Had a head moved by m, the sum of z times what is left would be (sum of z z') m: its length
        in the deviations that noise and what is not yet known of the head would give it.
        """
        limited = np.clip(left, -FOLLOWED, FOLLOWED)[..., None]
        products, keep = z[..., None] * z[..., None, :], 1.0 - CHANGED[..., None]
        self._slope = (1.0 - CHANGED) * self._slope + z * limited
        self._seen, self._noise = keep * self._seen + products, keep**2 * self._noise + products
        if self._row <= LEARNT:
            return np.zeros(self._slope.shape[:3])
        total = self._noise + self._seen @ self._covariance @ self._seen
        total = total + 1e-6 * np.eye(total.shape[-1])
        moved = np.linalg.solve(total, self._slope[..., None])[..., 0]
        evidence: Floats = np.sqrt(np.maximum((self._slope * moved).sum(axis=3), 0.0))
        return evidence


def features(inputs: Floats, sensors: int, lags: int) -> Floats:
    """Return what heads see of inputs (E, K), (E, G).

    Means of the `AVERAGED` latest rows and commands, the newest of each, and 1.
    """
    parts = np.split(inputs[:, :-1], [lags * sensors], axis=1)
    by_lag = [part.reshape(len(inputs), lags, -1)[:, :AVERAGED] for part in parts]
    means = [part.mean(axis=1) for part in by_lag]
    return np.concatenate([*means, *(part[:, 0] for part in by_lag), inputs[:, -1:]], axis=1)


def fitted(pairs: Sequence[Pair], lags: int, rank: int, rounds: int) -> Weights:
    """Return coefficients `forecast`, the prior of `heads`, and scales of errors, `unit`.

    Coefficients that ignore how episodes differ use old rows to find it out. So they are estimated
    anew, by generalized least squares, given the prior: what a head explains is no error then.
    """
    x, y = zip(*pairs, strict=True)
    f = [features(a, y[0].shape[1], lags) for a in x]
    grams = np.stack(
        [_moments(x[i::FOLDS], x[i::FOLDS]).sum(axis=0) for i in range(min(FOLDS, len(x)))]
    )
    crosses, seen = _moments(x, y), _moments(f, y)
    shared, inner = _moments(x, f), _moments(f, f)
    squares = np.stack([(b**2).sum(axis=0) for b in y])
    rows, gram, cross = sum(map(len, x)), grams.sum(axis=0), crosses.sum(axis=0)
    coefficients, errors, penalties = _ridge(grams, crosses, squares, rows)
    unit = np.maximum(np.sqrt(np.maximum(errors, 0.0)), LEAST_UNIT)
    heads = np.zeros((len(unit), rank, f[0].shape[1]))
    for n in range(rounds if rank else 0):
        if n:
            for d, penalty in enumerate(penalties * rows):
                known = heads[d].T / unit[d]
                z, zy = shared @ known, seen[:, :, d] @ known
                both = np.linalg.solve(known.T @ inner @ known + np.eye(rank), z.swapaxes(1, 2))
                within = gram - np.tensordot(z, both, ((0, 2), (0, 1)))
                target = cross[:, d] - np.einsum("erk,er->k", both, zy)
                coefficients[:, d] = np.linalg.solve(within + penalty * np.eye(len(gram)), target)
        left = seen - shared.swapaxes(1, 2) @ coefficients
        size = squares.sum(axis=0) + (coefficients * (gram @ coefficients - 2 * cross)).sum(axis=0)
        heads, unit = _heads(inner, left, size, unit, rank, rows)
    prior = (heads / unit[:, None, None]).transpose(2, 1, 0).reshape(f[0].shape[1], -1)
    return {"forecast": coefficients, "heads": prior, "unit": unit[None]}


def _moments(x: Sequence[Floats], y: Sequence[Floats]) -> Floats:
    return np.stack([a.T @ b for a, b in zip(x, y, strict=True)])


def _ridge(
    grams: Floats, crosses: Floats, squares: Floats, rows: int
) -> tuple[Floats, Floats, Floats]:
    """Return coefficients, a penalty a sensor chosen on folds left out, mean squares, penalties."""

    def solved(gram: Floats, cross: Floats) -> Floats:
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 0.0)[:, None] + PENALTIES[:, None, None] * rows
        coefficients: Floats = vectors @ ((vectors.T @ cross) / values)
        return coefficients

    errors = np.zeros((len(PENALTIES), crosses.shape[2]))
    for i, gram in enumerate(grams):
        cross = crosses[i::FOLDS].sum(axis=0)
        tried = solved(grams.sum(axis=0) - gram, crosses.sum(axis=0) - cross)
        errors += squares[i::FOLDS].sum(axis=0) + (tried * (gram @ tried - 2 * cross)).sum(axis=1)
    best = errors.argmin(axis=0)
    tried = solved(grams.sum(axis=0), crosses.sum(axis=0))
    sensors = np.arange(len(best))
    return tried[best, :, sensors].T.copy(), errors[best, sensors] / rows, PENALTIES[best]


def _heads(
    grams: Floats, crosses: Floats, squares: Floats, unit: Floats, rank: int, rows: int
) -> tuple[Floats, Floats]:
    """Return directions of heads, (D, R, G), and scales of errors, by sensor.

    Factors of a random-coefficients model (Laird & Ware 1982), by expectation and maximization from
    grams (E, G, G) of features, crosses (E, G, D) with what coefficients leave, and its squares.
    """
    episodes, g, sensors = crosses.shape
    total, eye = grams.sum(axis=0) / rows, np.eye(g)
    root = np.linalg.cholesky(total + 1e-6 * eye)
    # The start: principal components of each episode's ridge coefficients, in units of forecasts.
    ridge = 0.05 * rows / episodes * total + 1e-3 * eye
    loadings = root.T @ np.linalg.solve(grams + ridge, crosses)
    _, sizes, axes = np.linalg.svd(loadings.transpose(2, 0, 1), full_matrices=False)
    heads = np.zeros((sensors, rank, g))
    start = (axes * sizes[:, :, None])[:, :rank] / np.sqrt(episodes)
    heads[:, : start.shape[1]] = np.linalg.solve(root.T, start.swapaxes(1, 2)).swapaxes(1, 2)
    for _ in range(STEPS):
        noise = unit[:, None, None] ** 2
        precision = heads @ grams[:, None] @ heads.swapaxes(1, 2) / noise + np.eye(rank)
        covariance = np.linalg.inv(precision)
        target = heads @ crosses.transpose(0, 2, 1)[..., None] / noise
        means = covariance @ target
        seconds = covariance + means @ means.swapaxes(2, 3)
        gram = np.einsum("edrs,egh->drgsh", seconds, grams, optimize=True)
        gram = gram.reshape(sensors, rank * g, rank * g)
        cross = np.einsum("edr,egd->drg", means[..., 0], crosses).reshape(sensors, rank * g, 1)
        flat = np.linalg.solve(gram + 1e-3 * rows * np.eye(rank * g), cross)
        explained = (flat * (2 * cross - gram @ flat)).sum(axis=(1, 2))
        unit = np.maximum(np.sqrt(np.maximum(squares - explained, 0.0) / rows), LEAST_UNIT)
        # Constants of unit variance.
        scale = np.linalg.cholesky(seconds.mean(axis=0)).swapaxes(1, 2)
        heads = scale @ flat.reshape(sensors, rank, g)
    return heads, unit


def _limited(standard: Floats) -> Floats:
    return np.clip(standard, -LARGEST, LARGEST)
