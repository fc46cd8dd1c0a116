"""Figures of whole episodes: least, largest, mean and spread of each sensor.

A row can show what is there and odd, but not what is missing: a torque peak, a grasp, a charge.
So figures of each episode are compared with those of the others.
"""

from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_logs.scanning.outliers import LEAST

Floats = NDArray[np.float64]

KINDS: Final = ("least", "largest", "mean", "spread")
_FLOOR: Final = 0.02  # least deviation, of the usual range of a sensor in an episode
_CONSTANT: Final = 0.25  # that of a sensor that is constant in most, of its range in all
_LOG: Final = 0.05  # least deviation of a log spread
_TINY: Final = 1e-12
_BEYOND: Final = 1e30  # what stands for infinity
_MOST: Final = 0.1  # share of episodes at either end that a range leaves out


class Figure(NamedTuple):
    """The figure of an episode that is farthest from those of the others.

    Attributes
    ----------
    distance
        In usual deviations, the median of those of the others.
    sensor
        Its number.
    row
        Row of an extreme that others do not have; None for what is missing, a mean or a spread.
    figure, value
        What it is of a sensor, and how it differs: the two halves of a clause.
    """

    distance: float
    sensor: int
    row: int | None
    figure: str
    value: str


def compare_figures(episodes: Sequence[Floats], groups: Sequence[Hashable]) -> list[Figure]:
    """Compare figures of episodes within groups.

    Parameters
    ----------
    episodes
        Rows, (R, D), NaN where there is no reading.
    groups
        Of each; those of fewer than 8 episodes are compared with all.

    Returns
    -------
    list of Figure
        One an episode.
    """
    figures = np.stack([_figures(rows) for rows in episodes])
    oddest: dict[int, Figure] = {}
    for group in {*groups}:
        inside = np.array([other == group for other in groups])
        peers = figures[inside] if inside.sum() >= LEAST else figures
        deviations, larger = _compared(figures[inside], peers)
        ends = np.nanquantile(peers, [_MOST, 1 - _MOST], axis=0, method="nearest")
        for i, away, above in zip(np.flatnonzero(inside).tolist(), deviations, larger, strict=True):
            k, d = (int(x) for x in np.unravel_index(away.argmax(), away.shape))
            row = None
            if k < 2 and above[k, d] == bool(k):
                rows = episodes[i][:, d]
                row = int(np.nanargmax(rows) if k else np.nanargmin(rows))
            low, high = ends[:, k, d]
            reason = f"is {figures[i, k, d]:.3g}, of most others {low:.3g} to {high:.3g}"
            oddest[i] = Figure(float(away[k, d]), d, row, f"{KINDS[k]} of", reason)
    return [oddest[i] for i in range(len(episodes))]


def _figures(rows: Floats) -> Floats:
    """Return least, largest, mean and spread of each sensor, (4, D); NaN without a reading."""
    good = ~np.isnan(rows)
    values = np.where(good, np.clip(rows, -_BEYOND, _BEYOND), 0.0)
    n = np.maximum(good.sum(axis=0), 1)
    mean = values.sum(axis=0) / n
    spread = np.sqrt((np.where(good, values - mean, 0.0) ** 2).sum(axis=0) / n)
    least, largest = (np.where(good, values, end) for end in (np.inf, -np.inf))
    figures = np.stack([least.min(axis=0), largest.max(axis=0), mean, spread])
    return np.where(good.any(axis=0), figures, np.nan)


def _compared(figures: Floats, peers: Floats) -> tuple[Floats, Floats]:
    """Return deviations of figures from those of peers, and which are larger than usual."""
    # Nothing is said of how far a sensor goes that stands still in most episodes.
    ranges = np.nan_to_num(np.nanmedian(peers[:, 1] - peers[:, 0], axis=0))
    whole = np.nanmax(peers[:, 1], axis=0) - np.nanmin(peers[:, 0], axis=0)
    moves = ranges > 0
    floor = np.where(moves, _FLOOR * ranges, np.maximum(_CONSTANT * whole, _TINY))
    least = np.stack([floor, floor, floor, np.where(moves, _LOG, _CONSTANT)])
    parts = [np.concatenate([x[:, :3], np.log(x[:, 3:] + floor)], axis=1) for x in (figures, peers)]
    centre = np.nanmedian(parts[1], axis=0)
    usual = np.nanmedian(np.abs(parts[1] - centre), axis=0)
    deviation = np.maximum(np.nan_to_num(usual), least)
    away = np.nan_to_num(parts[0] - centre)
    return np.abs(away) / deviation, away > 0
