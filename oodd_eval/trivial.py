"""Three detectors that know nothing of dynamics: the rows every board needs beside the real ones.

`Clock` gives every step its number. It has the paper's AUC 1.0 in every cell, since the onset
splits an episode in time, and matched AUC 0.5, since its twin's clock is the same. `Random` is what
chance gives, `Persistence` what plain change gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np

from oodd_eval.detector import DetectorSpec, Scores
from oodd_eval.errors import NotFittedError
from oodd_eval.hookspecs import hookimpl
from oodd_eval.prediction import FeatureScale
from oodd_eval.trajectory import Trajectory


class Random:
    """Scores without meaning: ``s_t`` uniform on [0, 1), keyed by seed, t and the observation.

    Keyed by the observation too, so that trajectories get draws of their own: with draws that all
    trajectories share, one unlucky sequence would tilt a whole environment.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon

    def fit(self, nominal: Sequence[Trajectory]) -> Random:  # noqa: ARG002  the contract's name
        """Learn nothing."""
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return uniform draws; a prefix of the trajectory gets the prefix of the draws."""
        rows = trajectory.observations.astype("<f4")
        keys = (f"{self.seed}|{t}|".encode() + row.tobytes() for t, row in enumerate(rows))
        drawn = [int.from_bytes(blake2b(key, digest_size=8).digest()) for key in keys]
        # The upper 53 bits are what a double holds.
        return np.array([(x >> 11) / 2**53 for x in drawn])


class Persistence:
    """Predict that nothing changes: ``s_t`` is the mean over features of |o_t - o_{t-h}| / std.

    h is the horizon, std the standard deviation of the feature in training (1 where it is below
    1e-6). Undefined for t < h.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.scale_: FeatureScale | None = None

    def fit(self, nominal: Sequence[Trajectory]) -> Persistence:
        """Learn the scale of every feature."""
        self.scale_ = FeatureScale.fit(nominal)
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the standardized size of the change over one horizon."""
        if self.scale_ is None:
            raise NotFittedError("detector 'persistence' was asked for scores before fit")
        z = self.scale_(trajectory).astype(np.float64)
        scores = np.full(len(trajectory), np.nan)
        scores[self.horizon :] = np.abs(z[self.horizon :] - z[: -self.horizon]).mean(axis=1)
        return scores


class Clock:
    """The number of the step: ``s_t = t``."""

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon

    def fit(self, nominal: Sequence[Trajectory]) -> Clock:  # noqa: ARG002  the contract's name
        """Learn nothing."""
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return 0, 1, 2 and so on."""
        return np.arange(len(trajectory), dtype=np.float64)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the three trivial rows."""
    return [
        DetectorSpec("random", Random, "uniform noise: what chance gives"),
        DetectorSpec("persistence", Persistence, "predicts that the observation does not change"),
        DetectorSpec("clock", Clock, "the step number: AUC 1, matched AUC 0.5"),
    ]
