"""Episodes as the groups of an HDF5 file; nothing may lie in another file."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.data.logs import ARRAYS, Log, Logs, Reader, in_order, unreadable, whole_number
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import TrajectoryError


def read_groups(path: Path) -> Iterator[Log]:
    """Yield the groups of a file, each an episode, in the order of their names."""
    with contextlib.closing(StoredFile(path, EPISODE)) as file:
        for name in sorted(file.groups(), key=in_order):
            yield _episode(file, f"{path}, group {name}", name)


def _episode(file: StoredFile, source: str, name: str) -> Log:
    values = file.attributes(name, ("onset", "seed", "parameters"))
    values |= file.part(name, (*ARRAYS, "terminations"))
    if "observations" not in values:
        raise TrajectoryError(f"{source} lacks the dataset observations")
    try:
        parameters = json.loads(values.get("parameters", "{}"))
    except (TypeError, ValueError, RecursionError) as error:
        raise unreadable(f"{source}, attribute parameters,", error) from error
    return Log(
        name,
        source,
        values["observations"],
        values.get("actions"),
        values.get("rewards"),
        whole_number(source, "onset", values.get("onset")),
        whole_number(source, "seed", values.get("seed")),
        bool(np.any(values.get("terminations", False))),
        parameters if isinstance(parameters, dict) else {},
    )


READER: Final = Reader(
    "hdf5",
    "an HDF5 file with a group for each episode",
    lambda path: Logs(lambda: read_groups(path)),
    suffixes=(".h5", ".hdf5"),
)
