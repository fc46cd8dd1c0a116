"""Detectors that know nothing of dynamics: the rows every board needs beside the real ones.

numpy is imported where it is used: this module is loaded whenever detectors are listed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self, TypeAlias

from oodd_eval.errors import ContractError, NotFittedError
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.contract import DetectorSpec, Scores

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from oodd_eval.data.trajectory import Trajectory
    from oodd_eval.plugins.forecasting import FeatureScale
    from oodd_eval.plugins.state import Arrays, State

Row: TypeAlias = "NDArray[np.float32]"

PERIOD: Final = 100
"""Rows from one spike of `Comb` to the next."""

DISCRETE: Final = 8
"""A sensor with at most so many distinct values in training is discrete."""

LEAST_VARIANCE: Final = 1e-10
"""Share of the largest variance below which a direction does not vary in training."""

LEAST_SPREAD: Final = 1e-6
"""A product of sensors with less than this does not vary in training."""

RIDGE: Final = 1e-6
"""Variance that is added in every direction, as a share of that of one feature."""

MOST_SENSORS: Final = 60
"""Sensors of which all products are taken, 1 890 features with themselves."""


class _Baseline(ABC):
    """A detector that by default learns nothing and scores an observation by time and values."""

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> Self:  # noqa: ARG002  the contract's name
        """Learn from nominal trajectories."""
        self.reset()
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the score of every observation."""
        import numpy as np

        rows = trajectory.observations
        return np.array([self._score(t, row) for t, row in enumerate(rows)], dtype=np.float64)

    def reset(self) -> None:
        """Begin a new live episode."""
        self._now = 0

    def update(self, observation: Row, action: Row | None = None) -> float:  # noqa: ARG002
        """Return the score of the next observation of a live episode."""
        import numpy as np

        self._now += 1
        return self._score(self._now - 1, np.asarray(observation))

    @abstractmethod
    def _score(self, t: int, row: Row) -> float: ...


class Random(_Baseline):
    """Scores without meaning: ``s_t`` uniform on [0, 1), keyed by seed, t and the observation."""

    def _score(self, t: int, row: Row) -> float:
        # With draws that all trajectories share, one unlucky sequence would tilt a whole board.
        key = f"{self.seed}|{t}|".encode() + row.astype("<f4").tobytes()
        # The upper 53 bits are what a double holds.
        return (int.from_bytes(blake2b(key, digest_size=8).digest()) >> 11) / 2**53


class Clock(_Baseline):
    """The number of the step: ``s_t = t``.

    Its paper AUC is 1 in every cell, since the onset splits an episode in time, and its matched AUC
    0.5, since its twin's clock is the same.
    """

    def _score(self, t: int, row: Row) -> float:  # noqa: ARG002
        return float(t)


class Comb(_Baseline):
    """A spike every 100 rows: ``s_t`` is 1 where ``t % 100 == 99``, else 0.

    It knows nothing; an alarm rule that counts the steps until some alarm after the onset rewards
    it.
    """

    def _score(self, t: int, row: Row) -> float:  # noqa: ARG002
        return float(t % PERIOD == PERIOD - 1)


class _Scaled(_Baseline):
    """A detector that learns mean and spread of every sensor, and can hand over what it learns.

    The spread is the standard deviation in training, 1 where that is below 1e-6.
    """

    name: ClassVar[str]
    scale_: FeatureScale | None = None

    def fit(self, nominal: Sequence[Trajectory]) -> Self:
        """Learn from nominal trajectories, forgetting any earlier fit."""
        from oodd_eval.plugins.forecasting import FeatureScale

        self.scale_ = None
        scale = FeatureScale.fit(nominal)
        self._learn(nominal, scale)
        self.scale_ = scale
        return super().fit(nominal)

    def state(self) -> dict[str, Any]:
        """Return the fit as arrays."""
        from oodd_eval.plugins.state import labelled

        return labelled(f"{self.name}/1", {}, {**self._scale().arrays(), **self._arrays()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned; `FittedStateError` for another state."""
        from oodd_eval.plugins.forecasting import FeatureScale
        from oodd_eval.plugins.state import unlabelled

        arrays = unlabelled(state, f"{self.name}/1", {})
        scale = FeatureScale.of(arrays)
        self.scale_ = None
        self._restore(arrays, len(scale.mean))
        self.scale_ = scale
        self.reset()

    def _scale(self) -> FeatureScale:
        if self.scale_ is None:
            raise NotFittedError(f"detector {self.name!r} was asked for scores before fit")
        return self.scale_

    def _learn(self, nominal: Sequence[Trajectory], scale: FeatureScale) -> None: ...

    def _arrays(self) -> Arrays:
        return {}

    def _restore(self, arrays: Arrays, sensors: int) -> None: ...


class Persistence(_Scaled):
    """Predict that nothing changes: ``s_t`` is the mean over features of |o_t - o_{t-h}| / std.

    h is the horizon, std the spread of the feature in training. Undefined for t < h.
    """

    name = "persistence"

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the standardized size of the change over one horizon."""
        import numpy as np

        z = self._scale()(trajectory).astype("float64")
        changes = abs(z[self.horizon :] - z[: -self.horizon]).mean(axis=1)
        return np.concatenate([np.full(self.horizon, np.nan), changes])

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._latest: deque[NDArray[np.float64]] = deque(maxlen=self.horizon + 1)

    def _score(self, t: int, row: Row) -> float:
        self._latest.append(self._scale().row(row).astype("float64"))
        if t < self.horizon:
            return float("nan")
        return float(abs(self._latest[-1] - self._latest[0]).mean())


class Range(_Scaled):
    """Was a value ever seen, and did a sensor ever stand still for so long? No dynamics at all.

    ``s_t`` is the sum over sensors of three terms: by how much the value lies outside the training
    range, in units of the spread; 1 where a discrete sensor, one of at most 8 distinct values in
    training, shows another value; 1 where the value has been the same for more rows in a row than
    ever in training (not for sensors that had one value only).
    """

    name = "range"

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the score of every observation."""
        self._scale().must_fit(trajectory)
        rows = trajectory.observations
        return self._surprise(rows, _standing(rows))

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._stood: tuple[Row, NDArray[np.int64]] | None = None

    def _score(self, t: int, row: Row) -> float:  # noqa: ARG002
        import numpy as np

        now = self._scale().checked(row)
        before, stood = self._stood or (now, np.zeros(len(now), np.int64))
        stood = np.where(now == before, stood, 0) + 1
        self._stood = (now, stood)
        return float(self._surprise(now[None], stood[None])[0])

    def _surprise(self, rows: Row, stood: NDArray[np.int64]) -> Scores:
        """Return the scores of rows (N, D) that have stood still for so many rows, (N, D)."""
        import numpy as np

        outside = np.maximum(self.low_ - rows, rows - self.high_).clip(min=0) / self._scale().std
        seen = (rows[:, :, None] == self.values_).any(axis=2) | ~self.discrete_
        scores: Scores = (outside + ~seen + (stood > self.longest_)).sum(axis=1)
        return scores

    def _learn(self, nominal: Sequence[Trajectory], scale: FeatureScale) -> None:  # noqa: ARG002
        import numpy as np

        rows = np.concatenate([x.observations for x in nominal])
        values = [np.unique(column) for column in rows.T]
        counts = np.array([len(v) for v in values])
        self.low_, self.high_ = (ends.astype(np.float64) for ends in (rows.min(0), rows.max(0)))
        self.discrete_ = counts <= DISCRETE
        # The last of fewer than 8 values is repeated; those of other sensors are never looked at.
        self.values_ = np.array([np.pad(v, (0, DISCRETE), "edge")[:DISCRETE] for v in values])
        longest = np.max([_standing(x.observations).max(axis=0) for x in nominal], axis=0)
        self.longest_ = np.where(counts == 1, np.iinfo(np.int64).max, longest)

    def _arrays(self) -> Arrays:
        return {
            "low": self.low_,
            "high": self.high_,
            "values": self.values_,
            "discrete": self.discrete_.astype("int64"),
            "longest": self.longest_,
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        from oodd_eval.plugins.state import take

        self.low_, self.high_ = (take(arrays, name, (sensors,)) for name in ("low", "high"))
        self.values_ = take(arrays, "values", (sensors, DISCRETE))
        self.discrete_ = take(arrays, "discrete", (sensors,), "i").astype(bool)
        self.longest_ = take(arrays, "longest", (sensors,), "i")


class Mahalanobis(_Scaled):
    r"""Distance of a single row from the training rows: ``s_t = sqrt((o_t - m)' C^+ (o_t - m))``.

    m and C are mean and covariance of all training rows. C^+ is the pseudo-inverse of the
    correlations: directions in which training rows did not vary, such as a constant sensor, are
    left out.
    """

    name = "mahalanobis"

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the score of every observation."""
        self._scale().must_fit(trajectory)
        return self._distances(trajectory.observations)

    def _score(self, t: int, row: Row) -> float:  # noqa: ARG002
        return float(self._distances(self._scale().checked(row)[None])[0])

    def _distances(self, rows: Row) -> Scores:
        import numpy as np

        z = (rows - self._scale().mean) / self._scale().std
        # Not a matrix product, whose bits depend on the number of rows.
        lengths: Scores = np.sqrt((np.einsum("nd,dk->nk", z, self.root_) ** 2).sum(axis=1))
        return lengths

    def _learn(self, nominal: Sequence[Trajectory], scale: FeatureScale) -> None:
        import numpy as np

        rows = np.concatenate([x.observations for x in nominal])
        z = (rows - scale.mean) / scale.std
        values, vectors = np.linalg.eigh(z.T @ z / len(z))
        varies = values > LEAST_VARIANCE * max(values[-1], LEAST_VARIANCE)
        self.root_ = vectors[:, varies] / np.sqrt(values[varies])

    def _arrays(self) -> Arrays:
        return {"root": self.root_}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        from oodd_eval.plugins.state import take

        self.root_ = take(arrays, "root", (sensors, None))


class Manifold(Mahalanobis):
    r"""`Mahalanobis` of a row's sensors and all their products: surfaces that rows stay on.

    With z the standardized sensors and f those of z_i, z_i z_j that vary in training, standardized
    too, and with eigenvalues w_k and eigenvectors v_k of the correlations of f in training,
    ``s_t = sqrt(sum_k (v_k' f)^2 / (w_k + 1e-6))``. Directions in which training rows hardly vary
    are equations that they obey, such as cos^2 + sin^2 = 1; what is added to w_k keeps rounding
    from looking like a fault. Sensors that are constant in training are left out.
    """

    name = "manifold"

    def _distances(self, rows: Row) -> Scores:
        import numpy as np

        features = (self._products(rows) - self.centre_) / self.spread_
        # One row at a time: the bits of a product of matrices depend on the number of rows.
        lengths: Scores = np.array([np.linalg.norm(row @ self.root_) for row in features])
        return lengths

    def _products(self, rows: Row, scale: FeatureScale | None = None) -> NDArray[np.float64]:
        """Return sensors, and products of pairs of them: shape (N, features)."""
        import numpy as np

        scale = scale or self._scale()
        z = (rows - scale.mean) / scale.std
        first, second = np.triu_indices(z.shape[1])
        return np.concatenate([z, z[:, first] * z[:, second]], axis=1)[:, self.varies_]

    def _learn(self, nominal: Sequence[Trajectory], scale: FeatureScale) -> None:
        import numpy as np

        sensors = len(scale.mean)
        if sensors > MOST_SENSORS:
            raise ContractError(
                f"detector 'manifold' has the products of all pairs of sensors, got {sensors} "
                f"sensors, expected at most {MOST_SENSORS}: use 'mahalanobis'"
            )
        rows = np.concatenate([x.observations for x in nominal])
        moving = np.ptp(rows, axis=0) > 0
        first, second = np.triu_indices(sensors)
        self.varies_ = np.concatenate([moving, moving[first] & moving[second]])
        blocks = [self._products(x.observations, scale) for x in nominal]
        n = len(rows)
        self.centre_ = sum(block.sum(axis=0) for block in blocks) / n
        spread = np.sqrt(sum(((block - self.centre_) ** 2).sum(axis=0) for block in blocks) / n)
        # The square of a sensor with two values of one size does not vary, but for rounding.
        self.spread_ = np.where(spread < LEAST_SPREAD, 1.0, spread)
        covariance = np.zeros((len(spread), len(spread)))
        for block in blocks:
            features = (block - self.centre_) / self.spread_
            covariance += features.T @ features / n
        values, vectors = np.linalg.eigh(covariance)
        self.root_ = vectors / np.sqrt(np.maximum(values, 0.0) + RIDGE)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "varies": self.varies_.astype("int64"),
            "centre": self.centre_,
            "spread": self.spread_,
            "root": self.root_,
        }

    def _restore(self, arrays: Mapping[str, NDArray[Any]], sensors: int) -> None:
        from oodd_eval.plugins.state import take

        n = sensors + sensors * (sensors + 1) // 2
        self.varies_ = take(arrays, "varies", (n,), "i").astype(bool)
        features = int(self.varies_.sum())
        self.centre_ = take(arrays, "centre", (features,))
        self.spread_ = take(arrays, "spread", (features,), "+")
        self.root_ = take(arrays, "root", (features, features))


def _standing(rows: Row) -> NDArray[np.int64]:
    """Return for how many rows in a row each value has been the same, itself included: (N, D)."""
    import numpy as np

    times = np.arange(len(rows))[:, None]
    changed = np.ones(rows.shape, dtype=bool)
    changed[1:] = rows[1:] != rows[:-1]
    stood: NDArray[np.int64] = times - np.maximum.accumulate(np.where(changed, times, 0)) + 1
    return stood


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the trivial rows."""
    known: dict[str, Any] = {"deterministic": True, "horizon_decides_fit": False}
    unchanged = "predicts that the observation does not change"
    unseen = "distance outside the training range, unseen and frozen values"
    return [
        DetectorSpec("random", Random, "uniform noise: what chance gives"),
        DetectorSpec("persistence", Persistence, unchanged, **known),
        DetectorSpec("clock", Clock, "the step number: AUC 1, matched AUC 0.5", **known),
        DetectorSpec("comb", Comb, "a spike every 100 rows: matched AUC 0.5", **known),
        DetectorSpec("range", Range, unseen, **known),
        DetectorSpec("mahalanobis", Mahalanobis, "distance of single rows from the mean", **known),
        DetectorSpec("manifold", Manifold, "mahalanobis of sensors and their products", **known),
    ]
