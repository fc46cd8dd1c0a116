"""Forecasts of a trained ensemble at any horizon, all times of all trajectories as one batch.

Up to the last true observation one pass of the GRU serves all samples. From there on every time t
has rollouts of its own: M sampled ones, or one that is fed the mean of M samples at each step.

Letters: E members, K networks, C times of a chunk, B trajectories, M samples, D sensors, H units,
R rollouts of a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.windows import windows
from torch import Tensor

from oodd_torch.network import GRID, Ensemble
from oodd_torch.training import corrections, hidden

ROWS = 256
"""Forecasts of one network that are computed together at horizon 1.

Each group is scored in a new process. There, arrays that fit the processor's cache are quickest.
"""

ROLLOUTS = 1024
"""The same at larger horizons, where arrays that fit the processor's cache are quicker."""

KEPT = 2**27
"""Bytes of output layers that are kept at horizon 1.

The levels of a time are the same in every episode, and so are the output layers at them. What is
made before the first episode is shared by all processes that score.
"""

LONGEST = 1000
"""Times beyond the benchmark's longest episode are not kept."""


def arrange(rows: Sequence[NDArray[np.float32]], window: int) -> Tensor:
    """Lay out B trajectories, time first: windows (T + 1, B, W * D), zeros after an end."""
    x = np.zeros((max(len(r) for r in rows), len(rows), window * rows[0].shape[1]), np.float32)
    for b, r in enumerate(rows):
        x[: len(r), b] = windows(r, np.arange(len(r)), window).reshape(len(r), -1)
    return torch.from_numpy(x)


class Forecaster:
    """Forecasts at horizon h by M samples, with or without mean sampling; the seed keys levels.

    With `scale`, (D,), the distance is that of a point forecast, in these units. Episodes of up to
    `longest` transitions, by default `LONGEST`, are forecast quickest.
    """

    @torch.no_grad()
    def __init__(
        self,
        network: Ensemble,
        *,
        horizon: int,
        samples: int,
        mean_sampling: bool,
        seed: int,
        scale: NDArray[np.float32] | None = None,
        longest: int | None = None,
    ) -> None:
        self.network, self.horizon, self.samples, self.seed = network, horizon, samples, seed
        self.scale = None if scale is None else torch.from_numpy(scale).to(network.device)
        # Embeddings of the quantile levels depend on nothing else.
        self.table = network.table() if network.architecture.quantiles else None
        alone = mean_sampling or horizon == 1 or self.table is None
        self.width = 1 if alone else samples
        """Rollouts of every time, R."""
        self.kept = self._kept(longest) if horizon == 1 and self.table is not None else None

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself, which copies of a detector share: nothing of it ever changes."""
        return self

    @torch.no_grad()
    def errors(self, rows: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float64]]:
        """Return `distance` of every ``o_t``, ``t >= horizon``, averaged over sensors.

        From standardized observations of shape (T + 1, D) to errors of shape (max(T + 1 - h, 0),).
        """
        return [e.mean(1) for e in self.distances(rows)]

    @torch.no_grad()
    def distances(self, rows: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float64]]:
        """Return the same of every sensor: shape (max(T + 1 - h, 0), D)."""
        network, horizon = self.network, self.horizon
        longest = max(len(r) for r in rows)
        counts = [max(0, len(r) - horizon) for r in rows]
        if longest <= horizon:
            return [np.zeros((0, rows[0].shape[1])) for _ in rows]
        x = arrange(rows, network.architecture.window).to(network.device)
        target = x[..., : network.architecture.features]
        x = x.expand(network.members, -1, -1, -1)  # (E, T + 1, B, W * D)
        memory = network.start(len(rows))
        together = ROWS if horizon == 1 else ROLLOUTS // self.width
        chunk = max(1, together // len(rows))
        parts = []
        for start in range(0, longest - horizon, chunk):
            stop = min(start + chunk, longest - horizon)
            times = range(start + horizon, stop + horizon)
            predicted, memory = self.forecast(x[:, start:stop], memory, times)
            parts.append(self.distance(predicted, target[start + horizon : stop + horizon]))
        errors = torch.cat(parts).cpu().numpy()  # (T + 1 - h, B, D)
        return [errors[:count, b].copy() for b, count in enumerate(counts)]

    def distance(self, samples: Tensor, truth: Tensor) -> Tensor:
        """Return the distance between what came, (C, B, D), and its samples (E, C, B, M, D).

        The mean absolute distance to the samples of all members, or, where there is a scale, the
        absolute distance to their median divided by the scale: (C, B, D) in double precision.
        """
        if self.scale is None:
            far = (truth[:, :, None] - samples).abs_().double()
            return far.sum(0).sum(2) / (len(samples) * samples.shape[3])
        middle = samples.movedim(0, -1).transpose(2, 3).flatten(3).median(-1).values
        return ((truth - middle).abs() / self.scale).double()

    @torch.no_grad()
    def forecast(self, x: Tensor, memory: Tensor, times: range) -> tuple[Tensor, Tensor]:
        """Forecast the observations of C times, which key the levels, from those h steps before.

        From inputs (E, C, B, W * D) and the memory before them, (K, B, H), to samples
        (E, C, B, M, D) and the memory after them.
        """
        network = self.network
        if self.horizon > 1:
            levels = self._levels(times)
            return rollouts(
                network, x, memory, levels, self.table, horizon=self.horizon, width=self.width
            )
        z, memory = hidden(network, x, memory)
        if self.kept is not None and times.stop <= 1 + len(self.kept):
            heads = self.kept[times.start - 1 : times.stop - 1]
            outputs = torch.matmul(z.transpose(0, 1), heads).transpose(0, 1).contiguous()
            outputs = outputs.reshape(*outputs.shape[:3], -1, network.architecture.outputs)
            change = network.gather(outputs + network.out_bias[:, None, None])
        else:
            change = corrections(network, z, self._heads(times))
        return network.linear(x)[..., None, :] + network.unit * change, memory

    def _heads(self, times: range) -> Tensor | None:
        """Output layers at the levels of C times, (K, C, H, N * P); None without quantiles."""
        levels = self._levels(times)
        if levels is None or self.table is None:
            return None
        return self.network.heads_from(levels[0], self.table)

    def _kept(self, longest: int | None) -> Tensor:
        """Output layers of the first times, as many as `KEPT` holds: (C, K, H, N * P)."""
        a, k = self.network.architecture, len(self.network.first)
        width = self.samples * a.outputs
        count = min(longest or LONGEST, KEPT // (4 * k * width * a.units))
        # As `heads_from` lays them out: other layouts round otherwise.
        kept = torch.empty(count, k, width, a.units, device=self.network.device).transpose(2, 3)
        for start in range(0, count, 32):
            part = kept[start : start + 32]
            heads = self._heads(range(1 + start, 1 + start + len(part)))
            if heads is not None:
                part.copy_(heads.transpose(0, 1))
        return kept

    def _levels(self, times: range) -> Tensor | None:
        """Levels of shape (h, E, C, M, D), or None without quantiles."""
        if self.table is None:
            return None
        members, features = self.network.members, self.network.architecture.features
        drawn = quantile_levels(self.seed, times, self.horizon, members, self.samples, features)
        return torch.from_numpy(drawn.transpose(1, 2, 0, 3, 4).copy()).to(self.network.device)


def rollouts(
    network: Ensemble,
    x: Tensor,
    memory: Tensor,
    levels: Tensor | None,
    table: Tensor | None,
    *,
    horizon: int,
    width: int,
) -> tuple[Tensor, Tensor]:
    """Roll out from every time of a chunk.

    Parameters
    ----------
    x : (E, C, B, W * D)
        Inputs at the last true observations.
    memory : (K, B, H)
        Memory before the chunk.
    levels : (h, E, C, M, D)
        Grid indices of the levels of every step; None without quantiles.
    table : (K, GRID, H)
        Embeddings of the grid.
    horizon, width
        h, and the number of rollouts R of every time: M, each fed its own samples, or 1, fed the
        mean of M samples.

    Returns
    -------
    samples : (E, C, B, M, D)
    memory : (K, B, H)
        Memory after the chunk.
    """
    a = network.architecture
    e, c, b, _ = x.shape
    d = a.features

    def sample(window: Tensor, f: Tensor, state: Tensor, step: int) -> Tensor:
        """Draw the next observation of every rollout, (E, C, B, M, D)."""
        z = network.trunk(f, state)
        k, p = len(z), a.outputs
        if levels is None or table is None:
            change = torch.bmm(z, network.out).reshape(k, c, width, b, p).transpose(2, 3)
        else:
            # R = M: a rollout has the level of its own sample; R = 1: M levels in one product.
            heads = network.heads_from(levels[step].reshape(e, c * width, -1, d), table)
            change = torch.matmul(z.reshape(k, c * width, b, -1), heads)  # (K, C R, B, M / R P)
            change = change.reshape(k, c, width, b, -1, p).transpose(2, 3).flatten(3, 4)
        change = network.gather(change + network.out_bias[:, None, None])
        linear = network.linear(window).reshape(-1, c, width, b, d).transpose(2, 3)
        return linear + network.unit * change  # (E, C, B, R or M, D)

    def repeat(tensor: Tensor) -> Tensor:
        return tensor[:, :, None].expand(-1, -1, width, -1, -1).flatten(1, 3)

    f = network.inputs(x.reshape(e, c * b, -1)).reshape(-1, c, b, a.units)  # (K, C, B, H)
    state = f
    if a.recurrent:
        state, memory = network.run(f, memory)
    window, f, state = repeat(x), repeat(f), repeat(state)  # (E or K, C * R * B, ...)
    samples = sample(window, f, state, 0)
    cell = network.cell() if a.recurrent and horizon > 1 else None
    for step in range(1, horizon):
        fed = samples if width > 1 else samples.mean(3, keepdim=True)  # (E, C, B, R, D)
        newest = fed.transpose(2, 3).reshape(e, c * width * b, d)
        window = torch.cat([newest, window[..., :-d]], dim=2)
        f = network.inputs(window)
        state = f if cell is None else cell(f, state)
        samples = sample(window, f, state, step)
    return samples, memory


def quantile_levels(
    seed: int, times: range, steps: int, members: int, samples: int, features: int
) -> NDArray[np.int64]:
    """Draw quantile levels keyed by seed and time, as indices into the grid of midpoints.

    The levels for time t depend on nothing but the seed and t, so that scores do not depend on
    what is scored before, beside or after.

    Parameters
    ----------
    seed
        Seed of the detector.
    times
        Times t whose observation is predicted.
    steps
        Prediction horizon h: levels for every step of the rollout that ends at t.
    members, samples, features
        Ensemble members E, samples M, sensors D.

    Returns
    -------
    int64 array of shape (len(times), steps, E, M, D)
        Level ``(k + 0.5) / GRID`` for index k.
    """
    shape = (steps, members, samples, features)
    drawn = [np.random.default_rng([seed, t]).integers(GRID, size=shape) for t in times]
    return np.array(drawn, dtype=np.int64).reshape(len(times), *shape)
