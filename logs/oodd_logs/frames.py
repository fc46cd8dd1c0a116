"""Episodes that are in memory: data frames of any library, arrays, lists of mappings.

Libraries are told apart by what their objects offer, so that none of them is needed here.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.arrays import as_array, as_numbers, in_memory, is_missing
from oodd_eval.errors import TrajectoryError
from oodd_logs.episodes import EpisodeSource, make_episodes
from oodd_logs.readers import library
from oodd_logs.recipe import Recipe
from oodd_logs.recorded import FILES, Recorded
from oodd_logs.recording import Column, Recording, Topic
from oodd_logs.selecting import with_sensors

_FORMS: Final = (
    "a data frame, an array of shape (rows, columns), a pair of arrays, a mapping of columns or a "
    "list of mappings"
)


def recordings_of(
    part: str, episodes: Iterable[Any], time: str = ""
) -> Iterator[tuple[str, Recording]]:
    """Yield a title and a recording for each episode of a part.

    Parameters
    ----------
    part
        What titles begin with.
    episodes
        Data frames, tables of arrow's, arrays, pairs of arrays of observations and actions,
        mappings of columns, lists of mappings. What is missing or masked is NaN, or empty text.
    time
        Column with stamps, which may be the index of a data frame.

    Raises
    ------
    TrajectoryError
        When an episode is none of these; the message names it and its column.
    """
    for i, episode in enumerate(_each(episodes)):
        title = f"{part}{i}"
        try:
            topic = Topic.of(_columns(episode, time))
        except TrajectoryError as error:
            raise TrajectoryError(f"{title}: {error}") from error
        yield title, Recording(title, title, {"": topic})


def scanned_frames(episodes: Sequence[Any], sensors: Sequence[Any]) -> EpisodeSource | None:
    """Return episodes as a scan of files has them; None where all are arrays without actions.

    Parameters
    ----------
    episodes
        As `recordings_of` takes them.
    sensors
        Names of the columns to judge, or quantities; all without any.
    """
    episodes = [*_each(episodes)]
    if all(_labels(e) is None and not _is_pair(e) for e in episodes):
        return None
    recorded = [
        Recorded(recording, Path(title), title, frozenset({FILES}))
        for title, recording in recordings_of("episode ", episodes)
    ]
    names = tuple(str(getattr(sensor, "name", sensor)) for sensor in sensors)
    recipe = with_sensors(Recipe("frames", "frames", sensors=names), recorded[0].recording)
    return make_episodes(recipe, recorded, every=True)


def _each(episodes: Iterable[Any]) -> Iterator[Any]:
    """Return episodes in memory; `TrajectoryError` for a single table in place of several."""
    if not isinstance(episodes, list) and _labels(episodes) is not None:
        kind = type(episodes).__name__
        raise TrajectoryError(f"the episodes are one {kind}, expected a list with one each")
    return map(_eager, episodes)


def _eager(episode: Any) -> Any:
    """Return an episode in memory, and as a table where all that it offers is a stream of one."""
    episode = in_memory(episode)
    offers = [hasattr(episode, a) for a in ("columns", "__array__", "__arrow_c_stream__")]
    if offers != [False, False, True]:
        return episode
    arrow = library("pyarrow")
    try:
        return arrow.table(episode)
    except Exception as error:
        raise TrajectoryError(f"a {type(episode).__name__} is no table: {error}") from error


def _is_pair(episode: Any) -> bool:
    return isinstance(episode, tuple) and len(episode) == 2


def _labels(episode: Any) -> list[Any] | None:
    """Return the names of the columns of an episode; None where they have none."""
    if isinstance(episode, list) and episode and all(isinstance(r, Mapping) for r in episode):
        return [*dict.fromkeys(label for row in episode for label in row)]
    labels = episode if isinstance(episode, Mapping) else getattr(episode, "column_names", None)
    if labels is None:  # arrow has arrays as columns
        fields = getattr(getattr(episode, "dtype", None), "names", None)
        labels = getattr(episode, "columns", fields)
    return None if labels is None else [*labels]


def _columns(episode: Any, time: str) -> dict[str, Column]:
    labels = _labels(episode)
    if labels is not None:
        counts = Counter(map(str, labels))
        if double := [repr(name) for name, count in counts.items() if count > 1]:
            advice = "expected unlike names: rename or drop them"
            raise TrajectoryError(f"there are several columns {', '.join(double)}, {advice}")
        if any(isinstance(label, tuple) for label in labels):
            raise TrajectoryError(
                f"names of columns have several levels, such as {labels[0]!r}, expected one: "
                "frame.columns = ['.'.join(map(str, names)) for names in frame.columns]"
            )
        is_rows = isinstance(episode, list)
        table = {n: [row.get(n) for row in episode] for n in labels} if is_rows else episode
        columns = {str(label): _column(table[label], label) for label in labels}
        index: Any = getattr(episode, "index", None)
        if time and time not in columns and time in getattr(index, "names", ()):
            columns[time] = _column(index.get_level_values(time), time)
        return columns
    if not _is_pair(episode):
        return _matrix(episode, "obs:sensor")
    sensors, actions = _matrix(episode[0], "obs:sensor"), _matrix(episode[1], "action:action")
    rows, commands = (len(next(iter(part.values()), ())) for part in (sensors, actions))
    if commands not in {rows, rows - 1}:
        expected = f"expected {rows} or {rows - 1} actions"
        raise TrajectoryError(f"it has {rows} observations and {commands} actions, {expected}")
    # What the last action led to was not recorded.
    return sensors | {name: np.append(a[: rows - 1], np.nan) for name, a in actions.items()}


def _matrix(values: Any, name: str) -> dict[str, Column]:
    array = as_numbers(values)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise TrajectoryError(f"it is an array of shape {array.shape}, expected {_FORMS}")
    return {f"{name} {i}": array[:, i] for i in range(array.shape[1])}


def _column(values: Any, label: object) -> Column:
    """Return numbers, or texts; dates as ISO 8601, durations in seconds; NaN and "" are missing."""
    if hasattr(getattr(values, "type", None), "index_type"):
        values = values.to_pylist()  # arrow's arrays have the last word where one is missing
    elif hasattr(values, "to_numpy") and not hasattr(values, "__array__"):
        values = values.to_numpy()
    elif isinstance(values, list) and any(isinstance(cell, str) for cell in values):
        values = np.fromiter(values, object, len(values))  # in which NaN is no text
    subject = f"column {label!r}: "
    array = as_array(values, subject)
    if array.ndim == 1 and array.dtype.kind == "M":
        return np.where(np.isnat(array), "", np.datetime_as_string(array.astype("M8[ns]")))
    if array.ndim == 1 and array.dtype.kind in "OSTU":
        cells = [_cell(cell) for cell in array.tolist()]
        if any(isinstance(cell, str) for cell in cells):
            return np.array(["" if cell is None else str(cell) for cell in cells])
        array = np.fromiter(cells, object, len(cells))
    elif array.dtype.kind == "m":
        array = array / np.timedelta64(1, "s")
    numbers = as_numbers(array, subject)
    if numbers.ndim != 1:
        shape = numbers.shape[1:]
        raise TrajectoryError(f"column {label!r} has cells of shape {shape}, expected one number")
    return numbers


def _cell(cell: Any) -> Any:
    """Return a cell as a number, a text or None."""
    if is_missing(cell):
        return None
    if isinstance(cell, bytes):
        return cell.decode(errors="replace")
    if hasattr(cell, "total_seconds"):
        return cell.total_seconds()
    return cell.isoformat() if hasattr(cell, "isoformat") else cell
