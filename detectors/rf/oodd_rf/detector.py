"""An ensemble of random forests whose prediction failure is the anomaly score.

The score of an observation is the mean absolute difference between it and the forests' forecasts,
over forests and sensors, in training standard deviations of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays
from oodd_rf import ForestParameters
from oodd_rf.forest import Forest
from oodd_rf.windows import Floats, Rows

BATCH: Final = 8192
"""Windows that are rolled out together: bounds the memory of scoring."""

MEMBERS: Final = ((1 / 3, 2), (1 / 3, 1), (1 / 2, 2), (2 / 3, 3), (1 / 4, 1))
"""``max_features`` and ``min_samples_leaf`` of the members, repeated after the last."""


class RandomForestDetector(StorableWindowDetector):
    r"""Random forests that predict the next observation from a window of recent ones.

    .. math:: s_t = \frac{1}{e D} \sum_{i=1}^{e} \sum_{d=1}^{D}
              \frac{|o_{t,d} - \hat o^{(i)}_{t,d}|}{\sigma_d}

    where :math:`\hat o^{(i)}_t` is what forest i makes of the observations up to
    :math:`o_{t-h}`, fed back h times, and :math:`\sigma_d` the standard deviation of sensor d in
    training (1 where it is below 1e-6). Higher means more anomalous. Scores are undefined (NaN)
    for t < h only: windows that reach before the beginning repeat the first observation.

    A forest predicts the difference from the newest observation: averages of training rows cannot
    follow a sensor beyond them, and the error on held-out nominal trajectories is a third lower.
    Members use windows of W, W - 1, ..., 1, W observations and so on. Whatever the horizon, they
    learn one-step transitions, each from a random subset of its own.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. The seed decides rows, bootstrap samples and features of every tree.
    parameters
        `members`, `trees` and `leaves` bound the memory of a fitted detector to about
        ``members * trees * 2 * leaves * (64 + 8 * D)`` bytes.

    Notes
    -----
    Source: Danesh & Fern (2021), section 3; Breiman, "Random forests", Machine Learning 45 (2001).
    """

    kind: ClassVar[str] = "rf/1"

    def __init__(self, name: str, parameters: ForestParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window)
        self.parameters = parameters
        self.members_: list[Forest] = []

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        return self.score_many([trajectory])[0]

    def score_many(self, trajectories: Sequence[Trajectory]) -> list[Floats]:
        """Return the scores of several trajectories, rolled out together.

        Every window is predicted on its own, so the scores are those of `score`, bit for bit.
        """
        scale = self._scale()
        if not trajectories:
            return []
        stacked = Rows.stack(trajectories, scale)
        scores = np.full(len(stacked.values), np.nan)
        defined = stacked.with_history(self.horizon)
        for start in range(0, len(defined), BATCH):
            batch = defined[start : start + BATCH]
            history = stacked.window(batch - self.horizon, self.window)
            scores[batch] = self._errors(history, stacked.values[batch])
        return np.split(scores, np.cumsum([len(x) for x in trajectories])[:-1])

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        stacked = Rows.stack(nominal, scale)
        self.members_ = [self._fit_member(stacked, i) for i in range(self.parameters.members)]
        return scale

    def _fit_member(self, stacked: Rows, i: int) -> Forest:
        from sklearn.ensemble import RandomForestRegressor  # noqa: PLC0415  an optional extra

        p = self.parameters
        rng = np.random.default_rng([self.seed, i])
        rows = stacked.with_history(1)
        if len(rows) > p.rows:
            rows = np.sort(rng.choice(rows, p.rows, replace=False))
        window = self._window_of(i)
        max_features, min_samples_leaf = MEMBERS[i % len(MEMBERS)]
        history = stacked.window(rows - 1, window)  # (N, W, D)
        difference = stacked.values[rows].astype(np.float64) - history[:, 0]  # (N, D)
        forest = RandomForestRegressor(
            n_estimators=p.trees,
            max_features=max_features,
            min_samples_leaf=min_samples_leaf,
            max_leaf_nodes=p.leaves,
            max_samples=min(p.draws, len(rows)),
            random_state=int(rng.integers(2**31)),
            n_jobs=1,
        )
        # With a single sensor scikit-learn wants a vector of targets.
        target = difference if difference.shape[1] > 1 else difference[:, 0]
        forest.fit(history.reshape(len(rows), -1), target)
        return Forest([tree.tree_ for tree in forest.estimators_], window)

    def _window_of(self, i: int) -> int:
        return self.window - i % self.window

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        return float(self._errors(window[None], now[None])[0])

    def _errors(self, history: NDArray[np.float32], now: NDArray[np.float32]) -> Floats:
        """Return the mean absolute errors, (B,), of forecasts of (B, D) from (B, W, D)."""
        total = np.zeros(len(now))
        for member in self.members_:
            predicted = member.forecast(history[:, : member.window], self.horizon)
            total += np.abs(now - predicted).mean(axis=1)
        return total / len(self.members_)

    def _fitted_with(self) -> dict[str, Any]:
        return {"members": self.parameters.members, "window": self.window}

    def _arrays(self) -> Arrays:
        return {
            f"{i}.{name}": array
            for i, member in enumerate(self.members_)
            for name, array in member.arrays().items()
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self.members_ = [
            Forest.of(
                {k.partition(".")[2]: v for k, v in arrays.items() if k.startswith(f"{i}.")},
                self._window_of(i),
                sensors,
            )
            for i in range(self.parameters.members)
        ]
