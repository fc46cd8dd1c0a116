"""Windows of recent observations as rows for other libraries, and functions applied row by row."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import windows

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale

Floats = NDArray[np.float64]
Function = Callable[[Floats], Floats]

BLOCK: Final = 256
"""Rows that a library is given at once: their number has to stay the same, see `row_by_row`."""


def flat_windows(rows: NDArray[np.float32], times: NDArray[np.int64], length: int) -> Floats:
    """Return the latest observations at the given times, newest first: rows of W * D numbers."""
    width = length * rows.shape[1]
    flat: Floats = windows(rows, times, length).reshape(len(times), width).astype(np.float64)
    return flat


def sample_windows(
    nominal: Sequence[Trajectory],
    scale: FeatureScale,
    *,
    length: int,
    ahead: int,
    limit: int,
    seed: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return windows (N, W * D) of standardized trajectories, and the rows (N, D) `ahead` of them.

    Of more than `limit` windows a random choice is taken, which the seed decides.
    """
    counts = np.array([max(len(x) - ahead, 0) for x in nominal])
    chosen = np.arange(counts.sum())
    if len(chosen) > limit:
        chosen = np.sort(np.random.default_rng(seed).choice(chosen, limit, replace=False))
    starts = np.cumsum(counts) - counts
    rows, later = [], []
    for x, start, count in zip(nominal, starts, counts, strict=True):
        times = chosen[(chosen >= start) & (chosen < start + count)] - start
        standardized = scale(x)
        width = length * standardized.shape[1]
        rows.append(windows(standardized, times, length).reshape(len(times), width))
        later.append(standardized[times + ahead])
    return np.concatenate(rows), np.concatenate(later)


def row_by_row(function: Function, rows: Floats, *, alone: bool) -> Floats:
    """Apply a function of many rows such that the value of a row depends on that row only.

    A library may sum in another order when it is given another number of rows. Blocks of one fixed
    size, the last one filled up with zeros, make the values of the first rows the same whatever
    follows them, to the last bit.

    With `alone` it is given one row at a time: for functions that compare the rows they are given.
    """
    size = 1 if alone else BLOCK
    values = []
    for start in range(0, len(rows), size):
        block = rows[start : start + size]
        filled = np.zeros((size, rows.shape[1]))
        filled[: len(block)] = block
        values.append(np.asarray(function(filled), dtype=np.float64)[: len(block)])
    return np.concatenate(values)


def compares_rows(function: Function, rows: Floats) -> bool:
    """Find out whether a function gives a row another value in other company.

    Some outlier detectors rank the rows of a call among each other, so that scores of a whole
    episode would know the future. Eight training rows are tried, as they are and three times as far
    out.
    """
    some = rows[np.linspace(0, len(rows) - 1, num=8).astype(int)]
    company = np.concatenate([some, 3.0 * some])
    together = np.asarray(function(company), dtype=np.float64)
    alone = np.concatenate([np.asarray(function(row[None]), np.float64) for row in company])
    scale = np.abs(together).max()
    return not np.allclose(together, alone, rtol=1e-6, atol=1e-9 * scale)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the global generators of random, numpy and a loaded torch; restore them afterwards.

    For classes that draw from there and take no seed.
    """
    torch = sys.modules.get("torch")
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002  what they draw from
    deep = torch.random.get_rng_state() if torch else None
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002  likewise
    if torch:
        torch.manual_seed(seed)
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002  likewise
        if torch:
            torch.random.set_rng_state(deep)
