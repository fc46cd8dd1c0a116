"""Curves as the page keeps them: what is shared stands there once, and examples are on a grid.

What is drawn from them is the same to the pixel; the page is much smaller.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from oodd_eval.metrics.cusum import THRESHOLD

LEVELS: Final = 250
"""Least number of steps between zero and the largest value of a drawing, about one a pixel."""

HEAVY: Final = 30
"""A largest value this many times the typical one asks for a logarithmic scale."""

Json = dict[str, Any]
Series = Sequence[float | None]


def packed(curves: Mapping[str, Json]) -> Json:
    """Return the curves of a row's cells in fewer characters.

    Parameters
    ----------
    curves
        ``seed``, ``roc``, ``delay_far`` and ``example`` of cells, by ``environment/anomaly``, laid
        out as in `oodd_eval.results.curve_file`.

    Returns
    -------
    dict
        ``lists``: every list of ``roc`` and ``delay_far``, once. ``cells``: the same as `curves`,
        but with places in ``lists`` for these lists; examples are those of `gridded`, and their
        twins lack the first ``same_scores`` and ``same_cusum`` values, which are no others.

    Examples
    --------
    >>> example = {"scores": [0.5, None], "twin": [1.0], "cusum": [0.0], "twin_cusum": [0.02]}
    >>> one = {"roc": {"fpr": [0, 1], "tpr": [0, 1]}, "delay_far": {}, "example": example}
    >>> packed({"hopper/iid": one})["lists"]
    [[0, 1]]
    """
    places: dict[tuple[float, ...], int] = {}

    def place(numbers: Sequence[float]) -> int:
        return places.setdefault(tuple(numbers), len(places))

    cells = {
        name: cell
        | {
            part: {key: place(numbers) for key, numbers in cell[part].items()}
            for part in ("roc", "delay_far")
        }
        | {"example": _without_same(gridded(cell["example"]))}
        for name, cell in curves.items()
    }
    return {"lists": [list(numbers) for numbers in places], "cells": cells}


def gridded(example: Json) -> Json:
    """Return an example whose scores and statistics are whole numbers of steps.

    Returns
    -------
    dict
        The example, and ``score_step`` and ``cusum_step``. A step of None says that the numbers are
        as they were, because a few are so large that they need a logarithmic scale.

    Examples
    --------
    >>> example = {"scores": [0.5, None], "twin": [1.0], "cusum": [0.0], "twin_cusum": [0.02]}
    >>> found = gridded(example)
    >>> found["score_step"], found["scores"], found["twin"]
    (0.002, [250, None], [500])
    """
    found = dict(example)
    for step_name, unit, names in (
        ("score_step", 1.0, ("scores", "twin")),
        ("cusum_step", THRESHOLD, ("cusum", "twin_cusum")),
    ):
        step = _step((v for name in names for v in example[name] if v is not None), unit)
        found[step_name] = step
        if step is not None:
            for name in names:
                found[name] = [None if v is None else round(v / step) for v in example[name]]
    return found


def _without_same(example: Json) -> Json:
    """Leave out the beginnings of the twin's series: up to the onset both are the same."""
    found = dict(example)
    for name, twin in (("scores", "twin"), ("cusum", "twin_cusum")):
        pairs = zip(example[name], example[twin], strict=False)
        same = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))
        found[f"same_{name}"] = same
        found[twin] = example[twin][same:]
    return found


def _step(numbers: Iterable[float], unit: float) -> float | None:
    """Return a round step for numbers that are drawn together; None where they are too uneven."""
    sizes = [abs(v) for v in numbers]
    largest = max([unit, *sizes])
    typical = max(unit, statistics.median(sizes) if sizes else unit)
    if largest > HEAVY * typical:
        return None
    power = math.floor(math.log10(largest / LEVELS))
    # Not 10**-4 but the float that is printed as 0.0001.
    steps = [float(f"{digit}e{power}") for digit in (1, 2, 5)]
    return max(s for s in steps if s <= largest / LEVELS * (1 + 1e-9))
