"""Isotonic regression: shares that must rise with the strength of an anomaly."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def isotonic(found: Floats, total: Floats) -> Floats:
    """Return the non-decreasing shares that are nearest to `found` / `total`, weighted by `total`.

    Least squares; the min-max formula of isotonic regression (Barlow et al. 1972), for many columns
    at once. Shapes are (K, ...), by rung; no total may be 0. At rung k it is the largest, over the
    rungs i up to k, of the smallest pooled share of i to j, over the rungs j from k on. That is
    what pooling adjacent violators gives.

    >>> isotonic(np.array([1.0, 3.0, 1.0, 4.0]), np.array([4.0, 4.0, 4.0, 4.0])).tolist()
    [0.25, 0.5, 0.5, 1.0]
    """
    shares = np.full_like(found, -np.inf)
    for i in range(len(shares)):
        pooled = found[i:].cumsum(axis=0) / total[i:].cumsum(axis=0)
        smallest = np.minimum.accumulate(pooled[::-1], axis=0)[::-1]
        np.maximum(shares[i:], smallest, out=shares[i:])
    return shares
