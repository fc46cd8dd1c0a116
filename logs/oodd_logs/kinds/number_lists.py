"""Lists of numbers: long ones, and covariances, become a few figures."""

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
    made = ragged_figures(rows.ravel(), owners, len(rows))
    return {f"{name}.{figure}": column for figure, column in made.items()}


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
    if not isinstance(value, list | tuple | np.ndarray) or not is_folded(name, np.size(value)):
        return None
    if (numbers := as_numbers(value)) is None:
        return None
    return [(label, float(x[0])) for label, x in figures(name, numbers[None]).items()]


def as_numbers(value: Any) -> NDArray[np.float64] | None:
    """Return nested lists as an array; None where they hold other things, or are ragged."""
    array = value
    if not isinstance(value, np.ndarray):
        head = value
        while isinstance(head, list | tuple) and head:
            head = head[0]
        if not (head is None or isinstance(head, int | float | np.number)):
            return None
        try:
            array = np.array(value)
        except ValueError:
            return None
    if array.dtype.kind not in "fiub":
        items = array.ravel().tolist() if array.dtype.kind == "O" else [""]
        if not all(x is None or isinstance(x, int | float) for x in items):
            return None
    return np.asarray(array, np.float64)


KIND: Final = Kind(
    "number-lists",
    "a long list, or one of changing length: the least, mean and number of its finite values stand "
    "in its place",
    flatten=_flatten,
)
