"""Export a split as datasets that Minari opens.

One dataset per environment and part, in Minari's documented layout: ``data/main_data.hdf5`` with a
group per episode, ``data/metadata.json`` with spaces and totals. Minari itself is not needed to
write them. Seeds are episode metadata, and for anomalous parts onset, redraws and parameters.

Source: Minari's dataset standards, https://minari.farama.org/content/dataset_standards
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from oodd_eval._version import __version__
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, EnvironmentInfo
from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import AnomalousSet, EnvironmentData, Split, TrajectorySet
from oodd_eval.errors import OutputError

MINARI_VERSION: Final = "0.5.0"
"""Version of the layout that is written."""

NAMESPACE: Final = "oodd"

_PARTS: Final = ("train", "calibration", TWINS, *(f"test/{a}" for a in ANOMALIES))


def export(
    split: Split,
    directory: Path,
    *,
    environments: Sequence[str],
    progress: Callable[[str], None] = lambda _identity: None,
) -> list[str]:
    """Write all parts of some environments below a directory, Minari's root.

    Parameters
    ----------
    split
        What to export; its digests are verified.
    directory
        The root: what ``MINARI_DATASETS_PATH`` names for Minari.
    environments
        Names.
    progress
        Called with the id of each dataset when it is there.

    Returns
    -------
    Ids of the datasets, such as ``oodd/mini/hopper/test-iid-v0``.

    Raises
    ------
    OutputError
        When one of them is there already, before any work, or cannot be written.
    """
    name = re.sub(r"[^-\w]", "-", str(split.manifest["name"]))
    found = [directory / NAMESPACE / name / e / _dataset(p) for e in environments for p in _PARTS]
    for place in found:
        if place.exists():
            raise OutputError(f"{str(place)!r} exists: remove it, or export to another directory")
    written = []
    try:
        for environment in environments:
            data = split.environment(environment)
            try:
                for part, trajectories in _parts(data).items():
                    identity = f"{NAMESPACE}/{name}/{environment}/{_dataset(part)}"
                    _write(directory / identity, identity, part, environment, trajectories, split)
                    written.append(identity)
                    progress(identity)
            finally:
                data.close()
    except OSError as error:
        raise OutputError(f"{str(directory)!r} cannot be written to: {error}") from error
    return written


def _dataset(part: str) -> str:
    return f"{part.replace('/', '-')}-v0"


def _parts(data: EnvironmentData) -> dict[str, TrajectorySet]:
    anomalous = {f"test/{a}": data.anomalous(a) for a in data.anomalies}
    return {"train": data.train, "calibration": data.calibration, TWINS: data.twins, **anomalous}


def _write(
    place: Path,
    identity: str,
    part: str,
    environment: str,
    trajectories: TrajectorySet,
    split: Split,
) -> None:
    """Write one dataset, all or nothing."""
    info = ENVIRONMENTS[environment]
    place.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=".", dir=place.parent))
    try:
        data = made / "data"
        data.mkdir()
        with h5py.File(data / "main_data.hdf5", "w", track_order=True) as file:
            for i, ended in enumerate(trajectories.terminated.tolist()):
                _episode(file.create_group(f"episode_{i}"), i, info, trajectories, ended=ended)
        metadata = {
            "dataset_id": identity,
            "minari_version": MINARI_VERSION,
            "data_format": "hdf5",
            "total_episodes": len(trajectories),
            "total_steps": int(trajectories.lengths.sum()),
            "dataset_size": round((data / "main_data.hdf5").stat().st_size / 1e6, 1),
            **_spaces(info),
            "algorithm_name": info.policy,
            "author": ["The oodd-eval developers"],
            "description": _description(info, part, split),
            "oodd_eval_version": __version__,
            "split_digest": split.digest,
        }
        (data / "metadata.json").write_text(json.dumps(metadata, indent=1), encoding="utf-8")
        made.chmod(0o755)  # temporary directories are their maker's alone
        made.rename(place)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def _episode(
    group: h5py.Group, i: int, info: EnvironmentInfo, data: TrajectorySet, *, ended: bool
) -> None:
    trajectory, steps = data[i], int(data.lengths[i])
    actions = trajectory.actions.argmax(axis=1) if info.discrete else trajectory.actions
    last = np.arange(steps) == steps - 1
    arrays = {
        "observations": trajectory.observations,
        "actions": actions,
        "rewards": data.rewards(i),
        "terminations": last & ended,
        "truncations": last & (not ended),
    }
    for name, array in arrays.items():
        group.create_dataset(name, data=array, chunks=True, compression="gzip", shuffle=True)
    group.create_group("infos")
    group.attrs.update({"id": i, "seed": int(data.seeds[i]), "total_steps": steps})
    if isinstance(data, AnomalousSet):
        parameters = json.dumps(data.parameters[i], sort_keys=True)
        group.attrs.update(
            {
                "anomaly": data.group.removeprefix("test/"),
                "onset": int(data.onsets[i]),
                "redraws": int(data.redraws[i]),
                "parameters": parameters,
            }
        )


def _spaces(info: EnvironmentInfo) -> dict[str, str]:
    d, a = info.observation_dim, info.action_dim
    infinite = [float("inf")] * d
    observation = {"type": "Box", "dtype": "float32", "shape": [d],
                   "low": [-x for x in infinite], "high": infinite}  # fmt: skip
    action: dict[str, Any] = {"type": "Box", "dtype": "float32", "shape": [a],
                              "low": [-1.0] * a, "high": [1.0] * a}  # fmt: skip
    if info.discrete:
        action = {"type": "Discrete", "dtype": "int64", "start": 0, "n": a}
    return {"observation_space": json.dumps(observation), "action_space": json.dumps(action)}


def _description(info: EnvironmentInfo, part: str, split: Split) -> str:
    anomaly = part.removeprefix("test/") if part not in {"train", "calibration", TWINS} else ""
    what = f"{anomaly} anomalies from an onset on" if anomaly else f"nominal, {part}"
    return (
        f"{info.title}, {what}: trajectories of a frozen {info.policy} policy, from split "
        f"{split.name} of oodd-eval. Episode metadata: seed"
        + (", anomaly, onset, redraws, parameters as JSON." if anomaly else ".")
    )
