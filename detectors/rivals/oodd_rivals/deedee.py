"""Two statistics of the episode so far: its mean, and its similarity to rows of training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_rivals.parameters import DeedeeParameters
from oodd_rivals.recent import FOLDS, evenly, stretches

BLOCK: Final = 8
"""Rows that are compared with the summary at once."""

AGES: Final = 10
"""Nominal statistics are told apart by the rows that went into them: 1, 2 to 3, 4 to 7, and so on,
the last of so many groups holding all from 512 on."""

LEAST_SIMILARITY: Final = 1e-300
"""Similarities are not below this, so that their logarithm is finite."""


class RunningMean:
    """Means of the rows so far, of which the latest 1 / w count most.

    ``m_t = m_{t-1} + max(w, 1 / (t + 1)) (y_t - m_{t-1})``: the mean of all rows in the first 1 / w
    of them, then an exponentially weighted one; for w = 0 the mean of all rows for ever.
    """

    def __init__(self, weight: float) -> None:
        self._weight = weight
        self._mean: Floats | float = 0.0
        self._count = 0

    def __call__(self, rows: Floats) -> Floats:
        """Return the mean after each of the next rows, (N, K) to (N, K)."""
        means = np.empty_like(rows)
        for t, row in enumerate(rows):
            self._count += 1
            self._mean = self._mean + max(self._weight, 1 / self._count) * (row - self._mean)
            means[t] = self._mean
        return means


def ages(count: int, begun: int = 0) -> NDArray[np.int64]:
    """Return the groups of the next rows of an episode by the rows so far, see `AGES`: (count,).

    Examples
    --------
    >>> ages(8).tolist(), ages(2, begun=1000).tolist()
    ([0, 1, 1, 2, 2, 2, 2, 3], [9, 9])
    """
    rows = np.arange(begun + 1, begun + count + 1)
    return np.minimum(np.log2(rows).astype(np.int64), AGES - 1)


def similarities(rows: Floats, summary: Floats, bandwidth: float) -> Floats:
    """Return the mean of ``exp(-|x - c|^2 / (2 bandwidth))`` over rows c of a summary: (N,).

    Examples
    --------
    >>> similarities(np.array([[0.0]]), np.array([[0.0], [2.0]]), 2.0).round(4).tolist()
    [0.6839]
    """
    squared = (rows**2).sum(axis=1)[:, None] + (summary**2).sum(axis=1)
    squared -= 2 * product(rows, np.ascontiguousarray(summary.T), BLOCK)
    return np.asarray(np.exp(np.maximum(squared, 0.0) / (-2 * bandwidth)).mean(axis=1))


class DeedeeDetector(StorableWindowDetector):
    r"""Deviation of the mean of the rows so far from training, plus their distance from it.

    .. math:: a_t = \sqrt{\frac{1}{D} \sum_d \Big(\frac{m_{t,d}}{\sigma_d}\Big)^2}, \quad
              b_t = -\log \bar k_t, \quad
              s_t = \frac{a_t - \mu_{a,n}}{\sigma_{a,n}} + \frac{b_t - \mu_{b,n}}{\sigma_{b,n}}

    with :math:`m_t` and :math:`\bar k_t` the running means (`RunningMean`) of the standardized rows
    and of their similarities to a summary of training (`similarities`), and the other letters means
    and deviations of nominal episodes after as many rows (`ages`). Higher means more anomalous. All
    scores are defined; the horizon is without effect: nothing is forecast.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. Nothing here is random.
    parameters
        See `oodd_rivals.parameters.DeedeeParameters`.

    Notes
    -----
    Nominal episodes are compared with a summary that holds none of their rows: five folds take
    turns.

    Source: T. Aljaafari, V. Kanade, P. Torr & C. Schroeder de Witt, "DEEDEE: fast and scalable
    out-of-distribution dynamics detection", arXiv 2510.21638 (2025).
    """

    kind: ClassVar[str] = "deedee/1"

    def __init__(self, name: str, parameters: DeedeeParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, lag=0)
        self.parameters = parameters
        self.summary_: Floats  # (S, D)
        self.bandwidth_: float
        self.spread_: Floats  # (D,), of running means
        self.centre_: Floats  # (AGES, 2), of a and b
        self.unit_: Floats  # (AGES, 2)

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation."""
        self._must_fit(trajectory)
        rows = self._scale()(trajectory).astype(np.float64)
        means = RunningMean(self.parameters.weight)(self._columns(rows))
        return self._judged(means, ages(len(rows)))

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._running: RunningMean | None = None

    def _judge(self, window: NDArray[Any], now: NDArray[Any], t: int) -> float:  # noqa: ARG002
        self._running = self._running or RunningMean(self.parameters.weight)
        means = self._running(self._columns(now[None].astype(np.float64)))
        return float(self._judged(means, ages(1, t))[0])

    def _columns(self, rows: Floats, summary: Floats | None = None) -> Floats:
        """Return rows and their similarities to a summary: (N, D) to (N, D + 1)."""
        summary = self.summary_ if summary is None else summary
        return np.column_stack([rows, similarities(rows, summary, self.bandwidth_)])

    def _statistics(self, means: Floats) -> Floats:
        """Return a and b of running means: (N, D + 1) to (N, 2)."""
        a = np.sqrt(((means[:, :-1] / self.spread_) ** 2).mean(axis=1))
        return np.stack([a, -np.log(np.maximum(means[:, -1], LEAST_SIMILARITY))], axis=1)

    def _judged(self, means: Floats, age: NDArray[np.int64]) -> Floats:
        both = (self._statistics(means) - self.centre_[age]) / self.unit_[age]
        return np.asarray(both[:, 0] + both[:, 1])

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        episodes = stretches([scale(x).astype(np.float64) for x in nominal])
        p = self.parameters
        self.summary_ = evenly(np.concatenate(episodes), p.summary)
        self.bandwidth_ = p.bandwidth * typical_distance(self.summary_)
        count = min(FOLDS, len(episodes))
        means = []
        for i in range(count):
            others = [x for j, x in enumerate(episodes) if j % count != i]
            summary = evenly(np.concatenate(others), p.summary)
            means += [RunningMean(p.weight)(self._columns(x, summary)) for x in episodes[i::count]]
        pooled = np.concatenate(means)
        self.spread_ = _positive(np.sqrt((pooled[:, :-1] ** 2).mean(axis=0)))
        both, age = self._statistics(pooled), np.concatenate([ages(len(m)) for m in means])
        oldest = age.max()
        # Few episodes give few values of a group: those of its neighbours count, too.
        groups = [both[abs(age - min(i, oldest)) <= 1] for i in range(AGES)]
        self.centre_ = np.stack([group.mean(axis=0) for group in groups])
        self.unit_ = _positive(np.stack([group.std(axis=0) for group in groups]))
        return scale

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        return {"weight": p.weight, "bandwidth": p.bandwidth, "summary": p.summary}

    def _arrays(self) -> Arrays:
        return {
            "summary": self.summary_,
            "bandwidth": np.array([self.bandwidth_]),
            "spread": self.spread_,
            "centre": self.centre_,
            "unit": self.unit_,
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self.summary_ = take(arrays, "summary", (None, sensors))
        self.bandwidth_ = float(take(arrays, "bandwidth", (1,), "+")[0])
        self.spread_ = take(arrays, "spread", (sensors,), "+")
        self.centre_ = take(arrays, "centre", (AGES, 2))
        self.unit_ = take(arrays, "unit", (AGES, 2), "+")


def typical_distance(rows: Floats, most: int = 200) -> float:
    """Return the median squared distance of pairs among at most so many rows; 1 where it is 0.

    Examples
    --------
    >>> typical_distance(np.array([[0.0], [1.0], [3.0]]))
    4.0
    """
    few = evenly(rows, most)
    first, second = np.triu_indices(len(few), 1)
    median = float(np.median(((few[first] - few[second]) ** 2).sum(axis=1))) if len(first) else 0.0
    return median if median > CONSTANT else 1.0


def _positive(spread: Floats) -> Floats:
    return np.where(spread < CONSTANT, 1.0, spread)
