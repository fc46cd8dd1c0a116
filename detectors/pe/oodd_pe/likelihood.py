"""Log densities of residuals whose tails are not known beforehand."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from oodd_common.charts import Floats

TAILS: Final = (2.0, 4.0, 8.0, 16.0, 64.0)
"""Degrees of freedom that are tried."""
ROUNDS: Final = 30
"""Steps of the iteration that finds a scale."""


def student(residuals: Floats) -> Floats:
    """Return log densities of residuals (N, D) under the likeliest t distribution of each column.

    Its scale is found by expectation maximization (Lange, Little & Taylor 1989), its degrees of
    freedom among a few. Two numbers a column, so that thousands of rows are not fitted too closely.
    """
    squares = residuals**2
    best = np.full_like(squares, -np.inf)
    for nu in TAILS:
        scale = np.maximum(np.median(squares, axis=0), 1e-12)
        for _ in range(ROUNDS):
            scale = ((nu + 1) * squares / (nu + squares / scale)).mean(axis=0)
            scale = np.maximum(scale, 1e-12)
        constant = math.lgamma((nu + 1) / 2) - math.lgamma(nu / 2) - 0.5 * math.log(nu * math.pi)
        density = constant - 0.5 * np.log(scale) - (nu + 1) / 2 * np.log1p(squares / (nu * scale))
        better = density.mean(axis=0) > best.mean(axis=0)
        best[:, better] = density[:, better]
    return best
