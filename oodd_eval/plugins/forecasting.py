"""The paper's section 3, once: the anomaly score of any ensemble of forecasters, at any horizon.

A forecaster predicts ``o_t`` from ``o_0 .. o_{t-h}``. What the forecasters of an ensemble predict,
M samples from each of e members, is compared with what came:

``A_t = 1 / (M e D) * sum_i sum_d |o_{t,d} - f^(i)_{t,d}| / sigma_d``

with sensors standardized by training statistics. Scores are undefined for t < h.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError

CONSTANT: Final = 1e-6
"""A training standard deviation below this is a sensor that does not vary; its scale is then 1."""

GRID: Final = 4096
"""Sampled quantile levels are the midpoints of this many equal parts of (0, 1).

Finer than any quantile that can be learned, and coarse enough for embeddings to be tabulated.
"""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureScale:
    """Mean and standard deviation of every sensor in training: float64 arrays of shape (D,)."""

    mean: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> FeatureScale:
        """Pool all rows of all trajectories; a sensor with std < 1e-6 gets the scale 1.

        Raises
        ------
        TrajectoryError
            When there is no transition, or trajectories differ in their number of sensors.
        """
        widths = sorted({x.observation_dim for x in nominal})
        if len(widths) != 1 or not any(x.transitions for x in nominal):
            raise TrajectoryError(
                f"cannot fit on {len(nominal)} trajectories with "
                f"{sum(x.transitions for x in nominal)} transitions and {widths} sensors: expected "
                "at least one transition and the same number of sensors everywhere"
            )
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        std = rows.std(axis=0)
        return cls(rows.mean(axis=0), np.where(std < CONSTANT, 1.0, std))

    def __call__(self, trajectory: Trajectory) -> NDArray[np.float32]:
        """Return the standardized observations, float32 of shape (T + 1, D).

        Raises
        ------
        TrajectoryError
            When the trajectory has another number of sensors.
        """
        if trajectory.observation_dim != len(self.mean):
            raise TrajectoryError(
                f"fitted on {len(self.mean)} sensors and asked to score a trajectory of "
                f"{trajectory.observation_dim}: score trajectories of the environment that the "
                "detector was fitted on"
            )
        return ((trajectory.observations - self.mean) / self.std).astype(np.float32)

    def row(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return one standardized observation, float32 of shape (D,).

        Raises
        ------
        TrajectoryError
            When it has another number of sensors, or a value that is not finite.
        """
        found = np.asarray(observation, dtype=np.float32)
        if found.shape != self.mean.shape or not np.isfinite(found).all():
            raise TrajectoryError(
                f"fitted on {len(self.mean)} sensors and given an observation of shape "
                f"{found.shape} with {int((~np.isfinite(found)).sum())} values that are not "
                f"finite: expected ({len(self.mean)},), all finite"
            )
        return ((found - self.mean) / self.std).astype(np.float32)


def anomaly_scores(
    observations: NDArray[np.float32], errors: NDArray[np.float64], horizon: int
) -> NDArray[np.float64]:
    """Return scores of one trajectory from the mean absolute errors of its forecasts.

    Parameters
    ----------
    observations : array of shape (T + 1, D)
    errors : float64 array of shape (T + 1 - horizon,)
        Mean over samples, members and sensors of ``|o_t - f_t|`` for ``t >= horizon``.
    """
    scores = np.full(len(observations), np.nan)
    scores[horizon:] = errors
    return scores


def quantile_levels(
    seed: int, times: range, steps: int, members: int, samples: int, features: int
) -> NDArray[np.int64]:
    """Draw quantile levels keyed by seed and time, as indices into the grid of midpoints.

    The levels for time t depend on nothing but the seed and t, so that scores do not depend on
    what is scored before, beside or after.

    Parameters
    ----------
    seed
        Seed of the detector.
    times
        Times t whose observation is predicted.
    steps
        Prediction horizon h: levels for every step of the rollout that ends at t.
    members, samples, features
        Ensemble members E, samples M, sensors D.

    Returns
    -------
    int64 array of shape (len(times), steps, E, M, D)
        Level ``(k + 0.5) / GRID`` for index k.
    """
    shape = (steps, members, samples, features)
    drawn = [np.random.default_rng([seed, t]).integers(GRID, size=shape) for t in times]
    return np.array(drawn, dtype=np.int64).reshape(len(times), *shape)
