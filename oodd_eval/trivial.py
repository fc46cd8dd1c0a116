"""Three detectors that know nothing of dynamics: the rows every board needs beside the real ones.

`Clock` gives every step its number. It has the paper's AUC 1.0 in every cell, since the onset
splits an episode in time, and matched AUC 0.5, since its twin's clock is the same. `Random` is what
chance gives, `Persistence` what plain change gives.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from oodd_eval.detector import DetectorSpec, Scores
from oodd_eval.errors import NotFittedError
from oodd_eval.hookspecs import hookimpl
from oodd_eval.trajectory import Trajectory


class Random:
    """Scores without meaning: ``s_t`` uniform on [0, 1), a function of seed and t alone.

    A twin and its anomalous trajectory get the same scores, as from `Clock`; the paper's AUC is
    0.5 on average over seeds.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon

    def fit(self, nominal: Sequence[Trajectory]) -> Random:  # noqa: ARG002  the contract's name
        """Learn nothing."""
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return uniform draws; a shorter trajectory gets a prefix of the same sequence."""
        return np.random.default_rng(self.seed).random(len(trajectory))


class Persistence:
    """Predict that nothing changes: ``s_t`` is the mean over features of |o_t - o_{t-h}| / std.

    h is the horizon, std the standard deviation of the feature in training (1 where it is below
    1e-6). Undefined for t < h.
    """

    def __init__(self, *, seed: int = 0, horizon: int = 1) -> None:
        self.seed, self.horizon = seed, horizon
        self.std_: NDArray[np.float64] | None = None

    def fit(self, nominal: Sequence[Trajectory]) -> Persistence:
        """Learn the scale of every feature."""
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        std = rows.std(axis=0)
        self.std_ = np.where(std < 1e-6, 1.0, std)
        return self

    def score(self, trajectory: Trajectory) -> Scores:
        """Return the standardized size of the change over one horizon."""
        if self.std_ is None:
            raise NotFittedError("detector 'persistence' was asked for scores before fit")
        z = trajectory.observations / self.std_
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
