"""An ensemble of random forests whose prediction failure is the anomaly score."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval import Trajectory
from oodd_eval.errors import NotFittedError, UsageError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import load_state, save_state, take
from oodd_rf.forest import Forest
from oodd_rf.windows import Floats, Indices, Rows

KIND: Final = "rf/1"
"""What is saved, and the version of its layout."""

BATCH: Final = 8192
"""Windows that are rolled out together: bounds the memory of scoring."""

SETTINGS: Final = ((1 / 3, 2), (1 / 3, 1), (1 / 2, 2), (2 / 3, 3), (1 / 4, 1))
"""``max_features`` and ``min_samples_leaf`` of the members, repeated after the last."""


class RandomForestDetector:
    r"""Random forests that predict the next observation from a window of recent ones.

    .. math:: s_t = \frac{1}{e D} \sum_{i=1}^{e} \sum_{d=1}^{D}
              \frac{|o_{t,d} - \hat o^{(i)}_{t,d}|}{\sigma_d}

    where :math:`\hat o^{(i)}_t` is what forest i makes of the observations up to
    :math:`o_{t-h}`, fed back h times, and :math:`\sigma_d` the standard deviation of sensor d in
    training (1 where it is below 1e-6). Higher means more anomalous. Scores are undefined (NaN)
    for t < h only: windows that reach before the beginning repeat the first observation.

    A forest predicts the difference from the newest observation: averages of training rows cannot
    follow a sensor beyond them, and the error on held-out nominal trajectories is a third lower.

    Parameters
    ----------
    seed
        Decides rows, bootstrap samples and features of every tree.
    horizon
        Steps between the last observation that a forecast uses and the one it predicts, h.
    members
        Forests, e. They differ in seed, training rows, window, ``max_features`` and
        ``min_samples_leaf``.
    window
        Observations in the longest window, W; members use W, W - 1, ..., 1, W and so on.
    trees
        Trees in a forest.
    leaves
        Leaves of a tree, at most; together with `trees` this bounds the memory of a fitted
        detector to about ``members * trees * 2 * leaves * (64 + 8 * D)`` bytes.
    rows
        Transitions that a forest is trained on, at most: a random subset of all.
    draws
        Size of the bootstrap sample of a tree, at most `rows`.

    Raises
    ------
    UsageError
        When a parameter is not an integer in its range.

    Notes
    -----
    Source: Danesh & Fern (2021), section 3; Breiman, "Random forests", Machine Learning 45 (2001).
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        horizon: int = 1,
        members: int = 5,
        window: int = 4,
        trees: int = 10,
        leaves: int = 2000,
        rows: int = 20_000,
        draws: int = 6000,
    ) -> None:
        self.seed = _integer("seed", seed, 0)
        self.horizon = _integer("horizon", horizon, 1)
        self.members = _integer("members", members, 1)
        self.window = _integer("window", window, 1)
        self.trees = _integer("trees", trees, 1)
        self.leaves = _integer("leaves", leaves, 2)
        self.rows = _integer("rows", rows, 1)
        self.draws = _integer("draws", draws, 1)
        self.members_: list[Forest] = []
        self.scale_: FeatureScale
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> RandomForestDetector:
        """Fit the forests to one-step transitions of nominal trajectories, whatever the horizon.

        Raises
        ------
        TrajectoryError
            When there is no transition, or the trajectories differ in their number of sensors.
        """
        self.scale_ = FeatureScale.fit(nominal)
        stacked = Rows.stack(nominal, self.scale_)
        self.members_ = [self._fit_member(stacked, i) for i in range(self.members)]
        self.reset()
        return self

    def save(self, directory: Path) -> None:
        """Write the forests into a directory, as plain arrays and JSON.

        Raises
        ------
        NotFittedError
            Before `fit`.
        """
        self._check_fitted()
        arrays = {"mean": self.scale_.mean, "std": self.scale_.std}
        for i, member in enumerate(self.members_):
            arrays |= {f"{i}.{name}": array for name, array in member.arrays().items()}
        save_state(directory, kind=KIND, settings=self._settings, arrays=arrays)

    def load(self, directory: Path) -> None:
        """Take over forests that `save` wrote; the horizon may be another.

        Raises
        ------
        FittedStateError
            When the files are missing, damaged, or of other forests.
        """
        arrays = load_state(directory, kind=KIND, settings=self._settings)
        mean = take(arrays, "mean", (None,))
        self.scale_ = FeatureScale(mean, take(arrays, "std", mean.shape))
        self.members_ = [
            Forest.of(
                {k.partition(".")[2]: v for k, v in arrays.items() if k.startswith(f"{i}.")},
                self._window_of(i),
                len(mean),
            )
            for i in range(self.members)
        ]
        self.reset()

    def reset(self) -> None:
        """Begin a new live episode."""
        self._latest: deque[NDArray[np.float32]] = deque(maxlen=self.window)
        self._awaited: deque[Floats] = deque()

    def update(
        self,
        observation: NDArray[np.float32],
        action: NDArray[np.float32] | None = None,  # noqa: ARG002  the contract's name
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When the observation has another number of sensors, or a value that is not finite.
        """
        self._check_fitted()
        row = self.scale_.row(observation)
        score = float("nan")
        if len(self._awaited) == self.horizon:
            score = float(np.abs(row - self._awaited.popleft()).mean(axis=1).mean())
        if not self._latest:
            self._latest.extend([row] * self.window)
        self._latest.appendleft(row)
        history = np.stack(self._latest)[None]  # (1, W, D)
        forecasts = [m.forecast(history[:, : m.window], self.horizon) for m in self.members_]
        self._awaited.append(np.concatenate(forecasts))  # (e, D)
        return score

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When the trajectory has another number of sensors than those of `fit`.
        """
        return self.score_many([trajectory])[0]

    def score_many(self, trajectories: Sequence[Trajectory]) -> list[Floats]:
        """Return the scores of several trajectories, rolled out together.

        Every window is predicted on its own, so the scores are those of `score`, bit for bit.
        """
        self._check_fitted()
        if not trajectories:
            return []
        stacked = Rows.stack(trajectories, self.scale_)
        scores = np.full(len(stacked.values), np.nan)
        defined = stacked.with_history(self.horizon)
        for start in range(0, len(defined), BATCH):
            batch = defined[start : start + BATCH]
            scores[batch] = self._errors(stacked, batch)
        return np.split(scores, np.cumsum([len(x) for x in trajectories])[:-1])

    def _check_fitted(self) -> None:
        if not self.members_:
            raise NotFittedError(
                "detector 'rf' was asked for scores before fit: fit it on nominal trajectories"
            )

    @property
    def _settings(self) -> dict[str, Any]:
        return {"members": self.members, "window": self.window}

    def _window_of(self, i: int) -> int:
        return self.window - i % self.window

    def _fit_member(self, stacked: Rows, i: int) -> Forest:
        from sklearn.ensemble import RandomForestRegressor  # noqa: PLC0415  an optional extra

        rng = np.random.default_rng([self.seed, i])
        rows = stacked.with_history(1)
        if len(rows) > self.rows:
            rows = np.sort(rng.choice(rows, self.rows, replace=False))
        window = self._window_of(i)
        max_features, min_samples_leaf = SETTINGS[i % len(SETTINGS)]
        history = stacked.window(rows - 1, window)  # (N, W, D)
        difference = stacked.values[rows].astype(np.float64) - history[:, 0]  # (N, D)
        forest = RandomForestRegressor(
            n_estimators=self.trees,
            max_features=max_features,
            min_samples_leaf=min_samples_leaf,
            max_leaf_nodes=self.leaves,
            max_samples=min(self.draws, len(rows)),
            random_state=int(rng.integers(2**31)),
            n_jobs=1,
        )
        # With a single sensor scikit-learn wants a vector of targets.
        target = difference if difference.shape[1] > 1 else difference[:, 0]
        forest.fit(history.reshape(len(rows), -1), target)
        return Forest([tree.tree_ for tree in forest.estimators_], window)

    def _errors(self, stacked: Rows, batch: Indices) -> Floats:
        """Return the mean absolute error of the members' forecasts of the rows of a batch."""
        total = np.zeros(len(batch))
        for member in self.members_:
            history = stacked.window(batch - self.horizon, member.window)
            predicted = member.forecast(history, self.horizon)
            total += np.abs(stacked.values[batch] - predicted).mean(axis=1)
        return total / len(self.members_)


def _integer(name: str, value: object, least: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise UsageError(
            f"parameter {name} of detector 'rf': expected an integer of at least {least}, "
            f"got {value!r}"
        )
    return value
