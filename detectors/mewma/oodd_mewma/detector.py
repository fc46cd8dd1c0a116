"""Fit and score of the vector autoregression with a multivariate EWMA chart.

The errors of a linear forecast, with their sign, enter exponentially weighted sums of several
memories. The score is how far the most unusual of these sums lies from where nominal ones lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import (
    Floats,
    Onset,
    Smoother,
    distance,
    product,
    shares_of,
    smooth,
    whitening,
)
from oodd_common.latest_rows import LatestRowsNamer
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Explanation, Naming, Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_mewma import MewmaParameters
from oodd_mewma.forecast import Moments, regressors

FOLDS: Final = 5
"""Parts of the nominal trajectories, each judged by what was learnt from the others."""
REFERENCE: Final = 2.5
"""Score that a row must exceed to count as anomalous in the estimate of the onset."""


class MewmaDetector(StorableWindowDetector):
    r"""Signed forecast residuals, accumulated with several memories, far from where they belong.

    .. math:: u_t = \mathrm{clip}\left(\frac{o_t - B^\top x_t}{\rho}\right), \quad
              z^\lambda_t = (1 - \lambda) z^\lambda_{t-1} + \lambda u_t, \quad
              d^\lambda_t = \sqrt{\tilde z^{\lambda\top}_t \Sigma_\lambda^{-1} \tilde z^\lambda_t},
              \quad s_t = \max_\lambda \frac{d^\lambda_t - m_\lambda}{q_\lambda}

    where :math:`x_t` holds the latest observations up to :math:`o_{t-h}` (and actions, if asked
    for), B a ridge regression, :math:`\rho` the root mean square of the residuals, and
    :math:`\tilde z` is z scaled to one variance at all times (`smooth`). Higher means more
    anomalous. Scores are undefined (NaN) for t < h, and 0, about the mean of nominal scores, in the
    next ``order - 1`` steps, when a forecast has too few observations yet: no evidence either way.

    A score per step forgets at once; this one adds up evidence with its sign. So it sees small
    changes that persist, and stays high for a while after a change has gone.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. Nothing here is random. The regression is fitted to the horizon
        directly, without feeding forecasts back.
    parameters
        See `MewmaParameters`.
    actions
        Whether the forecast uses the commanded actions ``a_{t-h}, a_{t-h-1}, ...`` too.

    Notes
    -----
    Residuals, covariances, m and q come from nominal trajectories that the regression (and for m
    and q, the covariance) has not seen: five folds take turns, and scoring uses what all of them
    give together. Fewer than five trajectories are as many folds; a single one judges itself,
    which makes nominal scores of others too high. With autocorrelated residuals, as for h > 1, the
    variance of the first steps is approximate.

    Source: Lowry, Woodall, Champ & Rigdon, "A multivariate exponentially weighted moving average
    control chart", Technometrics 34 (1992).
    """

    kind: ClassVar[str] = "mewma/5"

    def __init__(
        self, name: str, parameters: MewmaParameters, *, seed: int, horizon: int, actions: bool
    ) -> None:
        self._namer = LatestRowsNamer(None)
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.order, actions=actions)
        self.parameters = parameters
        self._first = horizon + parameters.order - 1  # first time that has all its regressors

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        self._must_fit(trajectory)
        scores = np.full(len(trajectory), np.nan)
        scores[self.horizon :] = 0.0
        if trajectory.transitions >= self._first:
            smoothed = self._smoothed(trajectory, self.coefficients_)
            scores[self._first :] = self._standardized(smoothed).max(axis=0)
        return scores

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return the sensors that the most unusual sum points at, and since when.

        A sensor's share is its part of the square of that sum's Mahalanobis length. The onset is
        where a CUSUM of the scores last left zero (Page 1954). Parts at fault are named of at most
        64 sensors, see `oodd_common.naming`.
        """
        scores, h = self.score(trajectory), self.horizon
        sums = np.zeros((len(self.parameters.weights), *trajectory.observations.shape))
        sums[:, self._first :] = self._smoothed(trajectory, self.coefficients_)
        shares = self._shares(sums)
        shares[:h] = np.nan
        onset, onsets = Onset(REFERENCE, h), np.full(len(trajectory), -1)
        onsets[h:] = [onset(score) for score in scores[h:].tolist()]
        return Explanation(shares, onsets, self._namer(trajectory) if len(trajectory) > h else None)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._smoother: Smoother | None = None
        self._onset, self._since = Onset(REFERENCE, self.horizon), -1
        self._namer.reset()

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon."""
        score = super().update(observation, action)
        self._namer.update(self._rows[0], self._commands[0] if self._commands else None)
        return score

    def explain_last(self) -> tuple[Floats, int, Naming | None]:
        """Return what `explain` says of the latest `update`: shares (sensors,), onset, naming."""
        if self._since < 0:
            return np.full(len(self._scale().mean), np.nan), -1, None
        return self._shares(self._sums)[0], self._since, self._namer.last()

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        if t < self._first:
            self._since = self._onset(0.0)
            self._sums = np.zeros((len(self.parameters.weights), 1, len(now)))
            return 0.0
        known = [_standard(window, self.observation_scale_).ravel()]
        if self.actions:
            commands = np.stack(list(self._commands)[self.lag - 1 :])
            known.append(_standard(commands, self.action_scale_).ravel())
        x = np.concatenate([*known, np.ones(1)])[None]
        residual = _standard(now[None], self.observation_scale_) - product(x, self.coefficients_)
        self._smoother = self._smoother or Smoother(self.parameters.weights, len(now))
        self._sums = self._smoother(self._clipped(residual))
        score = float(self._standardized(self._sums).max(axis=0)[0])
        self._since = self._onset(score)
        return score

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        usable = [x for x in nominal if x.transitions >= self._first]
        widths = {self._widths(x) for x in nominal}
        if not usable or len(widths) != 1:
            raise TrajectoryError(
                f"detector {self.name!r} cannot be fitted on {len(nominal)} trajectories, of "
                f"which {len(usable)} have at least {self._first} transitions, of (sensors, "
                f"action columns) {sorted(widths)}: expected at least one that long, all of the "
                "same shape"
            )
        self.observation_scale_ = _scale_of([x.observations for x in usable])
        known = usable if self.actions else [x.without_actions() for x in usable]
        self.action_scale_ = _scale_of([x.actions for x in known])
        self._namer = LatestRowsNamer.fit(known)
        folds = [usable[i :: min(FOLDS, len(usable))] for i in range(min(FOLDS, len(usable)))]

        ridge = self.parameters.ridge
        moments = [
            reduce(add, (Moments.of(self._regressors(x), self._targets(x)) for x in fold))
            for fold in folds
        ]
        every = reduce(add, moments)
        self.coefficients_ = every.solve(ridge)
        # What scoring will see: residuals of forecasts that were fitted to other trajectories.
        # A single trajectory has no others, and judges itself.
        alone = len(folds) == 1
        unseen = [(every if alone else every - m).solve(ridge) for m in moments]

        squares, rows = np.zeros(len(self.observation_scale_.mean)), 0
        for fold, coefficients in zip(folds, unseen, strict=True):
            for x in fold:
                residuals = self._residuals(x, coefficients)
                squares += (residuals**2).sum(axis=0)
                rows += len(residuals)
        self.residual_scale_ = _positive(np.sqrt(squares / rows))

        # One uncentred covariance per weight: residuals are zero on average, by the regression.
        sums, counts = [], []
        for fold, coefficients in zip(folds, unseen, strict=True):
            charts = (self._smoothed(x, coefficients) for x in fold)
            sums.append(reduce(add, (z.swapaxes(1, 2) @ z for z in charts)))  # (W, D, D)
            counts.append(sum(len(x) - self._first for x in fold))
        total, count = reduce(add, sums), sum(counts)
        self.whitening_ = self._whitening(total / count)

        distances: list[Floats] = []
        for fold, coefficients, fold_sum, n in zip(folds, unseen, sums, counts, strict=True):
            others = total / count if alone else (total - fold_sum) / (count - n)
            root = self._whitening(others)
            distances += [_distances(self._smoothed(x, coefficients), root) for x in fold]
        pooled = np.concatenate(distances, axis=1)  # (W, N)
        self.distance_mean_ = pooled.mean(axis=1, keepdims=True)
        self.distance_std_ = _positive(pooled.std(axis=1, keepdims=True))
        return self.observation_scale_

    def _targets(self, x: Trajectory) -> Floats:
        return _standard(x.observations[self._first :], self.observation_scale_)

    def _regressors(self, x: Trajectory) -> Floats:
        actions = _standard(x.actions, self.action_scale_) if self.actions else None
        observations = _standard(x.observations, self.observation_scale_)
        return regressors(observations, actions, order=self.window, horizon=self.horizon)

    def _residuals(self, x: Trajectory, coefficients: Floats) -> Floats:
        return self._targets(x) - product(self._regressors(x), coefficients)  # (N, D)

    def _clipped(self, residuals: Floats) -> Floats:
        clip = self.parameters.clip
        return np.clip(residuals / self.residual_scale_, -clip, clip)

    def _smoothed(self, x: Trajectory, coefficients: Floats) -> Floats:
        """Return the scaled, exponentially weighted, clipped residuals: (W, N, D)."""
        return smooth(self._clipped(self._residuals(x, coefficients)), self.parameters.weights)

    def _standardized(self, smoothed: Floats) -> Floats:
        """Return the standardized distances of sums: (W, N, D) to (W, N)."""
        distances = _distances(smoothed, self.whitening_)
        standardized: Floats = (distances - self.distance_mean_) / self.distance_std_
        return standardized

    def _shares(self, smoothed: Floats) -> Floats:
        """Return the sensors' shares in the largest distance: (W, N, D) to (N, D)."""
        loudest = self._standardized(smoothed).argmax(axis=0)
        precisions = self.whitening_ @ self.whitening_.swapaxes(1, 2)
        parts = smoothed * np.stack([*map(product, smoothed, precisions)])
        return shares_of(np.maximum(parts[loudest, np.arange(len(loudest))], 0.0))

    def _whitening(self, covariances: Floats) -> Floats:
        return np.stack([whitening(c, self.parameters.shrinkage) for c in covariances])

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        return {
            "actions": self.actions,
            "horizon": self.horizon,
            "order": p.order,
            "clip": p.clip,
            "weights": p.weights,
        }

    def _arrays(self) -> Arrays:
        return {
            "action_scale": np.stack([self.action_scale_.mean, self.action_scale_.std]),
            "coefficients": self.coefficients_,
            "residual_scale": self.residual_scale_,
            # As they lie in memory, on which the last bit of a product depends.
            "whitening": self.whitening_.swapaxes(1, 2),
            "distance_mean": self.distance_mean_,
            "distance_std": self.distance_std_,
            **self._namer.arrays(),
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        d, w = sensors, len(self.parameters.weights)
        self.observation_scale_ = FeatureScale(
            take(arrays, "mean", (d,)), take(arrays, "std", (d,), "+")
        )
        self.action_scale_ = FeatureScale.of(arrays, "action_scale")
        used = len(self.action_scale_.mean) if self.actions else 0
        self.coefficients_ = take(arrays, "coefficients", (self.window * (d + used) + 1, d))
        self.residual_scale_ = take(arrays, "residual_scale", (d,), "+")
        self.whitening_ = take(arrays, "whitening", (w, d, d)).swapaxes(1, 2)
        self.distance_mean_ = take(arrays, "distance_mean", (w, 1))
        self.distance_std_ = take(arrays, "distance_std", (w, 1), "+")
        self._namer = LatestRowsNamer.of(arrays)


def _scale_of(arrays: Sequence[NDArray[np.float32]]) -> FeatureScale:
    rows = sum(len(a) for a in arrays)
    mean: Floats = np.sum([a.sum(axis=0, dtype=np.float64) for a in arrays], axis=0) / rows
    squares = np.sum([((a - mean) ** 2).sum(axis=0) for a in arrays], axis=0)
    return FeatureScale(mean, _positive(np.sqrt(squares / rows)))


def _positive(std: Floats) -> Floats:
    """Return standard deviations, 1 for quantities that do not vary."""
    return np.where(std < CONSTANT, 1.0, std)


def _standard(values: NDArray[np.float32], scale: FeatureScale) -> Floats:
    """Return standardized values in double precision, unlike calling the scale."""
    standardized: Floats = (values - scale.mean) / scale.std
    return standardized


def _distances(smoothed: Floats, roots: Floats) -> Floats:
    """Return the Mahalanobis lengths (W, N) of rows (W, N, D)."""
    return np.stack([distance(z, r) for z, r in zip(smoothed, roots, strict=True)])
