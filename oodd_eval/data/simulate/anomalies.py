"""The eight anomaly types with the values of the paper's Table 1.

An anomaly is drawn once per trajectory (`draw`: parameters, and which sensors), then acts from the
onset on: a sensor anomaly on each observation row, a dynamics anomaly on each transition. All
randomness comes from the generator that is handed in, which is the anomaly's own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.simulate.environments import Simulator
from oodd_eval.errors import UnknownNameError

NOMINAL_MARGIN: Final = 0.02
"""Draws within this share of the nominal value are redrawn: they would change next to nothing."""

SENSOR_SHARE: Final = 0.2
"""Share of the sensors that a sensor anomaly corrupts, rounded down, at least one."""

IID: Final = MappingProxyType(
    {
        "acrobot": (2.0, 2.0), "cartpole": (1.0, 2.0), "lunarlander": (0.0, 1.0),
        "ant": (0.0, 1.0), "halfcheetah": (0.0, 0.12), "hopper": (0.0, 1.0),
        "walker2d": (0.0, 0.12),
    }
)  # fmt: skip
"""Mean and standard deviation of the noise, in the sensor's unit."""

CALIBRATION: Final = MappingProxyType(
    {
        "acrobot": 10.0, "cartpole": 3.0, "lunarlander": 3.0, "ant": 2.0,
        "halfcheetah": 1.25, "hopper": 1.25, "walker2d": 1.25,
    }
)  # fmt: skip
"""Factor."""

DRIFT: Final = MappingProxyType(
    {
        "acrobot": 5e-3, "cartpole": 2e-4, "lunarlander": 1e-4, "ant": 1e-4,
        "halfcheetah": 2e-5, "hopper": 2e-5, "walker2d": 2e-5,
    }
)  # fmt: skip
"""Slope per step of the trajectory, in the sensor's unit."""

WIND: Final = MappingProxyType(
    {
        "acrobot": 0.66, "cartpole": 0.66, "lunarlander": 0.5,
        "ant": 0.33, "halfcheetah": 0.33, "hopper": 0.33, "walker2d": 0.33,
    }
)  # fmt: skip
"""Probability of a gust in a step (discrete actions), or strength added to each motor (Bullet)."""

GRAVITY: Final = MappingProxyType(
    {
        "acrobot": (10.0, 11.0), "cartpole": (9.0, 11.0), "lunarlander": (9.0, 10.0),
        "ant": (9.8, 10.5), "halfcheetah": (9.8, 10.5), "hopper": (9.8, 10.5),
        "walker2d": (9.8, 10.5),
    }
)  # fmt: skip
"""Range of the magnitude."""

# CartPole's lower bounds are 0 in the paper; the simulator divides by length and mass.
COMPONENTS: Final = MappingProxyType(
    {
        "acrobot": {
            "link_length_1": (0.5, 2.0), "link_length_2": (0.5, 2.0),
            "link_mass_1": (0.5, 2.0), "link_mass_2": (0.5, 2.0),
        },
        "cartpole": {"pole_length": (0.1, 2.0), "pole_mass": (0.01, 1.0)},
        "lunarlander": {"main_engine_power": (10.0, 15.0), "side_engine_power": (0.0, 1.0)},
        "ant": {"power": (1.5, 1.5)}, "halfcheetah": {"power": (0.6, 0.6)},
        "hopper": {"power": (0.65, 0.65)}, "walker2d": {"power": (0.35, 0.35)},
    }
)  # fmt: skip
"""Range of each attribute."""

VARYING_SENSORS: Final = MappingProxyType(
    {
        "acrobot": (0, 1, 2, 3, 4, 5),
        "cartpole": (0, 1, 2, 3),
        "lunarlander": (0, 1, 2, 3, 4, 5, 6, 7),
        "ant": tuple(range(28)),
        "halfcheetah": (0, 3, 5, 7, *range(8, 21), 22, 23),
        "hopper": (0, 3, 5, 7, *range(8, 15)),
        "walker2d": (0, 3, 5, 7, *range(8, 22)),
    }
)
"""Sensors that vary in nominal operation: corrupting a constant zero may change nothing.

A sensor is listed when it differs from its median in at least 1 % of the mini split's training
rows. Planar robots move in x and z: sideways speed and roll stay zero, and the angle to the target
is constant; HalfCheetah's front shin, back shin and back thigh touch the ground never, or in one
step of ten thousand.
"""


@dataclass(frozen=True, slots=True)
class Draw:
    """One anomaly as drawn for one trajectory.

    Attributes
    ----------
    anomaly
        Name of the type.
    parameters
        What was drawn, as JSON-able values: what a split stores.
    sensors
        Corrupted sensors, as indices; empty for dynamics anomalies.
    attributes
        Simulator attributes and the values they are set to.
    """

    anomaly: str
    parameters: dict[str, Any]
    sensors: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    attributes: dict[str, float] = field(default_factory=dict)

    def corrupt(
        self, row: NDArray[np.float32], step: int, rng: np.random.Generator
    ) -> NDArray[np.float32]:
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
            gust = (
                "probability" not in self.parameters
                or rng.random() < self.parameters["probability"]
            )
            simulator.wind = self.parameters["direction"] if gust else 0


def draw(environment: str, anomaly: str, simulator: Simulator, rng: np.random.Generator) -> Draw:
    """Draw an anomaly for one trajectory.

    Parameters
    ----------
    environment, anomaly
        Names of `oodd_eval.data.facts`.
    simulator
        A nominal simulator, from which nominal values are read.
    rng
        The anomaly's generator.
    """
    if anomaly not in ANOMALIES:
        raise UnknownNameError("anomaly", anomaly, ANOMALIES)
    if ANOMALIES[anomaly].group == "sensor":
        return _draw_sensor(environment, anomaly, rng)
    if anomaly == "gravity":
        value = _redraw(rng, GRAVITY[environment], simulator.get("gravity"))
        return Draw(anomaly, {"gravity": value}, attributes={"gravity": value})
    if anomaly == "components":
        names = sorted(COMPONENTS[environment])
        chosen = rng.random(len(names)) < 0.5
        while not chosen.any():  # uniform over the non-empty subsets
            chosen = rng.random(len(names)) < 0.5
        values = {
            name: _redraw(rng, COMPONENTS[environment][name], simulator.get(name))
            for name, use in zip(names, chosen, strict=True)
            if use
        }
        return Draw(anomaly, dict(values), attributes=values)
    direction = 1 if anomaly == "wind-l2r" else -1
    kind = "probability" if ENVIRONMENTS[environment].discrete else "strength"
    return Draw(anomaly, {"direction": direction, kind: WIND[environment]})


def _draw_sensor(environment: str, anomaly: str, rng: np.random.Generator) -> Draw:
    count = max(1, int(SENSOR_SHARE * ENVIRONMENTS[environment].observation_dim))
    sensors = np.sort(rng.choice(VARYING_SENSORS[environment], size=count, replace=False))
    parameters: dict[str, Any] = {"sensors": [int(s) for s in sensors]}
    if anomaly == "iid":
        parameters["mean"], parameters["std"] = IID[environment]
    elif anomaly == "calibration":
        parameters["factor"] = CALIBRATION[environment]
    elif anomaly == "drift":
        parameters["slope"] = DRIFT[environment]
    return Draw(anomaly, parameters, sensors=sensors)


def _redraw(rng: np.random.Generator, bounds: tuple[float, float], nominal: float) -> float:
    low, high = bounds
    if low == high:
        return low
    while True:
        value = float(rng.uniform(low, high))
        if abs(value - nominal) > NOMINAL_MARGIN * abs(nominal):
            return value
