"""Mean distance of the latest rows to the nearest of nominal ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from oodd_common.windows import windows

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_rivals.parameters import KnnParameters
from oodd_rivals.recent import RecentRowsDetector, evenly

BLOCK: Final = 8
"""Rows that are compared at once: a streamed one costs as much as so many, thousands of them."""


class KnnDetector(RecentRowsDetector):
    r"""Mean distance to the k nearest nominal windows: ``s_t = 1/k sum_{i<=k} |x_t - n_(i)(x_t)|``.

    :math:`x_t` are the standardized rows :math:`o_t .. o_{t-W+1}` one after the other, divided by
    the square root of W, and :math:`n_{(i)}(x)` the i-th nearest of at most `most` windows, taken
    from training at equal distances. Higher means more anomalous.

    Parameters
    ----------
    name, seed, horizon
        See `RecentRowsDetector`. Nothing here is random.
    parameters
        See `oodd_rivals.parameters.KnnParameters`.

    Notes
    -----
    Source: S. Ramaswamy, R. Rastogi & K. Shim, "Efficient algorithms for mining outliers from large
    data sets", SIGMOD (2000).
    """

    kind: ClassVar[str] = "knn/1"

    def __init__(self, name: str, parameters: KnnParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window)
        self.parameters = parameters
        self.bank_: Floats  # (B, W D)

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        self._keep(evenly(self._windows_of(nominal, scale), self.parameters.most))
        return scale

    def _windows_of(self, nominal: Sequence[Trajectory], scale: FeatureScale) -> Floats:
        """Return every window of training, (N, W D), in the order of time."""
        rows = [windows(scale(x), np.arange(len(x)), self.window) for x in nominal]
        return self._columns(np.concatenate(rows))

    def _columns(self, latest: NDArray[np.float32]) -> Floats:
        flat = latest.reshape(len(latest), -1).astype(np.float64)
        return np.asarray(flat / np.sqrt(self.window))

    def _keep(self, bank: Floats) -> None:
        self.bank_ = bank
        self._transposed = np.ascontiguousarray(bank.T)
        self._lengths = (bank**2).sum(axis=1)

    def _scores(self, latest: NDArray[np.float32]) -> Floats:
        x = self._columns(latest)
        between = (x**2).sum(axis=1)[:, None] + self._lengths
        between -= 2 * product(x, self._transposed, BLOCK)
        return mean_of_nearest(between, self.parameters.neighbours)

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        return {"window": p.window, "neighbours": p.neighbours, "most": p.most}

    def _arrays(self) -> Arrays:
        return {"bank": self.bank_}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self._keep(take(arrays, "bank", (None, sensors * self.window)))


def mean_of_nearest(squared: Floats, neighbours: int) -> Floats:
    """Return the mean of the roots of the smallest squared distances of each row, (N, B) to (N,).

    Examples
    --------
    >>> mean_of_nearest(np.array([[9.0, 1.0, 16.0]]), 2).tolist()
    [2.0]
    """
    k = min(neighbours, squared.shape[1])
    nearest = np.sort(np.partition(squared, k - 1, axis=1)[:, :k], axis=1)
    return np.asarray(np.sqrt(np.maximum(nearest, 0.0)).mean(axis=1))
