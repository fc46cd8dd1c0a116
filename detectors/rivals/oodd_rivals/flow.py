"""The logpZO detector: squared length of a row that a learned flow carried to a Gaussian.

After FAIL-Detect (Xu et al., RSS 2025, arXiv 2503.08558), from the paper alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from torch import Tensor
from torch.nn.functional import silu as torch_silu

from oodd_rivals.network_parameters import FlowParameters, TransitionFlowParameters
from oodd_rivals.network_training import arrays_of, draw, minimize, ridge
from oodd_rivals.networks import BLOCK, LIMIT, NetworkRival, Shapes, settings, silu

LAYERS: Final = 3
"""Hidden layers of the velocity."""

FEATURES: Final = 8
"""Cosines by which the velocity knows the time."""

LEAST_VARIANCE: Final = 1e-8
"""Least variance of a direction of standardized rows: rows are single precision."""

DRAWS: Final = 4
"""Noises of each held-out row behind the held-out loss."""


class FlowNorm(NetworkRival):
    r"""Squared norm of the latent to which a flow carries a row, a dimension.

    .. math:: \frac{dx}{d\tau} = v(x, \tau), \quad x(0) = W (y_t - \bar y), \quad
              s_t = \frac{1}{C} \lVert x(1) \rVert^2, \qquad
              v = \operatorname{argmin} \; E \, \lVert v((1 - \tau) x + \tau z, \tau)
              - (z - x) \rVert^2

    with z standard normal and W the whitening of nominal rows. A row y is an observation, or with
    actions a transition :math:`(o_{t-h}, a_{t-h}, o_t)`. Undefined (NaN) for t < h with actions.
    Higher means more anomalous. The held-out loss is the mean squared error of the velocity a
    dimension, at noises and times drawn once.

    Parameters
    ----------
    name, seed, horizon, actions
        See `NetworkRival`. Without actions the horizon has no effect.
    parameters
        See `FlowParameters`, and with actions `TransitionFlowParameters`.
    """

    kind: ClassVar[str] = "flow/1"

    def __init__(
        self, name: str, parameters: FlowParameters, *, seed: int, horizon: int, actions: bool
    ) -> None:
        lag = horizon if actions else 0
        super().__init__(name, seed=seed, horizon=horizon, lag=lag, actions=actions)
        self.parameters = parameters
        self.conditional = isinstance(parameters, TransitionFlowParameters) and (
            parameters.conditional
        )

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        return self._norms(*self._columns(rows), observations)

    def latents(self, context: Floats, rows: Floats) -> Floats:
        """Return where the flow carries rows, (N, C), given what it knows of each, (N, K)."""
        w, steps = self.weights_, self.parameters.steps
        known = np.clip(context, -LIMIT, LIMIT)
        centred = rows - product(known, w["base"][:-1], BLOCK) - w["base"][-1]
        x = product(centred, w["whitening"], BLOCK)
        for k in range(steps):
            x = x + self._velocity(known, x, k / steps) / steps
        return x

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        rows = self._standard_rows(np.stack([window[0], now]))
        known = rows[:1]
        if self.actions:
            command = self._standard_action(self._commands[self.lag - 1])
            known = np.concatenate([known, command[None]], axis=1)
        return float(self._norms(*self._arranged(known, rows[1:]), now[None])[0])

    def _columns(self, episode: Floats) -> tuple[Floats, Floats]:
        """Return what is known, (N, K), and what the flow carries, (N, C), of every row."""
        n = max(0, len(episode) - self.lag)
        return self._arranged(episode[:n], episode[self.lag :, : len(self.varying_)])

    def _arranged(self, known: Floats, now: Floats) -> tuple[Floats, Floats]:
        if not self.actions:
            return known[:, :0], now
        if self.conditional:
            return known, now
        return known[:, :0], np.concatenate([known, now], axis=1)

    def _norms(self, context: Floats, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        """Return one number a row, from what is carried (N, C) and the rows as they are (N, D)."""
        squares = (self.latents(context, rows) ** 2).sum(axis=1)
        constant = observations.shape[1] - len(self.varying_)
        norms: Floats = squares + self.surprise_ * self._moved(observations)
        norms /= rows.shape[1] + constant
        return norms

    def _velocity(self, known: Floats, x: Floats, time: float) -> Floats:
        """Return the velocity of points x, (N, C), at a time between 0 and 1."""
        w = self.weights_
        when = np.broadcast_to(_cosines(np.array([[time]])), (len(x), FEATURES))
        inputs = np.concatenate([np.clip(x, -LIMIT, LIMIT), known, when], axis=1)
        hidden = silu(product(inputs, w["layer_0"], BLOCK) + w["layer_0_bias"])
        for n in range(1, LAYERS):
            hidden = hidden + silu(product(hidden, w[f"layer_{n}"], BLOCK) + w[f"layer_{n}_bias"])
        velocity: Floats = _linear(time) * x + product(hidden, w["out"], BLOCK) + w["out_bias"]
        return velocity

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        p = self.parameters
        known, rows = self._pooled(training)
        base, _ = ridge(known, rows)
        centred = rows - known @ base[:-1] - base[-1]
        variances, directions = np.linalg.eigh(centred.T @ centred / len(centred))
        whitening = directions / np.sqrt(np.maximum(variances, LEAST_VARIANCE))
        x, c = _single(centred @ whitening), _single(known)

        known, rows = self._pooled(held_out)
        unseen = (rows - known @ base[:-1] - base[-1]) @ whitening
        held_x, held_c = (_single(v).repeat(DRAWS, 1) for v in (unseen, known))

        weights = draw(self._network_shapes(x.shape[1], c.shape[1]), self.seed)
        random = np.random.default_rng([self.seed, 1])
        noise = torch.Generator().manual_seed(self.seed)

        def loss(update: int) -> Tensor:  # noqa: ARG001
            index = torch.from_numpy(random.integers(0, len(x), p.batch))
            return _error(weights, x[index], c[index], noise)

        def held_out_loss() -> Tensor:
            return _error(weights, held_x, held_c, torch.Generator().manual_seed(0))

        hidden = [f"layer_{n}" for n in range(1, LAYERS)]
        minimize(weights, loss, held_out_loss, p.updates if x.shape[1] else 0, hidden)
        self.weights_ = arrays_of(weights) | {"base": base, "whitening": whitening}
        with torch.no_grad():
            self.loss_ = float(held_out_loss()) if x.shape[1] else 0.0

    def _pooled(self, episodes: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return `_columns` of all rows, the known ones limited."""
        known, rows = zip(*map(self._columns, episodes), strict=True)
        return np.clip(np.concatenate(known), -LIMIT, LIMIT), np.concatenate(rows)

    def _network_shapes(self, carried: int, known: int) -> Shapes:
        h = self.parameters.units
        shapes = {"layer_0": (carried + known + FEATURES, h), "layer_0_bias": (1, h)}
        for n in range(1, LAYERS):
            shapes |= {f"layer_{n}": (h, h), f"layer_{n}_bias": (1, h)}
        return {**shapes, "out": (h, carried), "out_bias": (1, carried)}

    def _shapes(self, sensors: int, commands: int) -> Shapes:
        before = sensors + commands if self.actions else 0
        known = before if self.conditional else 0
        carried = sensors + before - known
        return {
            **self._network_shapes(carried, known),
            "base": (known + 1, carried),
            "whitening": (carried, carried),
        }

    def _fitted_with(self) -> dict[str, Any]:
        return {
            "actions": self.actions,
            "horizon": self.horizon if self.actions else 0,
            "conditional": self.conditional,
            **settings(self.parameters, "units", "steps"),
        }


def of_rows(name: str, parameters: FlowParameters, *, seed: int, horizon: int) -> FlowNorm:
    """Return an unfitted `FlowNorm` of observations."""
    return FlowNorm(name, parameters, seed=seed, horizon=horizon, actions=False)


def of_transitions(
    name: str, parameters: TransitionFlowParameters, *, seed: int, horizon: int
) -> FlowNorm:
    """Return an unfitted `FlowNorm` of transitions."""
    return FlowNorm(name, parameters, seed=seed, horizon=horizon, actions=True)


def _linear(time: Any) -> Any:
    """Return the slope of the best velocity of a standard normal x: E[z - x | y] / y.

    For y = (1 - time) x + time z. The network learns what other laws add to it.
    """
    return (2 * time - 1) / ((1 - time) ** 2 + time**2)


def _cosines(time: Floats) -> Floats:
    """Return cosines of 1 to 8 half turns, from times (N, 1) to (N, 8)."""
    cosines: Floats = np.cos(np.pi * time * np.arange(1, FEATURES + 1))
    return cosines


def _single(rows: Floats) -> Tensor:
    return torch.from_numpy(rows.astype(np.float32))


def _error(weights: dict[str, Tensor], x: Tensor, known: Tensor, noise: torch.Generator) -> Tensor:
    """Return the mean squared error of velocities at noises and times of their own."""
    z = torch.randn(x.shape, generator=noise)
    time = torch.rand(len(x), 1, generator=noise)
    between = (1 - time) * x + time * z
    when = torch.cos(torch.pi * time * torch.arange(1, FEATURES + 1))
    inputs = torch.cat([between.clamp(-LIMIT, LIMIT), known, when], 1)
    w = {name: weight[0] for name, weight in weights.items()}
    hidden = torch_silu(inputs @ w["layer_0"] + w["layer_0_bias"])
    for n in range(1, LAYERS):
        hidden = hidden + torch_silu(hidden @ w[f"layer_{n}"] + w[f"layer_{n}_bias"])
    extra = hidden @ w["out"] + w["out_bias"]
    velocity = _linear(time) * between + extra
    loss: Tensor = (velocity - (z - x)).square().mean()
    return loss
