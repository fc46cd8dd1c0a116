"""The wm-kl-a detector: KL divergence of a world model's latent after and before a row.

After Zollicoffer et al., "Novelty detection in reinforcement learning with world models"
(arXiv 2310.08731, ICML 2025).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from torch import Tensor

from oodd_rivals.network_parameters import WorldModelParameters
from oodd_rivals.network_training import arrays_of, draw, minimize, pieces_of, ridge, side_by_side
from oodd_rivals.networks import LIMIT, SHRINK, NetworkRival, Shapes, gru_step, settings, silu
from oodd_rivals.world_training import LOG_SCALE, Training


class Belief(NamedTuple):
    """A normal latent: means and logarithms of scales in units of a linear forecast's error."""

    mean: Floats  # (1, V), in standard deviations of the sensors
    log_scale: Floats  # (1, V)


class WorldModel(NetworkRival):
    r"""Divergence of a latent's posterior from its prior, a sensor.

    .. math:: m_t = \mathrm{GRU}(m_{t-1}, z_{t-1}, a_{t-1}), \qquad
              s_t = \frac{1}{D} \, \mathrm{KL}\big(q(z \mid m_t, o_t) \,\big\|\, p(z \mid m_t)\big)

    with the prior p made from what was known at t - h, and :math:`z_{t-1}` the mean of the
    posterior, so that nothing is drawn in scoring. With the statistic "bound" it is the paper's
    criterion, positive where a novelty is declared:
    :math:`\mathrm{KL}(q(z|m_t, o_t) \| p(z|m_t)) - \mathrm{KL}(q(z|m_t, o_t) \| q(z|0, o_t))`.
    Undefined (NaN) for t < h. Higher means more anomalous. The held-out loss is the negative
    evidence bound a sensor, in nats, but for a constant.

    Parameters
    ----------
    name, seed, horizon
        See `NetworkRival`. Beyond one step the prior is rolled out with the actions commanded.
    parameters
        See `WorldModelParameters`.
    """

    kind: ClassVar[str] = "world-model/1"

    def __init__(
        self, name: str, parameters: WorldModelParameters, *, seed: int, horizon: int
    ) -> None:
        super().__init__(name, seed=seed, horizon=horizon, lag=1, actions=True)
        self.parameters = parameters

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        v = len(self.varying_)
        run = Run(self, rows[:1, :v])
        values = [run.step(rows[t - 1 : t, v:], rows[t : t + 1, :v]) for t in range(1, len(rows))]
        pairs = zip(values, self._moved(observations), strict=True)
        return np.array([self._statistic(*pair) for pair in pairs])

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._run: Run | None = None

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        if self._run is None:
            self._run = Run(self, self._standard_rows(window))
        command = self._standard_action(self._commands[0][None])
        value = self._run.step(command, self._standard_rows(now[None]))
        return self._statistic(value, float(self._moved(now[None])[0]))

    def _statistic(self, divergence: float, moved: float) -> float:
        return (divergence + 0.5 * self.surprise_ * moved) / len(self.observation_scale_.mean)

    def advance(self, memory: Floats, z: Floats, command: Floats) -> tuple[Floats, Belief]:
        """Return the memory and the prior after a step from latent z by an action."""
        w = self.weights_
        x = np.concatenate([np.clip(z, -LIMIT, LIMIT), np.clip(command, -LIMIT, LIMIT)], axis=1)
        memory = gru_step(w, silu(x @ w["first"] + w["first_bias"]), memory)
        hidden = silu(np.concatenate([memory, x], axis=1) @ w["prior"] + w["prior_bias"])
        mean, scale = np.split(hidden @ w["out_prior"] + w["out_prior_bias"], 2, axis=1)
        linear = z + x @ w["base"][:-1] + w["base"][-1]
        log_scale = np.minimum(LOG_SCALE * np.tanh(scale / LOG_SCALE), w["widest"])
        return memory, Belief(linear + w["unit"] * mean, log_scale)

    def posterior(self, memory: Floats, prior: Floats, row: Floats) -> Belief:
        """Return what is believed after an observation, (1, V), given the prior's mean."""
        w = self.weights_
        surprise = np.clip((row - prior) / w["unit"], -LIMIT, LIMIT)
        seen = np.concatenate([memory, np.clip(row, -LIMIT, LIMIT), surprise], axis=1)
        hidden = silu(seen @ w["posterior"] + w["posterior_bias"])
        mean, scale = np.split(hidden @ w["out_posterior"] + w["out_posterior_bias"], 2, axis=1)
        log_scale = LOG_SCALE * np.tanh(scale / LOG_SCALE)
        return Belief(row + w["unit"] * mean, log_scale)

    def divergence(self, one: Belief, other: Belief) -> float:
        """Return the Kullback-Leibler divergence of a belief from another, in nats."""
        shift = (one.mean - other.mean) / self.weights_["unit"] * np.exp(-other.log_scale)
        log_ratio = one.log_scale - other.log_scale
        terms = 0.5 * (shift**2 + np.expm1(2 * log_ratio)) - log_ratio
        return float(terms.sum())

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        p, v = self.parameters, len(self.varying_)
        x = np.concatenate([np.clip(e[:-1], -LIMIT, LIMIT) for e in training])
        changes = np.concatenate([np.diff(e[:, :v], axis=0) for e in training])
        base, unit = ridge(x, changes)
        weights = draw(self._network_shapes(v, x.shape[1] - v), self.seed)
        trained = Training(weights, base, unit, p.noise, v)
        clipped = [np.clip(e, -LIMIT, LIMIT).astype(np.float32) for e in training]
        chunks = pieces_of(clipped, p, self.seed)
        random = torch.Generator().manual_seed(self.seed)
        state = torch.zeros(p.batch, p.units), torch.zeros(p.batch, v)

        def loss(update: int) -> Tensor:  # noqa: ARG001
            nonlocal state
            x, y, starts = (part[0] for part in next(chunks))
            values, state = trained.loss(x, y[..., :v], starts, state, random)
            return values.mean()

        rows, counts = side_by_side(
            [np.clip(e, -LIMIT, LIMIT).astype(np.float32) for e in held_out]
        )
        first = torch.zeros(counts[1:].shape, dtype=torch.bool)
        first[0] = True
        empty = torch.zeros(len(held_out), p.units), torch.zeros(len(held_out), v)

        def held_out_loss() -> Tensor:
            same = torch.Generator().manual_seed(0)
            values, _ = trained.loss(rows[:-1], rows[1:, :, :v], first, empty, same)
            return (values * counts[1:]).sum() / counts[1:].sum()

        hidden = ["gru_in", "gru", "prior", "posterior", "decoder"]
        minimize(weights, loss, held_out_loss, p.updates if v else 0, hidden, SHRINK)
        self.weights_ = arrays_of(weights) | {"base": base, "unit": unit}
        self.weights_["widest"] = np.full((1, v), LOG_SCALE)
        scales = [p.log_scale for e in [*training, *held_out] for p, _ in self._beliefs(e)]
        self.weights_["widest"] = np.concatenate(scales).max(axis=0, keepdims=True)
        self.loss_ = self._held_out_loss(held_out)

    def _beliefs(self, episode: Floats) -> list[tuple[Belief, Belief]]:
        """Return prior and posterior of every row but the first."""
        v = len(self.varying_)
        run = Run(self, episode[:1, :v])
        beliefs = []
        for t in range(1, len(episode)):
            run.step(episode[t - 1 : t, v:], episode[t : t + 1, :v])
            beliefs.append(run.beliefs)
        return beliefs

    def _held_out_loss(self, held_out: Sequence[Floats]) -> float:
        """Return divergence plus expected error of the latent itself as reconstruction."""
        v, losses = len(self.varying_), []
        for e in held_out:
            for t, (prior, posterior) in enumerate(self._beliefs(e), start=1):
                error = (e[t, :v] - posterior.mean) / self.weights_["unit"]
                spread = error**2 + np.exp(2 * posterior.log_scale)
                decoded = 0.5 * float(spread.sum()) / self.parameters.noise**2
                losses.append((self.divergence(posterior, prior) + decoded) / max(1, v))
        return float(np.mean(losses))

    def _network_shapes(self, sensors: int, commands: int) -> Shapes:
        h = self.parameters.units
        layers = {
            "first": (sensors + commands, h),
            "gru_in": (h, 3 * h),
            "gru": (h, 3 * h),
            "prior": (h + sensors + commands, h),
            "out_prior": (h, 2 * sensors),
            "posterior": (h + 2 * sensors, h),
            "out_posterior": (h, 2 * sensors),
            "decoder": (h + sensors, h),
            "out_decoder": (h, sensors),
        }
        return layers | {f"{name}_bias": (1, columns) for name, (_, columns) in layers.items()}

    def _shapes(self, sensors: int, commands: int) -> Shapes:
        return {
            **self._network_shapes(sensors, commands),
            "base": (sensors + commands + 1, sensors),
            "unit": (1, sensors),
            "widest": (1, sensors),
        }

    def _fitted_with(self) -> dict[str, Any]:
        return settings(self.parameters, "units", "noise", "statistic")


class Run:
    """A world model in an episode: memory and latent after each row."""

    beliefs: tuple[Belief, Belief]
    """Prior, from the row before, and posterior of the latest row."""

    def __init__(self, model: WorldModel, first: Floats) -> None:
        self._model = model
        self._empty = np.zeros((1, model.parameters.units))
        # What a memory of nothing believes of a row expects the row itself.
        z = model.posterior(self._empty, first, first).mean
        self._past = deque([(self._empty, z)], maxlen=model.horizon)
        self._commands: deque[Floats] = deque(maxlen=model.horizon)

    def step(self, command: Floats, row: Floats) -> float:
        """Return the divergence of the next row, NaN before the horizon: (1, A), (1, V)."""
        model = self._model
        self._commands.append(command)
        memory, prior = model.advance(*self._past[-1], command)
        posterior = model.posterior(memory, prior.mean, row)
        self.beliefs = prior, posterior
        complete = len(self._commands) == model.horizon
        if complete and model.horizon > 1:
            older, z = self._past[0]
            for past_command in self._commands:
                older, prior = model.advance(older, z, past_command)
                z = prior.mean
        self._past.append((memory, posterior.mean))
        if not complete:
            return float("nan")
        value = model.divergence(posterior, prior)
        if model.parameters.statistic == "bound":
            value -= model.divergence(posterior, model.posterior(self._empty, row, row))
        return value
