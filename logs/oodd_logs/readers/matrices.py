"""Episodes as arrays with a row a step: what formats that name arrays have in common."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.data.facts import Quantity
from oodd_eval.errors import TrajectoryError
from oodd_logs.kinds import images, number_lists
from oodd_logs.ledger import Ledger
from oodd_logs.readers.cells import check_width, column_names, role_of
from oodd_logs.recording import Column, Topic

_KINDS: Final = "fiub"
_LONGEST_FIELD: Final = 1000  # items

_Index = tuple[int, ...] | str  # of a number in a row, or the figure of all of them


class MatrixRows(Protocol):
    """MatrixRows that are read when asked for: an array, or a dataset in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of rows, and of columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Kind of the numbers."""

    def __getitem__(self, rows: Any, /) -> NDArray[Any]:
        """Return a range of rows."""


def episode_of(
    arrays: Mapping[str, MatrixRows],
    source: str,
    sensors: Sequence[Quantity] = (),
    actions: Sequence[Quantity] = (),
) -> tuple[Topic, dict[str, Any], Ledger]:
    """Return the rows of an episode, what holds for all of it, and what became of arrays.

    Observations, actions and rewards are known by their usual names, ``obs/NAME`` among them; other
    arrays of their length are columns under their names. Actions and rewards are those of
    transitions: they lack the last row, and where they have it, what it led to was not recorded, so
    that it counts as missing. What is no array of that length is a field. Images are left out, and
    other long matrices in each row become figures.

    Parameters
    ----------
    arrays
        Arrays of numbers by name.
    source
        What messages call the episode.
    sensors, actions
        Names and units of the columns of observations and actions, where they are known.

    Raises
    ------
    TrajectoryError
        When there are no rows, or lengths differ.
    """
    kinds = {name: role_of(name.partition("/")[0]) for name in arrays}
    kinds |= {name: "" for name, kind in kinds.items() if kind == "reward" and "/" in name}
    observed = {len_of(arrays[n]) for n, kind in kinds.items() if kind == "obs"}
    if len(observed) > 1:
        raise TrajectoryError(f"{source}: observations have {sorted(observed)} rows")
    # Without observations it is a table: its length is the most frequent one, the longest of these.
    lengths = [len_of(a) for a in arrays.values() if a.dtype.kind in _KINDS and len_of(a) > 1]
    rows = max(observed or lengths, key=lambda n: (lengths.count(n), n), default=0)
    if not rows:
        listed = ", ".join(arrays) or "nothing"
        expected = "arrays with a row a step, such as observations"
        raise TrajectoryError(f"{source} holds {listed}, expected {expected}")
    parts: dict[str, tuple[str, _Index]] = {}
    fields: dict[str, Any] = {}
    ledger = Ledger()
    for name, array in arrays.items():
        kind, length = kinds[name], len_of(array)
        fits = length in {rows, rows - 1} and len(array.shape) > 0
        if not fits and kind:
            raise TrajectoryError(
                f"{source}: {name} has shape {array.shape}, expected {rows} or {rows - 1} rows"
            )
        if fits and array.dtype.kind in _KINDS:
            quantities = {"obs": sensors, "action": actions}.get(kind, ())
            places = _places(name, array, ledger)
            check_width(source, len(parts) + len(places))
            for index in places:
                parts[_label(name, kind, index, array, quantities)] = name, index
        elif len(array.shape) < 2 and length <= _LONGEST_FIELD:
            values = np.asarray(array[()])
            fields[name] = values.item() if values.size == 1 else values.tolist()
        else:
            shape = f"no numbers in {rows} rows: shape {array.shape}, {array.dtype}"
            ledger.add("column", "dropped", shape, name=name)
    labels = dict(zip(column_names(parts), parts.values(), strict=True))

    def read(selected: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        blocks: dict[str, Any] = {}
        for name in {labels[label][0] for label in selected}:
            array = arrays[name]
            size = array.dtype.itemsize * math.prod(array.shape[1:]) * (stop - start)
            EPISODE.check(f"{source}, {name}", array.dtype, size)
            blocks[name] = np.asarray(array[start:stop], np.float64)
        columns = {}
        for label in selected:
            name, index = labels[label]
            if isinstance(index, str):
                column = number_lists.figures("", blocks[name])[f".{index}"]
            else:
                column = blocks[name][:, *index]
            if stop == rows and kinds[name] in {"action", "reward"}:
                column = column[: rows - 1 - start]
            columns[label] = np.append(column, np.full(stop - start - len(column), np.nan))
        return columns

    return Topic(tuple(labels), rows, read), fields, ledger


def _places(name: str, array: MatrixRows, ledger: Ledger) -> Sequence[_Index]:
    """Return the columns of an array: places in a row, figures, or none of an image."""
    size = math.prod(array.shape[1:])
    if len(array.shape) < 3 or size <= number_lists.LONGEST:
        return [*np.ndindex(*array.shape[1:])]
    if array.dtype.itemsize == 1 or size > images.PIXELS:
        ledger.add("column", "dropped", images.KIND.words, name=name)
        return ()
    ledger.add("column", "changed", number_lists.KIND.words, name=name)
    return number_lists.FIGURES


def _label(
    name: str, kind: str, index: _Index, array: MatrixRows, quantities: Sequence[Quantity]
) -> str:
    """Return the name of a column; observations and actions have those of quantities, if any."""
    if kind == "reward":
        return kind
    steps = (index,) if isinstance(index, str) else index
    inner = (name.partition("/")[2] if kind else name).replace("/", ".")
    if not inner and len(quantities) == math.prod(array.shape[1:]) and len(steps) < 2:
        quantity = quantities[int(steps[0]) if steps else 0]
        label = quantity.name + ("" if quantity.unit == "1" else f"[{quantity.unit}]")
    elif inner:
        label = ".".join((inner, *map(str, steps)))
    else:
        label = f"{'sensor' if kind == 'obs' else kind} {'.'.join(map(str, steps or (0,)))}"
    return f"{kind}:{label}" if kind else label


def len_of(array: MatrixRows) -> int:
    """Return the number of rows; 0 for a single value."""
    return array.shape[0] if array.shape else 0


def whole_number(source: str, name: str, value: Any) -> int | None:
    """Return a number that a file gives as an array or scalar, if it does; one value, no text."""
    if value is None:
        return None
    array = np.asarray(value)
    if array.size == 1 and array.dtype.kind in "iuf" and float(array.item()).is_integer():
        number = int(array.item())
        if abs(number) < 2**63:
            return number
    raise TrajectoryError(f"{source}: {name} is {value!r:.80}, expected one whole number")
