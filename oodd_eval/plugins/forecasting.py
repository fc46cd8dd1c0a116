"""Sensors standardized by training statistics, as most detectors look at them."""

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
