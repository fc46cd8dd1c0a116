"""A split as datasets of Minari: one for each environment and part.

The layout is that of https://minari.farama.org/content/dataset_standards. Minari is not needed.
"""

import contextlib
import dataclasses
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from oodd_eval._version import __version__
from oodd_eval.data.facts import ENVIRONMENTS, title_of
from oodd_eval.data.files import Unfailing, remove_abandoned, temporary_directory
from oodd_eval.data.parts import (
    FAILURES,
    AnomalousSet,
    EnvironmentData,
    LabelledSet,
    TrajectorySet,
    parts_of,
)
from oodd_eval.data.split import Split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import OutputError

NAMESPACE: Final = "oodd"


def export(
    split: Split,
    directory: Path,
    *,
    environments: Sequence[str],
    progress: Callable[[str], None] = lambda _identity: None,
) -> list[str]:
    """Write all parts of some environments as datasets below Minari's root.

    Parameters
    ----------
    split
        The split.
    directory
        Minari's root.
    environments
        Those to export.
    progress
        Called with the id of each dataset when it is written.

    Returns
    -------
    list of str
        Ids of the datasets, such as ``oodd/mini/hopper/test-iid-v0``.

    Raises
    ------
    OutputError
        When a dataset exists, before any work, or cannot be written.
    """
    name = re.sub(r"[^-\w]", "-", str(split.manifest["name"]))
    entries = split.manifest["environments"]
    targets = [
        directory / NAMESPACE / name / e / _dataset(part)
        for e in environments
        for part in entries[e]["groups"]
    ]
    for parent in {target.parent for target in targets}:
        remove_abandoned(parent)
    for target in (target for target in targets if target.exists()):
        raise OutputError(f"{str(target)!r} exists: remove it, or export to another directory")
    written = []
    try:
        for environment in environments:
            with contextlib.closing(split.environment(environment)) as data:
                parts = data.train, *parts_of(data, data.anomalies).values(), data.failures
                for trajectories in filter(None, parts):
                    identity = f"{NAMESPACE}/{name}/{environment}/{_dataset(trajectories.group)}"
                    _write(directory, identity, data, trajectories, split)
                    written.append(identity)
                    progress(identity)
    except OSError as error:
        raise OutputError(f"{str(directory)!r} cannot be written to: {error}") from error
    return written


def _dataset(part: str) -> str:
    return f"{part.replace('/', '-').replace('@', '-')}-v0"


def _write(
    directory: Path, identity: str, data: EnvironmentData, trajectories: TrajectorySet, split: Split
) -> None:
    """Write one dataset, all or nothing."""
    target = directory / identity
    policy = ENVIRONMENTS[data.id].policy if data.id in ENVIRONMENTS else "own"
    with temporary_directory(target.parent, target.name) as partial:
        file = partial / "data" / "main_data.hdf5"
        file.parent.mkdir()
        with Unfailing(file) as disk, h5py.File(disk, "w", track_order=True) as stored:
            ended = trajectories.terminated.tolist()
            for i, trajectory in enumerate(trajectories):
                group = stored.create_group(f"episode_{i}")
                _episode(group, i, trajectories, trajectory, data.discrete, ended[i])
        content, further = f"nominal, {trajectories.group}", ""
        if trajectories.group == FAILURES:
            content = "failed episodes for training"
        anomalies = f"{trajectories.group.removeprefix('test/')} anomalies"
        if isinstance(trajectories, AnomalousSet):
            content = f"{anomalies} from an onset on"
            further = ", anomaly, onset, effect, redraws, parameters as JSON"
        elif isinstance(trajectories, LabelledSet):
            content = f"{anomalies} in intervals of rows"
            further = ", anomaly, intervals as JSON (a start of -1 is unknown, none: outcome alone)"
        source = f"trajectories of a fixed policy ({policy}), from"
        source = "episodes of logs, as imported into" if data.logs else source
        further = f", name, task{further}" if data.logs else further
        scores = [q.name for q in data.columns if q.role == "score"]
        without = f", without the recorded scores {', '.join(scores)}" if scores else ""
        infinity = float("inf")
        # Commands of the benchmark's robots are shares of a motor's power; others may be anything.
        bound = 1.0 if data.id in ENVIRONMENTS else infinity
        action = _box(len(data.actions), -bound, bound)
        if data.discrete:
            action = {"type": "Discrete", "dtype": "int64", "start": 0, "n": len(data.actions)}
        metadata = {
            "dataset_id": identity,
            "minari_version": "0.5.0",
            "data_format": "hdf5",
            "total_episodes": len(trajectories),
            "total_steps": int(trajectories.lengths.sum()),
            "dataset_size": round(file.stat().st_size / 1e6, 1),
            "observation_space": json.dumps(_box(len(data.sensors), -infinity, infinity)),
            "action_space": json.dumps(action),
            "algorithm_name": policy,
            "author": ["The oodd-eval developers"],
            "description": f"{title_of(data.id)}, {content}: {source} split {split.name} of "
            f"oodd-eval{without}. Episode metadata: seed{further}.",
            "oodd_eval_version": __version__,
            "split_digest": split.digest,
            "sensors": [dataclasses.asdict(quantity) for quantity in data.sensors],
            "actions": [dataclasses.asdict(quantity) for quantity in data.actions],
        }
        if data.logs:
            # Offsets have been subtracted from observations, as float32 has no room for them.
            metadata |= {"author": [], "logs": dataclasses.asdict(data.logs)}
        file.with_name("metadata.json").write_text(json.dumps(metadata, indent=1), "utf-8")
        partial.rename(target)


def _box(n: int, low: float, high: float) -> dict[str, Any]:
    return {"type": "Box", "dtype": "float32", "shape": [n], "low": [low] * n, "high": [high] * n}


def _episode(
    group: h5py.Group, i: int, data: TrajectorySet, episode: Trajectory, discrete: bool, ended: bool
) -> None:
    steps = episode.transitions
    last = np.arange(steps) == steps - 1
    actions = episode.actions.argmax(axis=1) if discrete else episode.actions
    arrays = {"observations": episode.observations, "actions": actions, "rewards": data.rewards(i)}
    arrays |= {"terminations": last & ended, "truncations": last & (not ended)}
    for name, array in arrays.items():
        group.create_dataset(name, data=array, chunks=True, compression="gzip", shuffle=True)
    group.create_group("infos")
    group.attrs.update({"id": i, "seed": int(data.seeds[i]), "total_steps": steps})
    described = {"name": data.names[i], "task": data.tasks[i]}
    if isinstance(data, LabelledSet | AnomalousSet):
        described["anomaly"] = data.group.removeprefix("test/")
    group.attrs.update({key: text for key, text in described.items() if text})
    if isinstance(data, LabelledSet):
        group.attrs["intervals"] = json.dumps(data.intervals[i])
    elif isinstance(data, AnomalousSet):
        drawn = {"onset": data.onsets, "effect": data.effects, "redraws": data.redraws}
        group.attrs.update({name: int(values[i]) for name, values in drawn.items()})
        group.attrs["parameters"] = json.dumps(data.parameters[i], sort_keys=True)
