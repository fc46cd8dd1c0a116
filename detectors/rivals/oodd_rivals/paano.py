"""Distance of the latest rows to nominal ones among what a small network makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from sklearn.cluster import KMeans

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_rivals.knn import mean_of_nearest
from oodd_rivals.parameters import PaanoParameters
from oodd_rivals.patches import (
    KERNEL,
    LAYERS,
    Convolutions,
    Heads,
    Patches,
    embedded,
    normalized,
    train,
)
from oodd_rivals.recent import RecentRowsDetector, spread

BLOCK: Final = 8
"""Patches that are compared with the bank at once."""

CHUNK: Final = 1024
"""Patches that are embedded at once, which bounds memory."""

LEAST_LENGTH: Final = 1e-12

CLUSTERED: Final = 10_000
"""Patches from which the bank is chosen at most, at equal distances."""


class PaanoDetector(RecentRowsDetector):
    r"""Mean distance of a patch's embedding to the nearest of nominal patches.

    .. math:: s_t = \frac{1}{k} \sum_{i \le k} |f(p_t) - n_{(i)}(p_t)|

    with the patch :math:`p_t` of the rows :math:`o_t .. o_{t-W+1}`, the encoder f of
    `oodd_rivals.patches` and the nearest embeddings n in a bank of nominal ones. Higher means more
    anomalous.

    Parameters
    ----------
    name, seed, horizon
        See `RecentRowsDetector`. The seed decides networks, batches and clusters.
    parameters
        See `oodd_rivals.parameters.PaanoParameters`.

    Notes
    -----
    Source: J. Park & S. Kang, "PaAno: patch-based representation learning for time-series anomaly
    detection", ICLR (2026), arXiv 2602.01359.
    """

    kind: ClassVar[str] = "paano/1"

    def __init__(self, name: str, parameters: PaanoParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window)
        self.parameters = parameters
        self.layers_: Convolutions
        self.bank_: Floats  # (B, H)

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        patches = Patches.of([scale(x) for x in nominal])
        p = self.parameters
        rng = np.random.default_rng(self.seed)
        heads = Heads(len(scale.mean), p.width, rng)
        train(heads, patches, p, rng)
        self.layers_ = heads.convolutions()
        ends = spread(len(patches.rows), CLUSTERED)
        vectors = np.concatenate(
            [
                self._embedded(patches.ending(ends[i : i + CHUNK], self.window))
                for i in range(0, len(ends), CHUNK)
            ]
        )
        count = max(min(p.least, len(vectors)), round(p.share * len(vectors)))
        self._keep(representatives(vectors, count, self.seed))
        return scale

    def _embedded(self, latest: NDArray[np.float32]) -> Floats:
        p = self.parameters
        patches = normalized(latest) if p.normalize == "patch" else latest.astype(np.float64)
        vectors = embedded(patches, self.layers_)
        if p.lengths == "kept":
            return vectors
        lengths = np.sqrt((vectors**2).sum(axis=1, keepdims=True))
        return np.asarray(vectors / np.maximum(lengths, LEAST_LENGTH))

    def _keep(self, bank: Floats) -> None:
        self.bank_ = bank
        self._transposed = np.ascontiguousarray(bank.T)
        self._squares = (bank**2).sum(axis=1)

    def _scores(self, latest: NDArray[np.float32]) -> Floats:
        vectors = np.concatenate(
            [self._embedded(latest[i : i + CHUNK]) for i in range(0, len(latest), CHUNK)]
        )
        between = (vectors**2).sum(axis=1)[:, None] + self._squares
        between -= 2 * product(vectors, self._transposed, BLOCK)
        return mean_of_nearest(between, self.parameters.neighbours)

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        names = ("window", "normalize", "width", "neighbours", "lengths")
        return {name: getattr(p, name) for name in names}

    def _arrays(self) -> Arrays:
        layers = {
            f"{kind}.{i}": array
            for i, layer in enumerate(self.layers_)
            for kind, array in zip(("filters", "bias"), layer, strict=True)
        }
        return {**layers, "bank": self.bank_}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        width = self.parameters.width
        inputs = [sensors, *[width] * (LAYERS - 1)]
        self.layers_ = [
            (take(arrays, f"filters.{i}", (KERNEL * n, width)), take(arrays, f"bias.{i}", (width,)))
            for i, n in enumerate(inputs)
        ]
        self._keep(take(arrays, "bank", (None, width)))


def representatives(vectors: Floats, count: int, seed: int) -> Floats:
    """Return the rows nearest to the centres of so many clusters: (N, H) to (count, H) at most."""
    distinct = np.unique(vectors, axis=0)
    if len(distinct) <= count:
        return distinct
    clusters = KMeans(count, n_init=1, max_iter=10, random_state=seed).fit(distinct)
    centres: Floats = clusters.cluster_centers_
    distances = (distinct**2).sum(axis=1)[:, None] - 2 * distinct @ centres.T  # up to a constant
    return np.asarray(distinct[np.unique(distances.argmin(axis=0))])
