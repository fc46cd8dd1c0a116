"""Fit and score of the vector autoregression with a multivariate EWMA chart."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval import Trajectory
from oodd_eval.errors import NotFittedError, TrajectoryError, UsageError
from oodd_eval.plugins.state import load_state, save_state, take
from oodd_mewma.chart import Floats, Smoother, distance, smooth, whitening
from oodd_mewma.forecast import Moments, first_forecast, product, regressors

CONSTANT: Final = 1e-6
"""A standard deviation below this is a quantity that does not vary; its scale is then 1."""

FOLDS: Final = 5
"""Parts of the nominal trajectories, each judged by what was learnt from the others."""


KIND: Final = "mewma/1"
"""What is saved, and the version of its layout."""


class MewmaDetector:
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
    seed
        Accepted as the contract asks; nothing here is random.
    horizon
        Steps between the last observation that a forecast uses and the one it predicts, h. The
        regression is fitted to that horizon directly, without feeding forecasts back.
    actions
        Whether the forecast uses the commanded actions ``a_{t-h}, a_{t-h-1}, ...`` too.
    order
        Latest observations that a forecast uses.
    ridge
        Penalty on the squared coefficients of standardized sensors, relative to the mean squared
        error; positive.
    clip
        Residuals are limited to this many root mean squares on either side; positive.
    shrinkage
        Share of the identity in every covariance, in (0, 1].
    weights
        Weights of the newest residual, each in (0, 1].

    Raises
    ------
    UsageError
        When a parameter is not in its range.

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

    def __init__(
        self,
        *,
        seed: int = 0,
        horizon: int = 1,
        actions: bool = False,
        order: int = 3,
        ridge: float = 1e-4,
        clip: float = 3.0,
        shrinkage: float = 0.05,
        weights: Sequence[float] = (0.3, 0.1, 0.03),
    ) -> None:
        self._name = "mewma-a" if actions else "mewma"
        self.seed, self.actions = seed, actions
        self.horizon, self.order = self._integer("horizon", horizon), self._integer("order", order)
        self._first = first_forecast(order=self.order, horizon=self.horizon)
        self.ridge = self._number("ridge", ridge)
        self.clip = self._number("clip", clip)
        self.shrinkage = self._number("shrinkage", shrinkage, most=1.0)
        if isinstance(weights, str) or not isinstance(weights, Sequence) or not weights:
            raise self._wrong("weights", "a list of at least one number", weights)
        self.weights = tuple(self._number("weights", w, most=1.0) for w in weights)
        self._widths: tuple[int, int] | None = None
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> MewmaDetector:
        """Learn the forecast, then where its accumulated residuals lie.

        Raises
        ------
        TrajectoryError
            When no trajectory is long enough for a forecast, or they differ in their number of
            sensors or the width of their actions.
        """
        usable = [x for x in nominal if x.transitions >= self._first]
        widths = {(x.observation_dim, x.action_dim) for x in nominal}
        if not usable or len(widths) != 1:
            raise TrajectoryError(
                f"detector {self._name!r} cannot be fitted on {len(nominal)} trajectories, of "
                f"which {len(usable)} have at least {self._first} transitions, of (sensors, "
                f"action columns) {sorted(widths)}: expected at least one that long, all of the "
                "same shape"
            )
        self._widths = widths.pop()
        self.observation_scale_ = _mean_and_std([x.observations for x in usable])
        self.action_scale_ = _mean_and_std([x.actions for x in usable])
        folds = [usable[i :: min(FOLDS, len(usable))] for i in range(min(FOLDS, len(usable)))]

        moments = [
            reduce(add, (Moments.of(self._regressors(x), self._targets(x)) for x in fold))
            for fold in folds
        ]
        every = reduce(add, moments)
        self.coefficients_ = every.solve(self.ridge)
        # What scoring will see: residuals of forecasts that were fitted to other trajectories.
        # A single trajectory has no others, and judges itself.
        alone = len(folds) == 1
        unseen = [(every if alone else every - own).solve(self.ridge) for own in moments]

        squares, rows = np.zeros(self._widths[0]), 0
        for fold, coefficients in zip(folds, unseen, strict=True):
            for x in fold:
                residuals = self._residuals(x, coefficients)
                squares += (residuals**2).sum(axis=0)
                rows += len(residuals)
        self.residual_scale_ = _scale(np.sqrt(squares / rows))

        # One uncentred covariance per weight: residuals are zero on average, by the regression.
        sums, counts = [], []
        for fold, coefficients in zip(folds, unseen, strict=True):
            charts = (self._smoothed(x, coefficients) for x in fold)
            sums.append(reduce(add, (z.swapaxes(1, 2) @ z for z in charts)))  # (W, D, D)
            counts.append(sum(len(x) - self._first for x in fold))
        total, count = reduce(add, sums), sum(counts)
        self.whitening_ = self._whitening(total / count)

        distances: list[Floats] = []
        for fold, coefficients, own, n in zip(folds, unseen, sums, counts, strict=True):
            others = total / count if alone else (total - own) / (count - n)
            root = self._whitening(others)
            distances += [self._distances(self._smoothed(x, coefficients), root) for x in fold]
        pooled = np.concatenate(distances, axis=1)  # (W, N)
        self.distance_mean_ = pooled.mean(axis=1, keepdims=True)
        self.distance_std_ = _scale(pooled.std(axis=1, keepdims=True))
        self.reset()
        return self

    def save(self, directory: Path) -> None:
        """Write what was learnt into a directory, as plain arrays and JSON.

        Raises
        ------
        NotFittedError
            Before `fit`.
        """
        self._fitted_widths()
        arrays = {
            "observation_scale": np.stack(self.observation_scale_),
            "action_scale": np.stack(self.action_scale_),
            "coefficients": self.coefficients_,
            "residual_scale": self.residual_scale_,
            "whitening": np.stack(self.whitening_),
            "distance_mean": self.distance_mean_,
            "distance_std": self.distance_std_,
        }
        save_state(directory, kind=KIND, settings=self._settings, arrays=arrays)

    def load(self, directory: Path) -> None:
        """Take over what `save` wrote.

        Raises
        ------
        FittedStateError
            When the files are missing, damaged, or of a chart with other parameters.
        """
        arrays = load_state(directory, kind=KIND, settings=self._settings)
        sensors, w = take(arrays, "observation_scale", (2, None)), len(self.weights)
        actions = take(arrays, "action_scale", (2, None))
        d, a = sensors.shape[1], actions.shape[1]
        inputs = self.order * (d + (a if self.actions else 0)) + 1
        self.observation_scale_ = sensors[0], sensors[1]
        self.action_scale_ = actions[0], actions[1]
        self.coefficients_ = take(arrays, "coefficients", (inputs, d))
        self.residual_scale_ = take(arrays, "residual_scale", (d,))
        self.whitening_ = list(take(arrays, "whitening", (w, d, d)))
        self.distance_mean_ = take(arrays, "distance_mean", (w, 1))
        self.distance_std_ = take(arrays, "distance_std", (w, 1))
        self._widths = d, a
        self.reset()

    def reset(self) -> None:
        """Begin a new live episode."""
        self._now = 0
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=self._first + 1)
        self._commands: deque[NDArray[np.float32]] = deque(maxlen=self._first)
        self._smoother: Smoother | None = None

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon.

        Parameters
        ----------
        observation : array of shape (D,)
        action : array of shape (A,), optional
            Commanded since the previous observation. `mewma-a` needs it from the second
            observation on.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When a shape is not that of `fit`, a value is not finite, or an action is missing.
        """
        d, a = self._fitted_widths()
        row = self._live("an observation", observation, d)
        command = np.zeros(a, np.float32)
        if self.actions and self._now:
            command = self._live("an action", action, a)
        if self._now:
            self._commands.append(command)
        self._rows.append(row)
        t, self._now = self._now, self._now + 1
        if t < self._first:
            return float("nan") if t < self.horizon else 0.0
        latest = Trajectory(np.stack(self._rows), np.stack(self._commands))
        self._smoother = self._smoother or Smoother(self.weights, d)
        smoothed = self._smoother(self._clipped(latest, self.coefficients_))
        return float(self._standardized(self._distances(smoothed, self.whitening_))[0])

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When sensors or actions have another width than those of `fit`.
        """
        widths = self._fitted_widths()
        found = (trajectory.observation_dim, trajectory.action_dim)
        if found != widths:
            raise TrajectoryError(
                f"detector {self._name!r} was fitted on (sensors, action columns) {widths} "
                f"and asked to score a trajectory of {found}: score trajectories of the "
                "environment that it was fitted on"
            )
        scores = np.full(len(trajectory), np.nan)
        scores[self.horizon :] = 0.0
        if trajectory.transitions >= self._first:
            smoothed = self._smoothed(trajectory, self.coefficients_)
            distances = self._distances(smoothed, self.whitening_)
            scores[self._first :] = self._standardized(distances)
        return scores

    @property
    def _settings(self) -> dict[str, Any]:
        return {
            "actions": self.actions,
            "horizon": self.horizon,
            "order": self.order,
            "clip": self.clip,
            "weights": self.weights,
        }

    def _fitted_widths(self) -> tuple[int, int]:
        if self._widths is None:
            raise NotFittedError(
                f"detector {self._name!r} was asked for scores before fit: fit it on nominal "
                "trajectories"
            )
        return self._widths

    def _live(self, what: str, values: ArrayLike | None, width: int) -> NDArray[np.float32]:
        found = np.asarray(np.nan if values is None else values, dtype=np.float32)
        if found.shape != (width,) or not np.isfinite(found).all():
            raise TrajectoryError(
                f"detector {self._name!r} was given {what} {'None' if values is None else found}, "
                f"expected {width} finite numbers"
            )
        return found

    def _targets(self, x: Trajectory) -> Floats:
        mean, std = self.observation_scale_
        return (x.observations[self._first :] - mean) / std

    def _regressors(self, x: Trajectory) -> Floats:
        mean, std = self.observation_scale_
        actions = None
        if self.actions:
            action_mean, action_std = self.action_scale_
            actions = (x.actions - action_mean) / action_std
        observations = (x.observations - mean) / std
        return regressors(observations, actions, order=self.order, horizon=self.horizon)

    def _residuals(self, x: Trajectory, coefficients: Floats) -> Floats:
        return self._targets(x) - product(self._regressors(x), coefficients)  # (N, D)

    def _smoothed(self, x: Trajectory, coefficients: Floats) -> Floats:
        """Return the scaled, exponentially weighted, clipped residuals: (W, N, D)."""
        return smooth(self._clipped(x, coefficients), self.weights)

    def _clipped(self, x: Trajectory, coefficients: Floats) -> Floats:
        residuals = self._residuals(x, coefficients) / self.residual_scale_
        return np.clip(residuals, -self.clip, self.clip)

    def _standardized(self, distances: Floats) -> Floats:
        """Return the largest standardized distance of every step: (W, N) to (N,)."""
        standardized: Floats = (distances - self.distance_mean_) / self.distance_std_
        return np.asarray(standardized.max(axis=0))

    def _whitening(self, covariances: Floats) -> list[Floats]:
        return [whitening(c, self.shrinkage) for c in covariances]

    def _distances(self, smoothed: Floats, roots: list[Floats]) -> Floats:
        return np.stack([distance(z, r) for z, r in zip(smoothed, roots, strict=True)])  # (W, N)

    def _integer(self, name: str, value: object) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise self._wrong(name, "an integer of at least 1", value)
        return value

    def _number(self, name: str, value: object, most: float = np.inf) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= most:
            return float(value)
        bound = "" if most == np.inf else f" of at most {most:g}"
        raise self._wrong(name, f"a positive number{bound}", value)

    def _wrong(self, name: str, expected: str, value: object) -> UsageError:
        return UsageError(
            f"parameter {name} of detector {self._name!r}: expected {expected}, got {value!r}"
        )


def _mean_and_std(arrays: Sequence[NDArray[np.float32]]) -> tuple[Floats, Floats]:
    rows = sum(len(a) for a in arrays)
    mean: Floats = np.sum([a.sum(axis=0, dtype=np.float64) for a in arrays], axis=0) / rows
    squares = np.sum([((a - mean) ** 2).sum(axis=0) for a in arrays], axis=0)
    return mean, _scale(np.sqrt(squares / rows))


def _scale(std: Floats) -> Floats:
    return np.where(std < CONSTANT, 1.0, std)
