"""Four coupled tanks and two pumps under PI control: the quadruple tank of Johansson (2000).

Pump i sends a share of its flow to tank i, and the rest to the upper tank of the other side, which
drains into the lower one. With levels h, orifices a, areas A, splits g and flows q = k u:

    A1 h1' = a3 sqrt(2 g h3) - a1 sqrt(2 g h1) + g1 q1      A3 h3' = (1 - g2) q2 - a3 sqrt(2 g h3)
    A2 h2' = a4 sqrt(2 g h4) - a2 sqrt(2 g h2) + g2 q2      A4 h4' = (1 - g1) q1 - a4 sqrt(2 g h4)

A pump follows its voltage with a lag: u' = (v - u) / lag. A leak is a further orifice in a tank.
"""

import math
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from oodd_worlds.facts import read_world

WORLD: Final = read_world("tank")
ROWS: Final = 400  # transitions of an episode
SUBSTEPS: Final = 3  # of the integration, a row
HOLD: Final = (40, 120)  # rows for which set points stay


class Tank(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The tanks as an environment: levels and set points, and voltages of pumps.

    Attributes
    ----------
    pump_gain, split, orifice, leak
        Numbers of this episode: cm³/(V s) of each pump, its share to its lower tank, and cm² of
        each tank's orifice and leak.
    pump_lag
        Seconds, of each pump.
    """

    def __init__(self) -> None:
        high = np.full(len(WORLD.sensors), np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        volts = np.full(2, WORLD.value("highest voltage"), np.float32)
        self.action_space = gymnasium.spaces.Box(np.zeros(2, np.float32), volts)
        self.pump_gain: list[float] = [*WORLD.value("pump gain")]
        self.orifice: list[float] = [*WORLD.value("orifice")]
        self.split: list[float] = [*WORLD.value("split")]
        self.leak = [0.0] * 4
        self.pump_lag = [WORLD.value("pump lag")] * 2
        self.level = [0.0] * 4
        self.flow_voltage = [0.0] * 2

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode at rest at its first set points' voltages."""
        super().reset(seed=seed)
        rng = self.np_random
        self.pump_gain = [*map(float, WORLD.drawn("pump gain", rng))]
        self.orifice = [*map(float, WORLD.drawn("orifice", rng))]
        self._set_points, self._next = self._draw_set_points(), int(rng.integers(*HOLD))
        self._row = 0
        voltages = 3.0 + 0.2 * rng.standard_normal(2)
        self.flow_voltage = [*map(float, voltages)]
        self.level = steady_levels(self, self.flow_voltage)
        return self._observation(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold voltages for a row."""
        highest = WORLD.value("highest voltage")
        voltage = [min(max(float(v), 0.0), highest) for v in action]
        self.fill(voltage)
        self._row += 1
        if self._row == self._next:
            self._set_points = self._draw_set_points()
            self._next += int(self.np_random.integers(*HOLD))
        error = sum(abs(h - r) for h, r in zip(self.level, self._set_points, strict=False))
        reward = max(0.0, 1.0 - error / WORLD.value("error of no reward"))
        return self._observation(), reward, False, False, {}

    def fill(self, voltage: list[float]) -> None:
        """Let levels and voltages change for a row."""
        seconds = WORLD.value("period") / SUBSTEPS
        state = (*self.level, *self.flow_voltage)
        for _ in range(SUBSTEPS):
            state = _rk4(self, state, voltage, seconds)
        top = WORLD.value("height")
        self.level = [min(max(h, 0.0), top) for h in state[:4]]
        self.flow_voltage = [*state[4:]]

    def _draw_set_points(self) -> list[float]:
        change = WORLD.value("set point change")
        drawn = WORLD.value("set points") + self.np_random.uniform(-change, change, 2)
        return [*map(float, drawn)]

    def _observation(self) -> NDArray[np.float32]:
        return np.array([*self.level, *self._set_points], np.float32)


State = tuple[float, ...]


def derivative(tank: Tank, state: State, voltage: list[float]) -> State:
    """Return the change of levels, cm/s, and of the pumps' voltages, V/s."""
    h1, h2, h3, h4, u1, u2 = state
    gravity = 2 * WORLD.value("gravity")
    speed = [math.sqrt(gravity * max(h, 0.0)) for h in (h1, h2, h3, h4)]
    out = [(a + leak) * v for a, leak, v in zip(tank.orifice, tank.leak, speed, strict=True)]
    drained = [a * v for a, v in zip(tank.orifice, speed, strict=True)]
    q1, q2 = tank.pump_gain[0] * u1, tank.pump_gain[1] * u2
    s1, s2 = tank.split
    area = AREA
    return (
        (drained[2] - out[0] + s1 * q1) / area[0],
        (drained[3] - out[1] + s2 * q2) / area[1],
        ((1 - s2) * q2 - out[2]) / area[2],
        ((1 - s1) * q1 - out[3]) / area[3],
        (voltage[0] - u1) / tank.pump_lag[0],
        (voltage[1] - u2) / tank.pump_lag[1],
    )


AREA: Final[tuple[float, ...]] = tuple(WORLD.value("area").tolist())


def steady_levels(tank: Tank, voltage: list[float]) -> list[float]:
    """Return the levels in cm at which constant voltages keep tanks without leaks."""
    q1, q2 = tank.pump_gain[0] * voltage[0], tank.pump_gain[1] * voltage[1]
    s1, s2 = tank.split
    flows = (s1 * q1 + (1 - s2) * q2, s2 * q2 + (1 - s1) * q1, (1 - s2) * q2, (1 - s1) * q1)
    gravity = 2 * WORLD.value("gravity")
    return [(q / a) ** 2 / gravity for q, a in zip(flows, tank.orifice, strict=True)]


def _rk4(tank: Tank, state: State, voltage: list[float], dt: float) -> State:
    def moved(slope: State, share: float) -> State:
        return tuple(x + share * dt * d for x, d in zip(state, slope, strict=True))

    k1 = derivative(tank, state, voltage)
    k2 = derivative(tank, moved(k1, 0.5), voltage)
    k3 = derivative(tank, moved(k2, 0.5), voltage)
    k4 = derivative(tank, moved(k3, 1.0), voltage)
    return tuple(
        x + dt / 6 * (a + 2 * b + 2 * c + d)
        for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
    )


class PI:
    """Johansson's decentralized PI controllers, with clamped integrals: they have memory."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all errors."""
        self._integral = [3.0, 3.0]  # V, near the voltages that hold the set points

    def act(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the voltages for a row."""
        period, highest = WORLD.value("period"), WORLD.value("highest voltage")
        voltages = []
        for i in range(2):
            error = WORLD.value("sensor gain") * (float(row[4 + i]) - float(row[i]))
            proportional = GAIN[i] * error
            growth = GAIN[i] * period / INTEGRAL_TIME[i] * error
            voltage = proportional + self._integral[i] + growth
            if 0.0 < voltage < highest:  # else the integral would wind up
                self._integral[i] += growth
            voltages.append(min(max(proportional + self._integral[i], 0.0), highest))
        return np.array(voltages, np.float32)


GAIN: Final[tuple[float, ...]] = tuple(WORLD.value("controller gain").tolist())
INTEGRAL_TIME: Final[tuple[float, ...]] = tuple(WORLD.value("integral time").tolist())
