"""Errors of a stacked LSTM's forecasts of the next rows, as draws from a normal law.

After Malhotra, Vig, Shroff and Agarwal (ESANN 2015).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats, product, whitening
from torch import Tensor

from oodd_rivals.network_parameters import LstmParameters
from oodd_rivals.network_training import (
    arrays_of,
    draw,
    left_to_forecast,
    minimize,
    pieces_of,
    ridge,
    side_by_side,
)
from oodd_rivals.networks import BLOCK, LIMIT, SHRINK, NetworkRival, Shapes, settings

LAYERS: Final = 2
"""Recurrent layers, one on top of the other."""

SHRINKAGE: Final = 1e-3
"""Share of the identity in the covariance of errors, each in its root mean square."""

LEAST: Final = 1e-3
"""Least deviation of an error, in those of a linear forecast: a sensor may be forecast exactly."""

Carried = tuple[Floats, Floats]
"""Output and cell of each layer, (2, 2, 1, H), and the latest L forecasts of L rows, (L, L, D)."""


class StackedLstm(NetworkRival):
    r"""Squared Mahalanobis length of the errors of several forecasts of the same row.

    .. math:: e_t = (o_t - \hat o_{t|t-h}, \dots, o_t - \hat o_{t|t-h-l+1}), \qquad
              s_t = \frac{1}{l D} (e_t - \mu)^\top \Sigma^{-1} (e_t - \mu)

    with :math:`\hat o_{t|s}` the forecast by a stacked LSTM that has seen :math:`o_0 .. o_s`, and
    :math:`\mu, \Sigma` of held-out nominal episodes: minus the log-likelihood, twice and but for a
    constant. Errors of forecasts from before the beginning count as :math:`\mu`. Undefined (NaN)
    for t < h. Higher means more anomalous. The held-out loss is the mean squared error, in squared
    errors of a linear forecast.

    Parameters
    ----------
    name, seed, horizon
        See `NetworkRival`. The forecasts are fitted to the horizon directly.
    parameters
        See `LstmParameters`.

    Notes
    -----
    Source: P. Malhotra, L. Vig, G. Shroff & P. Agarwal, "Long short term memory networks for
    anomaly detection in time series", ESANN (2015).
    """

    kind: ClassVar[str] = "lstm/1"

    def __init__(self, name: str, parameters: LstmParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, actions=False)
        self.parameters = parameters
        self.reach = horizon + parameters.steps - 1

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        return self._lengths(self._errors(rows), observations)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._carried: Carried | None = None

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        carried = self._carried or self._beginning()
        rows = self._standard_rows(window), self._standard_rows(now[None])
        errors, self._carried = self._next(*rows, carried)
        return float(self._lengths(errors, now[None])[0])

    def _beginning(self) -> Carried:
        p = self.parameters
        forecasts = np.full((p.steps, p.steps, len(self.varying_)), np.nan)
        return np.zeros((LAYERS, 2, 1, p.units)), forecasts

    def _errors(self, rows: Floats) -> Floats:
        """Return the errors of all forecasts of o_h .. o_T, (T + 1 - h, L D); NaN without one."""
        carried = self._beginning()
        errors = [np.empty((0, carried[1][0].size))]
        for row, now in zip(rows[: -self.horizon], rows[self.horizon :], strict=True):
            error, carried = self._next(row[None], now[None], carried)
            errors.append(error)
        return np.concatenate(errors)

    def _next(self, row: Floats, now: Floats, carried: Carried) -> tuple[Floats, Carried]:
        """Take the next row, (1, D); return the errors of the one h steps later, (1, L D)."""
        w, x = self.weights_, np.clip(row, -LIMIT, LIMIT)
        output, memory = _step(np, w, x, carried[0])
        changes = x @ w["base"][:-1] + w["base"][-1] + w["unit"] * output
        steps = row + changes.reshape(1, self.parameters.steps, -1)
        forecasts = np.concatenate([steps, carried[1][:-1]])
        errors = now - forecasts.diagonal().T  # of the forecast j steps old its step j
        return errors.reshape(1, -1), (memory, forecasts)

    def _lengths(self, errors: Floats, observations: NDArray[np.float32]) -> Floats:
        """Return one number a row, from errors (N, L D) and the rows as they are (N, D)."""
        w = self.weights_
        centred = np.nan_to_num((errors - w["centre"]) / w["calibration"], nan=0.0)
        squares = (product(centred, w["whitening"], BLOCK) ** 2).sum(axis=1)
        squares = squares / self.parameters.steps + self.surprise_ * self._moved(observations)
        return np.asarray(squares / observations.shape[1])

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        p, d = self.parameters, len(self.varying_)
        rows, changes = (np.concatenate(v) for v in zip(*map(self._pairs, training), strict=True))
        base, unit = ridge(rows, changes)
        weights = draw(self._network_shapes(d), self.seed)
        packed = [left_to_forecast(self._pairs(e), base, unit) for e in training]
        chunks = pieces_of(packed, p, self.seed)
        memory = torch.zeros(LAYERS, 2, p.batch, p.units)

        def loss(update: int) -> Tensor:  # noqa: ARG001
            nonlocal memory
            x, y, starts = (v[0] for v in next(chunks))
            outputs, memory = _outputs(weights, x[..., :d], memory, starts)
            return (y[..., d:] - outputs).square().mean()

        packed = [left_to_forecast(self._pairs(e), base, unit) for e in held_out]
        unseen, counts = side_by_side(packed)
        empty, never = torch.zeros(LAYERS, 2, len(held_out), p.units), counts < 0

        def held_out_loss() -> Tensor:
            outputs, _ = _outputs(weights, unseen[:-1, :, :d], empty, never)
            squares = (unseen[1:, :, d:] - outputs).square().mean(2)
            return (squares * counts[1:]).sum() / counts[1:].sum()

        hidden = ["hidden_0", "in_1", "hidden_1"]
        minimize(weights, loss, held_out_loss, p.updates if d else 0, hidden, SHRINK)
        with torch.no_grad():
            self.loss_ = float(held_out_loss()) if d else 0.0
        self.weights_ = arrays_of(weights) | {"base": base, "unit": unit}
        errors = np.concatenate([self._errors(e)[p.steps - 1 :] for e in held_out])
        centre, spread = errors.mean(axis=0, keepdims=True), errors.std(axis=0, keepdims=True)
        self.weights_ |= {"centre": centre, "calibration": np.maximum(spread, LEAST * unit)}
        centred = (errors - centre) / self.weights_["calibration"]
        self.weights_["whitening"] = whitening(centred.T @ centred / len(centred), SHRINKAGE)

    def _pairs(self, episode: Floats) -> tuple[Floats, Floats]:
        """Return inputs (N, D) and the changes to the L rows from h on, (N, L D), from rows."""
        n, h = len(episode) - self.reach, self.horizon
        changes = [episode[h + j :][:n] - episode[:n] for j in range(self.parameters.steps)]
        return np.clip(episode[:n], -LIMIT, LIMIT), np.concatenate(changes, axis=1)

    def _network_shapes(self, sensors: int) -> Shapes:
        h, errors = self.parameters.units, self.parameters.steps * sensors
        shapes = {"out": (h, errors), "out_bias": (1, errors)}
        for n in range(LAYERS):
            shapes |= {f"in_{n}": (h if n else sensors, 4 * h), f"hidden_{n}": (h, 4 * h)}
            shapes[f"hidden_{n}_bias"] = (1, 4 * h)
        return shapes

    def _shapes(self, sensors: int, commands: int) -> Shapes:  # noqa: ARG002
        errors = self.parameters.steps * sensors
        rows = dict.fromkeys(("unit", "centre", "calibration"), (1, errors))
        matrices = {"base": (sensors + 1, errors), "whitening": (errors, errors)}
        return {**self._network_shapes(sensors), **rows, **matrices}

    def _fitted_with(self) -> dict[str, Any]:
        return {"horizon": self.horizon, **settings(self.parameters, "units", "steps")}


def _step(library: Any, w: Mapping[str, Any], x: Any, memory: Any) -> tuple[Any, Any]:
    """Return outputs (B, L D) and the new memory (2, 2, B, H), from x (B, D), of NumPy or torch."""
    after, h = [], memory.shape[-1]
    for n, (output, cell) in enumerate(memory):
        gates = x @ w[f"in_{n}"] + output @ w[f"hidden_{n}"] + w[f"hidden_{n}_bias"]
        opened = 0.5 + 0.5 * library.tanh(0.5 * gates[:, : 3 * h])  # the logistic function
        kept = opened[:, h : 2 * h] * cell + opened[:, :h] * library.tanh(gates[:, 3 * h :])
        x = opened[:, 2 * h :] * library.tanh(kept)
        after.append(library.stack([x, kept]))
    return x @ w["out"] + w["out_bias"], library.stack(after)


def _outputs(
    weights: Mapping[str, Tensor], x: Tensor, memory: Tensor, starts: Tensor
) -> tuple[Tensor, Tensor]:
    """Return outputs (T, B, L D) and the last memory, from x (T, B, D) and starts (T, B)."""
    w, outputs = {name: weight[0] for name, weight in weights.items()}, []
    for row, start in zip(x, starts, strict=False):
        output, memory = _step(torch, w, row, memory * ~start[:, None])
        outputs.append(output)
    return torch.stack(outputs), memory.detach()
