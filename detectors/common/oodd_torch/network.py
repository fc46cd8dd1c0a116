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

from oodd_torch.gru import GruCell, Sequence

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


class Ensemble(torch.nn.Module):
    """E networks of the paper's appendix B side by side.

    ``f = relu(x W1 + b1)``, ``g = GRU(f)``, ``z = relu(g W2 + b2) + f`` (the skip connection),
    ``phi(tau) = relu(cos(pi i tau) C + c)``, and for sensor d
    ``q_d(tau) = l_d + s_d [(z * phi(tau)) v_d + u_d]``: the output is a correction of the linear
    forecast ``l = x A + a``, `linear`, in units of the deviation ``s_d`` that this forecast has in
    training, so that an untrained network is a linear regression and all sensors weigh alike in
    the loss. Without memory ``g = f``; without quantiles ``phi = 1``.

    Parameters
    ----------
    architecture, generators
        Shape of the members, and a generator for the weights of each.
    base : (W * D + 1, D)
        A, and a in the last row.
    unit : (D,)
        s.
    """

    base: Tensor
    unit: Tensor

    def __init__(
        self,
        architecture: Architecture,
        generators: list[torch.Generator],
        base: NDArray[np.float32],
        unit: NDArray[np.float32],
    ) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.register_buffer("base", torch.from_numpy(base))
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

    def hidden(self) -> list[Tensor]:
        """Weights between hidden layers, which are those for `Muon`."""
        a = self.architecture
        return [
            self.second,
            *([self.gru_in, self.gru] if a.recurrent else []),
            *([self.cosine] if a.quantiles else []),
        ]

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

    def linear(self, x: Tensor) -> Tensor:
        """Linear forecast of the next observation: (..., W * D) to (..., D)."""
        return x @ self.base[:-1] + self.base[-1]

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

    def run(self, f: Tensor, memory: Tensor, kept: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """GRU over time: (K, T, B, H) to memories (K, T, B, H) and the last one (K, B, H).

        The memory is multiplied with `kept`, (K, T, B, 1), before each step. No gradient flows
        into it.
        """
        k, t, b, h = f.shape
        projected = torch.baddbmm(self.gru_in_bias, f.reshape(k, t * b, h), self.gru_in)
        projected = projected.reshape(k, t, b, 3 * h)
        memories: Tensor = Sequence.apply(  # type: ignore[no-untyped-call]
            projected, memory, self.gru, self.gru_bias, kept
        )
        return memories, memories[:, -1].detach()

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
        first = table.shape[1] * torch.arange(k, device=index.device)[:, None, None, None]
        phi = table.flatten(0, 1).index_select(0, (first + index).flatten())
        return self._fold(phi.reshape(k, g, n, p, -1))

    def _fold(self, phi: Tensor) -> Tensor:
        """Fold embeddings (K, G, N, P or 1, H) into the output layer.

        ``(z * phi) v_d`` is ``z (phi * v_d)``, so that the outputs of all trajectories at the
        levels of a time are one matrix product.
        """
        folded = phi * self.out.transpose(1, 2)[:, None, None]  # (K, G, N, P, H)
        return folded.flatten(2, 3).transpose(2, 3)
