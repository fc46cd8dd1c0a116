"""From residuals to one statistic: charts of several memories, brought to one scale.

One residual is weak evidence of a small change; many with the same sign are strong evidence. Each
chart adds up residuals with another memory. The statistic is the largest of their distances from
nominal operation, each in units of how far it gets in an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from oodd_common.charts import Floats, Smoother, whitening

from oodd_eval.plugins.forecasting import CONSTANT
from oodd_eval.plugins.state import Arrays, take

BINS: Final = 5
"""Groups of equal size, by the forecast tail, in which residuals are brought to one scale."""
PRIOR: Final = 50
"""Rows of average size that are added to each group, so that small groups stay near the average."""
LARGEST: Final = 36.0
"""Limit of a squared residual in these averages."""
SMALLEST: Final = 0.05
"""Least scale of a residual."""
ENERGY: Final = 25.0
"""Limit of a squared residual in the mean over sensors, which tells of zero-mean noise."""
MOVEMENT: Final = 0.7
"""Share of the median movement; where sensors move less, a step counts less in the sums."""
RETURN: Final = 60
"""Steps after the end of a fault in which sums are to come down."""
SHRINKAGE: Final = 0.02
"""Least share of the identity in a correlation matrix."""


def deviance(residual: Floats, log_tail: Floats) -> Floats:
    r"""Return signed deviance residuals.

    :math:`\operatorname{sign}(e) \sqrt{(\nu + 1) \log(1 + e^2 / \nu)}` has about a standard
    normal distribution where e has Student's t distribution with nu degrees of freedom.
    """
    nu = np.exp(log_tail)
    signed: Floats = np.sign(residual) * np.sqrt((nu + 1) * np.log1p(residual**2 / nu))
    return signed


class Evidence(NamedTuple):
    """Residuals of N steps of an episode, with what decides how much each of them counts.

    Attributes
    ----------
    residuals
        Signed deviance residuals of the varying sensors, (N, D); then one column a constant sensor.
    log_tails
        Logarithms of the degrees of freedom that were forecast, (N, D).
    movement
        How far the sensors moved since the step before: root mean square, in training standard
        deviations, (N,).
    """

    residuals: Floats
    log_tails: Floats
    movement: Floats


class Charts:
    """Charts of D sensors that vary and any that do not, one for each of W memories.

    The first has no memory: it judges a step by itself. Fitted attributes:

    knots_, scales_
        Root mean squares of residuals by the logarithm of the tail, each (D, bins).
    centre_, energy_, spread_
        Means of the columns, (C - 1,), mean and standard deviation of their energy, each ().
    still_
        Movement from which a step counts fully, ().
    roots_
        Matrices by which distances of smoothed columns are measured, (W, C, C).
    median_, reach_
        Median distance, and how far beyond it an episode's largest is, each (W, 1).
    """

    def __init__(self, memories: Sequence[float]) -> None:
        self.memories = list(memories)

    def fit(self, episodes: Sequence[Evidence]) -> None:
        """Learn from nominal episodes that the ensemble was not trained on."""
        residuals = np.concatenate([e.residuals for e in episodes])
        tails = np.concatenate([e.log_tails for e in episodes])
        squares = np.minimum(residuals[:, : tails.shape[1]] ** 2, LARGEST)
        prior = PRIOR * squares.mean(axis=0)
        groups = np.array_split(np.argsort(tails, axis=0, kind="stable"), min(BINS, len(tails)))
        self.knots_ = np.stack([np.take_along_axis(tails, g, 0).mean(axis=0) for g in groups], 1)
        sums = [np.take_along_axis(squares, g, 0).sum(axis=0) for g in groups]
        means = [(s + prior) / (len(g) + PRIOR) for s, g in zip(sums, groups, strict=True)]
        self.scales_ = np.maximum(np.sqrt(np.stack(means, axis=1)), SMALLEST)
        self._join()
        self.still_ = MOVEMENT * np.median(np.concatenate([e.movement for e in episodes]))
        self.centre_, self.energy_ = np.zeros(residuals.shape[1]), np.zeros(())
        columns = np.concatenate([self.columns(e) for e in episodes])
        self.centre_, self.energy_ = columns[:, :-1].mean(axis=0), columns[:, -1].mean()
        self.spread_ = columns[:, -1].std()

        weights = [1.0, *self.memories]
        sums = [Smoother(weights, columns.shape[1])(x) for x in self._weighed(episodes)]
        pooled = np.concatenate(sums, axis=1)
        self.roots_ = np.stack([_root(z, w) for z, w in zip(pooled, weights, strict=True)])
        lengths = [_lengths(z @ self.roots_) for z in sums]
        largest = np.stack([x.max(axis=1) for x in lengths], axis=1)
        median = np.median(np.concatenate(lengths, axis=1), axis=1)
        reach = largest.mean(axis=1) + largest.std(axis=1) - median
        self.median_ = median[:, None]
        self.reach_ = np.where(reach < CONSTANT, 1.0, reach)[:, None]

    def _join(self) -> None:
        """Join the scales at the knots by straight lines."""
        self._gaps = np.diff(self.knots_, axis=1)
        self._slopes = np.diff(self.scales_, axis=1) / np.where(self._gaps > 0, self._gaps, 1.0)

    def standardized(self, evidence: Evidence) -> Floats:
        """Return residuals in units of what is nominal where such a tail was forecast."""
        d = len(self.knots_)
        # Linear between the knots: the first scale, and each slope over what is passed of its gap.
        passed = np.minimum(evidence.log_tails[:, :, None] - self.knots_[:, :-1], self._gaps)
        scales = self.scales_[:, 0] + (self._slopes * np.maximum(passed, 0.0)).sum(axis=2)
        scaled: Floats = evidence.residuals.copy()
        scaled[:, :d] /= scales
        return scaled

    def columns(self, evidence: Evidence) -> Floats:
        """Return centred residuals and their energy, (N, C)."""
        u = self.standardized(evidence) - self.centre_
        energy = np.add.reduce(np.minimum(u**2, ENERGY), axis=1, keepdims=True) / u.shape[1]
        return np.concatenate([u, energy - self.energy_], axis=1)

    def share(self, movement: Floats) -> Floats:
        """Return how much steps count in the sums, (N,).

        While a robot stands still, the forecast repeats one error. Its residuals are then not
        independent evidence, and count less.
        """
        share: Floats = np.minimum(1.0, movement / max(float(self.still_), CONSTANT))
        return share

    def _weighed(self, episodes: Sequence[Evidence]) -> list[Floats]:
        return [self.columns(e) * self.share(e.movement)[:, None] for e in episodes]

    def limits(self) -> Floats:
        """Return the lengths that sums are kept below, one for each memory.

        A sum that nothing is added to any more falls from its limit to what is usual for the
        largest of an episode in `RETURN` steps. Without a limit, one of long memory would go on
        for hundreds of steps after a fault has ended.
        """
        median, usual = self.median_[1:, 0], (self.median_ + self.reach_)[1:, 0]
        kept = (1.0 - np.asarray(self.memories)) ** RETURN
        limits: Floats = np.sqrt(median**2 + (usual**2 - median**2) / np.maximum(kept, 1e-9) ** 2)
        return limits

    def statistic(self, lengths: Floats) -> Floats:
        """Return what `Running` returns on the charts' common scale, (W, N)."""
        w = len(lengths)
        scaled: Floats = (lengths - self.median_[:w]) / self.reach_[:w]
        return scaled

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        arrays = {name: np.asarray(getattr(self, name + "_")) for name in SHAPES}
        # As they lie in memory, on which the last bit of a product depends.
        return arrays | {"roots": self.roots_.swapaxes(1, 2)}

    def restore(self, arrays: Arrays, sensors: int, constant: int) -> None:
        """Take over fitted charts of so many varying and constant sensors."""
        w, c = len(self.memories) + 1, sensors + constant + 1
        lengths = {"D": sensors, "W": w, "C": c, "R": c - 1, "1": 1, "B": None}
        for name, shape in SHAPES.items():
            setattr(self, name + "_", take(arrays, name, tuple(lengths[n] for n in shape)))
        self.roots_ = self.roots_.swapaxes(1, 2)
        self._join()


SHAPES: Final = {
    "knots": "DB",
    "scales": "DB",
    "centre": "R",
    "energy": "",
    "spread": "",
    "still": "",
    "roots": "WCC",
    "median": "W1",
    "reach": "W1",
}


class Running:
    """The sums of an episode so far: each call continues where the last one ended."""

    def __init__(self, charts: Charts, *, accumulate: bool = True) -> None:
        self._charts = charts
        self._weight = np.array(charts.memories if accumulate else [])[:, None]
        self._keep = 1.0 - self._weight
        self._kept, self._settled = self._keep**2, self._weight / (2.0 - self._weight)
        self._limits = charts.limits()[:, None]
        self._sums = np.zeros((len(self._weight), len(charts.centre_) + 1))
        self._forgotten = np.ones((len(self._weight), 1))

    def __call__(self, columns: Floats, movement: Floats) -> Floats:
        """Return the Mahalanobis lengths of the next N steps and of their sums: (W, N).

        Sums are scaled to the variance of a single step, as `oodd_common.charts.smooth` does.
        """
        roots = self._charts.roots_
        newest = _lengths(columns @ roots[:1])
        if not len(self._weight):
            return newest
        whitened = (columns * self._charts.share(movement)[:, None]) @ roots[1:]
        lengths = np.empty((len(whitened), len(columns)))
        added = self._weight[..., None] * whitened
        for t in range(len(columns)):
            # A running product, not a power: its first n factors are the same however many follow.
            self._forgotten = self._forgotten * self._kept
            deviations = np.sqrt(self._settled * (1.0 - self._forgotten))
            sums = self._keep * self._sums + added[:, t]
            length = np.sqrt(np.einsum("wc,wc->w", sums, sums))[:, None]
            below = np.minimum(length, self._limits * deviations)
            self._sums = sums * (below / np.maximum(length, CONSTANT))
            lengths[:, t : t + 1] = below / deviations
        return np.concatenate([newest, lengths])


def _lengths(whitened: Floats) -> Floats:
    """Return the lengths of rows of columns, from (W, N, C) to (W, N)."""
    lengths: Floats = np.sqrt((whitened * whitened).sum(axis=2))
    return lengths


def _root(smoothed: Floats, weight: float) -> Floats:
    """Return the matrix that makes Mahalanobis lengths of rows like these, (N, C), about zero.

    Correlations are shrunk towards none, the more the fewer independent rows there are: sums with
    weight w forget in 1 / w rows.
    """
    n, c = smoothed.shape
    size = np.sqrt((smoothed**2).mean(axis=0))
    size = np.where(size < CONSTANT, 1.0, size)
    scaled = smoothed / size
    shrinkage = max(SHRINKAGE, c / (max(1.0, n * weight) + c))
    root: Floats = whitening(scaled.T @ scaled / n, shrinkage) / size[:, None]
    return root
