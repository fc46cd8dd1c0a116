"""A quadrotor that follows way points in wind: the Hummingbird of RotorS, in MuJoCo.

Rotor i gives the thrust k_i w_i² and the torque ± c k_i w_i² about its axis; its speed w_i follows
the commanded one with a lag. Rotors 1 and 3 lie on the body's x axis, 2 and 4 on its y axis. Each
rotor drags against the air with w_i d v, v the velocity of the air across its axis.
"""

import functools
import math
from typing import Any, Final

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from oodd_worlds.facts import read_world

WORLD: Final = read_world("drone")
ROWS: Final = 400
SUBSTEPS: Final = 10
HOLD: Final = (100, 200)  # rows from a way point to the next
REACH: Final = (1.0, 1.0, 0.4)  # m, of way points from the middle
MIDDLE: Final = (0.0, 0.0, 2.0)
SPINS: Final = (1.0, -1.0, 1.0, -1.0)  # signs of the torque about the body's z axis

_MASS: Final = WORLD.value("mass")
_GRAVITY: Final = WORLD.value("gravity")
_ARM: Final = WORLD.value("arm")
_TORQUE: Final = WORLD.value("torque")
_HIGHEST: Final = WORLD.value("highest rotor speed")
_PERIOD: Final = WORLD.value("period")
_THRUST: Final = float(WORLD.value("thrust")[0])
_INERTIA: Final[tuple[float, ...]] = tuple(WORLD.value("inertia").tolist())
_LAGS: Final[tuple[float, ...]] = tuple(WORLD.value("rotor lag").tolist())
_DRAG: Final = WORLD.value("rotor drag")


@functools.cache
def model_xml() -> str:
    """Return the model in MuJoCo's language: one free body of the published mass and inertia."""
    inertia = " ".join(map(str, _INERTIA))
    return f"""
    <mujoco>
      <option timestep="{_PERIOD / SUBSTEPS}" gravity="0 0 {-_GRAVITY}" integrator="Euler"/>
      <worldbody>
        <body name="drone" pos="0 0 2"><freejoint/>
          <inertial pos="0 0 0" mass="{_MASS}" diaginertia="{inertia}"/>
        </body>
      </worldbody>
    </mujoco>"""


class Drone(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The quadrotor as an environment: position, velocity, attitude, rates; speeds of rotors.

    Attributes
    ----------
    thrust
        N s², of each rotor in this episode.
    wind
        Mean velocity of the air in x and y, m/s.
    """

    def __init__(self) -> None:
        high = np.full(len(WORLD.sensors), np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        self.action_space = gymnasium.spaces.Box(np.float32(0), np.float32(_HIGHEST), (4,))
        self.model = mujoco.MjModel.from_xml_string(model_xml())
        self.data = mujoco.MjData(self.model)
        self.thrust = [_THRUST] * 4
        self.wind = [0.0, 0.0]
        self.speed = [hover_speed()] * 4

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode at hover near the middle."""
        super().reset(seed=seed)
        rng = self.np_random
        mujoco.mj_resetData(self.model, self.data)
        self.model.body_mass[1] = WORLD.drawn("mass", rng)
        self.thrust = WORLD.drawn("thrust", rng).tolist()
        strength, angle = WORLD.drawn("wind", rng), rng.uniform(0, 2 * math.pi)
        self.wind = [strength * math.cos(angle), strength * math.sin(angle)]
        self._gust = [0.0, 0.0]
        self.speed = [hover_speed()] * 4
        start = np.array(MIDDLE) + 0.1 * rng.standard_normal(3)
        self.data.qpos[:3] = start
        self._row, self._from, self._way = 0, start.tolist(), start.tolist()
        self._leave, self._arrive, self._to = 0, 0, start.tolist()
        self._way_velocity = [0.0] * 3
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold commanded rotor speeds, rad/s, for a row."""
        command = [min(max(float(w), 0.0), _HIGHEST) for w in action]
        self._blow()
        self.fly(command, (self.wind[0] + self._gust[0], self.wind[1] + self._gust[1]))
        self._row += 1
        self._move_way()
        data = self.data
        position = data.qpos[:3].tolist()
        error = math.dist(position, self._way)
        reward = max(0.0, 1.0 - error / WORLD.value("error of no reward"))
        up_z = 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)
        crashed = bool(error > WORLD.value("error of a crash") or up_z < 0)
        return self._observation(), reward, crashed, False, {}

    def fly(self, command: list[float], air: tuple[float, float]) -> None:
        """Move for a row in air of a velocity in x and y, m/s."""
        up, down = (1 - math.exp(-_PERIOD / SUBSTEPS / lag) for lag in _LAGS)
        model, data = self.model, self.data
        speed, force = self.speed, data.xfrc_applied[1]
        for _ in range(SUBSTEPS):
            towards = zip(speed, command, strict=True)
            speed = [w + (up if c > w else down) * (c - w) for w, c in towards]
            attitude, velocity = data.qpos[3:].tolist(), data.qvel[:3].tolist()
            force[:] = wrench(speed, self.thrust, attitude, velocity, air)
            mujoco.mj_step(model, data)
        self.speed = speed

    def _blow(self) -> None:
        """Let the gust go on: an Ornstein-Uhlenbeck process in x and y."""
        keep = math.exp(-_PERIOD / WORLD.value("gust time"))
        fresh = WORLD.value("gust") * math.sqrt(1 - keep**2) * self.np_random.standard_normal(2)
        self._gust = [keep * g + float(f) for g, f in zip(self._gust, fresh, strict=True)]

    def _move_way(self) -> None:
        """Move the way along a minimum-jerk path to a way point, and draw the next one there."""
        if self._row >= self._arrive:
            self._from, self._leave = self._to, self._row
            self._arrive = self._row + int(self.np_random.integers(*HOLD))
            drawn = self.np_random.uniform(-1, 1, 3) * REACH + MIDDLE
            self._to = drawn.tolist()
        share = (self._row - self._leave) / (self._arrive - self._leave)
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        rate = 30 * (share * (1 - share)) ** 2 / ((self._arrive - self._leave) * _PERIOD)
        ends = [*zip(self._from, self._to, strict=True)]
        self._way = [a + smooth * (b - a) for a, b in ends]
        self._way_velocity = [rate * (b - a) for a, b in ends]

    def _observation(self) -> NDArray[np.float32]:
        qpos, qvel = self.data.qpos.tolist(), self.data.qvel.tolist()
        state = (*qpos[:3], *qvel[:3], *euler(qpos[3:]), *qvel[3:])
        return np.array([*state, *self._way, *self._way_velocity], np.float32)


def hover_speed() -> float:
    """Return the rotor speed in rad/s at which the nominal thrust is the nominal weight."""
    return math.sqrt(_MASS * _GRAVITY / (4 * _THRUST))


def euler(q: list[float]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw in rad of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotation(q: list[float]) -> tuple[tuple[float, float, float], ...]:
    """Return the rotation matrix of a unit quaternion: rows of body to world."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def wrench(
    speed: list[float],
    thrust: list[float],
    quaternion: list[float],
    velocity: list[float],
    air: tuple[float, float],
) -> tuple[float, float, float, float, float, float]:
    """Return force in N and torque in N m on the body, both in the world's axes."""
    f1, f2, f3, f4 = (k * w * w for k, w in zip(thrust, speed, strict=True))
    total, drag = f1 + f2 + f3 + f4, _DRAG * sum(speed)
    tx, ty = _ARM * (f2 - f4), _ARM * (f3 - f1)
    tz = _TORQUE * sum(s * f for s, f in zip(SPINS, (f1, f2, f3, f4), strict=True))
    r = rotation(quaternion)
    vx, vy, vz = velocity[0] - air[0], velocity[1] - air[1], velocity[2]
    along = r[0][2] * vx + r[1][2] * vy + r[2][2] * vz
    return (
        total * r[0][2] - drag * (vx - along * r[0][2]),
        total * r[1][2] - drag * (vy - along * r[1][2]),
        total * r[2][2] - drag * (vz - along * r[2][2]),
        r[0][0] * tx + r[0][1] * ty + r[0][2] * tz,
        r[1][0] * tx + r[1][1] * ty + r[1][2] * tz,
        r[2][0] * tx + r[2][1] * ty + r[2][2] * tz,
    )


def control(row: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return rotor speeds for a row: the geometric controller of Lee, Leok and McClamroch (2010).

    It holds yaw at 0, and assumes the nominal mass and rotors, and still air.
    """
    x = row.tolist()
    p, a = WORLD.value("position rate"), WORLD.value("attitude rate")
    force = [
        _MASS * (p * p * (x[12 + i] - x[i]) + 2 * p * (x[15 + i] - x[3 + i])) for i in range(3)
    ]
    force[2] += _MASS * _GRAVITY
    r = rotation(quaternion_of(*x[6:9]))
    total = sum(force[i] * r[i][2] for i in range(3))
    norm = math.hypot(*force) or 1.0
    b3 = [f / norm for f in force]
    b2 = _unit((0.0, b3[2], -b3[1]))  # across b3 and the x axis
    b1 = (
        b2[1] * b3[2] - b2[2] * b3[1],
        b2[2] * b3[0] - b2[0] * b3[2],
        b2[0] * b3[1] - b2[1] * b3[0],
    )
    axes = tuple(zip(b1, b2, b3, strict=True))  # columns are the axes
    error = [
        0.5 * sum(axes[k][i] * r[k][j] - r[k][i] * axes[k][j] for k in range(3))
        for i, j in ((2, 1), (0, 2), (1, 0))
    ]
    w = x[9:12]
    torque = [-_INERTIA[i] * (a * a * error[i] + 2 * a * w[i]) for i in range(3)]
    torque[0] += w[1] * w[2] * (_INERTIA[2] - _INERTIA[1])
    torque[1] += w[2] * w[0] * (_INERTIA[0] - _INERTIA[2])
    quarter, roll, pitch = total / 4, torque[0] / (2 * _ARM), torque[1] / (2 * _ARM)
    yaw = torque[2] / (4 * _TORQUE)
    thrusts = (
        quarter - pitch + yaw,
        quarter + roll - yaw,
        quarter + pitch + yaw,
        quarter - roll - yaw,
    )
    speeds = [min(math.sqrt(max(f, 0.0) / _THRUST), _HIGHEST) for f in thrusts]
    return np.array(speeds, np.float32)


def quaternion_of(roll: float, pitch: float, yaw: float) -> list[float]:
    """Return the unit quaternion (w, x, y, z) of angles in rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def _unit(v: tuple[float, float, float]) -> tuple[float, float, float]:
    norm = math.hypot(*v) or 1.0
    return v[0] / norm, v[1] / norm, v[2] / norm
