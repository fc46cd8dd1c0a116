"""The seven simulators behind one small interface.

A simulator is used for one episode: PyBullet's client and Box2D's world keep hidden state that
makes later episodes differ from first ones with the same seed.
"""

import ctypes
import functools
import inspect
import math
import os
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.files import redirected
from oodd_eval.data.registry import EnvironmentSpec, environment_spec
from oodd_eval.errors import MissingExtraError


@contextmanager
def quiet_streams() -> Iterator[None]:
    """Send file descriptors 1 and 2 to the null device: PyBullet prints from C, past Python."""
    with Path(os.devnull).open("wb") as null, redirected(null):
        try:
            yield
        finally:
            # C has buffers of its own: their content has to go while the null device is in place.
            ctypes.CDLL(None).fflush(None)


try:
    # Box2D's C module warns while it is imported, and crashes where warnings are errors.
    with quiet_streams(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pybullet
        import pybullet_envs_gymnasium.gym_locomotion_envs as bullet
        from gymnasium.envs.box2d import lunar_lander
        from gymnasium.envs.classic_control.acrobot import AcrobotEnv
        from gymnasium.envs.classic_control.cartpole import CartPoleEnv
except ImportError as error:  # a clear way out for those who only installed the core
    raise MissingExtraError(
        f"recording needs the simulators ({error}): pip install 'oodd-eval[sim]'"
    ) from error

Row = NDArray[np.float32]


class Simulator:
    """One episode of one environment.

    `wind` is the direction of its pushes, -1, 0 or +1, where actions are discrete; elsewhere it is
    added to every command. `environment` is its name.
    """

    environment = ""
    names: ClassVar[Mapping[str, str]] = {}
    """The environment's names of attributes that it calls otherwise."""

    def __init__(self, env: Any) -> None:
        self.env, self.wind = env, 0.0
        self.gain, self.bias = 1.0, 0.0  # of the actuators, where actions are discrete
        self._nominal: dict[str, float] = {}

    def reset(self, seed: int) -> Row:
        """Start the episode; return the observation of shape (D,)."""
        return np.asarray(self.env.reset(seed=seed)[0], dtype=np.float32)

    def step(self, action: Any) -> tuple[Row, float, bool]:
        """Advance by one commanded action; return observation, reward and True at the end."""
        row, reward, over, _, _ = self.env.step(self.command(action))
        return np.asarray(row, dtype=np.float32), float(reward), bool(over)

    def command(self, action: Any) -> Any:
        """Return what the environment is given for an action in the present wind."""
        return action

    def set(self, attribute: str, value: float) -> None:
        """Change an attribute of the dynamics from the next step on."""
        setattr(self.env, self.names.get(attribute, attribute), value)

    def get(self, attribute: str) -> float:
        """Read an attribute back from where the simulator itself reads it."""
        return float(getattr(self.env, self.names.get(attribute, attribute)))

    def nominal(self, attribute: str) -> float:
        """Return the value that an attribute had when it was first asked for."""
        return self._nominal.setdefault(attribute, self.get(attribute))

    def scale(self, attribute: str, factor: float) -> None:
        """Make an attribute a multiple of its nominal value, if it is not so already."""
        value = self.nominal(attribute) * factor
        if self.get(attribute) != value:
            self.set(attribute, value)

    def restore(self) -> None:
        """Put the wind, and all attributes that were scaled, back."""
        self.wind = 0.0
        for attribute in self._nominal:
            self.scale(attribute, 1.0)

    def close(self) -> None:
        """Release what the simulator holds."""
        self.env.close()


class _Acrobot(AcrobotEnv):
    """Acrobot whose gravity can be changed: the stock equations hold it as a local constant.

    They stay in force until then; after, the same pendulum is solved from its mass matrix, with
    `friction` in both joints, in 1/s.
    """

    gravity, friction = 9.8, 0.0

    def _dsdt(self, s_augmented: Any) -> Any:
        if (self.gravity, self.friction) == (_Acrobot.gravity, _Acrobot.friction):
            return super()._dsdt(s_augmented)  # type: ignore[no-untyped-call]
        return self.derivative(s_augmented)

    def derivative(self, state: Any) -> tuple[float, float, float, float, float]:
        """Solve Lagrange's equations M(theta2) dω + c(theta, ω) = (0, torque) for (ω, dω, 0)."""
        theta1, theta2, omega1, omega2, torque = state
        m1, m2, l1 = self.LINK_MASS_1, self.LINK_MASS_2, self.LINK_LENGTH_1
        lc1, lc2, inertia, g = self.LINK_COM_POS_1, self.LINK_COM_POS_2, self.LINK_MOI, self.gravity
        coupling = m2 * l1 * lc2
        m22 = m2 * lc2**2 + inertia
        m12 = m22 + coupling * math.cos(theta2)
        m11 = m1 * lc1**2 + inertia + m2 * l1**2 + m12 + coupling * math.cos(theta2)
        # cos(angle - pi/2) = sin(angle): angles are measured from the downward vertical.
        weight2 = m2 * lc2 * g * math.sin(theta1 + theta2)
        weight1 = (m1 * lc1 + m2 * l1) * g * math.sin(theta1) + weight2
        swirl = coupling * math.sin(theta2)
        c1 = weight1 - swirl * omega2 * (omega2 + 2 * omega1)
        c2 = weight2 + swirl * omega1**2
        determinant = m11 * m22 - m12**2
        acceleration1 = (-c1 * m22 - m12 * (torque - c2)) / determinant
        acceleration2 = (m11 * (torque - c2) + m12 * c1) / determinant
        drag1, drag2 = self.friction * omega1, self.friction * omega2
        return omega1, omega2, acceleration1 - drag1, acceleration2 - drag2, 0.0


class Acrobot(Simulator):
    """Acrobot-v1: torque on the joint between two links; wind adds torque of its own sign."""

    names: ClassVar = {
        f"link_{w}_{i}": f"LINK_{w.upper()}_{i}" for w in ("mass", "length") for i in "12"
    }

    def __init__(self) -> None:
        super().__init__(_Acrobot())

    def command(self, action: int) -> int:
        # Per instance: action 0 is torque -1, action 2 is torque +1.
        torques = {0: [-1.0, 0.0, 1.0], 1: [0.0, 0.0, 2.0], -1: [-2.0, 0.0, 0.0]}
        self.env.AVAIL_TORQUE = [self.gain * t + self.bias for t in torques[int(self.wind)]]
        return int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute in {"gain", "bias"}:
            setattr(self, attribute, value)
        elif attribute == "body_mass":  # both links weigh the same
            self.env.LINK_MASS_1 = self.env.LINK_MASS_2 = value / 2
        else:
            super().set(attribute, value)
        if attribute.startswith("link_length_"):  # the centre of mass follows
            setattr(self.env, f"LINK_COM_POS_{attribute[-1]}", value / 2)

    def get(self, attribute: str) -> float:
        if attribute in {"gain", "bias"}:
            return float(getattr(self, attribute))
        if attribute == "body_mass":
            return float(self.env.LINK_MASS_1 + self.env.LINK_MASS_2)
        if attribute.startswith("link_length_"):
            return 2 * float(getattr(self.env, f"LINK_COM_POS_{attribute[-1]}"))
        return super().get(attribute)


class CartPole(Simulator):
    """CartPole-v1: a push of 10 N to the left or right; wind takes pushes away or doubles them."""

    names: ClassVar = {"pole_length": "length", "pole_mass": "masspole", "body_mass": "masscart"}

    def __init__(self) -> None:
        super().__init__(CartPoleEnv())
        self._force, self._friction = self.env.force_mag, 0.0

    def command(self, action: int) -> int:
        direction = 1 if action == 1 else -1
        force = self._force * (1 + self.wind * direction) * self.gain
        # The environment gives the force the direction of the action.
        push = self._force * self.bias - self._friction * float(self.env.state[1])
        self.env.force_mag = force + direction * push
        return int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute in {"gain", "bias"}:
            setattr(self, attribute, value)
            return
        if attribute == "friction":  # of the track, in N s/m
            self._friction = value
            return
        super().set(attribute, value)
        env = self.env  # computes two quantities once
        env.total_mass = env.masspole + env.masscart
        env.polemass_length = env.masspole * env.length

    def get(self, attribute: str) -> float:
        if attribute in {"gain", "bias"}:
            return float(getattr(self, attribute))
        if attribute == "friction":
            return self._friction
        if attribute == "pole_length":
            return float(self.env.polemass_length / self.env.masspole)
        if attribute == "pole_mass":
            return float(self.env.total_mass - self.env.masscart)
        return super().get(attribute)


class LunarLander(Simulator):
    """LunarLander-v3: engines 1 and 3 push to -x and +x; wind doubles one and stops the other."""

    def __init__(self) -> None:
        super().__init__(lunar_lander.LunarLander())
        # Engine powers are globals of the module: this instance's step gets a copy of its own.
        self._globals = dict(vars(lunar_lander))
        step = lunar_lander.LunarLander.step
        own_step = types.FunctionType(step.__code__, self._globals, closure=step.__closure__)
        setattr(self.env, "step", types.MethodType(own_step, self.env))  # noqa: B010  # for mypy
        self._side_power = self._nominal_side = float(self._globals["SIDE_ENGINE_POWER"])

    def command(self, action: int) -> int:
        push = {1: -1, 3: 1}.get(int(action), 0)
        self._globals["SIDE_ENGINE_POWER"] = self._side_power * (2 if push * self.wind > 0 else 1)
        if self.bias:
            lander = self.env.lander
            side = self._nominal_side * self.bias
            lander.ApplyLinearImpulse((side, 0.0), lander.worldCenter, True)
        return 0 if push * self.wind < 0 else int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute == "gravity":
            # The environment reads its gravity at reset only; the world's acts at once.
            self.env.world.gravity = (0.0, -value)
            return
        if attribute == "bias":  # in pushes of a side engine
            self.bias = value
            return
        if attribute == "body_mass":
            data, lander = self.env.lander.massData, self.env.lander
            data.I, data.mass = data.I * value / data.mass, value
            lander.massData = data
            return
        if attribute == "friction":
            for fixture in self.env.moon.fixtures[1:]:  # the first one lies below the ground
                fixture.friction = value
            return
        self._globals[attribute.upper()] = value
        self._side_power = value if attribute == "side_engine_power" else self._side_power

    def get(self, attribute: str) -> float:
        if attribute == "gravity":
            return -float(self.env.world.gravity[1])
        if attribute == "bias":
            return self.bias
        if attribute == "body_mass":
            return float(self.env.lander.mass)
        if attribute == "friction":
            return float(self.env.moon.fixtures[1].friction)
        return float(self._globals[attribute.upper()])


_FUNCTIONS = {
    name: function
    for name, function in vars(pybullet).items()
    if inspect.isbuiltin(function) and name != "disconnect"  # the client keeps track of this one
}


class Bullet(Simulator):
    """One of the four PyBullet robots in a client of its own; wind adds to every motor command."""

    def __init__(self, make_env: Callable[[], Any]) -> None:
        super().__init__(make_env())

    def reset(self, seed: int) -> Row:
        with quiet_streams():
            row = super().reset(seed)
        # The client binds a function to itself whenever one is called, some twenty times a step.
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        for name, function in _FUNCTIONS.items():
            setattr(client, name, functools.partial(function, physicsClientId=client._client))  # noqa: SLF001
        return row

    def command(self, action: Row) -> Row:
        return np.clip(action + np.float32(self.wind), -1, 1) if self.wind else action

    def set(self, attribute: str, value: float) -> None:
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        if attribute == "gravity":
            client.setGravity(0, 0, -value)
        elif attribute == "body_mass":
            client.changeDynamics(*self._torso(), mass=value)
        elif attribute == "friction":
            for body in self.env.stadium_scene.ground_plane_mjcf:
                client.changeDynamics(body, -1, lateralFriction=value)
        else:
            self.env.robot.power = value

    def get(self, attribute: str) -> float:
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        if attribute == "gravity":
            return -float(client.getPhysicsEngineParameters()["gravityAccelerationZ"])
        if attribute == "body_mass":
            return float(client.getDynamicsInfo(*self._torso())[0])
        if attribute == "friction":
            ground = self.env.stadium_scene.ground_plane_mjcf[0]
            return float(client.getDynamicsInfo(ground, -1)[1])
        return float(self.env.robot.power)

    def _torso(self) -> tuple[int, int]:
        part = self.env.robot.parts["torso"]
        return part.bodies[part.bodyIndex], part.bodyPartIndex

    def close(self) -> None:
        with quiet_streams():
            super().close()


class Custom(Simulator):
    """A plug-in's environment; wind adds to every command of continuous actions."""

    def __init__(self, env: Any, spec: EnvironmentSpec) -> None:
        super().__init__(env)
        self._attributes = spec.attributes

    def command(self, action: Any) -> Any:
        return np.clip(action + np.float32(self.wind), -1, 1) if self.wind else action

    def set(self, attribute: str, value: float) -> None:
        self._attributes[attribute].set(self.env, value)

    def get(self, attribute: str) -> float:
        return float(self._attributes[attribute].get(self.env))


def make(environment: str) -> Simulator:
    """Return a fresh simulator of an environment, to be used for one episode and closed."""
    spec = environment_spec(environment)
    env = spec.make()
    simulator = env if isinstance(env, Simulator) else Custom(env, spec)
    simulator.environment = environment
    return simulator


SIMULATORS: Final[Mapping[str, Callable[[], Simulator]]] = {
    "acrobot": Acrobot,
    "cartpole": CartPole,
    "lunarlander": LunarLander,
    "ant": functools.partial(Bullet, bullet.AntBulletEnv),
    "halfcheetah": functools.partial(Bullet, bullet.HalfCheetahBulletEnv),
    "hopper": functools.partial(Bullet, bullet.HopperBulletEnv),
    "walker2d": functools.partial(Bullet, bullet.Walker2DBulletEnv),
}
"""Simulators of the benchmark by environment."""
