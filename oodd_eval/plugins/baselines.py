"""Three detectors that know nothing of dynamics: the rows every board needs beside the real ones.

`Clock` gives every step its number. It has the paper's AUC 1.0 in every cell, since the onset
splits an episode in time, and matched AUC 0.5, since its twin's clock is the same. `Random` is what
chance gives, `Persistence` what plain change gives.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import NotFittedError
from oodd_eval.plugins.contract import DetectorSpec, Scores
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.hooks import hookimpl
from oodd_eval.plugins.state import load_state, save_state, take

Row = NDArray[np.float32]

KIND: Final = "persistence/1"
"""What is saved, and the version of its layout."""


class Random:
    """Scores without meaning: ``s_t`` uniform on [0, 1), keyed by seed, t and the observation.

    Keyed by the observation too, so that trajectories get draws of their own: with draws that all
    trajectories share, one unlucky sequence would tilt a whole environment.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> Random:  # noqa: ARG002  the contract's name
        """Learn nothing."""
        self.reset()
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return uniform draws; a prefix of the trajectory gets the prefix of the draws."""
        return np.array([self._draw(t, row) for t, row in enumerate(trajectory.observations)])

    def reset(self) -> None:
        """Begin a new live episode."""
        self._now = 0

    def update(self, observation: Row, action: Row | None = None) -> float:  # noqa: ARG002
        """Return the score of the next observation of a live episode."""
        self._now += 1
        return self._draw(self._now - 1, np.asarray(observation))

    def _draw(self, t: int, row: Row) -> float:
        key = f"{self.seed}|{t}|".encode() + row.astype("<f4").tobytes()
        # The upper 53 bits are what a double holds.
        return (int.from_bytes(blake2b(key, digest_size=8).digest()) >> 11) / 2**53


class Persistence:
    """Predict that nothing changes: ``s_t`` is the mean over features of |o_t - o_{t-h}| / std.

    h is the horizon, std the standard deviation of the feature in training (1 where it is below
    1e-6). Undefined for t < h.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.scale_: FeatureScale | None = None
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> Persistence:
        """Learn the scale of every feature."""
        self.scale_ = FeatureScale.fit(nominal)
        self.reset()
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the standardized size of the change over one horizon."""
        z = self._scale()(trajectory).astype(np.float64)
        scores = np.full(len(trajectory), np.nan)
        scores[self.horizon :] = np.abs(z[self.horizon :] - z[: -self.horizon]).mean(axis=1)
        return scores

    def save(self, directory: Path) -> None:
        """Write the scale into a directory."""
        scale = self._scale()
        arrays = {"mean": scale.mean, "std": scale.std}
        save_state(directory, kind=KIND, settings={}, arrays=arrays)

    def load(self, directory: Path) -> None:
        """Take over what `save` wrote."""
        arrays = load_state(directory, kind=KIND, settings={})
        mean = take(arrays, "mean", (None,))
        self.scale_ = FeatureScale(mean, take(arrays, "std", mean.shape))
        self.reset()

    def reset(self) -> None:
        """Begin a new live episode."""
        self._latest: deque[NDArray[np.float64]] = deque(maxlen=self.horizon + 1)

    def update(self, observation: Row, action: Row | None = None) -> float:  # noqa: ARG002
        """Return the score of the next observation of a live episode, NaN for t < horizon."""
        self._latest.append(self._scale().row(observation).astype(np.float64))
        if len(self._latest) <= self.horizon:
            return float("nan")
        return float(np.abs(self._latest[-1] - self._latest[0]).mean())

    def _scale(self) -> FeatureScale:
        if self.scale_ is None:
            raise NotFittedError("detector 'persistence' was asked for scores before fit")
        return self.scale_


class Clock:
    """The number of the step: ``s_t = t``."""

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> Clock:  # noqa: ARG002  the contract's name
        """Learn nothing."""
        self.reset()
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return 0, 1, 2 and so on."""
        return np.arange(len(trajectory), dtype=np.float64)

    def reset(self) -> None:
        """Begin a new live episode."""
        self._now = 0

    def update(self, observation: Row, action: Row | None = None) -> float:  # noqa: ARG002
        """Return 0, 1, 2 and so on."""
        self._now += 1
        return float(self._now - 1)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the three trivial rows."""
    return [
        DetectorSpec("random", Random, "uniform noise: what chance gives"),
        DetectorSpec(
            "persistence",
            Persistence,
            "predicts that the observation does not change",
            fit_ignores=("horizon",),
        ),
        DetectorSpec("clock", Clock, "the step number: AUC 1, matched AUC 0.5"),
    ]
