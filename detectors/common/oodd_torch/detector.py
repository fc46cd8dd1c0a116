"""A detector that scores by the prediction failure of a trained ensemble."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodd_eval import Trajectory
from oodd_eval.errors import NotFittedError, UsageError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale, anomaly_scores
from oodd_torch.forecast import Forecaster
from oodd_torch.network import Architecture, Ensemble
from oodd_torch.settings import Settings
from oodd_torch.storage import Fit, load_fit, save_fit
from oodd_torch.training import train

HELD_OUT = 0.15
"""Share of the nominal trajectories that decides when to stop training; at least one."""

MOST_HELD_OUT = 8
"""No more than so many decide it: the loss on them is looked at often, and on 75 episodes of 1000
steps it took twice the time of the training itself."""

BATCH = 64
"""Trajectories that are scored together."""


def change_scale(episodes: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the standard deviation of one-step changes, (D,); 1 for sensors that stand still."""
    changes = np.concatenate([np.diff(e, axis=0) for e in episodes])
    std = changes.std(axis=0, dtype=np.float64)
    return np.where(std < CONSTANT, 1.0, std).astype(np.float32)


@dataclass(slots=True)
class Stream:
    """Where a live episode is: memory, the latest rows, and forecasts that await their times."""

    memory: Tensor
    latest: deque[NDArray[np.float32]]
    awaited: deque[Tensor] = field(default_factory=deque)
    now: int = 0


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
        self.fit_: Fit | None = None
        self._forecaster: Forecaster | None = None
        self._stream: Stream | None = None

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
        held = min(max(1, round(HELD_OUT * len(episodes))), MOST_HELD_OUT)
        held_out = [episodes[i] for i in order[:held]]
        training = [episodes[i] for i in order[held:]] or held_out
        states = [np.random.SeedSequence([self.seed, i]) for i in range(s.members)]
        generators = [
            torch.Generator().manual_seed(int(state.generate_state(1)[0])) for state in states
        ]
        architecture = Architecture(features=nominal[0].observation_dim, **s.architecture)
        network = Ensemble(architecture, generators, change_scale(training)).to(s.place)
        rngs = [np.random.default_rng([self.seed, 1, i]) for i in range(s.members)]
        history = train(network, training, held_out, s.schedule, rngs)
        self._take(Fit(network.requires_grad_(requires_grad=False), scale, history))
        return self

    def save(self, directory: Path) -> None:
        """Write the fit into a directory: weights in safetensors, the rest in JSON.

        Raises
        ------
        NotFittedError
            Before `fit`.
        """
        save_fit(directory, self._fitted()[0])

    def load(self, directory: Path) -> None:
        """Take over a fit that `save` wrote; horizon, samples and device may be others.

        Raises
        ------
        FittedStateError
            When the files are missing, damaged, or of networks of another kind.
        """
        s = self.settings
        self._take(load_fit(directory, members=s.members, expected=s.architecture, device=s.place))

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
        fit, forecaster = self._fitted()
        rows = [fit.scale(x) for x in trajectories]
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        scores: list[NDArray[np.float64]] = [np.zeros(0)] * len(rows)
        for start in range(0, len(order), BATCH):
            batch = order[start : start + BATCH]
            errors = forecaster.errors([rows[i] for i in batch])
            for i, error in zip(batch, errors, strict=True):
                scores[i] = anomaly_scores(rows[i], error, self.horizon)
        return scores

    def reset(self) -> None:
        """Begin a new live episode.

        Raises
        ------
        NotFittedError
            Before `fit`.
        """
        self._stream = self._begin()

    @torch.no_grad()
    def update(
        self,
        observation: NDArray[np.float32],
        action: NDArray[np.float32] | None = None,  # noqa: ARG002  the contract's name
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When the observation has another number of sensors than those of `fit`, or a value that
            is not finite.
        """
        fit, forecaster = self._fitted()
        row = fit.scale.row(observation)
        stream = self._stream = self._stream or self._begin()
        score = float("nan")
        if len(stream.awaited) == self.horizon:
            error = (torch.from_numpy(row).to(fit.network.device) - stream.awaited.popleft()).abs()
            score = float(error.mean(dtype=torch.float64))
        if not stream.now:
            stream.latest.extend([row] * (fit.network.architecture.window - 1))
        stream.latest.appendleft(row)
        x = torch.from_numpy(np.concatenate(stream.latest)).to(fit.network.device)
        due = stream.now + self.horizon
        samples, stream.memory = forecaster.forecast(
            x.expand(fit.network.members, 1, 1, -1), stream.memory, range(due, due + 1)
        )
        stream.awaited.append(samples[:, 0, 0])  # (E, M, D)
        stream.now += 1
        return score

    @property
    def network_(self) -> Ensemble:
        """The trained networks."""
        return self._fitted()[0].network

    @property
    def scale_(self) -> FeatureScale:
        """Mean and standard deviation of every sensor in training."""
        return self._fitted()[0].scale

    @property
    def history_(self) -> list[list[float]]:
        """Held-out losses of all networks, one list per evaluation."""
        return self._fitted()[0].history

    def _take(self, fit: Fit) -> None:
        s = self.settings
        self.fit_, self._stream = fit, None
        self._forecaster = Forecaster.of(
            fit.network,
            horizon=self.horizon,
            samples=s.samples if s.quantiles else 1,
            mean_sampling=s.mean_sampling,
            seed=self.seed,
        )

    def _begin(self) -> Stream:
        network = self._fitted()[0].network
        return Stream(network.start(1), deque(maxlen=network.architecture.window))

    def _fitted(self) -> tuple[Fit, Forecaster]:
        if self.fit_ is None or self._forecaster is None:
            raise NotFittedError(
                f"detector {self.name!r} was asked for scores before fit: fit it on nominal "
                "trajectories"
            )
        return self.fit_, self._forecaster
