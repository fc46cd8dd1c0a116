"""Episodes that are in memory: data frames of any library, arrays, lists of mappings."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError
from oodd_logs.recording import Column, Recording, Topic


def recordings_of(
    part: str, episodes: Sequence[Any], time: str = ""
) -> Iterator[tuple[str, Recording]]:
    """Yield a title and a recording for each episode of a part.

    Parameters
    ----------
    part
        Name of the part.
    episodes
        Data frames, arrays, pairs of arrays of observations and actions, lists of mappings.
    time
        Column with stamps, which may be the index of a data frame.
    """
    for i, episode in enumerate(episodes):
        title = f"{part}-{i}"
        columns = _columns(episode, title, time)
        yield title, Recording(title, title, {"": Topic.of(columns)})


def _columns(episode: Any, title: str, time: str) -> dict[str, Column]:
    if hasattr(episode, "columns") and hasattr(episode, "__getitem__"):
        names = [*episode.columns]
        columns = {str(name): _column(episode[name].to_numpy(), title, name) for name in names}
        index: Any = getattr(episode, "index", None)
        if time and time not in columns and getattr(index, "name", None) == time:
            columns[time] = _column(index.to_numpy(), title, time)
        return columns
    if isinstance(episode, tuple) and len(episode) == 2:
        observations, actions = (np.asarray(array) for array in episode)
        sensors = _matrix(observations, title, "obs:sensor")
        rows = len(observations)
        actions = actions[:, None] if actions.ndim == 1 else actions
        if len(actions) not in {rows, rows - 1}:
            raise TrajectoryError(
                f"{title} has {rows} observations and {len(actions)} actions, expected {rows} or "
                f"{rows - 1} actions"
            )
        # What the last action led to was not recorded.
        ends = np.full((1, actions.shape[1]), np.nan)
        return sensors | _matrix(np.vstack([actions[: rows - 1], ends]), title, "action:action")
    if isinstance(episode, list) and episode and all(isinstance(r, Mapping) for r in episode):
        names = list(dict.fromkeys(name for row in episode for name in row))
        return {n: _column(np.array([r.get(n) for r in episode], object), title, n) for n in names}
    return _matrix(np.asarray(episode), title, "obs:sensor")


def _matrix(array: NDArray[Any], title: str, name: str) -> dict[str, Column]:
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or array.dtype.kind not in "fiub":
        raise TrajectoryError(
            f"{title} is an array of shape {array.shape} and dtype {array.dtype}, expected numbers "
            "of shape (rows, columns), a data frame, a pair of arrays or a list of mappings"
        )
    numbers = array.astype(np.float64)
    return {f"{name} {i}": numbers[:, i] for i in range(array.shape[1])}


def _column(values: NDArray[Any], title: str, name: Any) -> Column:
    """Return numbers, or texts; dates as ISO 8601, missing values as NaN or empty texts."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float64)
    if values.dtype.kind == "M":
        return np.where(np.isnat(values), "", np.datetime_as_string(values.astype("M8[ns]")))
    if values.dtype.kind == "U":
        return values
    cells = [_cell(cell) for cell in values.tolist()]
    if not any(isinstance(cell, str) for cell in cells):
        try:
            return np.array([np.nan if cell is None else cell for cell in cells], np.float64)
        except (TypeError, ValueError):
            raise TrajectoryError(
                f"{title}, column {name!r} holds {type(cells[0]).__name__} objects, expected "
                "numbers, texts or dates"
            ) from None
    return np.array(["" if cell is None else str(cell) for cell in cells])


def _cell(cell: Any) -> Any:
    """Return a cell as a number, text or None."""
    if cell is None or cell != cell:  # noqa: PLR0124  NaN, NaT and the like are not themselves
        return None
    return cell.isoformat() if hasattr(cell, "isoformat") else cell
