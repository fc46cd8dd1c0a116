"""Principal components of the latest rows: Hotelling's T2 and the squared prediction error Q."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from oodd_common.windows import windows

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_rivals.parameters import PcaParameters
from oodd_rivals.recent import RecentRowsDetector, folds_of

BLOCK: Final = 8
"""Rows that are judged at once: a streamed one costs as much as so many."""

MOST_ROWS: Final = 1000
"""Of windows with more numbers than this, about so many are learnt from, at equal distances.

With a thousand sensors the components of all of them would take minutes and gigabytes.
"""

LEAST_VARIANCE: Final = 1e-9
"""A component of less than this share of the largest one's variance is rounding."""


@dataclass(frozen=True, slots=True)
class Components:
    """Principal components of rows of K columns.

    Attributes
    ----------
    mean : float64 array of shape (K,)
        Mean of the rows.
    loadings : float64 array of shape (K, C)
        Orthonormal directions, that of the largest variance first.
    variances : float64 array of shape (C,)
        Variances along them.
    """

    mean: Floats
    loadings: Floats
    variances: Floats

    @classmethod
    def of(cls, rows: Floats, share: float) -> Components:
        """Return the fewest components that explain a share, in (0, 1], of the rows' variance.

        They are those of the covariance, (K, K), or of the products of rows, (N, N), whichever is
        smaller.

        Examples
        --------
        >>> c = Components.of(np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), 0.7)
        >>> c.variances.tolist(), abs(c.loadings).tolist()
        ([2.0], [[1.0], [0.0]])
        """
        mean, columns = rows.mean(axis=0), rows.shape[1]
        centred, n = rows - mean, len(rows)
        if columns <= n:
            variances, directions = np.linalg.eigh(centred.T @ centred / n)
        else:
            variances, left = np.linalg.eigh(centred @ centred.T / n)
        variances = variances[::-1]
        explained = np.cumsum(np.maximum(variances, 0.0))
        kept = 1 + int(np.searchsorted(explained, share * explained[-1] * (1 - LEAST_VARIANCE)))
        kept = min(kept, int((variances > LEAST_VARIANCE * max(variances[0], 0.0)).sum()))
        if columns <= n:
            loadings = directions[:, ::-1][:, :kept]
        else:
            loadings = centred.T @ left[:, ::-1][:, :kept] / np.sqrt(n * variances[:kept])
        return cls(mean, np.ascontiguousarray(loadings), variances[:kept])

    def t_squared_and_q(self, rows: Floats) -> Floats:
        """Return T2 and Q of rows (N, K), (2, N).

        T2 is the squared length within the components, each in its standard deviations; Q, the
        squared prediction error, that of what they leave.
        """
        centred = rows - self.mean
        scores = product(centred, self.loadings, BLOCK)
        left = centred - product(scores, self.loadings.T, BLOCK)
        return np.stack([(scores**2 / self.variances).sum(axis=1), (left**2).sum(axis=1)])


class PcaDetector(RecentRowsDetector):
    r"""Distance of the latest rows from the nominal mean, within and off the components.

    .. math:: s_t = \sqrt{T^2(x_t) / q_T + Q(x_t) / q_Q}

    where :math:`x_t` is the mean of the standardized rows :math:`o_t .. o_{t-W+1}`, or all of them
    in a row, and :math:`q_T, q_Q` are quantiles of nominal T2 and Q. Higher means more anomalous.

    Parameters
    ----------
    name, seed, horizon
        See `RecentRowsDetector`. Nothing here is random.
    parameters
        See `oodd_rivals.parameters.PcaParameters`.

    Notes
    -----
    The quantiles are of nominal rows that the components were not computed from, see
    `oodd_rivals.recent.folds_of`; scoring uses the components of all rows together.

    Sources: J. F. MacGregor & T. Kourti, "Statistical process control of multivariate processes",
    Control Engineering Practice 3 (1995); J. E. Jackson & G. S. Mudholkar, "Control procedures for
    residuals associated with principal component analysis", Technometrics 21 (1979).
    """

    kind: ClassVar[str] = "pca/1"

    def __init__(self, name: str, parameters: PcaParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window)
        self.parameters = parameters
        self.components_: Components
        self.limits_: Floats  # (2, 1), of T2 and Q

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        wide = self.window * len(scale.mean) > MOST_ROWS
        step = -(-sum(len(x) for x in nominal) // MOST_ROWS) if wide else 1
        folds = folds_of(
            [
                self._columns(windows(scale(x), np.arange(0, len(x), step), self.window))
                for x in nominal
            ]
        )
        p = self.parameters
        self.components_ = Components.of(np.concatenate(folds), p.share)
        unseen = []
        for i, fold in enumerate(folds):
            others = Components.of(np.concatenate(folds[:i] + folds[i + 1 :]), p.share)
            unseen.append(others.t_squared_and_q(fold))
        limits = np.quantile(np.concatenate(unseen, axis=1), p.quantile, axis=1, keepdims=True)
        # Without any variance, or with all of it explained, one of them is rounding.
        self.limits_ = np.where(limits < LEAST_VARIANCE, 1.0, limits)
        return scale

    def _scores(self, latest: NDArray[np.float32]) -> Floats:
        both = self.components_.t_squared_and_q(self._columns(latest)) / self.limits_
        return np.asarray(np.sqrt(both[0] + both[1]))

    def _columns(self, latest: NDArray[np.float32]) -> Floats:
        """Return what the components are of: windows (N, W, D) to (N, D) or (N, W D)."""
        if self.parameters.rows == "stacked":
            return latest.reshape(len(latest), -1).astype(np.float64)
        newest_first = (latest[:, i].astype(np.float64) for i in range(self.window))
        return reduce(add, newest_first) / self.window

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        return {"window": p.window, "rows": p.rows, "share": p.share, "quantile": p.quantile}

    def _arrays(self) -> Arrays:
        c = self.components_
        return {
            "centre": c.mean,
            "loadings": c.loadings,
            "variances": c.variances,
            "limits": self.limits_,
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        columns = sensors * (self.window if self.parameters.rows == "stacked" else 1)
        variances = take(arrays, "variances", (None,), "+")
        loadings = take(arrays, "loadings", (columns, len(variances)))
        self.components_ = Components(take(arrays, "centre", (columns,)), loadings, variances)
        self.limits_ = take(arrays, "limits", (2, 1), "+")
