"""Kinds of anomalies of the worlds: each with one strength, in a physical unit where it has one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from oodd_recording.faults import Command, SensorFault
from oodd_recording.simulator import Row, Simulator

from oodd_eval import Fault


class Change(Fault):
    """A fault that moves numbers of the environment: `set` is given the share of it in force."""

    def __init__(self, set_share: Any, **drawn: Any) -> None:
        super().__init__(drawn)
        self._set = set_share

    def command(self, action: Command, simulator: Simulator) -> Command:
        """Set the numbers to the share in force."""
        self._set(simulator.env, self.share)
        return action

    def end(self, simulator: Simulator) -> None:
        """Put the numbers back."""
        self._set(simulator.env, 0.0)


def _item(name: str, index: int, value: Any) -> Any:
    """Return what sets an item of a list of the environment to `value(share)`."""

    def set_share(env: Any, share: float) -> None:
        getattr(env, name)[index] = value(share)

    return set_share


# The arm


def joint_friction(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a joint's frictions grow by a factor of 1 + strength."""
    joint, env = int(rng.integers(6)), simulator.env
    viscous, dry = float(env.viscous[joint]), float(env.dry[joint])

    def set_share(env: Any, share: float) -> None:
        env.viscous[joint] = viscous * (1 + share * strength)
        env.dry[joint] = dry * (1 + share * strength)

    return Change(set_share, actuator=joint)


def payload(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Add a mass of `strength` kg to the payload."""
    mass = simulator.env.payload

    def set_share(env: Any, share: float) -> None:
        env.payload = mass + share * strength

    return Change(set_share)


def motor_loss(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a motor lose a share of its torque."""
    joint = int(rng.integers(6))
    return Change(_item("motor", joint, lambda share: 1 - share * strength), actuator=joint)


def encoder_offset(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Add `strength` rad to the angle of a joint, with a random sign."""
    joint, sign = int(rng.integers(6)), int(rng.choice([-1, 1]))
    offset = sign * strength
    return SensorFault(np.array([joint]), lambda x, _: x + offset, direction=sign)


def backlash(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Give a joint's gear a play of `strength` rad; its encoder is on the motor's side."""
    return Backlash(strength, int(rng.integers(6)))


class Backlash(Fault):
    """The angle lags the motor's by up to half of the play, on the side that it was pushed to."""

    def __init__(self, width: float, joint: int) -> None:
        super().__init__({"sensors": [joint], "actuator": joint})
        self._width, self._joint = width, joint
        self._middle: float | None = None

    def begin(self, simulator: Simulator, rows: Sequence[Row]) -> None:
        """Start in the middle of the play."""
        self._middle = float(rows[-1][self._joint])

    def observe(self, row: Row, step: int) -> Row:
        """Return the angle of the side of the gear that the encoder is not on."""
        angle, half = float(row[self._joint]), self._width / 2
        middle = self._middle if self._middle is not None else angle
        self._middle = min(max(middle, angle - half), angle + half)
        changed = row.copy()
        changed[self._joint] = self._middle
        return changed


# The drone


def rotor_loss(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a rotor lose a share of its thrust."""
    rotor = int(rng.integers(4))
    thrust = simulator.env.thrust[rotor]
    return Change(_item("thrust", rotor, lambda s: thrust * (1 - s * strength)), actuator=rotor)


def steady_wind(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Add a mean wind of `strength` m/s from a random direction."""
    angle, wind = float(rng.uniform(0, 2 * np.pi)), [*simulator.env.wind]
    x, y = strength * float(np.cos(angle)), strength * float(np.sin(angle))

    def set_share(env: Any, share: float) -> None:
        env.wind = [wind[0] + share * x, wind[1] + share * y]

    return Change(set_share, angle=angle)


def gyro_bias(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Add `strength` rad/s to an axis of the gyroscope, with a random sign."""
    axis, sign = 9 + int(rng.integers(3)), int(rng.choice([-1, 1]))
    bias = sign * strength
    return SensorFault(np.array([axis]), lambda x, _: x + bias, direction=sign)


def position_drift(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a measured position drift by `strength` m a row, with a random sign."""
    return _drift(int(rng.integers(3)), strength, rng)


def _drift(sensor: int, strength: float, rng: np.random.Generator) -> Fault:
    sign = int(rng.choice([-1, 1]))
    begin: list[int] = []

    def change(x: Any, step: int) -> Any:
        begin[:] = begin or [step - 1]
        return x + sign * strength * (step - begin[0])

    return SensorFault(np.array([sensor]), change, direction=sign)


# The tank


def leak(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Open a hole of `strength` cm² at the bottom of a tank."""
    tank = int(rng.integers(4))
    return Change(_item("leak", tank, lambda share: share * strength), tank=tank)


def pump_wear(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a pump lose a share of its flow."""
    pump = int(rng.integers(2))
    gain = simulator.env.pump_gain[pump]
    return Change(_item("pump_gain", pump, lambda s: gain * (1 - s * strength)), actuator=pump)


def slow_pump(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a pump's lag grow by `strength` s."""
    pump = int(rng.integers(2))
    lag = simulator.env.pump_lag[pump]
    return Change(_item("pump_lag", pump, lambda share: lag + share * strength), actuator=pump)


def split_valve(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a valve send `strength` less of its pump's flow to the lower tank."""
    valve = int(rng.integers(2))
    split = simulator.env.split[valve]
    return Change(_item("split", valve, lambda share: split - share * strength), valve=valve)


def level_drift(strength: float, rng: np.random.Generator, simulator: Simulator) -> Fault:
    """Let a controlled level's measurement drift by `strength` cm a row, with a random sign."""
    return _drift(int(rng.integers(2)), strength, rng)
