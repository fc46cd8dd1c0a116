"""Episodes in HDF5 files: a group an episode, or the datasets of the file itself."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.data.facts import Quantity
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import TRANSPOSE, Options, Reader, in_order, is_transposed, readable
from oodd_logs.readers.matrices import MatrixRows, episode_of, whole_number
from oodd_logs.recording import Recording

_DEEPEST: Final = 6  # levels of groups
_LONGEST: Final = 1000  # characters of a text among the fields; simulators keep their model there
_LEFT_OUT: Final = ("next_obs", "next_observations", "infos")


def read_groups(
    path: Path,
    *,
    sensors: Sequence[Quantity] = (),
    actions: Sequence[Quantity] = (),
    further: Mapping[str, Any] | None = None,
    transposed: bool = False,
) -> Iterator[Recording]:
    """Yield the episodes of a file, in the order of their names.

    Parameters
    ----------
    path
        The file.
    sensors, actions
        Names and units of the columns of observations and actions, where they are known.
    further
        Fields of every episode.
    transposed
        Whether rows and columns of matrices are exchanged.
    """
    file = StoredFile(path, EPISODE)  # the recordings hold it: their rows are read later
    groups = _episodes(file, "/", 0)
    if not groups:
        raise TrajectoryError(f"{path} holds no dataset with rows")
    for group in groups:
        source = str(path) if group == "/" else f"{path}, group {group.strip('/')}"
        fields = _fields(file, group, source)
        skipped: dict[str, str] = {}
        arrays: dict[str, MatrixRows] = dict(_arrays(file, group, "", 0, skipped))
        for flag in ("terminations", "truncations"):
            # Above the last row it ends one of several episodes, which a recipe may tell apart.
            if flag in arrays and not np.any(arrays[flag][:-1]):
                name = "terminated" if flag == "terminations" else "truncated"
                fields[name] = bool(np.any(arrays.pop(flag)[-1:]))
        for label in [n for n, rows in arrays.items() if transposed and len(rows.shape) == 2]:
            rows = arrays[label]
            size = rows.dtype.itemsize * math.prod(rows.shape)
            EPISODE.check(f"{source}, {label}", rows.dtype, size)
            arrays[label] = rows[:].T
        topic, single, ledger = episode_of(arrays, source, sensors, actions)
        for name, reason in skipped.items():
            ledger.add("column", "dropped", reason, name=name)
        name = path.stem if group == "/" else group.rpartition("/")[2]
        yield Recording(name, source, {"": topic}, {**single, **fields, **(further or {})}, ledger)


def _episodes(file: StoredFile, group: str, depth: int) -> list[str]:
    """Return the groups that are episodes: the outermost ones with a dataset of several rows."""
    members = file.members(group)
    if any(rows is not None and rows.shape and rows.shape[0] > 1 for rows in members.values()):
        return [group]
    if depth == _DEEPEST:
        return []
    names = sorted((name for name, rows in members.items() if rows is None), key=in_order)
    return [e for n in names for e in _episodes(file, f"{group.rstrip('/')}/{n}", depth + 1)]


def _arrays(
    file: StoredFile, group: str, prefix: str, depth: int, skipped: dict[str, str]
) -> Iterator[tuple[str, MatrixRows]]:
    """Yield the arrays below a group by their names relative to the episode; note others."""
    for name, rows in file.members(group).items():
        if name in _LEFT_OUT:
            skipped[f"{prefix}{name}"] = "it repeats others, or is no measurement"
        elif rows is not None and rows.dtype.hasobject:
            skipped[f"{prefix}{name}"] = "texts in an array"
        elif rows is not None:
            yield f"{prefix}{name}", rows
        elif depth < _DEEPEST:
            inner = f"{group.rstrip('/')}/{name}"
            yield from _arrays(file, inner, f"{prefix}{name}/", depth + 1, skipped)


def _fields(file: StoredFile, group: str, source: str) -> dict[str, Any]:
    single = file.single_values(group).items()
    fields = {k: v for k, v in single if not isinstance(v, str) or len(v) <= _LONGEST}
    for name, value in file.attributes(group, ("onset", "seed")).items():
        fields[name] = whole_number(source, name, value)
    for value in file.attributes(group, ("parameters",)).values():
        with readable(f"{source}, attribute parameters,"):
            parameters = json.loads(value)
        fields["parameters"] = parameters if isinstance(parameters, dict) else {}
    return fields


def _open(path: Path, options: Options) -> Iterator[Recording]:
    return read_groups(path, transposed=is_transposed(path, options))


READER: Final = Reader("hdf5", "an HDF5 file", (".h5", ".hdf5", ".hdf"), _open, options=TRANSPOSE)
