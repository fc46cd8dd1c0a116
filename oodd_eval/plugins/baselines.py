"""Three detectors that know nothing of dynamics: the rows every board needs beside the real ones.

numpy is imported where it is used: this module is loaded whenever detectors are listed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, TypeAlias

from oodd_eval.errors import NotFittedError
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.contract import DetectorSpec, Scores

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from oodd_eval.data.trajectory import Trajectory
    from oodd_eval.plugins.forecasting import FeatureScale

Row: TypeAlias = "NDArray[np.float32]"
_KIND: Final = "persistence/1"  # with the version of its layout


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


class Persistence(_Baseline):
    """Predict that nothing changes: ``s_t`` is the mean over features of |o_t - o_{t-h}| / std.

    h is the horizon, std the standard deviation of the feature in training (1 where it is below
    1e-6). Undefined for t < h.
    """

    scale_: FeatureScale | None = None

    def fit(self, nominal: Sequence[Trajectory]) -> Self:
        """Learn the scale of every feature."""
        from oodd_eval.plugins.forecasting import FeatureScale

        self.scale_ = FeatureScale.fit(nominal)
        return super().fit(nominal)

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the standardized size of the change over one horizon."""
        from oodd_eval.plugins.forecasting import anomaly_scores

        z = self._scale()(trajectory).astype("float64")
        changes = abs(z[self.horizon :] - z[: -self.horizon]).mean(axis=1)
        return anomaly_scores(trajectory.observations, changes, self.horizon)

    def save(self, directory: Path) -> None:
        """Write the scale into a directory."""
        from oodd_eval.plugins.state import save_state

        save_state(directory, kind=_KIND, settings={}, arrays=self._scale().arrays())

    def load(self, directory: Path) -> None:
        """Take over what `save` wrote."""
        from oodd_eval.plugins.forecasting import FeatureScale
        from oodd_eval.plugins.state import load_state

        self.scale_ = FeatureScale.of(load_state(directory, kind=_KIND, settings={}))
        self.reset()

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._latest: deque[NDArray[np.float64]] = deque(maxlen=self.horizon + 1)

    def _score(self, t: int, row: Row) -> float:
        self._latest.append(self._scale().row(row).astype("float64"))
        if t < self.horizon:
            return float("nan")
        return float(abs(self._latest[-1] - self._latest[0]).mean())

    def _scale(self) -> FeatureScale:
        if self.scale_ is None:
            raise NotFittedError("detector 'persistence' was asked for scores before fit")
        return self.scale_


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the three trivial rows."""
    unchanged = "predicts that the observation does not change"
    return [
        DetectorSpec("random", Random, "uniform noise: what chance gives"),
        DetectorSpec("persistence", Persistence, unchanged, horizon_decides_fit=False),
        DetectorSpec("clock", Clock, "the step number: AUC 1, matched AUC 0.5"),
    ]
