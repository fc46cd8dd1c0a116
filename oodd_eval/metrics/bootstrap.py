"""Bootstrap intervals over test trajectories and detector seeds, paired wherever these are shared.

One weight matrix says how often each test trajectory is drawn in each resample. All anomalies and
detectors of an environment use the same one, so that differences between them are paired. Sums are
taken in a fixed order, without a matrix library, so that an interval does not depend on what is
computed beside it.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import Contribution

RESAMPLES: Final = 2000
LEVEL: Final = 0.95

Weights = NDArray[np.float64]
Samples = NDArray[np.float64]
"""A number in every resample: shape (R,), NaN where it is undefined."""

CellPart = tuple[str, int, Contribution]
"""Environment, detector seed and metric of one cell."""


def bootstrap_weights(
    n: int, *, key: str = "", resamples: int = RESAMPLES, seed: int = 0
) -> Weights:
    """Return counts of each of n trajectories in each resample: shape (resamples, n).

    The same seed and key, such as an environment, give the same weights, and so the same intervals.
    """
    rng = np.random.default_rng([seed, zlib.crc32(key.encode()), n])
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples).astype(np.float64)


@functools.lru_cache(maxsize=64)
def shared_weights(environment: str, n: int) -> Weights:
    """Return the weights of an environment's n test trajectories, kept for the next cell."""
    weights = bootstrap_weights(n, key=environment)
    weights.setflags(write=False)
    return weights


def resampled(contribution: Contribution, weights: Weights) -> Samples:
    """Return a metric in every resample; NaN where its denominator is 0."""
    numerator = np.einsum("rn,n->r", weights, contribution.numerator)
    denominator = np.einsum("rn,n->r", weights, contribution.denominator)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominator > 0, numerator / denominator, np.nan)


def interval(
    contribution: Contribution, weights: Weights, *, level: float = LEVEL
) -> tuple[float, float]:
    """Return the percentile interval of a metric over the resamples in which it is defined.

    With few trajectories a percentile interval is too narrow; it is shown for what it is.
    """
    return percentiles(resampled(contribution, weights), level=level)


def percentiles(values: Samples, *, level: float = LEVEL) -> tuple[float, float]:
    """Return the central percentile interval of resampled values, NaN left out."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return float("nan"), float("nan")
    tail = 50 * (1 - level)
    low, high = np.percentile(defined, [tail, 100 - tail])
    return float(low), float(high)


def mean_value(contributions: Sequence[Contribution]) -> float:
    """Return the mean of a metric over the cells where it is defined."""
    values = np.array([c.value for c in contributions])
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else float("nan")


def cell_samples(environment: str, contribution: Contribution) -> Samples:
    """Return the resamples of one cell, with the weights that its environment shares."""
    return resampled(contribution, shared_weights(environment, len(contribution.numerator)))


def mean_samples(parts: Sequence[Samples]) -> Samples:
    """Return the mean of several numbers in every resample, over those that are defined there."""
    stacked = np.array(parts)
    total: Samples = stacked.sum(axis=0)
    if not np.isnan(total).any():
        return np.divide(total, len(stacked))
    defined = ~np.isnan(stacked)
    count = defined.sum(axis=0)
    total = np.where(defined, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_over_seeds(parts: Sequence[Samples], *, key: str = "") -> Samples:
    """Return the mean over detector seeds, which are drawn with replacement in every resample.

    The draws depend on nothing but the number of seeds and `key`, so that differences of two means
    over the same seeds are paired. An environment as key gives each environment its own draws.
    """
    stacked = np.array(parts)  # (seeds, R)
    rng = np.random.default_rng([zlib.crc32(key.encode()), len(stacked)] if key else 0)
    drawn = rng.integers(len(stacked), size=stacked.shape)
    mean: Samples = stacked[drawn, np.arange(stacked.shape[1])].mean(axis=0)
    return mean


def samples(cells: Sequence[CellPart]) -> Samples:
    """Return the resamples of a mean over at least one cell; a seed's mean is over its own cells.

    Test trajectories are resampled, the same ones in all cells of an environment, and detector
    seeds where there are several. Differences, sums and `mean_samples` of what this returns for
    several detectors or anomalies are paired.
    """
    by_seed: dict[int, list[Samples]] = {}
    for environment, seed, contribution in cells:
        by_seed.setdefault(seed, []).append(cell_samples(environment, contribution))
    return mean_over_seeds([mean_samples(by_seed[seed]) for seed in sorted(by_seed)])
