"""Evidence of rare events: how improbable each step's residuals are where they occur.

Some noise comes in events. A lander's legs touch the ground and eight residuals are large at once;
an engine is off for seven steps of eight. Signed sums of residuals dilute an event that comes every
eighth step, and a covariance is set by the touch-downs. Here a step's residuals are compared with
those that were usual at such inputs, a step counts by its own improbability alone, and what is
improbable is added up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.forecasting import CONSTANT
from oodd_eval.plugins.state import Arrays, take
from oodd_pe.statistic import RETURN

LEAST_ROWS: Final = 300
"""Rows of a region of inputs from which a sensor's tail is learnt."""
LEAST_ROWS_OF_LENGTH: Final = 600
"""Rows of a region from which the tail of the residuals' length is learnt."""
USUAL: Final = 0.9
"""Quantile of the size of a sensor's residuals beyond which their tail is exponential."""
NORMAL: Final = 1.645
"""The same quantile of the size of a standard normal number."""
USUAL_LENGTH: Final = 0.95
"""Quantile of the logarithm of the length beyond which its tail is exponential."""
COUNTS: Final = -math.log(0.01)
"""Improbability, -log p, beyond which a step counts."""
LARGEST: Final = 4.0
"""Limit of what a step counts: how improbable a step is beyond that, no tail can tell."""
NOMINAL: Final = 1.0
"""Usual sum of a hundred nominal steps: one of them counts, on average by one."""
STEEP: Final = 1.5
"""Units of what is usual for an episode's largest beyond which the chart grows by its logarithm.

Errors of a model repeat from step to step where those of noise do not. A nominal episode that
comes to where training has hardly been has a sum of many units, without being as odd as that.
"""


class Regions:
    """Regions of inputs in which targets differ: the leaves of a regression tree, as arrays.

    Parameters
    ----------
    feature
        Input that each node splits by, (nodes,); -1 in leaves.
    threshold
        Inputs up to it go left, (nodes,).
    left, right
        Children of each node, (nodes,), later nodes; in leaves ``right`` is the leaf's number.
    """

    def __init__(
        self,
        feature: NDArray[np.int64],
        threshold: Floats,
        left: NDArray[np.int64],
        right: NDArray[np.int64],
    ) -> None:
        self.feature, self.threshold, self.left, self.right = feature, threshold, left, right
        self.count = int((feature < 0).sum())
        # Lists, since a walk of seven steps takes a microsecond there.
        columns = (a.tolist() for a in (feature, threshold, left, right))
        self._nodes = list(zip(*columns, strict=True))

    @classmethod
    def fit(cls, inputs: NDArray[np.float32], targets: Floats, least: int) -> Self:
        """Split inputs (N, I) such that targets (N, K) differ, into leaves of enough rows."""
        from sklearn.tree import DecisionTreeRegressor  # noqa: PLC0415  takes a second

        tree = DecisionTreeRegressor(min_samples_leaf=least, random_state=0)
        nodes = tree.fit(inputs, targets).tree_
        leaf = nodes.children_left < 0
        return cls(
            np.where(leaf, -1, nodes.feature).astype(np.int64),
            np.where(leaf, 0.0, nodes.threshold),
            np.where(leaf, -1, nodes.children_left).astype(np.int64),
            np.where(leaf, np.cumsum(leaf) - 1, nodes.children_right).astype(np.int64),
        )

    def __call__(self, inputs: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the number of the region of each row, (N,)."""
        regions = np.empty(len(inputs), np.int64)
        for n, row in enumerate(inputs.tolist()):
            feature, threshold, left, right = self._nodes[0]
            while feature >= 0:
                node = left if row[feature] <= threshold else right
                feature, threshold, left, right = self._nodes[node]
            regions[n] = right
        return regions

    def arrays(self, name: str) -> Arrays:
        """Return what `restored` takes, under names that begin with ``name``."""
        return {f"{name}.{n}": getattr(self, n) for n in ("feature", "threshold", "left", "right")}

    @classmethod
    def restored(cls, arrays: Arrays, name: str, inputs: int) -> Self:
        """Return the regions of so many inputs; `FittedStateError` where the arrays are no tree."""
        feature = take(arrays, f"{name}.feature", (None,), "i")
        threshold = take(arrays, f"{name}.threshold", feature.shape)
        left, right = (
            take(arrays, f"{name}.{side}", feature.shape, "i") for side in ("left", "right")
        )
        nodes, leaf = np.arange(len(feature)), feature < 0
        children = np.stack([left, right])[:, ~leaf]
        follow = (children > nodes[~leaf]) & (children < len(nodes))
        numbered = np.array_equal(right[leaf], np.arange(leaf.sum()))
        if not (follow.all() and numbered and leaf.any() and (feature < inputs).all()):
            raise FittedStateError(
                f"the arrays {name!r} of the state are no tree: expected children after their "
                f"parent among {len(nodes)} nodes, inputs below {inputs}, and leaves numbered from "
                "0; fit the detector again"
            )
        return cls(feature, threshold, left, right)


class Tails(NamedTuple):
    """Beginnings and lengths of the tails of K quantities in each of R regions, (R, K) both."""

    start: Floats
    length: Floats

    @classmethod
    def fit(cls, values: Floats, regions: NDArray[np.int64], usual: float) -> Self:
        """Learn from values (N, K) in regions (N,): exponential tails beyond a quantile."""
        starts, lengths = [], []
        for n in range(regions.max() + 1):
            part = values[regions == n]
            start = np.quantile(part, usual, axis=0)
            beyond = np.maximum(1, (part > start).sum(axis=0))
            starts.append(start)
            lengths.append(np.maximum(part - start, 0.0).sum(axis=0) / beyond)
        return cls(np.stack(starts), np.maximum(np.stack(lengths), CONSTANT))

    def arrays(self, name: str) -> Arrays:
        """Return what `restored` takes, under names that begin with ``name``."""
        return {f"{name}.start": self.start, f"{name}.length": self.length}

    @classmethod
    def restored(cls, arrays: Arrays, name: str, regions: int, quantities: int) -> Self:
        """Return tails; `FittedStateError` where the arrays are none of that shape."""
        shape = (regions, quantities)
        start = take(arrays, f"{name}.start", shape)
        return cls(start, take(arrays, f"{name}.length", shape, "+"))


class RareEvents:
    r"""Sums of how improbable steps are, each over how far it gets in a nominal episode.

    .. math:: q_d^2 = 1.645^2 + 2 \frac{|r_d| - a_d}{b_d} \;\text{ for } |r_d| > a_d,
              \text{ else } \Bigl(1.645 \frac{|r_d|}{a_d}\Bigr)^2, \quad
              c = -\log 0.05 + \frac{\log |q| - a}{b}

    where a are quantiles of a region of inputs, of 90 % and 95 %, and b the means of what lies
    beyond them. For numbers with such a tail, c is -log p of a step, and q about the size of a
    standard normal number as improbable as r. One touch-down, in which all sensors' residuals are
    large, counts once. What c exceeds 4.6 by, at most 4 and less while the sensors stand still, is
    added up in leaky sums.

    Parameters
    ----------
    memories
        Share of each sum that a step forgets.
    """

    def __init__(self, memories: Sequence[float]) -> None:
        self.memories = list(memories)

    def fit(
        self, inputs: Sequence[Floats], residuals: Sequence[Floats], shares: Sequence[Floats]
    ) -> None:
        """Learn from nominal episodes that the forecaster was not trained on.

        Parameters
        ----------
        inputs
            Of each episode what its forecasts are made from, and the time, (N, I).
        residuals
            Signed residuals of the varying sensors, (N, D).
        shares
            How much steps count, (N,), from 0 to 1.
        """
        places = np.concatenate([x.astype(np.float32) for x in inputs])
        sizes = np.abs(np.concatenate(residuals))
        logs = np.log1p(sizes**2)
        mean = logs.sum(axis=1, keepdims=True) / max(1, logs.shape[1])
        self.regions_ = Regions.fit(places, np.concatenate([logs, mean], axis=1), LEAST_ROWS)
        of_row = self.regions_(places)
        self.tails_ = Tails.fit(sizes, of_row, USUAL)
        squares = self._squares(sizes, of_row)
        self.wide_regions_ = Regions.fit(places, np.log1p(squares)[:, None], LEAST_ROWS_OF_LENGTH)
        lengths = np.log(np.maximum(squares, CONSTANT))[:, None] / 2
        self.wide_tails_ = Tails.fit(lengths, self.wide_regions_(places), USUAL_LENGTH)
        ones = np.ones(len(self.memories))
        episodes = zip(inputs, residuals, shares, strict=True)
        counts = [self.counts(*episode) for episode in episodes]
        largest = [Leaks(self.memories, ones, ones * np.inf).units(c).max(axis=1) for c in counts]
        # A single step is never more than what is usual for the largest sum of an episode.
        usual = np.mean(largest, axis=0) + np.std(largest, axis=0)
        self.excess_ = np.maximum(usual, LARGEST - NOMINAL)

    def counts(self, inputs: Floats, residuals: Floats, shares: Floats) -> Floats:
        """Return what each step adds to the sums, (N,)."""
        places = inputs.astype(np.float32)
        squares = self._squares(np.abs(residuals), self.regions_(places))
        start, length = (v[self.wide_regions_(places), 0] for v in self.wide_tails_)
        beyond = (np.log(np.maximum(squares, CONSTANT)) / 2 - start) / length
        improbability = beyond - math.log(1.0 - USUAL_LENGTH)
        counts: Floats = np.minimum(np.maximum((improbability - COUNTS) * shares, 0.0), LARGEST)
        return counts

    def _squares(self, sizes: Floats, regions: NDArray[np.int64]) -> Floats:
        """Return squared lengths of normal numbers as improbable as sizes of residuals, (N,)."""
        start, length = (v[regions] for v in self.tails_)
        beyond = NORMAL**2 + 2.0 * (sizes - start) / length
        within = (NORMAL * sizes / np.maximum(start, CONSTANT)) ** 2
        squares: Floats = np.where(sizes > start, beyond, within).sum(axis=1)
        return squares

    def running(self) -> Leaks:
        """Return the sums of a new episode.

        Like those of residuals they fall to what is usual within `RETURN` steps, wherever they are.
        """
        kept = np.maximum((1.0 - np.asarray(self.memories)) ** RETURN, CONSTANT)
        return Leaks(self.memories, self.excess_, (NOMINAL + self.excess_) / kept)

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {
            "events.excess": self.excess_,
            **self.regions_.arrays("events.regions"),
            **self.tails_.arrays("events.tails"),
            **self.wide_regions_.arrays("events.wide_regions"),
            **self.wide_tails_.arrays("events.wide_tails"),
        }

    def restore(self, arrays: Arrays, inputs: int, sensors: int) -> None:
        """Take over a fit for so many inputs and varying sensors."""
        self.regions_ = Regions.restored(arrays, "events.regions", inputs)
        self.tails_ = Tails.restored(arrays, "events.tails", self.regions_.count, sensors)
        self.wide_regions_ = Regions.restored(arrays, "events.wide_regions", inputs)
        self.wide_tails_ = Tails.restored(arrays, "events.wide_tails", self.wide_regions_.count, 1)
        self.excess_ = take(arrays, "events.excess", (len(self.memories),), "+")


class Leaks:
    """The leaky sums of an episode so far: each call continues where the last one ended.

    Parameters
    ----------
    memories
        Share of each of W sums that a step forgets.
    excess
        How far beyond `NOMINAL` the largest sum of an episode usually is, (W,).
    limits
        Largest sums that there can be, (W,).
    """

    def __init__(self, memories: Sequence[float], excess: Floats, limits: Floats) -> None:
        self._keep = [1.0 - w for w in memories]
        self._limits = limits.tolist()
        self._excess = excess[:, None]
        self._sums = [0.0] * len(self._keep)

    def __call__(self, counts: Floats) -> Floats:
        """Return the chart after each of the next N steps, 1 where sums are usual: (W, N)."""
        units = self.units(counts)
        beyond = np.maximum(units, STEEP)
        return np.minimum(units, STEEP + STEEP * np.log(beyond / STEEP))

    def units(self, counts: Floats) -> Floats:
        """Return the sums after each of the next N steps, in units of usual ones: (W, N)."""
        sums = np.empty((len(self._keep), len(counts)))
        for t, count in enumerate(counts.tolist()):
            for n, (keep, limit) in enumerate(zip(self._keep, self._limits, strict=True)):
                self._sums[n] = min(keep * self._sums[n] + count, limit)
            sums[:, t] = self._sums
        return (sums - NOMINAL) / self._excess
