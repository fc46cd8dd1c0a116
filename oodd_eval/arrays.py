"""Numbers that callers hand over, of any library, with NaN where an entry is missing or masked."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError

_MISSING: Final = {"NoneType", "NAType", "NaTType", "MaskedConstant"}  # of pandas and numpy.ma, too
_EMPTY: Final = {"M": "NaT", "m": "NaT", "O": None, "U": "", "S": b"", "T": ""}
_NOT_REAL: Final = {"c": "complex numbers", "M": "dates", "m": "durations", "V": "named fields"}


def is_missing(cell: object) -> bool:
    """Tell whether a cell of a table stands for no value: None, NaN, or a library's own mark."""
    number = isinstance(cell, float | np.generic)
    return type(cell).__name__ in _MISSING or bool(number and cell != cell)  # noqa: PLR0124  NaN


def in_memory(values: Any) -> Any:
    """Return what is lazy or on a device as it is in memory."""
    for method in ("collect", "compute", "detach", "cpu"):
        values = getattr(values, method)() if callable(getattr(values, method, None)) else values
    return values


def as_array(values: Any, subject: str = "") -> NDArray[Any]:
    """Return values as an array whose missing entries are NaN, NaT, empty, or None among objects.

    Parameters
    ----------
    values
        An array, a list of rows, a column or a data frame. Of masked entries nothing goes on.
    subject
        What messages begin with.

    Raises
    ------
    TrajectoryError
        When they are of another kind, or of unequal lengths.
    """
    try:
        is_list = isinstance(values, list | tuple)
        if is_list and any(hasattr(r, "filled") or hasattr(r, "detach") for r in values):
            return np.stack([as_array(row) for row in values])
        array: Any = np.asanyarray(in_memory(values))
        if not hasattr(array, "filled") or array.dtype.kind == "V" or not array.mask.any():
            return np.asarray(array)
        # Filled by hand: numpy takes None for its own fill value.
        data: NDArray[Any] = array.astype(float if array.dtype.kind in "iub" else array.dtype).data
        data[array.mask] = _EMPTY.get(data.dtype.kind, np.nan)
    except Exception as error:  # each library raises its own
        kind = type(values).__name__
        raise TrajectoryError(f"{subject}a {kind} is no array of rows: {error}") from error
    return data


def as_numbers(values: Any, subject: str = "") -> NDArray[np.float64]:
    """Return numbers as float64, NaN where an entry is missing or masked.

    Parameters
    ----------
    values, subject
        As for `as_array`.

    Raises
    ------
    TrajectoryError
        When something among them is no real number.

    Examples
    --------
    >>> as_numbers(np.ma.masked_values([1.0, 9999.0], 9999.0)), as_numbers([1, None])
    (array([ 1., nan]), array([ 1., nan]))
    """
    array = as_array(values, subject)
    if kind := _NOT_REAL.get(array.dtype.kind):
        raise TrajectoryError(f"{subject}{kind} ({array.dtype}), expected real numbers")
    try:
        if array.dtype.kind != "O":
            return array.astype(np.float64, copy=False)
        cells = (np.nan if is_missing(cell) else float(cell) for cell in array.flat)
        return np.fromiter(cells, np.float64, array.size).reshape(array.shape)
    except (TypeError, ValueError) as error:
        raise TrajectoryError(f"{subject}some are no real numbers: {error}") from None
