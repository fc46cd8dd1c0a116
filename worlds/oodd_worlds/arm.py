"""A six-axis arm that follows random way points: the UR5e by the numbers of its maker, in MuJoCo.

Links, masses and centres of mass are those of the Denavit-Hartenberg table; frame i lies at the
end of link i. A payload hangs before the flange. The controller is computed torque: it knows the
arm's equations with the nominal payload and frictions, and follows a minimum-jerk path.
"""

import functools
import math
from typing import Any, Final

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from oodd_worlds.facts import World, read_world

WORLD: Final = read_world("arm")
ROWS: Final = 400
SUBSTEPS: Final = 10
HOLD: Final = (75, 150)  # rows from a way point to the next
JOINTS: Final = 6
HOME: Final = (0.0, -1.3, 1.4, -1.6, -1.5, 0.0)  # rad
REACH: Final = (0.8, 0.5, 0.5, 0.6, 0.6, 0.8)  # rad, of way points from home
MOTION: Final = 0.05  # rad/s, at which dry friction is about three quarters of its full value

_PERIOD: Final = WORLD.value("period")


def model_xml(world: World = WORLD) -> str:
    """Return the arm in MuJoCo's language, made from its Denavit-Hartenberg table."""
    a, d, alpha, mass = (world.value(name) for name in ("a", "d", "alpha", "mass"))
    centres = np.stack([world.value(f"centre {axis}") for axis in "xyz"], axis=1)
    gyration, armature = world.value("gyration"), world.value("armature")
    opening, closing = "", ""
    for i in range(JOINTS):
        # Joint i turns about z of frame i - 1; frame i is d along that z, a along the new x, and
        # then turned by alpha about it. A body is frame i, its joint's axis lies in it.
        half = alpha[i] / 2
        pose = f'pos="{a[i]} 0 {d[i]}" quat="{math.cos(half)} {math.sin(half)} 0 0"'
        inertia = mass[i] * gyration[i] ** 2
        moved = " ".join(map(repr, centres[i].tolist()))
        joint = f'<joint name="joint{i + 1}" axis="0 0 1" armature="{armature[i]}"/>'
        # The hinge is a body of its own at frame i - 1, so that it turns about that frame's z.
        opening += (
            f'<body name="hinge{i + 1}">{joint}<inertial pos="0 0 0" mass="1e-9" '
            f'diaginertia="1e-9 1e-9 1e-9"/><body name="link{i + 1}" {pose}>'
            f'<inertial pos="{moved}" mass="{mass[i]}" '
            f'diaginertia="{inertia} {inertia} {inertia}"/>'
        )
        closing += "</body></body>"
    load = (
        f'<body name="payload" pos="0 0 {world.value("payload offset")}"><inertial pos="0 0 0" '
        f'mass="{world.value("payload")}" diaginertia="1e-4 1e-4 1e-4"/></body>'
    )
    option = f'timestep="{_PERIOD / SUBSTEPS}" gravity="0 0 {-world.value("gravity")}"'
    return (
        f'<mujoco><compiler angle="radian" boundmass="1e-9" boundinertia="1e-12"/><option {option} '
        f'integrator="implicitfast"/><worldbody>{opening}{load}{closing}</worldbody></mujoco>'
    )


@functools.cache
def nominal_model() -> mujoco.MjModel:
    """Return the arm as the controller knows it."""
    return mujoco.MjModel.from_xml_string(model_xml())


class Arm(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The arm as an environment: angles, velocities and the way; torques of the motors.

    Attributes
    ----------
    viscous, dry
        Frictions of the joints in this episode, N m s and N m.
    motor
        Share of its commanded torque that each motor gives.
    backlash
        Width of the play of each joint's gear, rad.
    """

    def __init__(self) -> None:
        high = np.full(len(WORLD.sensors), np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        torque = WORLD.value("highest torque").astype(np.float32)
        self.action_space = gymnasium.spaces.Box(-torque, torque)
        self.model = mujoco.MjModel.from_xml_string(model_xml())
        self.data = mujoco.MjData(self.model)
        self._torque = WORLD.value("highest torque")
        self._ripple = WORLD.value("ripple")
        self.viscous = WORLD.value("viscous friction")
        self.dry = WORLD.value("dry friction")
        self.motor = np.ones(JOINTS)
        self._payload = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "payload")

    @property
    def payload(self) -> float:
        """Mass of the payload, kg."""
        return float(self.model.body_mass[self._payload])

    @payload.setter
    def payload(self, mass: float) -> None:
        self.model.body_mass[self._payload] = mass

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode at rest near home."""
        super().reset(seed=seed)
        rng = self.np_random
        mujoco.mj_resetData(self.model, self.data)
        self.payload = WORLD.drawn("payload", rng)
        self.viscous = WORLD.drawn("viscous friction", rng)
        self.dry = WORLD.drawn("dry friction", rng)
        start = np.array(HOME) + 0.1 * rng.standard_normal(JOINTS)
        self.data.qpos[:] = start
        self._row, self._leave, self._arrive = 0, 0, 0
        self._from = self._to = start
        self._move_way()
        return self._observation(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold torques, N m, for a row."""
        torque = np.clip(action.astype(np.float64), -self._torque, self._torque) * self.motor
        torque += self._ripple * self.np_random.standard_normal(JOINTS)
        model, data, velocity = self.model, self.data, self.data.qvel
        applied = data.qfrc_applied
        for _ in range(SUBSTEPS):
            applied[:] = torque - self.viscous * velocity - self.dry * np.tanh(velocity / MOTION)
            mujoco.mj_step(model, data)
        self._row += 1
        self._move_way()
        error = float(np.abs(data.qpos - self._way[0]).sum())
        reward = max(0.0, 1.0 - error / WORLD.value("error of no reward"))
        return self._observation(), reward, False, False, {}

    def _move_way(self) -> None:
        """Move the way along a minimum-jerk path, and draw the next way point at its end."""
        if self._row >= self._arrive:
            self._from, self._leave = self._to, self._row
            self._arrive = self._row + int(self.np_random.integers(*HOLD))
            self._to = np.array(HOME) + self.np_random.uniform(-1, 1, JOINTS) * REACH
        rows = self._arrive - self._leave
        s, change = (self._row - self._leave) / rows, self._to - self._from
        seconds = rows * _PERIOD
        self._way = (
            self._from + s**3 * (10 - 15 * s + 6 * s**2) * change,
            30 * (s * (1 - s)) ** 2 / seconds * change,
            60 * s * (1 - s) * (1 - 2 * s) / seconds**2 * change,
        )

    def _observation(self) -> NDArray[np.float32]:
        return np.concatenate([self.data.qpos, self.data.qvel, *self._way]).astype(np.float32)


class ComputedTorque:
    """The controller: the nominal arm's inverse dynamics, and a pull towards the way."""

    def __init__(self) -> None:
        self._model = nominal_model()
        self._data = mujoco.MjData(self._model)
        self._viscous = WORLD.value("viscous friction")
        self._dry = WORLD.value("dry friction")
        self._torque = WORLD.value("highest torque")

    def __call__(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the torques for a row, N m."""
        angle, velocity, way, way_velocity, way_acceleration = row.astype(np.float64).reshape(5, 6)
        rate = WORLD.value("bandwidth")
        pull = rate**2 * (way - angle) + 2 * rate * (way_velocity - velocity)
        data = self._data
        data.qpos[:], data.qvel[:] = angle, velocity
        data.qacc[:] = way_acceleration + pull
        mujoco.mj_inverse(self._model, data)
        friction = self._viscous * velocity + self._dry * np.tanh(way_velocity / MOTION)
        torque = data.qfrc_inverse + friction
        return np.asarray(np.clip(torque, -self._torque, self._torque), np.float32)
