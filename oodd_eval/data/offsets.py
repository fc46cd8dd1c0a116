"""Offsets of sensors whose spread float32 cannot tell: northings, encoder counts, epochs.

Trajectories are float32. From such a sensor the training mean is subtracted before, in float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEPS: Final = 1 << 14
"""Steps of float32, at a sensor's largest value, below which its spread is not told well enough."""

_LOST: Final = 1 << 8  # steps below which rounding, by half of one, takes what changes tell
_STILL: Final = 2.0**-33  # share of the largest value that solvers and their like move by


@dataclass(slots=True)
class RunningMoments:
    """Range, mean and spread of numbers that come in blocks, of each column where there are some.

    Parameters
    ----------
    count
        Number of rows.
    low, high
        Range; plus and minus infinity without a row.
    pivot, total, squares
        First row, and the sums of what is above it and of its square.
    """

    count: int = 0
    low: Any = np.inf
    high: Any = -np.inf
    pivot: Any = 0.0
    total: Any = 0.0
    squares: Any = 0.0

    def add(self, rows: Floats) -> None:
        """Take the next rows, of shape (rows,) or (rows, columns)."""
        if not len(rows):
            return
        if not self.count:
            self.pivot = rows[0]
        self.count += len(rows)
        self.low = np.minimum(self.low, rows.min(axis=0))
        self.high = np.maximum(self.high, rows.max(axis=0))
        with np.errstate(all="ignore"):
            above = rows - self.pivot
            self.total = self.total + above.sum(axis=0)
            self.squares = self.squares + (above**2).sum(axis=0)

    @property
    def mean(self) -> Any:
        """Mean; NaN without a row."""
        return self.pivot + self.total / self.count if self.count else np.nan

    @property
    def spread(self) -> Any:
        """Standard deviation; NaN without a row."""
        if not self.count:
            return np.nan
        with np.errstate(all="ignore"):
            variance = self.squares / self.count - (self.total / self.count) ** 2
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def largest(self) -> Any:
        """The largest value regardless of its sign."""
        return np.maximum(np.abs(self.low), np.abs(self.high))


def is_coarse(spread: Any, largest: Any, least: int = STEPS) -> Any:
    """Tell which spreads have fewer steps of float32 than they need, given the largest values."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.spacing(np.float32(largest)).astype(np.float64)
    return (spread > 0) & (spread < least * steps)


def coarse_sensors(observations: Floats) -> str:
    """Return in a sentence which sensors of an episode lose their changes in float32, if any do.

    >>> print(coarse_sensors(5_412_345.0 + 0.02 * np.eye(2, 1)).partition(":")[0])
    float32 rounds off what sensor 0 tells, 5.41235e+06 +- 0.01
    """
    with np.errstate(all="ignore"):  # what is not finite is refused elsewhere
        spread, largest = observations.std(axis=0), np.abs(observations).max(axis=0)
        is_rounded = (observations.astype(np.float32) != observations).any(axis=0)
        is_lost = is_coarse(spread, largest, _LOST) & (spread > _STILL * largest) & is_rounded
    for d in np.flatnonzero(is_lost)[:1]:
        text = f"float32 rounds off what sensor {d} tells, {largest[d]:g} +- {spread[d]:.1g}: "
        return f"{text}hand float64 arrays to Watchdog.fit or scan_episodes, or subtract a mean"
    return ""


def fit_offsets(train: Sequence[Floats]) -> tuple[float, ...]:
    """Return what is to be subtracted from each sensor; empty where nothing has to be.

    Parameters
    ----------
    train : sequence of float64 arrays of shape (rows, D)
        Observations of training episodes, all finite.

    Returns
    -------
    tuple of float
        The mean of a sensor whose standard deviation is less than 2^14 steps of float32, else 0.

    Examples
    --------
    >>> rows = np.array([[5.4e6, 1.0], [5.4e6 + 2, 2.0]])
    >>> fit_offsets([rows]), fit_offsets([rows[:, 1:]])
    ((5400001.0, 0.0), ())
    """
    moments = RunningMoments()
    for rows in train:
        moments.add(rows)
    offsets = np.where(is_coarse(moments.spread, moments.largest), moments.mean, 0.0)
    return tuple(offsets.tolist()) if offsets.any() else ()
