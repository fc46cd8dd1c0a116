"""The probability that an episode fails, by running features of its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_outcomes.learning import LogOdds, learn

KINDS: Final = 4
"""Features of a sensor: its last reading, and mean, spread and largest of all so far."""


class RunningFeatures:
    """Features of the rows of an episode so far; each call continues where the last one ended.

    Of each sensor the last reading, and mean, standard deviation and largest of all so far; then
    the number of rows.

    Parameters
    ----------
    sensors
        Their number, D.

    Examples
    --------
    >>> RunningFeatures(1)(np.array([[1.0], [3.0]])).tolist()
    [[1.0, 1.0, 0.0, 1.0, 1.0], [3.0, 2.0, 1.0, 3.0, 2.0]]
    """

    def __init__(self, sensors: int) -> None:
        self._count = 0
        self._sums = np.zeros((1, 2 * sensors))  # of readings and of their squares
        self._largest = np.full((1, sensors), -np.inf)

    def __call__(self, rows: Floats) -> Floats:
        """Return the features after each of the next rows, (N, D) to (N, 4 D + 1)."""
        counts = np.arange(self._count + 1.0, self._count + len(rows) + 1)[:, None]
        # Both add row by row, so that a stream has the same bits.
        sums = np.cumsum(np.vstack([self._sums, np.hstack([rows, rows**2])]), axis=0)[1:]
        largest = np.maximum.accumulate(np.vstack([self._largest, rows]), axis=0)[1:]
        self._count, self._sums, self._largest = int(counts[-1, 0]), sums[-1:], largest[-1:]
        mean, square = np.hsplit(sums / counts, 2)
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        return np.hstack([rows, mean, spread, largest, counts])


class OutcomeDetector(StorableWindowDetector):
    """The probability that the episode fails, as rows so far tell it.

    It is a logistic function of `RunningFeatures`, fitted by `oodd_outcomes.learning.learn`. Higher
    means that a failure is likelier; both outcomes are taken to be equally frequent. All scores are
    defined; the horizon is without effect.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. Nothing here is random.
    ridge
        Precision of the coefficients of standardized features around 0.
    time
        Whether the number of the row is a feature.
    temporal
        Whether the probability of a row is fitted to that of the next one, and the last row's to
        the outcome. If not, each row's is fitted to the outcome, of rows up to the median length
        of nominal training episodes.
    """

    kind: ClassVar[str] = "outcome/1"

    def __init__(
        self, name: str, *, ridge: float, time: bool, temporal: bool, seed: int, horizon: int
    ) -> None:
        super().__init__(name, seed=seed, horizon=horizon, lag=0)
        self.ridge, self.time, self.temporal = ridge, time, temporal
        self.log_odds_: LogOdds

    def fit(
        self, nominal: Sequence[Trajectory], failures: Sequence[Trajectory] | None = None
    ) -> Self:
        """Learn from nominal and failed episodes, forgetting any earlier fit.

        Raises `TrajectoryError` without any of both, or where they cannot be learned from.
        """
        good, bad = len(nominal), len(failures or ())
        if not good or not bad:
            raise TrajectoryError(
                f"detector {self.name!r} was fitted on {good} nominal and {bad} failed episodes, "
                "expected some of both: call fit(nominal, failures=...); for logs, import them "
                "with an outcome and failures = 0.5, the share of failed episodes for training"
            )
        self._outcomes = np.repeat([0.0, 1.0], [good, bad])
        return super().fit([*nominal, *(failures or ())])

    def score(self, trajectory: Trajectory) -> Floats:
        """Return the probability of failure after each observation."""
        self._must_fit(trajectory)
        return self.log_odds_(self._features(self._scale()(trajectory)))

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._running: RunningFeatures | None = None

    def _judge(self, window: NDArray[Any], now: NDArray[Any], t: int) -> float:  # noqa: ARG002
        self._running = self._running or RunningFeatures(len(now))
        return float(self.log_odds_(self._features(now[None], self._running))[0])

    def _features(self, rows: NDArray[Any], running: RunningFeatures | None = None) -> Floats:
        features = (running or RunningFeatures(rows.shape[1]))(rows.astype(np.float64))
        return features if self.time else features[:, :-1]

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale, outcomes = FeatureScale.fit(nominal), self._outcomes
        episodes = [self._features(scale(x)) for x in nominal]
        if not self.temporal:
            # Beyond the usual length only failures go on, and the length alone tells outcomes.
            usual = int(
                np.median([len(x) for x, y in zip(episodes, outcomes, strict=True) if not y])
            )
            episodes = [x[:usual] for x in episodes]
        self.log_odds_ = learn(episodes, outcomes, self.ridge, temporal=self.temporal)
        return scale

    def _fitted_with(self) -> dict[str, Any]:
        return {"ridge": self.ridge, "time": self.time, "temporal": self.temporal}

    def _arrays(self) -> Arrays:
        return self.log_odds_._asdict()

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        columns = KINDS * sensors + self.time
        self.log_odds_ = LogOdds(
            take(arrays, "centre", (columns,)),
            take(arrays, "unit", (columns,), "+"),
            take(arrays, "weights", (columns + 1,)),
        )
