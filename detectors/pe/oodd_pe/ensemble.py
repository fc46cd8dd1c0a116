"""The trained ensemble: forecasts of its networks, and the residuals of what was observed.

Forecasts are made in NumPy, whose calls take less time than those of torch: beside a robot every
row is a call of its own.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Self

import numpy as np
import torch
from oodd_common.charts import Floats

from oodd_eval.plugins.state import Arrays, take
from oodd_pe.network import LAYERS, LOG_SCALE, LOG_TAIL, DensityNetworks

BLOCK: Final = 32
"""Rows that are forecast together.

Larger arrays would leave the processor's cache, and each be new pages from the operating system.
"""


class _Forecast(NamedTuple):
    """Forecasts of M networks for N rows of D sensors: see `oodd_pe.network.Forecast`."""

    residual: Floats  # (M, D, N)
    scale: Floats  # (M, D, N)
    log_tail: Floats  # (M, D, N)
    dependence: Floats  # (M, D (D - 1) / 2, N)


class DensityEnsemble:
    """Trained networks, as arrays in double precision.

    Parameters
    ----------
    arrays
        What `oodd_pe.network.DensityNetworks.arrays` returns.
    """

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays
        weights = [*(arrays[f"weights.{n}"] for n in range(LAYERS)), arrays["out"]]
        biases = [*(arrays[f"biases.{n}"] for n in range(LAYERS)), arrays["out_bias"]]
        # Rows last: what is gathered by sensor is then contiguous.
        self._layers = [(w.mT, b.mT) for w, b in zip(weights, biases, strict=True)]
        self._floor = arrays["floor"].mT
        self._sensors = d = self._floor.shape[1]
        self._row, self._column = np.tril_indices(d, -1)
        self._rows = np.searchsorted(self._row, np.arange(1, d))
        self._by_column = np.argsort(self._column, kind="stable")
        self._columns = np.searchsorted(self._column[self._by_column], np.arange(d - 1))

    @classmethod
    def restored(cls, arrays: Arrays, like: DensityNetworks) -> Self:
        """Return the ensemble of `arrays`; `FittedStateError` for shapes unlike the networks'."""
        shapes = {name: tuple(p.shape) for name, p in like.state_dict().items()}
        return cls({name: take(arrays, name, shape) for name, shape in shapes.items()})

    def __call__(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return whitened residuals and log degrees of freedom, means over the members.

        From inputs (N, I) and outcomes of each member (M, N, D) to two arrays (N, D).
        """
        residual, log_tail = np.empty(y.shape[1:]), np.empty(y.shape[1:])
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            forecast = self._forecast(x[rows], y[:, rows])
            residual[rows] = (np.add.reduce(forecast.residual) / len(y)).T
            log_tail[rows] = (np.add.reduce(forecast.log_tail) / len(y)).T
        return residual, log_tail

    def each(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return what a call returns the means of, two arrays (M, N, D)."""
        residual, log_tail = np.empty_like(y), np.empty_like(y)
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            forecast = self._forecast(x[rows], y[:, rows])
            residual[:, rows] = forecast.residual.mT
            log_tail[:, rows] = forecast.log_tail.mT
        return residual, log_tail

    def log_densities(self, x: Floats, y: Floats) -> Floats:
        """Return the members' log densities of outcomes (M, N, D), given inputs (N, I): (M, N)."""
        densities = []
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            residual, scale, log_tail, _ = self._forecast(x[rows], y[..., rows, :])
            nu = torch.from_numpy(np.exp(log_tail))
            constant = (torch.lgamma((nu + 1) / 2) - torch.lgamma(nu / 2)).numpy()
            each = constant - 0.5 * (log_tail + math.log(math.pi)) + np.log(scale)
            each -= (np.exp(log_tail) + 1) / 2 * np.log1p(residual**2 / np.exp(log_tail))
            densities.append(each.sum(axis=1))
        return np.concatenate(densities, axis=1)

    def of_sensors(self, x: Floats, y: Floats) -> Floats:
        r"""Return what an error of one sensor alone would explain: (N, D).

        With the precision :math:`\Lambda = L^\top L`, L = s (I + U), of a member's errors y - mean,
        it is the square of :math:`(\Lambda (y - \mu))_d / \sqrt{\Lambda_{dd}}`: by how much their
        squared length would fall if the reading of sensor d were free. Means over the members.
        """
        explained = np.empty(y.shape[1:])
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            residual, scale, _, dependence = self._forecast(x[rows], y[:, rows])
            slope, squares = scale * residual, scale**2
            entries, row = dependence[:, self._by_column], self._row[self._by_column]
            below = np.add.reduceat(entries * slope[:, row], self._columns, axis=1)
            more = np.add.reduceat(entries**2 * squares[:, row], self._columns, axis=1)
            slope[:, :-1] += below
            squares[:, :-1] += more
            explained[rows] = (slope**2 / squares).mean(axis=0).T
        return explained

    def _forecast(self, x: Floats, y: Floats) -> _Forecast:
        """Judge outcomes (M, N, D) by inputs (N, I), as `DensityNetworks` does."""
        (weights, bias), *deeper, (out, out_bias) = self._layers
        hidden = _silu(weights @ x.T + bias)
        for weights, bias in deeper:
            hidden += _silu(weights @ hidden + bias)
        outputs, d = out @ hidden + out_bias, self._sensors
        scale = np.tanh(outputs[:, d : 2 * d] / LOG_SCALE)
        scale = np.exp(np.maximum(LOG_SCALE * scale, self._floor))
        tail, dependence = outputs[:, 2 * d : 3 * d], outputs[:, 3 * d :]
        residual = y.mT - outputs[:, :d]
        known = dependence * residual[:, self._column]
        residual[:, 1:] += np.add.reduceat(known, self._rows, axis=1)
        residual *= scale
        return _Forecast(residual, scale, LOG_TAIL * (1 + np.tanh(tail)), dependence)


def _silu(x: Floats) -> Floats:
    """Return x / (1 + exp(-x)), by a function that never overflows."""
    half: Floats = 0.5 * x
    activated = np.tanh(half)
    activated *= half
    activated += half
    return np.asarray(activated, np.float64)
