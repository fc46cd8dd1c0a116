"""Members of the panel: distances of what an episode shows from what nominal operation shows.

Each is the length of some features, less a centre, times a matrix. They see different things: a
pattern of sensors that was never seen, forecast errors of one sign, a combination of errors that
was never seen, errors that grow, and latest rows that are far from nominal ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Final, NamedTuple

import numpy as np
from oodd_common.charts import Floats, Smoother, limited, product

from oodd_eval.plugins.state import Arrays, take
from oodd_panel.forecast import ROWS

WINDOW: Final = (5, 20)
"""Fewest and most of the latest rows in which a pattern is looked for."""
READINGS: Final = 1280
"""Readings of which a pattern is made, where there are neither too few rows nor too many."""
WEIGHTS: Final = (0.3, 0.1, 0.04)
"""Weights of the newest error in the sums. The smallest lets a sum fall back within 60 rows."""
CLIP: Final = 6.0
"""Limit of an error in the sums, in its standard deviations, so that a sum comes down again."""
ENERGY: Final = 10
"""Latest rows of which squared errors are averaged."""
LARGEST: Final = 1e4
"""Limit of a squared error."""
LEAST_ENERGY: Final = 1e-2
"""Added to a mean squared error before its logarithm is taken."""
VARIANCE: Final = 0.9
"""Share of the variance that the components of a pattern explain."""
RECENT: Final = 0.95
"""Share of the variance within which the latest rows are as far as nominal ones."""
RECENT_COMPONENTS: Final = 64
"""Most components for that: a live row is multiplied by all of them."""
USUAL: Final = 0.99
"""Quantile of nominal rows in whose units distances within and off the components are added."""
LEAST_VARIANCE: Final = 1e-9
"""Components with a smaller share of the largest one's variance are rounding."""
NEIGHBOURS: Final = 5
"""Nearest nominal rows whose distances are averaged."""
BANK: Final = 2000
"""Most nominal rows that are kept to compare with."""
COMPONENTS: Final = 20
"""Most principal components in which neighbours are looked for."""
SHRINKAGE: Final = 0.02
"""Least share of the identity in a correlation matrix."""
PATTERNS: Final = 1000
"""Most windows from which the components of many sensors are computed."""
RECENT_PATTERNS: Final = 500
"""Most of them where components are computed three times."""
CHUNK: Final = 4096
"""Rows whose features are looked at together: bounds memory."""


class Features(NamedTuple):
    """Features of N rows, all of them sums and means over the latest rows.

    Attributes
    ----------
    window
        The latest `window_of` rows of all sensors, newest first, (N, W * S).
    sums
        Exponentially weighted errors on the scale of one error, (N, WEIGHTS, D).
    energy
        Logarithms of the mean squared errors of `ENERGY` rows, (N, D).
    """

    window: Floats
    sums: Floats
    energy: Floats


def window_of(sensors: int) -> int:
    """Return the number of rows in a pattern of so many sensors, W."""
    return min(max(READINGS // sensors, WINDOW[0]), WINDOW[1])


class Latest:
    """Features of an episode, row by row: each call continues where the last one ended.

    Parameters
    ----------
    dimensions
        Number of errors of a row, D.
    window
        Rows that make a pattern, W.
    first
        The standardized first row of the episode, (S,). It stands for those before it.
    """

    def __init__(self, dimensions: int, window: int, first: Floats) -> None:
        self._window = window
        self._smoother = Smoother(WEIGHTS, dimensions)
        self._rows = np.repeat(first[None], window - 1, axis=0)  # newest first
        # What an error before the beginning would have been on average.
        self._squares = np.ones((ENERGY - 1, dimensions))

    def __call__(self, rows: Floats, errors: Floats) -> Features:
        """Return features of the next N rows, from standardized ones (N, S) and errors (N, D)."""
        n = len(rows)
        every = np.concatenate([rows[::-1], self._rows])
        # Windows overlap in memory: copies would take twenty times as much of it.
        row = every.itemsize * every.shape[1]
        shape, strides = (n, self._window * every.shape[1]), (-row, every.itemsize)
        window: Floats = np.ndarray(shape, every.dtype, every, max(n - 1, 0) * row, strides)
        squares = np.concatenate([self._squares, np.minimum(errors**2, LARGEST)])
        energy = _sums(squares, ENERGY) / ENERGY
        self._rows, self._squares = every[: self._window - 1], squares[n:]
        sums = self._smoother(limited(errors, CLIP)).swapaxes(0, 1)
        return Features(window, sums, np.log(energy + LEAST_ENERGY))


def _sums(rows: Floats, count: int) -> Floats:
    """Return the sum of each row (N + count - 1, D) and those before it, oldest first: (N, D)."""
    shape, strides = (count, len(rows) - count + 1, rows.shape[1]), (rows.strides[0], *rows.strides)
    lags: Floats = np.ndarray(shape, rows.dtype, rows, 0, strides)
    if lags[0].size == 1:  # numpy adds a single column in pairs, many of them one after the other
        return np.asarray(np.add.accumulate(lags, axis=0)[-1], np.float64)
    return np.asarray(np.add.reduce(lags, axis=0), np.float64)


class PanelMember(ABC):
    """Distance of some features from a centre."""

    name: ClassVar[str]

    @abstractmethod
    def features(self, features: Features) -> Floats:
        """Return the features that it looks at, (N, F)."""

    @abstractmethod
    def fit(self, features: Floats) -> None:
        """Learn from features of nominal rows, (N, F)."""

    @abstractmethod
    def differences(self, features: Floats) -> tuple[Floats, Floats]:
        """Return lengths (N,), and what each feature contributes to their squares, (N, F)."""

    def lengths(self, features: Floats) -> Floats:
        """Return lengths of features: (N, F) to (N,)."""
        if len(features) <= CHUNK:
            return self._lengths(features)
        chunks = [features[i : i + CHUNK] for i in range(0, len(features), CHUNK)]
        return np.concatenate([self._lengths(chunk) for chunk in chunks])

    @abstractmethod
    def _lengths(self, features: Floats) -> Floats:
        """Return lengths of few features, (N, F) to (N,)."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Return what `restore` takes."""

    @abstractmethod
    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""


class _Mahalanobis(PanelMember):
    """Mahalanobis length, with a covariance that is shrunk the more the fewer rows there are."""

    memory: ClassVar[float]
    """Rows over which a feature is averaged: so many rows count as one."""

    def fit(self, features: Floats) -> None:
        """Learn from features of nominal rows, (N, F)."""
        n, f = features.shape
        self.centre_ = self._centre(features)
        centred = features - self.centre_
        size = np.sqrt((centred**2).mean(axis=0))
        size = np.where(size < 1e-6, 1.0, size)
        scaled = centred / size
        shrinkage = max(SHRINKAGE, f / (max(1.0, n / self.memory) + f))
        correlation = (1 - shrinkage) * (scaled.T @ scaled) / n + shrinkage * np.eye(f)
        # Of a positive definite matrix: rows times the root have the Mahalanobis length.
        root = np.linalg.inv(np.linalg.cholesky(correlation)).T / size[:, None]
        self.root_ = np.ascontiguousarray(root)

    def _centre(self, features: Floats) -> Floats:
        centre: Floats = features.mean(axis=0)
        return centre

    def differences(self, features: Floats) -> tuple[Floats, Floats]:
        """Return lengths (N,), and what each feature contributes to their squares, (N, F)."""
        centred = features - self.centre_
        whitened = product(centred, self.root_, ROWS)
        contributed = centred * product(whitened, self.root_.T, ROWS)
        return np.sqrt((whitened * whitened).sum(axis=1)), contributed

    def _lengths(self, features: Floats) -> Floats:
        whitened = product(features - self.centre_, self.root_, ROWS)
        whitened *= whitened
        lengths: Floats = np.sqrt(np.add.reduce(whitened, axis=1))
        return lengths

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {"centre": self.centre_, "root": self.root_.T}

    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""
        self.centre_ = take(arrays, "centre", (None,))
        f = len(self.centre_)
        self.root_ = np.ascontiguousarray(take(arrays, "root", (f, f)).T)


class Sums(_Mahalanobis):
    """Multivariate EWMA charts of several memories in one distance (Lowry et al. 1992)."""

    name = "sums"
    memory = 1 / WEIGHTS[-1]

    def features(self, features: Features) -> Floats:
        """Return the features that it looks at, (N, F)."""
        return features.sums.reshape(len(features.sums), -1)

    def _centre(self, features: Floats) -> Floats:
        return np.zeros(features.shape[1])


class Energy(_Mahalanobis):
    """Mean squared errors of the sensors, or how noisy they are (MacGregor & Harris 1993)."""

    name = "energy"
    memory = float(ENERGY)

    def features(self, features: Features) -> Floats:
        """Return the features that it looks at, (N, F)."""
        return features.energy


class _ByComponents(PanelMember):
    """Principal components of the latest rows."""

    def features(self, features: Features) -> Floats:
        """Return the features that it looks at, (N, F)."""
        return features.window

    def _prepare(self, components: Floats) -> None:
        self.components_ = np.ascontiguousarray(components)
        self._back = np.ascontiguousarray(components.T)

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {"centre": self.centre_, "components": self.components_}

    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""
        self.centre_ = take(arrays, "centre", (None,))
        self._prepare(take(arrays, "components", (len(self.centre_), None)))


class Pattern(_ByComponents):
    """Residual of the principal components of the latest rows (Q of Jackson & Mudholkar 1979)."""

    name = "pattern"

    def fit(self, features: Floats) -> None:
        """Learn from features of nominal rows, (N, F)."""
        self.centre_ = features.mean(axis=0)
        few = features - self.centre_
        if few.shape[1] > PATTERNS:
            few = few[:: -(-len(few) // PATTERNS)]
        n, f = few.shape
        # Of the smaller matrix of products: both have the same eigenvalues.
        values, vectors = np.linalg.eigh(few @ few.T if n < f else few.T @ few)
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        total = values.sum()
        kept = int(np.searchsorted(np.cumsum(values), VARIANCE * total)) + 1 if total else 0
        components = vectors[:, :kept]
        if n < f:
            components = few.T @ components / np.sqrt(np.maximum(values[:kept], 1e-12))
        self._prepare(components)

    def differences(self, features: Floats) -> tuple[Floats, Floats]:
        """Return lengths (N,), and what each feature contributes to their squares, (N, F)."""
        left = features - self.centre_
        left -= product(product(left, self.components_, ROWS), self._back, ROWS)
        left *= left
        return np.sqrt(np.add.reduce(left, axis=1)), left

    def _lengths(self, features: Floats) -> Floats:
        return self.differences(features)[0]


class RecentRows(_ByComponents):
    """Principal components of the latest rows: Hotelling's T² and Q together.

    Each counts in units of a quantile of rows that the components were not computed from, of the
    other half (MacGregor & Kourti 1995).
    """

    name = "recent"

    def fit(self, features: Floats) -> None:
        """Learn from features of nominal rows, (N, F)."""
        few = features
        if few.shape[1] > RECENT_PATTERNS:
            few = few[:: -(-len(few) // RECENT_PATTERNS)]
        halves = np.array_split(few, 2) if len(few) > 1 else [few, few]
        unseen = [
            _t_squared_and_q(half - other.mean(axis=0), *_components(other))
            for half, other in (halves, halves[::-1])
        ]
        limits = np.quantile(np.concatenate(unseen, axis=1), USUAL, axis=1)
        within, off = np.where(limits < LEAST_VARIANCE, 1.0, limits).tolist()
        components, variances = _components(few)
        self.centre_ = few.mean(axis=0)
        # What components weigh beside the whole length, of which Q is what they leave.
        self.weights_ = 1.0 / (within * variances) - 1.0 / off
        self.unit_ = 1.0 / off
        self._prepare(components)

    def _lengths(self, features: Floats) -> Floats:
        # In rows, however windows overlap: the bits of a sum depend on it.
        centred: Floats = np.subtract(features, self.centre_, order="C")
        scores = product(centred, self.components_, ROWS)
        centred *= centred
        scores *= scores
        scores *= self.weights_
        squares = self.unit_ * np.add.reduce(centred, axis=1) + np.add.reduce(scores, axis=1)
        lengths: Floats = np.sqrt(np.maximum(squares, 0.0))
        return lengths

    def differences(self, features: Floats) -> tuple[Floats, Floats]:
        """Return lengths (N,), and what each feature contributes to their squares, (N, F)."""
        centred = features - self.centre_
        scores = product(centred, self.components_, ROWS)
        weighted = product(scores * self.weights_, self._back, ROWS)
        return self._lengths(features), centred * (self.unit_ * centred + weighted)

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {**super().arrays(), "weights": self.weights_, "unit": np.array(self.unit_)}

    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""
        super().restore(arrays)
        self.weights_ = take(arrays, "weights", (self.components_.shape[1],))
        self.unit_ = float(take(arrays, "unit", (), "+"))


def _components(features: Floats) -> tuple[Floats, Floats]:
    """Return principal components (F, C) of `RECENT` of the variance, and their variances (C,)."""
    centred = features - features.mean(axis=0)
    n, f = centred.shape
    values, vectors = np.linalg.eigh(centred @ centred.T if n < f else centred.T @ centred)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    if not values[0]:
        return np.empty((f, 0)), np.empty(0)
    kept = int(np.searchsorted(np.cumsum(values), RECENT * values.sum())) + 1
    kept = min(kept, RECENT_COMPONENTS, int((values > LEAST_VARIANCE * values[0]).sum()))
    values, components = values[:kept], vectors[:, :kept]
    if n < f:
        components = centred.T @ components / np.sqrt(values)
    return components, values / n


def _t_squared_and_q(centred: Floats, components: Floats, variances: Floats) -> Floats:
    """Return the squared lengths of rows within components and off them, (2, N)."""
    scores = centred @ components
    left = centred - scores @ components.T
    return np.stack([(scores**2 / variances).sum(axis=1), (left**2).sum(axis=1)])


class NeighbourDistance(PanelMember):
    """Mean distance of errors to the nearest nominal ones (Ramaswamy, Rastogi & Shim 2000)."""

    name = "neighbours"

    def features(self, features: Features) -> Floats:
        """Return the features that it looks at, (N, F)."""
        return features.sums[:, :2].reshape(len(features.sums), -1)

    def fit(self, features: Floats) -> None:
        """Learn from features of nominal rows, (N, F)."""
        self.centre_ = features.mean(axis=0)
        centred = features - self.centre_
        _, vectors = np.linalg.eigh(centred.T @ centred)
        self.components_ = np.ascontiguousarray(vectors[:, ::-1][:, :COMPONENTS])
        self.bank_ = (centred @ self.components_)[:: -(-len(centred) // BANK)]
        self._prepare()

    def _prepare(self) -> None:
        self._doubled = np.ascontiguousarray(-2.0 * self.bank_.T)
        self._squares = (self.bank_ * self.bank_).sum(axis=1)
        self._nearest = min(NEIGHBOURS, len(self.bank_))

    def differences(self, features: Floats) -> tuple[Floats, Floats]:
        """Return lengths (N,), and what each feature contributes to their squares, (N, F)."""
        centred = features - self.centre_
        query = product(centred, self.components_, ROWS)
        squares = self._distances(query)
        nearest = np.argpartition(squares, self._nearest - 1, axis=1)[:, : self._nearest]
        middle = product(self.bank_[nearest].mean(axis=1), self.components_.T, ROWS)
        inside = product(query, self.components_.T, ROWS)
        return self._means(squares), (inside - middle) ** 2

    def _lengths(self, features: Floats) -> Floats:
        query = product(features - self.centre_, self.components_, ROWS)
        return self._means(self._distances(query))

    def _distances(self, query: Floats) -> Floats:
        length: Floats = np.add.reduce(query * query, axis=1, keepdims=True)
        squares: Floats = length + self._squares
        squares += product(query, self._doubled, ROWS)
        return squares

    def _means(self, squares: Floats) -> Floats:
        if len(squares) == 1:  # as streams have it: a few searches take less than a partition
            (row,), nearest = squares, np.empty((1, self._nearest))
            for n in range(self._nearest):
                nearest[0, n] = row[least := row.argmin()]
                row[least] = np.inf
        else:
            nearest = np.partition(squares, self._nearest - 1, axis=1)[:, : self._nearest]
            nearest.sort(axis=1)
        np.maximum(nearest, 0.0, out=nearest)
        np.sqrt(nearest, out=nearest)
        means: Floats = np.add.reduce(nearest, axis=1) / self._nearest
        return means

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {"centre": self.centre_, "components": self.components_, "bank": self.bank_}

    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""
        self.centre_ = take(arrays, "centre", (None,))
        self.components_ = take(arrays, "components", (len(self.centre_), None))
        self.bank_ = take(arrays, "bank", (None, self.components_.shape[1]))
        self._prepare()


MEMBERS: Final = (Pattern, Sums, NeighbourDistance, Energy, RecentRows)
"""In the order in which they stand in fitted arrays."""
