"""Read the sensors of the episodes that the site shows, from splits that come with the package.

Entries hold scores, not observations. The site shows no sensors of other splits, so that its files
do not depend on which splits a machine has.
"""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import Quantity
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import SHIPPED, Split

SHOWN: Final = 3  # sensors of an episode: those that leave their twin's course most
STEPS: Final = 250  # steps between the least and the largest value: one a pixel

Json = dict[str, Any]


def shipped_split(digest: str) -> Split | None:
    """Return the split with a digest if it comes with the package."""
    found = (Split(path.parent) for path in SHIPPED.glob("*/manifest.json"))
    return next((split for split in found if split.digest == digest), None)


def shown_episodes(split: Split, environment: str, wanted: Iterable[tuple[str, int]]) -> Json:
    """Return the sensors of test episodes by ``anomaly/index``.

    Each sensor has its name with unit, a step, and in whole numbers of steps what the episode and
    its nominal twin read from row 0 on.
    """
    data = split.environment(environment)
    return {f"{a}/{i}": _sensors(data, a, i) for a, i in sorted(set(wanted))}


def _sensors(data: EnvironmentData, anomaly: str, index: int) -> list[Json]:
    own, twin = data.anomalous(anomaly)[index].observations, data.twins[index].observations
    both = min(len(own), len(twin))
    spread = np.maximum(twin.std(axis=0), 1e-6)
    apart = np.abs(own[:both] - twin[:both]).mean(axis=0) / spread
    return [
        _sensor(_title(data.sensors[d]), own[:, d], twin[:, d])
        for d in np.argsort(-apart, kind="stable")[:SHOWN]
    ]


def _title(sensor: Quantity) -> str:
    return sensor.name if sensor.unit == "1" else f"{sensor.name} ({sensor.unit})"


def _sensor(name: str, own: NDArray[Any], twin: NDArray[Any]) -> Json:
    values = np.concatenate([own, twin]).astype(np.float64)
    step = float(f"{max(np.ptp(values) / STEPS, 1e-9):.2g}")
    whole = np.round(values / step).astype(int).tolist()
    return {"name": name, "step": step, "own": whole[: len(own)], "twin": whole[len(own) :]}
