"""The seven simulators behind one small interface.

A simulator is used for one episode: `make` gives a fresh one each time, because PyBullet's client
and Box2D's world keep hidden state that makes later episodes differ from first ones with the same
seed. Attributes that anomalies change (gravity, link lengths, motor power) are reached through
`Simulator.set` and read back from the simulator itself through `Simulator.get`.
"""

from __future__ import annotations

import functools
import inspect
import math
import types
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.simulate.quiet import quiet_streams
from oodd_eval.errors import MissingExtraError, SimulationError, UnknownNameError

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
        f"recording trajectories needs the simulators ({error}): "
        "install them with pip install 'oodd-eval[sim]'"
    ) from error

Row = NDArray[np.float32]


class Simulator(Protocol):
    """One episode of one environment.

    ``wind`` is read every step: -1, 0 or +1, the direction into which a gust pushes in this step.
    """

    wind: int

    def reset(self, seed: int) -> Row:
        """Start the episode; return the observation of shape (D,)."""
        ...

    def step(self, action: Any) -> tuple[Row, float, bool]:
        """Advance by one commanded action: next observation, reward, whether the episode ended."""
        ...

    def set(self, attribute: str, value: float) -> None:
        """Change an attribute of the dynamics from the next step on."""
        ...

    def get(self, attribute: str) -> float:
        """Read an attribute back from where the simulator itself reads it."""
        ...

    def close(self) -> None:
        """Release what the simulator holds."""
        ...


class _Acrobot(AcrobotEnv):
    """Acrobot whose gravity can be changed.

    The stock equations hold gravity as a local constant. They stay in force until gravity is
    changed; then the same double pendulum is solved from its mass matrix.
    """

    gravity = 9.8

    def _dsdt(self, s_augmented: Any) -> Any:
        if self.gravity == _Acrobot.gravity:
            return super()._dsdt(s_augmented)  # type: ignore[no-untyped-call]
        return self.derivative(s_augmented)

    def derivative(self, state: Any) -> tuple[float, float, float, float, float]:
        """Time derivative of (theta1, theta2, omega1, omega2, torque) at ``self.gravity``.

        Lagrange's equations M(theta2) dω + c(theta, ω) = (0, torque), solved as a 2 x 2 system.
        """
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
        return omega1, omega2, acceleration1, acceleration2, 0.0


class Acrobot:
    """Acrobot-v1: torque on the joint between two links; wind adds torque of its own sign."""

    def __init__(self) -> None:
        self.env: Any = _Acrobot()
        self.wind = 0

    def reset(self, seed: int) -> Row:
        return np.asarray(self.env.reset(seed=seed)[0], dtype=np.float32)

    def step(self, action: int) -> tuple[Row, float, bool]:
        # Per instance: action 0 is torque -1, action 2 is torque +1.
        self.env.AVAIL_TORQUE = {0: [-1.0, 0.0, 1.0], 1: [0.0, 0.0, 2.0], -1: [-2.0, 0.0, 0.0]}[
            self.wind
        ]
        row, reward, over, _, _ = self.env.step(int(action))
        return row, float(reward), bool(over)

    def set(self, attribute: str, value: float) -> None:
        if attribute == "gravity":
            self.env.gravity = value
        elif attribute.startswith("link_length_"):
            link = attribute[-1]
            # Only link 1's length enters the equations; both centres of mass follow their length.
            setattr(self.env, f"LINK_LENGTH_{link}", value)
            setattr(self.env, f"LINK_COM_POS_{link}", value / 2)
        else:
            setattr(self.env, attribute.upper(), value)

    def get(self, attribute: str) -> float:
        if attribute.startswith("link_length_"):
            return 2 * float(getattr(self.env, f"LINK_COM_POS_{attribute[-1]}"))
        return float(getattr(self.env, attribute if attribute == "gravity" else attribute.upper()))

    def close(self) -> None:
        self.env.close()


class CartPole:
    """CartPole-v1: a push of 10 N to the left or right; wind takes pushes away or doubles them."""

    def __init__(self) -> None:
        self.env: Any = CartPoleEnv()
        self.wind = 0
        self._force = self.env.force_mag

    def reset(self, seed: int) -> Row:
        return np.asarray(self.env.reset(seed=seed)[0], dtype=np.float32)

    def step(self, action: int) -> tuple[Row, float, bool]:
        direction = 1 if action == 1 else -1
        # Against the wind: no force; with it: one unit more.
        self.env.force_mag = self._force * (1 + self.wind * direction)
        row, reward, over, _, _ = self.env.step(int(action))
        return row, float(reward), bool(over)

    def set(self, attribute: str, value: float) -> None:
        env = self.env
        setattr(
            env, {"pole_length": "length", "pole_mass": "masspole"}.get(attribute, attribute), value
        )
        # Two derived quantities that the simulator computes once.
        env.total_mass = env.masspole + env.masscart
        env.polemass_length = env.masspole * env.length

    def get(self, attribute: str) -> float:
        if attribute == "pole_length":
            return float(self.env.polemass_length / self.env.masspole)
        if attribute == "pole_mass":
            return float(self.env.total_mass - self.env.masscart)
        return float(self.env.gravity)

    def close(self) -> None:
        self.env.close()


class LunarLander:
    """LunarLander-v3: engine 1 pushes to -x, engine 3 to +x, engine 2 upwards."""

    def __init__(self) -> None:
        self.env: Any = lunar_lander.LunarLander()
        self.wind = 0
        # Engine powers are globals of the simulator's module. This instance's step gets a copy of
        # these globals, so that a changed power is seen by this episode alone.
        self._globals = dict(vars(lunar_lander))
        step = lunar_lander.LunarLander.step
        own_step = types.FunctionType(
            step.__code__, self._globals, step.__name__, step.__defaults__, step.__closure__
        )
        setattr(self.env, "step", types.MethodType(own_step, self.env))  # noqa: B010  # for mypy
        self._side_power = float(self._globals["SIDE_ENGINE_POWER"])

    def reset(self, seed: int) -> Row:
        return np.asarray(self.env.reset(seed=seed)[0], dtype=np.float32)

    def step(self, action: int) -> tuple[Row, float, bool]:
        push = {1: -1, 3: 1}.get(int(action), 0)
        # Against the wind: no engine; with it: the side engine doubled.
        effective = 0 if push * self.wind < 0 else int(action)
        self._globals["SIDE_ENGINE_POWER"] = self._side_power * (2 if push * self.wind > 0 else 1)
        row, reward, over, _, _ = self.env.step(effective)
        return np.asarray(row, dtype=np.float32), float(reward), bool(over)

    def set(self, attribute: str, value: float) -> None:
        if attribute == "gravity":
            # The environment reads its gravity at reset only; the world's acts at once.
            self.env.world.gravity = (0.0, -value)
        elif attribute == "side_engine_power":
            self._side_power = value
            self._globals["SIDE_ENGINE_POWER"] = value
        else:
            self._globals["MAIN_ENGINE_POWER"] = value

    def get(self, attribute: str) -> float:
        if attribute == "gravity":
            return -float(self.env.world.gravity[1])
        return float(self._globals[attribute.upper()])

    def close(self) -> None:
        self.env.close()


_FUNCTIONS = {
    name: function
    for name, function in vars(pybullet).items()
    if inspect.isbuiltin(function) and name != "disconnect"  # the client keeps track of this one
}


class Bullet:
    """One of the four PyBullet robots in a client of its own; wind adds to every motor command."""

    wind_strength: ClassVar[float] = 0.33

    def __init__(self, kind: type) -> None:
        self.env: Any = kind()
        self.wind = 0

    def reset(self, seed: int) -> Row:
        with quiet_streams():
            row = np.asarray(self.env.reset(seed=seed)[0], dtype=np.float32)
        # The client binds a function to itself whenever one is called, some twenty times a step.
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        for name, function in _FUNCTIONS.items():
            setattr(client, name, functools.partial(function, physicsClientId=client._client))  # noqa: SLF001
        return row

    def step(self, action: NDArray[np.float32]) -> tuple[Row, float, bool]:
        if self.wind:
            action = np.clip(action + np.float32(self.wind * self.wind_strength), -1, 1)
        row, reward, over, _, _ = self.env.step(action)
        return np.asarray(row, dtype=np.float32), float(reward), bool(over)

    def set(self, attribute: str, value: float) -> None:
        if attribute == "gravity":
            # Acts on all further steps of this client, which ends with the episode.
            self.env._p.setGravity(0, 0, -value)  # noqa: SLF001  # the simulator's only handle
        else:
            self.env.robot.power = value

    def get(self, attribute: str) -> float:
        if attribute == "gravity":
            parameters = self.env._p.getPhysicsEngineParameters()  # noqa: SLF001
            return -float(parameters["gravityAccelerationZ"])
        return float(self.env.robot.power)

    def close(self) -> None:
        with quiet_streams():
            self.env.close()


_BULLET = {
    "ant": bullet.AntBulletEnv,
    "halfcheetah": bullet.HalfCheetahBulletEnv,
    "hopper": bullet.HopperBulletEnv,
    "walker2d": bullet.Walker2DBulletEnv,
}
_CLASSIC: dict[str, Callable[[], Simulator]] = {
    "acrobot": Acrobot,
    "cartpole": CartPole,
    "lunarlander": LunarLander,
}


def make(environment: str) -> Simulator:
    """Return a fresh simulator of an environment, to be used for one episode and closed.

    Raises
    ------
    UnknownNameError
        For a name that is not in `oodd_eval.data.facts.ENVIRONMENTS`.
    """
    if environment in _BULLET:
        return Bullet(_BULLET[environment])
    if environment in _CLASSIC:
        return _CLASSIC[environment]()
    raise UnknownNameError("environment", environment, ENVIRONMENTS)


def check_observation(environment: str, row: Row) -> None:
    """Raise `SimulationError` unless the simulator gives what the benchmark's table says."""
    expected = ENVIRONMENTS[environment].observation_dim
    if row.shape != (expected,):
        raise SimulationError(
            f"{environment}'s simulator gave an observation of shape {row.shape}, expected "
            f"({expected},): another version of the simulator is installed than the benchmark's"
        )
