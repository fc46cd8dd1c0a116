"""The eight anomaly types with the values of the paper's Table 1.

An anomaly is drawn once per trajectory, then acts from the onset on: a sensor anomaly on each
observation row, a dynamics anomaly on each transition.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1
from oodd_eval.names import check_known
from oodd_recording.environments import Row, Simulator
from oodd_recording.faults import Command, Fault
from oodd_recording.values import VALUES, choose_sensors

NOMINAL_MARGIN: Final = 0.02  # draws this near to the nominal value change next to nothing


class Draw(Fault):
    """One anomaly as drawn: corrupted `sensors`, new values of the simulator's `attributes`."""

    def __init__(
        self,
        anomaly: str,
        parameters: dict[str, Any],
        rng: np.random.Generator,
        *,
        sensors: NDArray[np.intp] | None = None,
        attributes: dict[str, float] | None = None,
    ) -> None:
        super().__init__(parameters)
        self.anomaly, self._rng = anomaly, rng
        self.sensors = np.zeros(0, dtype=np.intp) if sensors is None else sensors
        self.attributes = attributes or {}

    def begin(self, simulator: Simulator, rows: Any) -> None:
        """Set the simulator's attributes to their new values."""
        for attribute, value in self.attributes.items():
            simulator.set(attribute, value)

    def command(self, action: Command, simulator: Simulator) -> Command:
        """Let the wind blow, or not."""
        p = self.parameters
        if "direction" in p:
            gust = "probability" not in p or self._rng.random() < p["probability"]
            simulator.wind = p["direction"] * p.get("strength", 1) if gust else 0
        return action

    def observe(self, row: Row, step: int) -> Row:
        """Return the observation row as the broken sensors report it."""
        if not self.sensors.size:
            return row
        values = row[self.sensors].astype(np.float64)
        p = self.parameters
        match self.anomaly:
            case "iid":
                values += self._rng.normal(p["mean"], p["std"], size=len(values))
            case "shutdown":
                values[:] = 0.0
            case "calibration":
                values *= p["factor"]
            case "drift":
                values += p["slope"] * step
        corrupted = row.copy()
        corrupted[self.sensors] = values.astype(np.float32)
        return corrupted


def draw(environment: str, anomaly: str, simulator: Simulator, rng: np.random.Generator) -> Draw:
    """Draw an anomaly for one trajectory; nominal values are read from the nominal simulator."""
    check_known("anomaly of Table 1", TABLE1, anomaly)
    info = ENVIRONMENTS[environment]
    if ANOMALIES[anomaly].group == "sensor":
        sensors = choose_sensors(environment, rng)
        parameters: dict[str, Any] = {"sensors": [int(s) for s in sensors]}
        if anomaly == "iid":
            parameters["mean"], parameters["std"] = VALUES["iid"][environment]
        elif anomaly in {"calibration", "drift"}:
            name = "factor" if anomaly == "calibration" else "slope"
            parameters[name] = VALUES[anomaly][environment]
        return Draw(anomaly, parameters, rng, sensors=sensors)
    if anomaly.startswith("wind"):
        kind = "probability" if info.discrete else "strength"
        direction = 1 if anomaly == "wind-l2r" else -1
        return Draw(anomaly, {"direction": direction, kind: VALUES["wind"][environment]}, rng)
    ranges, names = {"gravity": VALUES["gravity"][environment]}, ["gravity"]
    if anomaly == "components":
        ranges, names = VALUES["components"][environment], []
        while not names:  # uniform over the non-empty subsets
            chosen = rng.random(len(ranges)) < 0.5
            names = [name for name, use in zip(sorted(ranges), chosen, strict=True) if use]
    values = {name: _redraw(rng, ranges[name], simulator.get(name)) for name in names}
    return Draw(anomaly, dict(values), rng, attributes=values)


def _redraw(rng: np.random.Generator, bounds: tuple[float, float], nominal: float) -> float:
    low, high = bounds
    if low == high:
        return low
    while True:
        value = float(rng.uniform(low, high))
        if abs(value - nominal) > NOMINAL_MARGIN * abs(nominal):
            return value
