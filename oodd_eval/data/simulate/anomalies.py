"""The eight anomaly types with the values of the paper's Table 1.

An anomaly is drawn once per trajectory, then acts from the onset on: a sensor anomaly on each
observation row, a dynamics anomaly on each transition.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.simulate.environments import Row, Simulator
from oodd_eval.names import check_known

NOMINAL_MARGIN: Final = 0.02  # draws this near to the nominal value change next to nothing
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
have more than 8 distinct values (a contact of 0.87 gives itself away).
"""


@dataclass(frozen=True, slots=True)
class Draw:
    """One anomaly as drawn for a trajectory: corrupted `sensors`, the simulator's `attributes`."""

    anomaly: str
    parameters: dict[str, Any]
    sensors: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    attributes: dict[str, float] = field(default_factory=dict)

    def corrupt(self, row: Row, step: int, rng: np.random.Generator) -> Row:
        """Return the observation row as a broken sensor reports it at a step of the trajectory."""
        if not self.sensors.size:
            return row
        values = row[self.sensors].astype(np.float64)
        p = self.parameters
        match self.anomaly:
            case "iid":
                values += rng.normal(p["mean"], p["std"], size=len(values))
            case "shutdown":
                values[:] = 0.0
            case "calibration":
                values *= p["factor"]
            case "drift":
                values += p["slope"] * step
        corrupted = row.copy()
        corrupted[self.sensors] = values.astype(np.float32)
        return corrupted

    def apply(self, simulator: Simulator, rng: np.random.Generator, *, first: bool) -> None:
        """Change the simulator before a transition; `first` at the transition onto the onset."""
        if first:
            for attribute, value in self.attributes.items():
                simulator.set(attribute, value)
        if "direction" in self.parameters:
            chance = self.parameters.get("probability")
            gust = chance is None or rng.random() < chance
            simulator.wind = self.parameters["direction"] if gust else 0


def draw(environment: str, anomaly: str, simulator: Simulator, rng: np.random.Generator) -> Draw:
    """Draw an anomaly for one trajectory; nominal values are read from the nominal simulator."""
    check_known("anomaly", ANOMALIES, anomaly)
    info = ENVIRONMENTS[environment]
    if ANOMALIES[anomaly].group == "sensor":
        count = max(1, int(SENSOR_SHARE * info.observation_dim))
        sensors = np.sort(rng.choice(VALUES["sensors"][environment], size=count, replace=False))
        parameters: dict[str, Any] = {"sensors": [int(s) for s in sensors]}
        if anomaly == "iid":
            parameters["mean"], parameters["std"] = VALUES["iid"][environment]
        elif anomaly in {"calibration", "drift"}:
            name = "factor" if anomaly == "calibration" else "slope"
            parameters[name] = VALUES[anomaly][environment]
        return Draw(anomaly, parameters, sensors=sensors)
    if anomaly.startswith("wind"):
        kind = "probability" if info.discrete else "strength"
        direction = 1 if anomaly == "wind-l2r" else -1
        return Draw(anomaly, {"direction": direction, kind: VALUES["wind"][environment]})
    ranges, names = {"gravity": VALUES["gravity"][environment]}, ["gravity"]
    if anomaly == "components":
        ranges, names = VALUES["components"][environment], []
        while not names:  # uniform over the non-empty subsets
            chosen = rng.random(len(ranges)) < 0.5
            names = [name for name, use in zip(sorted(ranges), chosen, strict=True) if use]
    values = {name: _redraw(rng, ranges[name], simulator.get(name)) for name in names}
    return Draw(anomaly, dict(values), attributes=values)


def _redraw(rng: np.random.Generator, bounds: tuple[float, float], nominal: float) -> float:
    low, high = bounds
    if low == high:
        return low
    while True:
        value = float(rng.uniform(low, high))
        if abs(value - nominal) > NOMINAL_MARGIN * abs(nominal):
            return value
