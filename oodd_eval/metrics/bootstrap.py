"""Bootstrap intervals over test seeds, paired over everything that shares them.

One weight matrix says how often each test trajectory is drawn in each resample. All anomalies and
detectors of an environment use the same matrix, so that differences between them are paired;
environments have independent ones. The sums are taken in a fixed order, without a matrix library,
so that an interval does not depend on what is computed beside it.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import Contribution

RESAMPLES: Final = 2000
LEVEL: Final = 0.95

Weights = NDArray[np.float64]


def bootstrap_weights(
    n: int, *, key: str = "", resamples: int = RESAMPLES, seed: int = 0
) -> Weights:
    """Return counts of each of n trajectories in each resample: shape (resamples, n).

    Parameters
    ----------
    n
        Number of test trajectories.
    key
        What has weights of its own: the environment.
    resamples
        Number of resamples R.
    seed
        The same seed gives the same weights, and so the same intervals.

    Examples
    --------
    >>> bootstrap_weights(5, resamples=3).sum(axis=1).tolist()
    [5.0, 5.0, 5.0]
    """
    rng = np.random.default_rng([seed, zlib.crc32(key.encode()), n])
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples).astype(np.float64)


def resampled(contribution: Contribution, weights: Weights) -> NDArray[np.float64]:
    """Return the metric in every resample, of shape (R,); NaN where its denominator is 0."""
    numerator = np.einsum("rn,n->r", weights, contribution.numerator)
    denominator = np.einsum("rn,n->r", weights, contribution.denominator)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominator > 0, numerator / denominator, np.nan)


def interval(
    contribution: Contribution, weights: Weights, *, level: float = LEVEL
) -> tuple[float, float]:
    """Percentile interval of a metric; NaN where it is undefined in every resample.

    Resamples in which the metric is undefined (no trajectory with an alarm, say) are left out.
    With few trajectories a percentile interval is too narrow; it is shown for what it is.
    """
    return percentiles(resampled(contribution, weights), level=level)


def percentiles(values: NDArray[np.float64], *, level: float = LEVEL) -> tuple[float, float]:
    """Return the central percentile interval of resampled values, NaN left out."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return float("nan"), float("nan")
    tail = 50 * (1 - level)
    low, high = np.percentile(defined, [tail, 100 - tail])
    return float(low), float(high)


def mean_value(contributions: Sequence[Contribution]) -> float:
    """Mean over cells of the metric, over the cells where it is defined."""
    values = np.array([c.value for c in contributions])
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else float("nan")


def resampled_mean(
    contributions: Sequence[Contribution], weights: Sequence[Weights]
) -> NDArray[np.float64]:
    """Resamples of a mean over cells; `weights` holds each cell's matrix."""
    stacked = np.array([resampled(c, w) for c, w in zip(contributions, weights, strict=True)])
    defined = ~np.isnan(stacked)
    count = defined.sum(axis=0)
    total = np.where(defined, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_interval(
    contributions: Sequence[Contribution], weights: Sequence[Weights], *, level: float = LEVEL
) -> tuple[float, float]:
    """Interval of a mean over cells: over anomalies of one environment, or over environments.

    Cells of one environment are given the same weight matrix and so stay dependent, as they are.
    """
    if not contributions:
        return float("nan"), float("nan")
    return percentiles(resampled_mean(contributions, weights), level=level)


def difference_interval(
    first: Sequence[Contribution],
    second: Sequence[Contribution],
    weights: Sequence[Weights],
    *,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Paired interval of the difference of two means over the same cells."""
    difference = resampled_mean(first, weights) - resampled_mean(second, weights)
    return percentiles(difference, level=level)
