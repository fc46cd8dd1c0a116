"""A fitted forest, which predicts, and its trees as plain arrays, which are saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import take
from oodd_rf.windows import Floats

if TYPE_CHECKING:
    from sklearn.tree._tree import Tree

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Forest:
    """One fitted forest and the number of observations that it looks at.

    Only the trees are kept of scikit-learn's regressor: asking them directly spares the checks and
    threads that ``RandomForestRegressor.predict`` spends on every call, and its means are these.
    """

    trees: Sequence[Tree]
    window: int

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself, which copies of a detector share: nothing of it ever changes."""
        return self

    def predict(self, rows: NDArray[np.float32]) -> Floats:
        """Return the mean prediction of the trees, (B, D), for rows of shape (B, W * D)."""
        # A tree of a single sensor leaves out the last axis.
        each = (tree.predict(rows).reshape(len(rows), -1) for tree in self.trees)
        mean: Floats = reduce(add, each) / len(self.trees)
        return mean

    def forecast(self, history: NDArray[np.float32], horizon: int) -> Floats:
        """Roll the forest out, each prediction being the newest observation of the next window.

        From standardized observations (B, W, D), newest first, to those h steps after, (B, D).
        """
        predicted: Floats = history[:, 0].astype(np.float64)
        for _ in range(horizon):
            predicted = history[:, 0] + self.predict(history.reshape(len(history), -1))
            newest = predicted[:, None].astype(np.float32)
            history = np.concatenate([newest, history[:, :-1]], axis=1)
        return predicted

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the trees under each other: children, splits, and the values of the leaves."""
        states = [tree.__getstate__() for tree in self.trees]
        nodes = np.concatenate([s["nodes"] for s in states])
        values = np.concatenate([s["values"][..., 0] for s in states])
        return {
            "counts": np.array([s["node_count"] for s in states], np.int64),
            "depths": np.array([s["max_depth"] for s in states], np.int64),
            "left": nodes["left_child"].astype(np.int32),
            "right": nodes["right_child"].astype(np.int32),
            "feature": nodes["feature"].astype(np.int32),
            "threshold": nodes["threshold"].astype(np.float64),
            "leaves": values[nodes["left_child"] < 0].astype(np.float64),
        }

    @classmethod
    def of(cls, arrays: Arrays, window: int, features: int) -> Forest:
        """Put a forest of windows of W observations of D sensors together; inverse of `arrays`.

        Raises
        ------
        FittedStateError
            When the arrays are no trees: scikit-learn follows child numbers without looking.
        """
        counts, depths = take(arrays, "counts", (None,), "i"), take(arrays, "depths", (None,), "i")
        total = int(counts.sum()) if (counts > 0).all() else -1
        left, right = (take(arrays, n, (total,), "i") for n in ("left", "right"))
        feature, threshold = (
            take(arrays, "feature", (total,), "i"),
            take(arrays, "threshold", (total,)),
        )
        leaf = left < 0
        leaves = take(arrays, "leaves", (int(leaf.sum()), features))
        values = np.zeros((total, features, 1))
        values[leaf, :, 0] = leaves
        if not len(counts) or len(depths) != len(counts):
            raise FittedStateError(f"a saved forest has {len(counts)} trees, expected at least 1")
        ends = np.cumsum(counts).tolist()
        parts = [slice(end - count, end) for end, count in zip(ends, counts.tolist(), strict=True)]
        nodes = {
            "left_child": left,
            "right_child": right,
            "feature": feature,
            "threshold": threshold,
        }
        trees = [
            _tree({n: a[p] for n, a in nodes.items()}, values[p], depth, window * features)
            for p, depth in zip(parts, depths.tolist(), strict=True)
        ]
        return cls(trees, window)


def _tree(nodes: Arrays, values: Floats, depth: int, inputs: int) -> Tree:
    """Return a tree of scikit-learn's from arrays whose every step leads to a later node."""
    # The class has no public name, and no other way in than the state that it gives out itself.
    from sklearn.tree._tree import Tree  # noqa: PLC0415  an optional extra

    left, right, feature = nodes["left_child"], nodes["right_child"], nodes["feature"]
    indices, count, leaf = np.arange(len(left)), len(left), left < 0
    follows = (left > indices) & (right > indices) & (left < count) & (right < count)
    splits = (feature >= 0) & (feature < inputs)
    if not (follows & splits)[~leaf].all() or (right[leaf] >= 0).any() or not leaf[-1]:
        raise FittedStateError(
            "a saved tree has children or sensors that do not exist: expected children after their "
            f"parent among {count} nodes, and inputs below {inputs}"
        )
    tree = Tree(inputs, np.ones(values.shape[1], np.intp), values.shape[1])
    packed = np.zeros(count, dtype=tree.__getstate__()["nodes"].dtype)
    for name, array in nodes.items():
        packed[name] = array
    tree.__setstate__({"max_depth": depth, "node_count": count, "nodes": packed, "values": values})
    return tree
