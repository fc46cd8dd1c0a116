"""A detector that scores by the prediction failure of a trained ensemble of networks.

The score of an observation is the mean absolute difference between it and its sampled forecasts,
over networks, samples and sensors, in training standard deviations of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.windows import LongFitDetector
from torch import Tensor

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_torch.device import resolved_device
from oodd_torch.forecast import Forecaster
from oodd_torch.network import Architecture, Ensemble
from oodd_torch.parameters import NetworkParameters
from oodd_torch.training import LEAST, Schedule, linear_forecast, train

WIDTHS: Final = (0.2, 0.1, 0.4, 0.2, 0.3)
"""Widths of the quadratic part of the quantile loss, in turn over the members.

In standard deviations of a sensor's change. With the usual 1 nearly all errors of a good forecast
would fall into the quadratic part, and the minimizer would be an expectile instead of a quantile.
"""

HELD_OUT: Final = 0.15
"""Share of the nominal trajectories that is not learned from; at least one. The loss on them is
reported, and each sensor's nominal distance is measured on them."""

MOST_HELD_OUT: Final = 8
"""No more than so many are."""

RESIDUAL_SAMPLES: Final = 8
"""Samples of each network behind the nominal distances, whatever the number in scoring."""

BATCH: Final = 64
"""Trajectories that are scored together."""

WEIGHTS: Final = "weights."
"""Prefix of the names of weights in a state."""


class NetworkDetector(LongFitDetector):
    r"""Mean absolute distance between an observation and its sampled forecasts.

    .. math:: A_t = \frac{1}{M e D} \sum_{i=1}^{M e} \sum_{d=1}^{D}
              \frac{|o_{t,d} - \hat f^{(i)}_{t,d}|}{\sigma_d}

    Each forecast of :math:`o_t` is made from the observations up to :math:`o_{t-h}`. Undefined
    (NaN) for t < h. Higher means more anomalous.

    The seed decides held-out episodes, networks, orders and quantile levels.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`.
    parameters
        Those that all networks share.
    window
        Observations in the input, W.
    samples, levels
        Samples of each network, M, and quantile levels of an update.
    recurrent, quantiles
        Whether the networks have memory, and a quantile function as their output.
    mean_sampling
        Whether each step of a rollout feeds back the mean of M samples rather than one sample.
    residual_units
        Whether a sensor's distance is that to the median of all samples, divided by what it is on
        nominal trajectories, instead of the mean distance to the samples.

    Notes
    -----
    Scores depend on a trajectory's past alone, up to the rounding of single-precision matrix
    products of different shapes (differences below 1e-3 of how far scores vary). Quantile levels
    are keyed by seed and time. Source: Danesh & Fern (2021), section 3 and appendix B.
    """

    kind: ClassVar[str] = "networks/5"

    def __init__(
        self,
        name: str,
        parameters: NetworkParameters,
        *,
        seed: int,
        horizon: int,
        window: int = 1,
        samples: int = 1,
        levels: int = 1,
        recurrent: bool = True,
        quantiles: bool = True,
        mean_sampling: bool = False,
        residual_units: bool = False,
    ) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=window)
        self.parameters, self.samples, self.mean_sampling = parameters, samples, mean_sampling
        self.residual_units = residual_units
        self.architecture: dict[str, Any] = {
            "window": window,
            "recurrent": recurrent,
            "quantiles": quantiles,
            "per_feature": parameters.trunk == "per-feature",
        }
        members = range(parameters.members)
        self.schedule = Schedule(
            updates=parameters.updates,
            batch=parameters.batch,
            chunk=parameters.chunk,
            levels=levels,
            widths=tuple(WIDTHS[i % len(WIDTHS)] for i in members),
            # A forecast of the next observation is never made from a forecast.
            scheduled_sampling=parameters.scheduled_sampling if horizon > 1 else 0.0,
        )
        self.device = resolved_device(name, parameters.device)
        self.network_: Ensemble
        self.history_: list[list[float]]
        self.residual_: NDArray[np.float32]
        self._forecaster: Forecaster

    def score(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return one score per observation, NaN for t < horizon."""
        return self.score_many([trajectory])[0]

    def score_many(self, trajectories: Sequence[Trajectory]) -> list[NDArray[np.float64]]:
        """Return the scores of several trajectories, computed in batches of similar length."""
        scale = self._scale()
        rows = [scale(x) for x in trajectories]
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        scores: list[NDArray[np.float64]] = [np.zeros(0)] * len(rows)
        for start in range(0, len(order), BATCH):
            batch = order[start : start + BATCH]
            errors = self._forecaster.errors([rows[i] for i in batch])
            for i, error in zip(batch, errors, strict=True):
                scores[i] = np.concatenate([np.full(self.horizon, np.nan), error])
        return scores

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._memory: Tensor | None = None

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        episodes = [scale(x) for x in nominal if x.transitions]
        order = np.random.default_rng([self.seed, 0]).permutation(len(episodes))
        held = min(max(1, round(HELD_OUT * len(episodes))), MOST_HELD_OUT)
        held_out = [episodes[i] for i in order[:held]]
        training = [episodes[i] for i in order[held:]] or held_out
        members = range(self.parameters.members)
        seeds = [np.random.SeedSequence([self.seed, i]).generate_state(1)[0] for i in members]
        generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
        architecture = Architecture(features=nominal[0].observation_dim, **self.architecture)
        base = linear_forecast(training, self.window)
        network = Ensemble(architecture, generators, *base).to(self.device)
        rngs = [np.random.default_rng([self.seed, 1, i]) for i in members]
        history = train(network, training, held_out, self.schedule, rngs, self.progress)
        self._take(network, history, self._residual(network, held_out))
        return scale

    def _residual(
        self, network: Ensemble, held_out: Sequence[NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Return every sensor's mean distance to the median one-step forecast, (D,)."""
        still = np.ones(network.architecture.features, np.float32)
        forecaster = Forecaster(
            network,
            horizon=1,
            samples=RESIDUAL_SAMPLES,
            mean_sampling=False,
            seed=self.seed,
            scale=still,
            longest=max(map(len, held_out)) - 1,
        )
        distances = np.concatenate(forecaster.distances(held_out)).mean(0)
        residual: NDArray[np.float32] = np.maximum(distances, LEAST).astype(np.float32)
        return residual

    def _take(
        self, network: Ensemble, history: list[list[float]], residual: NDArray[np.float32]
    ) -> None:
        self.network_, self.history_ = network.requires_grad_(requires_grad=False), history
        self.residual_ = residual
        self._forecaster = Forecaster(
            network,
            horizon=self.horizon,
            samples=self.samples,
            mean_sampling=self.mean_sampling,
            seed=self.seed,
            scale=residual if self.residual_units else None,
        )

    @torch.no_grad()
    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        network = self.network_
        memory = network.start(1) if self._memory is None else self._memory
        x = torch.from_numpy(window.reshape(-1)).to(network.device)
        x = x.expand(network.members, 1, 1, -1)
        samples, self._memory = self._forecaster.forecast(x, memory, range(t, t + 1))
        truth = torch.from_numpy(now).to(network.device).reshape(1, 1, -1)
        return float(self._forecaster.distance(samples, truth).mean())

    def _fitted_with(self) -> dict[str, Any]:
        return {
            "members": self.parameters.members,
            "scheduled_sampling": self.schedule.scheduled_sampling,
            **self.architecture,
        }

    def _arrays(self) -> Arrays:
        weights = {WEIGHTS + n: t.cpu().numpy() for n, t in self.network_.state_dict().items()}
        return {"history": np.array(self.history_), "residual": self.residual_, **weights}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        generators = [torch.Generator() for _ in range(self.parameters.members)]
        architecture = Architecture(features=sensors, **self.architecture)
        base = np.zeros((self.window * sensors + 1, sensors), np.float32)
        network = Ensemble(architecture, generators, base, np.ones(sensors, np.float32))
        weights = {
            n: torch.from_numpy(take(arrays, WEIGHTS + n, tuple(t.shape)))
            for n, t in network.state_dict().items()
        }
        network.load_state_dict(weights)
        residual = take(arrays, "residual", (sensors,), "+").astype(np.float32)
        self._take(
            network.to(self.device), take(arrays, "history", (None, None)).tolist(), residual
        )
