"""Lists of numbers: long ones, and covariances, become a few figures."""

import contextlib
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_logs.kinds import Kind

LONGEST: Final = 32
"""Numbers of a list that become columns, if every row has as many."""

FIGURES: Final = ("least", "mean", "count")
"""Figures of a long list, as names of columns end."""


def figures(name: str, rows: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the least and the mean of the finite numbers of each row, and how many there are.

    >>> figures("r", np.array([[1.0, np.inf, 3.0]]))
    {'r.least': array([1.]), 'r.mean': array([2.]), 'r.count': array([2.])}
    """
    owners = np.repeat(np.arange(len(rows)), rows.size // max(1, len(rows)))
    columns = ragged_figures(rows.ravel(), owners, len(rows))
    return {f"{name}.{figure}": column for figure, column in columns.items()}


def ragged_figures(
    numbers: NDArray[np.float64], owners: NDArray[np.intp], rows: int
) -> dict[str, NDArray[np.float64]]:
    """Return the figures of lists, one after the other; `owners` has the row of each number."""
    finite = np.isfinite(numbers)
    numbers, owners = numbers[finite], owners[finite]
    count = np.bincount(owners, minlength=rows).astype(np.float64)
    with np.errstate(all="ignore"):
        mean = np.bincount(owners, numbers, minlength=rows) / count
    least = np.full(rows, np.nan)
    np.fmin.at(least, owners, numbers)
    return dict(zip(FIGURES, (least, mean, count), strict=True))


def is_folded(name: str, size: int) -> bool:
    """Tell whether a list of numbers becomes figures, by its name and size."""
    return size > LONGEST or "covariance" in name.rpartition(".")[2].lower()


def _flatten(name: str, value: Any) -> Iterable[tuple[str, Any]] | None:
    is_list = isinstance(value, list | tuple | np.ndarray) and is_folded(name, np.size(value))
    if not is_list or (numbers := as_numbers(value)) is None:
        return None
    return [(label, float(x[0])) for label, x in figures(name, numbers[None]).items()]


def as_numbers(value: Any) -> NDArray[np.float64] | None:
    """Return nested lists as an array; None where they hold other things, or are ragged."""
    head = value
    while isinstance(head, list | tuple) and head:
        head = head[0]
    if isinstance(head, int | float | np.number | np.ndarray | None):
        with contextlib.suppress(ValueError):
            array = np.asarray(value)
            items = array.ravel().tolist() if array.dtype.kind == "O" else []
            if array.dtype.kind in "fiubO" and all(
                isinstance(x, int | float | None) for x in items
            ):
                return np.asarray(array, np.float64)
    return None


KIND: Final = Kind(
    "number-lists",
    "a long list, or one of changing length: the least, mean and number of its finite values stand "
    "in its place",
    flatten=_flatten,
)
