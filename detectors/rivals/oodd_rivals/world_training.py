"""The world model in torch, and what its training minimizes."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from oodd_common.charts import Floats
from torch import Tensor
from torch.nn.functional import silu

from oodd_rivals.networks import LIMIT

LOG_SCALE: Final = 6.0
"""Largest size of the logarithm of a latent's scale."""


class Training:
    """A `oodd_rivals.world_model.WorldModel` whose weights learn, and its loss over pieces."""

    def __init__(
        self, weights: dict[str, Tensor], base: Floats, unit: Floats, noise: float, sensors: int
    ) -> None:
        self.weights, self.noise, self.sensors = weights, noise, sensors
        self.base, self.unit = (torch.from_numpy(v.astype(np.float32)) for v in (base, unit))

    def loss(
        self,
        x: Tensor,
        y: Tensor,
        starts: Tensor,
        state: tuple[Tensor, Tensor],
        random: torch.Generator,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return negative evidence bounds a sensor, (T, B), and the last memory and latent.

        Parameters
        ----------
        x : (T, B, V + A)
            Rows and the actions that follow them.
        y : (T, B, V)
            The next rows.
        starts : (T, B)
            Whether an episode begins with the row of x.
        state
            Memory (B, H) and latent (B, V) before.
        random
            Of the latents that are drawn.
        """
        v, (memory, z) = self.sensors, state
        drawn = torch.randn(y.shape, generator=random)
        rows: list[tuple[Tensor, ...]] = []
        for t in range(len(x)):
            begins = starts[t][:, None]
            memory = memory.masked_fill(begins, 0.0)
            if starts[t].any():
                z = torch.where(begins, self._posterior(memory, x[t, :, :v], x[t, :, :v])[0], z)
            memory, prior = self._advance(memory, z, x[t, :, v:])
            posterior = self._posterior(memory, prior[0], y[t])
            z = posterior[0] + self.unit * posterior[1].exp() * drawn[t]
            rows.append((*prior, *posterior, memory, z))
        p_mean, p_log, q_mean, q_log, memories, latents = map(torch.stack, zip(*rows, strict=True))
        divergence = self._divergence(q_mean, q_log, p_mean, p_log)
        decoded = self._decoded(memories, latents)
        error = ((y - decoded) / (self.unit * self.noise)).square()
        return (divergence + 0.5 * error).mean(-1), (memory.detach(), z.detach())

    def _layer(self, x: Tensor, name: str) -> Tensor:
        return x @ self.weights[name][0] + self.weights[name + "_bias"][0]

    def _head(self, hidden: Tensor, name: str) -> tuple[Tensor, Tensor]:
        mean, scale = self._layer(silu(self._layer(hidden, name)), "out_" + name).chunk(2, -1)
        return mean, LOG_SCALE * torch.tanh(scale / LOG_SCALE)

    def _advance(
        self, memory: Tensor, z: Tensor, command: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        x = torch.cat([z.clamp(-LIMIT, LIMIT), command], 1)
        h = memory.shape[1]
        projected = self._layer(silu(self._layer(x, "first")), "gru_in")
        recurrent = self._layer(memory, "gru")
        gates = torch.sigmoid(projected[:, : 2 * h] + recurrent[:, : 2 * h])
        new = torch.tanh(projected[:, 2 * h :] + gates[:, :h] * recurrent[:, 2 * h :])
        memory = torch.lerp(new, memory, gates[:, h:])
        mean, log_scale = self._head(torch.cat([memory, x], 1), "prior")
        linear = z + x @ self.base[:-1] + self.base[-1]
        return memory, (linear + self.unit * mean, log_scale)

    def _posterior(self, memory: Tensor, prior: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        surprise = ((row - prior) / self.unit).clamp(-LIMIT, LIMIT)
        mean, log_scale = self._head(torch.cat([memory, row, surprise], 1), "posterior")
        return row + self.unit * mean, log_scale

    def _decoded(self, memory: Tensor, z: Tensor) -> Tensor:
        hidden = silu(self._layer(torch.cat([memory, z], -1), "decoder"))
        return z + self.unit * self._layer(hidden, "out_decoder")

    def _divergence(self, mean: Tensor, log: Tensor, other: Tensor, other_log: Tensor) -> Tensor:
        shift = (mean - other) / self.unit * torch.exp(-other_log)
        return 0.5 * (shift.square() + torch.expm1(2 * (log - other_log))) - (log - other_log)
