"""A recurrent probabilistic forecast whose deviations are calibrated sensor by sensor.

After RAPT (Munn, Tidd, Bohm, Gallagher and Howard 2026, arXiv 2602.01515).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_torch.gru import Sequence as GruSequence
from torch import Tensor
from torch.nn.functional import silu as torch_silu

from oodd_rivals.network_parameters import RaptParameters
from oodd_rivals.network_training import (
    arrays_of,
    draw,
    left_to_forecast,
    minimize,
    pieces_of,
    ridge,
    side_by_side,
)
from oodd_rivals.networks import LIMIT, SHRINK, NetworkRival, Shapes, gru_step, settings, silu

LOG_SCALE: Final = 12.0
"""Largest size of the logarithm of a scale."""

MEAN_FIRST: Final = 0.25
"""Share of the updates in which squared errors weigh more than the likelihood.

A likelihood alone widens the scales of what it could still learn to forecast.
"""

LEAST: Final = 1e-3
"""Least spread of a calibrated residual: a sensor may be forecast exactly."""


class RecurrentForecast(NetworkRival):
    r"""Standardized residuals of a recurrent Gaussian forecast, each on its nominal scale.

    .. math:: r_{t,d} = \frac{o_{t,d} - \mu_d(m_{t-h})}{\sigma_d(m_{t-h})}, \qquad
              m_s = \mathrm{GRU}(m_{s-1}, o_s, a_s), \qquad
              s_t = \frac{1}{D} \sum_d \frac{r_{t,d}^2}{c_d^2}

    with :math:`c_d` the root mean square of :math:`r_d` on held-out nominal episodes; or the
    largest of the sensors' terms. Undefined (NaN) for t < h. Higher means more anomalous. The
    held-out loss is the negative log-likelihood a sensor, in nats, of the errors of the linear
    forecast in units of their root mean square.

    Parameters
    ----------
    name, seed, horizon
        See `NetworkRival`. The forecast is fitted to the horizon directly.
    parameters
        See `RaptParameters`.
    """

    kind: ClassVar[str] = "rapt/1"

    def __init__(self, name: str, parameters: RaptParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, actions=True)
        self.parameters = parameters

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        return self._statistic(self._residuals(rows), observations)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._memory = np.zeros((1, 0))

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        if t == self.lag:
            self._memory = np.zeros((1, self.parameters.units))
        before, after = self._standard_rows(window), self._standard_rows(now[None])
        command = self._standard_action(self._commands[self.lag - 1][None])
        x = np.clip(np.concatenate([before, command], axis=1), -LIMIT, LIMIT)
        self._memory, mean, width = self._step(x, self._memory)
        return float(self._statistic((after - before - mean) / width, now[None])[0])

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        p = self.parameters
        d = len(self.varying_)
        inputs, changes = (np.concatenate(v) for v in zip(*map(self._pairs, training), strict=True))
        base, unit = ridge(inputs, changes)
        commands = inputs.shape[1] - d
        weights = draw(self._network_shapes(d, commands), self.seed)
        packed = [left_to_forecast(self._pairs(e), base, unit) for e in training]
        chunks = pieces_of(packed, p, self.seed)
        memory = torch.zeros(1, p.batch, p.units)

        def loss(update: int) -> Tensor:
            nonlocal memory
            x, y, starts = next(chunks)
            mean, log_scale, memory = _forecast(weights, x[..., :-d], memory, starts)
            error = y[..., -d:] - mean
            surprise = _surprise(error, log_scale)
            if update < MEAN_FIRST * p.updates:
                return 0.3 * surprise.mean() + 3.0 * error.square().clamp(max=25.0).mean()
            return surprise.mean()

        packed = [left_to_forecast(self._pairs(e), base, unit) for e in held_out]
        rows, counts = side_by_side(packed)
        never = torch.zeros(1, *counts[1:].shape, dtype=torch.bool)

        def held_out_loss() -> Tensor:
            empty = torch.zeros(1, len(held_out), p.units)
            mean, log_scale, _ = _forecast(weights, rows[None, :-1, :, :-d], empty, never)
            surprise = _surprise(rows[None, 1:, :, -d:] - mean, log_scale)[0].mean(-1)
            return (surprise * counts[1:]).sum() / counts[1:].sum()

        hidden = ["gru_in", "gru", "second"]
        minimize(weights, loss, held_out_loss, p.updates if d else 0, hidden, SHRINK)
        self.weights_ = arrays_of(weights) | {"base": base, "unit": unit}
        self.weights_["widest"] = np.full((1, d), LOG_SCALE)
        scales = np.concatenate([self._forecasts(e)[1] for e in [*training, *held_out]])
        self.weights_["widest"] = scales.max(axis=0, keepdims=True)
        self.weights_["calibration"] = np.ones((1, d))
        residuals = np.concatenate([self._residuals(e) for e in held_out])
        size = np.sqrt((residuals**2).mean(axis=0, keepdims=True))
        self.weights_["calibration"] = np.maximum(size, LEAST)
        scales = np.concatenate([self._forecasts(e)[1] for e in held_out])
        self.loss_ = float((0.5 * residuals**2 + scales).sum() / max(1, scales.size))

    def _pairs(self, episode: Floats) -> tuple[Floats, Floats]:
        """Return inputs (N, I) and changes over the horizon (N, D), from `_standard` rows."""
        v, n = len(self.varying_), max(0, len(episode) - self.horizon)
        rows = episode[:, :v]
        return np.clip(episode[:n], -LIMIT, LIMIT), rows[self.horizon :] - rows[:n]

    def _step(self, x: Floats, memory: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the memory after an input, and means and widths of the change: (1, D) each."""
        w = self.weights_
        memory, mean, log_scale = self._network(x, memory)
        linear = x @ w["base"][:-1] + w["base"][-1]
        return memory, linear + w["unit"] * mean, w["unit"] * np.exp(log_scale)

    def _network(self, x: Floats, memory: Floats) -> tuple[Floats, Floats, Floats]:
        w = self.weights_
        first = silu(x @ w["first"] + w["first_bias"])
        memory = gru_step(w, first, memory)
        hidden = first + silu(memory @ w["second"] + w["second_bias"])
        mean, scale = np.split(hidden @ w["out"] + w["out_bias"], 2, axis=1)
        log_scale = LOG_SCALE * np.tanh(scale / LOG_SCALE)
        return memory, mean, np.minimum(log_scale, w["widest"])

    def _forecasts(self, episode: Floats) -> tuple[Floats, Floats]:
        """Return residuals and log scales of all rows of an episode, (N, D) each."""
        x, changes = self._pairs(episode)
        # Rows in one piece, as they come live: of others some processors round products otherwise.
        x = np.ascontiguousarray(x)
        memory = np.zeros((1, self.parameters.units))
        residuals, log_scales = np.empty_like(changes), np.empty_like(changes)
        for n in range(len(x)):
            memory, mean, width = self._step(x[n : n + 1], memory)
            residuals[n] = (changes[n] - mean[0]) / width[0]
            log_scales[n] = np.log(width[0] / self.weights_["unit"][0])
        return residuals, log_scales

    def _residuals(self, episode: Floats) -> Floats:
        return self._forecasts(episode)[0]

    def _statistic(self, residuals: Floats, observations: NDArray[np.float32]) -> Floats:
        """Return one number a row, from residuals (N, V) and the rows as they are (N, D)."""
        terms = (residuals / self.weights_["calibration"]) ** 2
        moved = self._moved(observations)
        if self.parameters.statistic == "largest":
            largest: Floats = np.maximum(
                terms.max(axis=1, initial=0.0), self.surprise_ * np.sign(moved)
            )
            return largest
        mean: Floats = (terms.sum(axis=1) + self.surprise_ * moved) / observations.shape[1]
        return mean

    def _network_shapes(self, sensors: int, commands: int) -> Shapes:
        h, inputs = self.parameters.units, sensors + commands
        return {
            "first": (inputs, h),
            "first_bias": (1, h),
            "gru_in": (h, 3 * h),
            "gru_in_bias": (1, 3 * h),
            "gru": (h, 3 * h),
            "gru_bias": (1, 3 * h),
            "second": (h, h),
            "second_bias": (1, h),
            "out": (h, 2 * sensors),
            "out_bias": (1, 2 * sensors),
        }

    def _shapes(self, sensors: int, commands: int) -> Shapes:
        inputs = sensors + commands
        row = (1, sensors)
        return {
            **self._network_shapes(sensors, commands),
            "base": (inputs + 1, sensors),
            "unit": row,
            "widest": row,
            "calibration": row,
        }

    def _fitted_with(self) -> dict[str, Any]:
        return {"horizon": self.horizon, **settings(self.parameters, "units", "statistic")}


def _surprise(error: Tensor, log_scale: Tensor) -> Tensor:
    """Return negative log-likelihoods of normal errors, but for a constant."""
    return 0.5 * (error * torch.exp(-log_scale)).square() + log_scale


def _forecast(
    w: dict[str, Tensor], x: Tensor, memory: Tensor, starts: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means and log scales, (1, T, B, D), and the last memory, from x (1, T, B, I)."""
    _, t, b, _ = x.shape
    first = torch_silu(torch.baddbmm(w["first_bias"], x.reshape(1, t * b, -1), w["first"]))
    projected = torch.baddbmm(w["gru_in_bias"], first, w["gru_in"]).reshape(1, t, b, -1)
    kept = (~starts).to(x.dtype)[..., None]
    after: Tensor = GruSequence.apply(  # type: ignore[no-untyped-call]
        projected, memory, w["gru"], w["gru_bias"], kept
    )
    flat = after.reshape(1, t * b, -1)
    hidden = first + torch_silu(torch.baddbmm(w["second_bias"], flat, w["second"]))
    out = torch.baddbmm(w["out_bias"], hidden, w["out"]).reshape(1, t, b, -1)
    mean, scale = out.chunk(2, -1)
    return mean, LOG_SCALE * torch.tanh(scale / LOG_SCALE), after[:, -1].detach()
