"""An ensemble of forecasting networks as one set of batched matrix products.

Letters in shape comments: E members, B trajectories, T steps, D sensors, N quantile levels,
H = 64 units, W window; K = E networks with P = D outputs each, or, with one network per sensor,
K = E D networks with P = 1 output.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

GRID: Final = 4096
"""Sampled quantile levels are the midpoints of this many equal parts of (0, 1).

Finer than any quantile that can be learned, and coarse enough for embeddings to be tabulated.
"""


@dataclass(frozen=True, slots=True)
class Architecture:
    """Shape of the ensemble's members.

    Attributes
    ----------
    features
        Sensors, D.
    window
        Observations in the input, W: 1 with memory.
    recurrent
        Whether a GRU stands between the first and the second layer.
    quantiles
        Whether the output is a quantile function rather than one value.
    per_feature
        Whether every sensor has a network of its own, rather than a head on a shared trunk.
    units, cosines
        Width of every layer, and of the cosine embedding.
    """

    features: int
    window: int = 1
    recurrent: bool = True
    quantiles: bool = True
    per_feature: bool = False
    units: int = 64
    cosines: int = 64

    @property
    def networks(self) -> int:
        """Networks of a member, K / E."""
        return self.features if self.per_feature else 1

    @property
    def outputs(self) -> int:
        """Sensors that one network predicts, P."""
        return 1 if self.per_feature else self.features


@dataclass(frozen=True, slots=True)
class GruCell:
    """A GRU's weights for many single steps: one product for both gates, two for the candidate.

    Everything else works in place. A rollout's step is bound by passes over arrays larger than the
    cache, and this way needs half of those of `Ensemble.gate`.
    """

    gates: Tensor  # (K, 2H, 2H): reset and update from input and memory
    gates_bias: Tensor
    new: Tensor  # (K, H, H): candidate from the input
    new_bias: Tensor
    old: Tensor  # (K, H, H): candidate from the memory
    old_bias: Tensor

    def __call__(self, f: Tensor, memory: Tensor) -> Tensor:
        """One step: (K, B, H) and (K, B, H) to the new memory (K, B, H)."""
        both = torch.cat([f, memory], 2)
        reset, update = torch.bmm(both, self.gates).add_(self.gates_bias).sigmoid_().chunk(2, 2)
        old = torch.bmm(memory, self.old).add_(self.old_bias)
        candidate = torch.bmm(f, self.new).add_(self.new_bias).addcmul_(reset, old).tanh_()
        return candidate.lerp_(memory, update)


class Ensemble(torch.nn.Module):
    """E networks of the paper's appendix B side by side.

    ``f = relu(x W1 + b1)``, ``g = GRU(f)``, ``z = relu(g W2 + b2) + f`` (the skip connection),
    ``phi(tau) = relu(cos(pi i tau) C + c)``, and for sensor d
    ``q_d(tau) = o_d + s_d [(z * phi(tau)) v_d + u_d]``: the output is the change from the newest
    observation in units of the training standard deviation ``s_d`` of that change, so that an
    untrained network predicts no change and all sensors weigh alike in the loss. Without memory
    ``g = f``; without quantiles ``phi = 1``.
    """

    unit: Tensor

    def __init__(
        self,
        architecture: Architecture,
        generators: list[torch.Generator],
        unit: NDArray[np.float32],
    ) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.register_buffer("unit", torch.from_numpy(unit))
        h, inputs = a.units, a.window * a.features
        self.members = len(generators)

        def weight(rows: int, columns: int, fan_in: int | None = None) -> torch.nn.Parameter:
            bound = 1 / math.sqrt(fan_in or rows)
            drawn = [
                torch.empty(a.networks, rows, columns).uniform_(-bound, bound, generator=g)
                for g in generators
            ]
            return torch.nn.Parameter(torch.cat(drawn))  # (K, rows, columns)

        def zeros(rows: int, columns: int) -> torch.nn.Parameter:
            return torch.nn.Parameter(torch.zeros(self.members * a.networks, rows, columns))

        self.first, self.first_bias = weight(inputs, h), weight(1, h, inputs)
        if a.recurrent:
            # Gates in the order reset, update, candidate.
            self.gru_in, self.gru_in_bias = weight(h, 3 * h), weight(1, 3 * h, h)
            self.gru, self.gru_bias = weight(h, 3 * h), weight(1, 3 * h, h)
        self.second, self.second_bias = weight(h, h), weight(1, h, h)
        if a.quantiles:
            self.cosine, self.cosine_bias = weight(a.cosines, h), weight(1, h, a.cosines)
        self.out, self.out_bias = zeros(h, a.outputs), zeros(1, a.outputs)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.first.device

    def start(self, rows: int) -> Tensor:
        """Return the memory before the first observation: zeros of shape (K, rows, H)."""
        return self.first.new_zeros(len(self.first), rows, self.architecture.units)

    def spread(self, x: Tensor) -> Tensor:
        """Give every network what its member sees: (E, ...) to (K, ...)."""
        return x.repeat_interleave(self.architecture.networks, 0) if self._split else x

    def gather(self, out: Tensor) -> Tensor:
        """Put the outputs of a member's networks together: (K, ..., P) to (E, ..., D)."""
        if not self._split:
            return out
        return out[..., 0].reshape(self.members, -1, *out.shape[1:-1]).movedim(1, -1)

    @property
    def _split(self) -> bool:
        return self.architecture.networks > 1

    def inputs(self, x: Tensor) -> Tensor:
        """First layer: (E, B, W * D) to (K, B, H)."""
        return torch.relu(torch.baddbmm(self.first_bias, self.spread(x), self.first))

    def cell(self) -> GruCell:
        """Return the GRU laid out for rollouts; without gradients."""
        h = self.architecture.units
        return GruCell(
            gates=torch.cat([self.gru_in[..., : 2 * h], self.gru[..., : 2 * h]], 1),
            gates_bias=(self.gru_in_bias + self.gru_bias)[..., : 2 * h],
            new=self.gru_in[..., 2 * h :].contiguous(),
            new_bias=self.gru_in_bias[..., 2 * h :],
            old=self.gru[..., 2 * h :].contiguous(),
            old_bias=self.gru_bias[..., 2 * h :],
        )

    def gate(self, projected: Tensor, memory: Tensor) -> Tensor:
        """One step of the GRU from the projected input (K, B, 3H)."""
        h = self.architecture.units
        recurrent = torch.baddbmm(self.gru_bias, memory, self.gru)  # (K, B, 3H)
        opened = torch.sigmoid(projected[..., : 2 * h] + recurrent[..., : 2 * h])
        reset, update = opened[..., :h], opened[..., h:]
        candidate = torch.tanh(
            torch.addcmul(projected[..., 2 * h :], reset, recurrent[..., 2 * h :])
        )
        return torch.lerp(candidate, memory, update)

    def run(self, f: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """GRU over time: (K, T, B, H) to memories (K, T, B, H) and the last one (K, B, H)."""
        k, t, b, h = f.shape
        projected = torch.baddbmm(self.gru_in_bias, f.reshape(k, t * b, h), self.gru_in)
        outputs = []
        for now in projected.reshape(k, t, b, 3 * h).unbind(1):
            memory = self.gate(now, memory)
            outputs.append(memory)
        return torch.stack(outputs, dim=1), memory

    def trunk(self, f: Tensor, g: Tensor) -> Tensor:
        """Second layer and skip connection: (K, B, H) and (K, B, H) to (K, B, H)."""
        return torch.relu(torch.baddbmm(self.second_bias, g, self.second)) + f

    def embedding(self, tau: Tensor) -> Tensor:
        """Cosine embedding of quantile levels: (K, N) to (K, N, H)."""
        i = torch.arange(self.architecture.cosines, dtype=tau.dtype, device=tau.device)
        cosines = torch.cos(math.pi * i * tau[..., None])  # (K, N, cosines)
        return torch.relu(torch.baddbmm(self.cosine_bias, cosines, self.cosine))

    def table(self) -> Tensor:
        """Embeddings of the whole grid of levels: (K, GRID, H)."""
        tau = (torch.arange(GRID, dtype=torch.float32, device=self.device) + 0.5) / GRID
        return self.embedding(tau.expand(len(self.first), -1))

    def heads_at(self, tau: Tensor) -> Tensor:
        """Output layers at levels (E, N) that all sensors share: (K, 1, H, N * P)."""
        phi = self.embedding(self.spread(tau))[:, None, :, None]  # (K, 1, N, 1, H)
        return self._fold(phi)

    def heads_from(self, index: Tensor, table: Tensor) -> Tensor:
        """Output layers at grid levels per time and sensor: (E, G, N, D) to (K, G, H, N * P)."""
        if self._split:
            index = index.movedim(-1, 1).flatten(0, 1)[..., None]  # (K, G, N, 1)
        k, g, n, p = index.shape
        flat = index.reshape(k, -1)
        phi = torch.stack([table[i][flat[i]] for i in range(k)])
        return self._fold(phi.reshape(k, g, n, p, -1))

    def _fold(self, phi: Tensor) -> Tensor:
        """Fold embeddings (K, G, N, P or 1, H) into the output layer.

        ``(z * phi) v_d`` is ``z (phi * v_d)``, so that the outputs of all trajectories at the
        levels of a time are one matrix product.
        """
        folded = phi * self.out.transpose(1, 2)[:, None, None]  # (K, G, N, P, H)
        return folded.flatten(2, 3).transpose(2, 3)
