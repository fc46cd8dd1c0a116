"""Forecasts of a trained ensemble at any horizon, all times of all trajectories as one batch.

Up to the last true observation one pass of the GRU serves all samples. From there on every time t
has rollouts of its own: M sampled ones, or one that is fed the mean of M samples at each step.

Letters: E members, C times of a chunk, B trajectories, M samples, D sensors, H units.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodd_eval.prediction import quantile_levels
from oodd_torch.network import Ensemble
from oodd_torch.training import arrange, predict

ROWS = 16_384
"""Rollouts of one member that are computed together: bounds memory."""


@torch.no_grad()
def forecast_errors(
    network: Ensemble,
    rows: Sequence[NDArray[np.float32]],
    *,
    horizon: int,
    samples: int,
    mean_sampling: bool,
    seed: int,
) -> list[NDArray[np.float64]]:
    """Return mean absolute errors of the forecasts of every ``o_t``, ``t >= horizon``.

    Parameters
    ----------
    rows : list of float32 arrays of shape (T + 1, D)
        Standardized observations.
    horizon, samples, mean_sampling, seed
        h, M, how rollouts go on, and the seed of the quantile levels.

    Returns
    -------
    list of float64 arrays of shape (max(T + 1 - h, 0),)
    """
    longest = max(len(r) for r in rows)
    counts = [max(0, len(r) - horizon) for r in rows]
    if longest <= horizon:
        return [np.zeros(0) for _ in rows]
    x, _, _ = arrange([[r if len(r) > 1 else np.repeat(r, 2, axis=0) for r in rows]],
                      network.architecture.window)  # fmt: skip
    truth = np.zeros((longest, len(rows), network.architecture.features), np.float32)
    for b, r in enumerate(rows):
        truth[: len(r), b] = r
    target = torch.from_numpy(truth)
    x = x.expand(network.members, -1, -1, -1)  # (E, T, B, W * D)
    table = network.table() if network.architecture.quantiles else None
    memory = network.start(len(rows))
    width = 1 if mean_sampling or horizon == 1 else samples
    chunk = max(1, ROWS // (len(rows) * width * (1 if horizon > 1 else 4)))
    parts = []
    for start in range(0, longest - horizon, chunk):
        stop = min(start + chunk, longest - horizon)
        times = range(start + horizon, stop + horizon)
        levels = _levels(network, seed, times, horizon, samples)
        if horizon == 1:
            heads = None
            if levels is not None and table is not None:
                heads = network.heads_from(levels[0], table)
            change, memory = predict(network, x[:, start:stop], memory, heads)
            newest = x[:, start:stop, :, None, : network.architecture.features]
            predicted = newest + network.unit * change
        else:
            predicted, memory = rollouts(
                network, x[:, start:stop], memory, levels, table,
                horizon=horizon, width=width if levels is not None else 1,
            )  # fmt: skip
        error = (target[start + horizon : stop + horizon, :, None] - predicted).abs()
        parts.append(error.mean((0, 3, 4), dtype=torch.float64))
    errors = torch.cat(parts).numpy()  # (T + 1 - h, B)
    return [errors[:count, b].copy() for b, count in enumerate(counts)]


def _levels(
    network: Ensemble, seed: int, times: range, horizon: int, samples: int
) -> Tensor | None:
    """Levels of shape (h, E, C, M, D), or None without quantiles."""
    if not network.architecture.quantiles:
        return None
    drawn = quantile_levels(
        seed, times, horizon, network.members, samples, network.architecture.features
    )
    return torch.from_numpy(drawn.transpose(1, 2, 0, 3, 4).copy())


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
    memory : (E, B, H)
        Memory before the chunk.
    levels : (h, E, C, M, D)
        Grid indices of the levels of every step; None without quantiles.
    table : (E, GRID, H)
        Embeddings of the grid.
    horizon, width
        h, and the number of rollouts R of every time: M, each fed its own samples, or 1, fed the
        mean of M samples.

    Returns
    -------
    samples : (E, C, B, M, D)
    memory : (E, B, H)
        Memory after the chunk.
    """
    a = network.architecture
    e, c, b, _ = x.shape
    d, h = a.features, a.units
    f = network.inputs(x.reshape(e, c * b, -1)).reshape(e, c, b, h)
    state = f
    if a.recurrent:
        state, memory = network.run(f, memory)

    def spread(tensor: Tensor) -> Tensor:
        return tensor[:, :, None].expand(-1, -1, width, -1, -1).reshape(e, c * width * b, -1)

    window, f, state = spread(x), spread(f), spread(state)  # (E, C * R * B, ...)
    samples = _sample(network, window, f, state, levels, 0, table, (c, width, b))
    for k in range(1, horizon):
        fed = samples if width > 1 else samples.mean(3, keepdim=True)  # (E, C, B, R, D)
        newest = fed.transpose(2, 3).reshape(e, c * width * b, d)
        window = torch.cat([newest, window[..., :-d]], dim=2)
        f = network.inputs(window)
        state = network.step(f, state) if a.recurrent else f
        samples = _sample(network, window, f, state, levels, k, table, (c, width, b))
    return samples, memory


def _sample(
    network: Ensemble,
    window: Tensor,
    f: Tensor,
    state: Tensor,
    levels: Tensor | None,
    step: int,
    table: Tensor | None,
    shape: tuple[int, int, int],
) -> Tensor:
    """Draw the next observation of every rollout: (E, C, B, M, D) from states (E, C * R * B, H)."""
    c, width, b = shape
    e, d = network.members, network.architecture.features
    z = network.trunk(f, state)
    if levels is None or table is None:
        change = torch.bmm(z, network.out).reshape(e, c, width, b, d).transpose(2, 3)
    else:
        # R = M: every rollout has the level of its own sample; R = 1: M levels in one product.
        heads = network.heads_from(levels[step].reshape(e, c * width, -1, d), table)
        change = torch.matmul(z.reshape(e, c * width, b, -1), heads)  # (E, C * R, B, M / R * D)
        change = change.reshape(e, c, width, b, -1, d).transpose(2, 3).flatten(3, 4)
    newest = window[..., :d].reshape(e, c, width, b, d).transpose(2, 3)
    return newest + network.unit * (change + network.out_bias[:, None, None])
