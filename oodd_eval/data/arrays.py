"""Numbers that callers hand over, of any library, with NaN where an entry is missing or masked."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError

_NO_VALUE: Final = {"NAType", "NaTType", "MaskedConstant"}  # pandas.NA, pandas.NaT, numpy.ma.masked
_NOT_REAL: Final = {"c": "complex numbers", "M": "dates", "m": "durations", "V": "named fields"}
_EMPTY: Final[dict[str, Any]] = {
    **dict.fromkeys("fc", np.nan),
    **dict.fromkeys("OT"),
    "M": np.datetime64("NaT"),
    "m": np.timedelta64("NaT"),
}


def is_missing(cell: object) -> bool:
    """Tell whether a cell of a table stands for no value: None, NaN, or a library's own mark."""
    number = isinstance(cell, float | np.generic)
    return cell is None or type(cell).__name__ in _NO_VALUE or bool(number and cell != cell)  # noqa: PLR0124  NaN is not itself


def in_memory(values: Any) -> Any:
    """Return a lazy frame or lazy array computed, a tensor off its graph and device."""
    for method in ("collect", "compute"):
        if callable(getattr(values, method, None)):
            return getattr(values, method)()
    return values.detach().cpu() if hasattr(values, "detach") else values


def as_array(values: Any) -> NDArray[Any]:
    """Return values as an array whose missing entries are NaN, NaT, or None among objects.

    Fill values of masked arrays go nowhere.

    Parameters
    ----------
    values
        An array, a list of rows, a column or a data frame.

    Raises
    ------
    TrajectoryError
        When they are of another kind, or of unequal lengths.
    """
    try:
        if isinstance(values, list | tuple) and any(
            isinstance(row, list | tuple) or hasattr(row, "filled") or hasattr(row, "detach")
            for row in values
        ):
            return np.stack([as_array(row) for row in values])
        array: Any = np.asanyarray(in_memory(values))
        if not hasattr(array, "filled") or array.dtype.kind == "V" or not array.mask.any():
            return np.asarray(array)
        # Filled by hand: numpy takes None for its own fill value.
        data: NDArray[Any] = array.data.astype(
            np.float64 if array.dtype.kind in "iub" else array.dtype
        )
        data[array.mask] = _EMPTY.get(data.dtype.kind, "")
    except Exception as error:  # each library raises its own
        raise TrajectoryError(
            f"a {type(values).__name__} cannot be read as an array, expected numbers of shape "
            f"(rows, sensors): {error}"
        ) from error
    return data


def as_numbers(values: Any) -> NDArray[np.float64]:
    """Return numbers as float64, NaN where an entry is missing or masked.

    Parameters
    ----------
    values
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
    array = as_array(values)
    if kind := _NOT_REAL.get(array.dtype.kind):
        raise TrajectoryError(f"there are {kind} ({array.dtype}), expected real numbers")
    try:
        if array.dtype.kind == "O":
            cells = (np.nan if is_missing(cell) else float(cell) for cell in array.flat)
            return np.fromiter(cells, np.float64, array.size).reshape(array.shape)
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise TrajectoryError(f"there are values that are no real numbers: {error}") from None
