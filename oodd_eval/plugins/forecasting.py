"""The paper's section 3: the anomaly score of any ensemble of forecasters, at any horizon.

A forecaster predicts ``o_t`` from ``o_0 .. o_{t-h}``. What the forecasters of an ensemble predict,
M samples from each of e members, is compared with what came:

``A_t = 1 / (M e D) * sum_i sum_d |o_{t,d} - f^(i)_{t,d}| / sigma_d``

with sensors standardized by training statistics. Scores are undefined for t < h.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.state import Arrays, take

CONSTANT: Final = 1e-6
"""A training standard deviation below this is a sensor that does not vary; its scale is then 1."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureScale:
    """Mean and standard deviation of every sensor in training: float64 arrays of shape (D,)."""

    mean: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> "FeatureScale":
        """Pool all rows of all trajectories; a sensor with std < 1e-6 gets the scale 1.

        Raises `TrajectoryError` without a transition, or for unequal numbers of sensors.
        """
        widths = sorted({x.observation_dim for x in nominal})
        transitions = sum(x.transitions for x in nominal)
        if len(widths) != 1 or not transitions:
            data = f"{len(nominal)} trajectories with {transitions} transitions, {widths} sensors"
            expected = "at least one transition and the same number of sensors everywhere"
            raise TrajectoryError(f"cannot fit on {data}: expected {expected}")
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        std = rows.std(axis=0)
        return cls(rows.mean(axis=0), np.where(std < CONSTANT, 1.0, std))

    @classmethod
    def of(cls, arrays: Arrays, name: str = "") -> "FeatureScale":
        """Return the scale among saved arrays; `FittedStateError` where there is none.

        With a `name` it is the two rows of that array.
        """
        if name:
            arrays = dict(zip(("mean", "std"), take(arrays, name, (2, None)), strict=True))
        mean = take(arrays, "mean", (None,))
        return cls(mean, take(arrays, "std", mean.shape, "+"))

    def arrays(self) -> Arrays:
        """Return what `of` reads."""
        return {"mean": self.mean, "std": self.std}

    def __call__(self, trajectory: Trajectory) -> NDArray[np.float32]:
        """Return the standardized observations, float32 of shape (T + 1, D).

        Raises `TrajectoryError` when the trajectory has another number of sensors.
        """
        self.must_fit(trajectory)
        return ((trajectory.observations - self.mean) / self.std).astype(np.float32)

    def must_fit(self, trajectory: Trajectory) -> None:
        """Raise `TrajectoryError` when the trajectory has another number of sensors."""
        if (sensors := trajectory.observation_dim) != len(self.mean):
            mismatch = (
                f"fitted on {len(self.mean)} sensors and asked to score a trajectory of {sensors}"
            )
            advice = "score trajectories of the environment that the detector was fitted on"
            raise TrajectoryError(f"{mismatch}: {advice}")

    def row(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return one standardized observation, float32 of shape (D,); raises as `checked` does."""
        return ((self.checked(observation) - self.mean) / self.std).astype(np.float32)

    def checked(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return a copy of one observation as it is, float32 of shape (D,).

        Raises `TrajectoryError` for another number of sensors, or a value that is not finite.
        """
        row = np.array(observation, dtype=np.float32)
        if row.shape != self.mean.shape or not np.isfinite(row).all():
            n, wild = len(self.mean), int((~np.isfinite(row)).sum())
            actual = f"an observation of shape {row.shape} with {wild} values that are not finite"
            expected = f"expected ({n},), all finite"
            raise TrajectoryError(f"fitted on {n} sensors and given {actual}: {expected}")
        return row


def anomaly_scores(
    observations: NDArray[np.float32], errors: NDArray[np.float64], horizon: int
) -> NDArray[np.float64]:
    """Return scores of one trajectory from the mean absolute errors of its forecasts.

    Parameters
    ----------
    observations : float32 array of shape (T + 1, D)
        Standardized readings of one episode; only their number counts.
    errors : float64 array of shape (T + 1 - horizon,)
        Means over samples, members and sensors of ``|o_t - f_t|`` for ``t >= horizon``, in training
        standard deviations.
    horizon : int
        Prediction horizon in steps.

    Returns
    -------
    float64 array of shape (T + 1,)
        NaN for ``t < horizon``.
    """
    scores = np.full(len(observations), np.nan)
    scores[horizon:] = errors
    return scores
