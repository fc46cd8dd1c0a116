"""Windows of standardized observations, gathered from many trajectories at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import windows

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Rows:
    """Observations of several trajectories under each other.

    Attributes
    ----------
    values : float32 array of shape (N, D)
        Standardized observations.
    first : int64 array of shape (N,)
        Row number of ``o_0`` of the trajectory that each row belongs to.
    """

    values: NDArray[np.float32]
    first: Indices

    @classmethod
    def stack(cls, trajectories: Sequence[Trajectory], scale: FeatureScale) -> Rows:
        """Standardize the observations of the trajectories and stack them."""
        lengths = np.array([len(x) for x in trajectories], dtype=np.int64)
        values = np.concatenate([scale(x) for x in trajectories])
        return cls(values, np.repeat(np.cumsum(lengths) - lengths, lengths))

    def with_history(self, horizon: int) -> Indices:
        """Return the rows ``o_t`` with t >= horizon: those that a forecast can be made for."""
        rows = np.arange(len(self.first))
        return rows[rows - self.first >= horizon]

    def window(self, last: Indices, length: int) -> NDArray[np.float32]:
        """Return the windows that end in the rows of these numbers: (B, W, D), newest first."""
        return windows(self.values, last, length, self.first[last])
