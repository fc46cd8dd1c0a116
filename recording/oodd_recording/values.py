"""Values of anomalies by environment: Table 1 of the paper, sensors, spreads, largest strengths."""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.registry import anomaly_spec
from oodd_recording.registered import MEASURED, Measured, info_of

SENSOR_SHARE: Final = 0.2  # of the sensors that an anomaly corrupts, rounded down, at least one

VALUES: Final[dict[str, dict[str, Any]]] = json.loads(
    Path(__file__).with_name("anomaly_values.json").read_text(encoding="utf-8")
)
"""The values of each kind of anomaly by environment, in the units of the sensors:

``iid``: mean and standard deviation of the noise; ``calibration``: factor; ``drift``: slope per
step; ``wind``: probability of a gust in a step (discrete actions), or strength added to each motor
(Bullet); ``gravity``, ``components``: ranges. CartPole's lower bounds are 0 in the paper; the
simulator divides by length and mass.

``sensors`` are those that sensor anomalies corrupt. In the mini split's training rows they differ
from their median in at least 1 % of the rows (to switch off a constant zero changes nothing), and
have more than 8 distinct values (a contact of 0.87 gives itself away). ``spread`` is the standard
deviation of each sensor in these rows.
"""

MEASURED.update(
    (name, Measured(tuple(spread), tuple(VALUES["sensors"][name])))
    for name, spread in VALUES["spread"].items()
)


def choose_sensors(environment: str, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw the sensors that an anomaly corrupts, sorted."""
    breakable = MEASURED[environment].sensors
    count = min(len(breakable), max(1, int(SENSOR_SHARE * info_of(environment).observation_dim)))
    return np.sort(rng.choice(breakable, size=count, replace=False))


def spread_of(environment: str) -> NDArray[np.float64]:
    """Return the nominal standard deviation of each sensor, of shape (D,)."""
    return np.array(MEASURED[environment].spread, dtype=np.float64)


def unit_of(environment: str, kind: str) -> str:
    """Return what a kind's strength of 1 means in an environment."""
    return anomaly_spec(kind).scale(info_of(environment))[0]


def bound_of(environment: str, kind: str) -> float:
    """Return the largest sensible strength of a kind in an environment."""
    return float(anomaly_spec(kind).scale(info_of(environment))[1])
