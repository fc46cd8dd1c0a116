"""Intervals of means over the selections of cells that the site's filters can make.

The page computes means itself, from the values of single cells; an interval needs the bootstrap,
and so is computed here, for every selection there can be.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.metrics.bootstrap import bootstrap_weights, percentiles, resampled
from oodd_eval.results.record import Record
from oodd_eval.results.tables.board import contribution

Cell = tuple[str, str]
"""Environment and anomaly."""

_weights = functools.lru_cache(maxsize=32)(bootstrap_weights)


def selections(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """Return the selections of cells that filters can make, by key.

    A key is ``environments|anomalies``: for the one ``all``, a family or an environment, for the
    other ``all``, a group or an anomaly.

    Examples
    --------
    >>> sorted(selections([("hopper", "iid")]))[:3]
    ['all|all', 'all|iid', 'all|sensor']
    >>> len(selections([("hopper", "iid")]))
    9
    """
    environments: dict[str, set[str]] = {}
    anomalies: dict[str, set[str]] = {}
    for environment, anomaly in cells:
        for name in ("all", ENVIRONMENTS[environment].family, environment):
            environments.setdefault(name, set()).add(environment)
        for name in ("all", ANOMALIES[anomaly].group, anomaly):
            anomalies.setdefault(name, set()).add(anomaly)
    found = {
        f"{some}|{others}": [(e, a) for e, a in cells if e in environments[some] and a in named]
        for some in environments
        for others, named in anomalies.items()
    }
    return {key: chosen for key, chosen in found.items() if chosen}


def selection_intervals(
    records: Sequence[Record], metric: str, chosen: Mapping[str, Sequence[Cell]]
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of one row's mean over each selection of cells.

    Test trajectories are resampled, the same ones for all cells of an environment, and detector
    seeds where there are several: the intervals of `oodd_eval.results.tables.board.Board.mean`, with each
    cell resampled once.

    Parameters
    ----------
    records
        Of one row of a board.
    metric
        One that is a ratio of sums.
    chosen
        See `selections`.

    Returns
    -------
    By key; selections with a failed cell, or without an interval, are left out, and so are those
    of one record, which has its own.
    """
    draws: dict[tuple[int, str, str], NDArray[np.float64]] = {}
    for r in records:
        if metric in r.per_trajectory:
            c = contribution(r, metric)
            weights = _weights(len(c.numerator), key=r.environment)
            draws[r.seed, r.environment, r.anomaly] = resampled(c, weights)
    seeds = list(dict.fromkeys(seed for seed, _, _ in draws))
    failed = {(r.environment, r.anomaly) for r in records if not r.ok}
    found = {}
    for key, cells in chosen.items():
        by_seed = [
            _mean([draws[seed, *cell] for cell in cells if (seed, *cell) in draws])
            for seed in seeds
            if any((seed, *cell) in draws for cell in cells)
        ]
        one = len(seeds) == len(cells) == 1
        if by_seed and not one and not failed.intersection(cells):
            means = np.array(by_seed)
            drawn = np.random.default_rng(0).integers(len(means), size=means.shape)
            low, high = percentiles(np.take_along_axis(means, drawn, axis=0).mean(axis=0))
            if not math.isnan(low):
                found[key] = low, high
    return found


def _mean(resamples: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Mean over cells in every resample, over those where the metric is defined."""
    stacked = np.array(resamples)
    defined = ~np.isnan(stacked)
    count = defined.sum(axis=0)
    total = np.where(defined, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
