"""A detector that scores by the prediction failure of a trained ensemble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from oodd_eval import Trajectory
from oodd_eval.errors import NotFittedError, UsageError
from oodd_eval.prediction import CONSTANT, FeatureScale, anomaly_scores
from oodd_torch.forecast import forecast_errors
from oodd_torch.network import Architecture, Ensemble
from oodd_torch.training import Schedule, train

HELD_OUT = 0.15
"""Share of the nominal trajectories that decides when to stop training; at least one."""

RATES = (1e-2,)
"""Largest learning rates, in turn over the members: the paper's two (appendix B)."""

BATCH = 64
"""Trajectories that are scored together."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What a detector of this family may be told.

    Attributes
    ----------
    members
        Networks in the ensemble, e; they differ in seed, order of episodes and learning rate.
    samples
        Samples of each network, M; 1 without quantiles.
    window
        Observations in the input, W.
    recurrent, quantiles
        Whether the networks have memory, and a quantile function as their output.
    mean_sampling
        Whether each step of a rollout feeds back the mean of M samples rather than one sample.
    updates
        Gradient steps of each member, at most.
    batch, chunk
        Episodes in a batch, and steps through which gradients flow.
    levels
        Quantile levels of an update, one from each of as many equal parts of (0, 1).
    scheduled_sampling
        Share of inputs that are the network's own samples at the end of training; it rises
        linearly from 0 with the updates.
    """

    members: int = 5
    samples: int = 8
    window: int = 1
    recurrent: bool = True
    quantiles: bool = True
    mean_sampling: bool = False
    updates: int = 600
    batch: int = 16
    chunk: int = 100
    levels: int = 8
    scheduled_sampling: float = 0.0

    def check(self, name: str) -> None:
        """Raise `UsageError` when a value is out of range, naming detector and parameter."""
        for field in ("members", "samples", "window", "updates", "batch", "chunk", "levels"):
            value = getattr(self, field)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise UsageError(
                    f"parameter {field} of detector {name!r}: expected an integer of at least 1, "
                    f"got {value!r}"
                )
        share = self.scheduled_sampling
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
            raise UsageError(
                f"parameter scheduled_sampling of detector {name!r}: expected a number between 0 "
                f"and 1, got {share!r}"
            )


def change_scale(episodes: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the standard deviation of one-step changes, (D,); 1 for sensors that stand still."""
    changes = np.concatenate([np.diff(e, axis=0) for e in episodes])
    std = changes.std(axis=0, dtype=np.float64)
    return np.where(std < CONSTANT, 1.0, std).astype(np.float32)


class ForecastDetector:
    r"""Mean absolute distance between an observation and its sampled forecasts.

    .. math:: A_t = \frac{1}{M e D} \sum_{i=1}^{M e} \sum_{d=1}^{D}
              \frac{|o_{t,d} - \hat f^{(i)}_{t,d}|}{\sigma_d}

    Each forecast of :math:`o_t` is made from the observations up to :math:`o_{t-h}`. Undefined
    (NaN) for t < h. Higher means more anomalous.

    Parameters
    ----------
    name
        Name for messages.
    settings
        See `Settings`.
    seed
        Decides held-out episodes, networks, orders and quantile levels.
    horizon
        Steps between the last observation a forecast uses and the one it predicts, h.

    Notes
    -----
    Scores depend on a trajectory's past alone, up to the rounding of single-precision matrix
    products of different shapes (relative differences of 1e-5). Quantile levels are keyed by seed
    and time. Source: Danesh & Fern (2021), section 3 and appendix B.
    """

    def __init__(self, name: str, settings: Settings, *, seed: int, horizon: int) -> None:
        settings.check(name)
        for what, value, least in (("seed", seed, 0), ("horizon", horizon, 1)):
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise UsageError(
                    f"{what} of detector {name!r}: expected an integer of at least {least}, "
                    f"got {value!r}"
                )
        self.name, self.settings, self.seed, self.horizon = name, settings, seed, horizon
        self.scale_: FeatureScale | None = None
        self.network_: Ensemble | None = None
        self.history_: list[list[float]] = []

    def fit(self, nominal: Sequence[Trajectory]) -> ForecastDetector:
        """Train the ensemble on nominal trajectories, forgetting any earlier fit.

        Raises
        ------
        TrajectoryError
            When there is no transition, or trajectories differ in their number of sensors.
        """
        s = self.settings
        scale = FeatureScale.fit(nominal)
        episodes = [scale(x) for x in nominal if x.transitions]
        order = np.random.default_rng([self.seed, 0]).permutation(len(episodes))
        held = max(1, round(HELD_OUT * len(episodes)))
        held_out = [episodes[i] for i in order[:held]]
        training = [episodes[i] for i in order[held:]] or held_out
        states = [np.random.SeedSequence([self.seed, i]) for i in range(s.members)]
        generators = [
            torch.Generator().manual_seed(int(state.generate_state(1)[0])) for state in states
        ]
        network = Ensemble(
            Architecture(
                features=nominal[0].observation_dim,
                window=s.window,
                recurrent=s.recurrent,
                quantiles=s.quantiles,
            ),
            generators,
            change_scale(training),
        )
        self.history_ = train(
            network,
            training,
            held_out,
            Schedule(
                updates=s.updates,
                batch=s.batch,
                chunk=s.chunk,
                levels=s.levels,
                rates=tuple(RATES[i % len(RATES)] for i in range(s.members)),
                scheduled_sampling=s.scheduled_sampling,
            ),
            [np.random.default_rng([self.seed, 1, i]) for i in range(s.members)],
        )
        self.scale_, self.network_ = scale, network.requires_grad_(requires_grad=False)
        return self

    def score(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return one score per observation, NaN for t < horizon.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When the trajectory has another number of sensors than those of `fit`.
        """
        return self.score_many([trajectory])[0]

    def score_many(self, trajectories: Sequence[Trajectory]) -> list[NDArray[np.float64]]:
        """Return the scores of several trajectories, computed in batches of similar length."""
        if self.scale_ is None or self.network_ is None:
            raise NotFittedError(
                f"detector {self.name!r} was asked for scores before fit: fit it on nominal "
                "trajectories"
            )
        rows = [self.scale_(x) for x in trajectories]
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        scores: list[NDArray[np.float64]] = [np.zeros(0)] * len(rows)
        for start in range(0, len(order), BATCH):
            batch = order[start : start + BATCH]
            errors = forecast_errors(
                self.network_,
                [rows[i] for i in batch],
                horizon=self.horizon,
                samples=self.settings.samples if self.settings.quantiles else 1,
                mean_sampling=self.settings.mean_sampling,
                seed=self.seed,
            )
            for i, error in zip(batch, errors, strict=True):
                scores[i] = anomaly_scores(rows[i], error, self.horizon)
        return scores
