"""Datasets of Minari: a Box of observations in a row, Box or Discrete actions."""

import json
from pathlib import Path
from typing import Final

from oodd_eval.data.bounded import EPISODE, read_bytes
from oodd_eval.data.facts import Quantity
from oodd_eval.data.logs import Logs, Reader, unreadable
from oodd_eval.data.logs.hdf5 import read_groups
from oodd_eval.errors import TrajectoryError, UsageError


def _open(directory: Path) -> Logs:
    data, metadata = directory / "data" / "main_data.hdf5", directory / "data" / "metadata.json"
    if not data.exists() or not metadata.exists():
        raise UsageError(
            f"{str(directory)!r} is no Minari dataset in HDF5, expected data/main_data.hdf5 and "
            "data/metadata.json in it"
        )
    try:
        facts = json.loads(read_bytes(metadata, EPISODE.most, TrajectoryError))
        observations, actions = (
            json.loads(facts[f"{kind}_space"]) for kind in ("observation", "action")
        )
        kinds = observations["type"], actions["type"]
        sensors, commands = (
            tuple(Quantity(str(row["name"]), str(row["unit"])) for row in facts.get(columns, ()))
            for columns in ("sensors", "actions")
        )
        is_discrete = kinds[1] == "Discrete"
        discrete, start = (int(is_discrete and actions.get(k, 0)) for k in ("n", "start"))
    except TrajectoryError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise unreadable(metadata, error) from error
    if kinds[0] != "Box" or kinds[1] not in {"Box", "Discrete"}:
        raise TrajectoryError(
            f"{metadata}: observations are {kinds[0]} and actions {kinds[1]}, expected a Box of "
            "observations and a Box of actions or Discrete ones: flatten them first"
        )
    return Logs(lambda: read_groups(data), sensors, commands, discrete, start)


READER: Final = Reader(
    "minari",
    "the directory of a Minari dataset",
    _open,
    tests=r"test-(.+)-v\d+",  # as an export names them
)
