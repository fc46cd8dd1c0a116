"""Datasets of Minari: a Box of observations in a row, Box or Discrete actions.

Minari itself is not needed.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import EPISODE, read_json
from oodd_eval.data.facts import Quantity
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_logs.readers import Options, Reader, readable
from oodd_logs.readers.hdf5 import read_groups
from oodd_logs.recording import Recording


def _open(directory: Path, _options: Options) -> Iterator[Recording]:
    data, metadata = directory / "data" / "main_data.hdf5", directory / "data" / "metadata.json"
    if not data.exists() or not metadata.exists():
        raise UsageError(
            f"{str(directory)!r} is no Minari dataset in HDF5, expected data/main_data.hdf5 and "
            "data/metadata.json in it"
        )
    with readable(metadata):
        facts = read_json(metadata, EPISODE.most, TrajectoryError)
        observations, actions = (
            json.loads(facts[f"{kind}_space"]) for kind in ("observation", "action")
        )
        kinds = observations["type"], actions["type"]
        sensors, commands = (
            tuple(Quantity(str(row["name"]), str(row["unit"])) for row in facts.get(columns, ()))
            for columns in ("sensors", "actions")
        )
        further: dict[str, Any] = {}
        if kinds[1] == "Discrete":
            further = {"discrete": int(actions.get("n", 0)), "start": int(actions.get("start", 0))}
            if len(commands) == further["discrete"]:
                further["choices"] = [quantity.name for quantity in commands]
    if kinds[0] != "Box" or kinds[1] not in {"Box", "Discrete"}:
        raise TrajectoryError(
            f"{metadata}: observations are {kinds[0]} and actions {kinds[1]}, expected a Box of "
            "observations and a Box of actions or Discrete ones: flatten them first"
        )
    yield from read_groups(data, sensors=sensors, actions=commands, further=further)


READER: Final = Reader(
    "minari",
    "the directory of a Minari dataset",
    (),
    _open,
    directory_markers=("data/main_data.hdf5",),
)
