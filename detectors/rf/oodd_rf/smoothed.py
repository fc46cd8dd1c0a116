"""The running mean of the forests' score: what accumulating evidence adds to a score per step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from oodd_eval import Trajectory
from oodd_rf import SmoothedForestParameters
from oodd_rf.detector import RandomForestDetector
from oodd_rf.windows import Floats


class SmoothedForestDetector(RandomForestDetector):
    r"""Exponentially weighted running mean of `RandomForestDetector`'s score.

    .. math:: z_h = s_h, \quad z_t = (1 - w) z_{t-1} + w s_t

    with the weight w and the horizon h, before which z is undefined as s is. The state of one is
    one of the other.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`.
    parameters
        Those of `RandomForestDetector`, and the weight.
    """

    def __init__(
        self, name: str, parameters: SmoothedForestParameters, *, seed: int, horizon: int
    ) -> None:
        super().__init__(name, parameters, seed=seed, horizon=horizon)
        self.weight = parameters.weight

    def score_many(self, trajectories: Sequence[Trajectory]) -> list[Floats]:
        """Return the scores of several trajectories, rolled out together."""
        return [
            np.array(list(accumulate(raw.tolist(), self._mean)), dtype=np.float64)
            for raw in super().score_many(trajectories)
        ]

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._latest = math.nan

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        self._latest = self._mean(self._latest, super()._judge(window, now, t))
        return self._latest

    def _mean(self, before: float, score: float) -> float:
        """Return the next running mean; the first defined score is its own."""
        if math.isnan(before):
            return score
        return (1.0 - self.weight) * before + self.weight * score
