"""The eight anomaly types with the values of the paper's Table 1.

An anomaly is drawn once per trajectory, then acts from the onset on: a sensor anomaly on each
observation row, a dynamics anomaly on each transition.
"""

from typing import Final

import numpy as np

from oodd_eval.data.facts import ANOMALIES, TABLE1
from oodd_eval.data.registry import Fault
from oodd_eval.names import check_known
from oodd_recording.faults import MAKERS, Command, Dynamics, SensorFault, choose_attributes
from oodd_recording.registered import info_of
from oodd_recording.simulator import Simulator
from oodd_recording.values import VALUES, choose_sensors

NOMINAL_MARGIN: Final = 0.02  # draws this near to the nominal value change next to nothing


def draw(environment: str, anomaly: str, simulator: Simulator, rng: np.random.Generator) -> Fault:
    """Draw an anomaly for one trajectory; nominal values are read from the nominal simulator."""
    check_known("anomaly of Table 1", TABLE1, anomaly)
    if ANOMALIES[anomaly].group == "sensor":
        return _sensor_fault(environment, anomaly, rng)
    if anomaly.startswith("wind"):
        strength = VALUES["wind"][environment]
        wind = MAKERS[anomaly](environment, strength, simulator, rng)
        wind.parameters["probability" if info_of(environment).discrete else "strength"] = strength
        return wind
    ranges, names = {"gravity": VALUES["gravity"][environment]}, ["gravity"]
    if anomaly == "components":
        ranges, names = VALUES["components"][environment], choose_attributes(environment, rng)
    values = {name: _redraw(rng, ranges[name], simulator.get(name)) for name in names}

    def act(action: Command, simulator: Simulator) -> Command:
        for name, value in values.items():
            simulator.set(name, value)
        return action

    return Dynamics(act, **values)


def _sensor_fault(environment: str, anomaly: str, rng: np.random.Generator) -> Fault:
    sensors = choose_sensors(environment, rng)
    if anomaly == "shutdown":
        return SensorFault(sensors, lambda x, _: np.zeros_like(x))
    value = VALUES[anomaly][environment]
    if anomaly == "iid":
        mean, std = value
        noisy = lambda x, _: x + rng.normal(mean, std, size=len(x))  # noqa: E731
        return SensorFault(sensors, noisy, mean=mean, std=std)
    if anomaly == "calibration":
        return SensorFault(sensors, lambda x, _: x * value, factor=value)
    return SensorFault(sensors, lambda x, step: x + value * step, slope=value)


def _redraw(rng: np.random.Generator, bounds: tuple[float, float], nominal: float) -> float:
    low, high = bounds
    if low == high:
        return low
    while True:
        value = float(rng.uniform(low, high))
        if abs(value - nominal) > NOMINAL_MARGIN * abs(nominal):
            return value
