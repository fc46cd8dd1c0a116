"""The oracle: a Kalman filter that has a world's equations, but not what an episode has drawn.

The episode's parameters are part of the state, with their nominal spread as the prior. Innovations
are white and of unit variance in nominal operation, and a fault moves their mean or their size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Smoother
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_worlds.facts import read_world

Floats = NDArray[np.float64]

WEIGHTS: Final = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Weights of the newest innovation in the charts."""

CLIP: Final = 4.0
"""Standard deviations of an innovation that the state follows at most."""

JUMP: Final = 100.0
"""Standard deviations of an innovation from which on measured quantities begin anew at the row."""

LIMIT: Final = 30.0
"""Standard deviations of an innovation that count in the charts at most."""


class Model(Protocol):
    """The equations of a world.

    Attributes
    ----------
    measured
        Number of measured sensors: the first ones of a row, and of the state.
    parameters
        Columns of the state that an episode keeps.
    """

    measured: int
    parameters: slice

    def start(self, row: Floats) -> tuple[Floats, Floats]:
        """Return mean and variances of the state, both (N,), after an episode's first row."""

    def step(self, mean: Floats, action: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the state after an action, (N,), and two matrices (N, N).

        They are its derivative by the state before, and the covariance of what is drawn in the row.
        """

    def drawn(self, env: Any) -> Floats:
        """Return the parameters of an environment's episode as the state has them."""


class TankModel:
    """The tanks: levels and the pumps' voltages; gains and orifices relative to the nominal."""

    measured, parameters = 4, slice(6, 12)

    def __init__(self) -> None:
        from oodd_worlds.tank import Tank  # noqa: PLC0415  of an extra

        self._facts, self._env = read_world("tank"), Tank()
        value = self._facts.value
        self._gain, self._orifice = value("pump gain"), value("orifice")
        s1, s2 = value("split")
        area = value("area")[:, None]
        into = np.array([[s1, 0], [0, s2], [0, 1 - s2], [1 - s1, 0]])
        self._of_pumps, self._of_drains = into / area, (np.eye(4, k=2) - np.eye(4)) / area

    def start(self, row: Floats) -> tuple[Floats, Floats]:
        """Begin at the measured levels, near 3 V."""
        facts = self._facts
        spreads = [facts.facts[name].spread for name in ("pump gain", "orifice")]
        variances = np.repeat(np.square([0.0, 0.2, *spreads]), (4, 2, 2, 4))
        variances[:4] = facts.noise()[:4] ** 2
        return np.concatenate([row[:4], [3.0, 3.0], np.zeros(6)]), variances

    def step(self, mean: Floats, action: Floats) -> tuple[Floats, Floats, Floats]:
        """Integrate as the world does; the derivative is that of the equations in between."""
        env, value = self._env, self._facts.value
        gain, orifice = self._gain * (1 + mean[6:8]), self._orifice * (1 + mean[8:])
        env.pump_gain, env.orifice = gain.tolist(), orifice.tolist()
        env.level, env.flow_voltage = mean[:4].tolist(), mean[4:6].tolist()
        env.fill(np.clip(action, 0, value("highest voltage")).tolist())
        after = np.concatenate([env.level, env.flow_voltage, mean[6:]])
        between = (mean + after) / 2
        level = np.maximum(between[:4], 0.01)
        speed = np.sqrt(2 * value("gravity") * level)
        slope = np.zeros((12, 12))
        slope[:4, :4] = self._of_drains * (orifice * speed / (2 * level))
        slope[:4, 4:6] = self._of_pumps * gain
        slope[:4, 6:8] = self._of_pumps * (self._gain * between[4:6])
        slope[:4, 8:] = self._of_drains * (self._orifice * speed)
        slope[4:6, 4:6] = -np.eye(2) / value("pump lag")
        return after, exponential(slope * value("period")), np.zeros((12, 12))

    def drawn(self, env: Any) -> Floats:
        """Return gains and orifices relative to the nominal."""
        return (
            np.concatenate(
                [np.divide(env.pump_gain, self._gain), np.divide(env.orifice, self._orifice)]
            )
            - 1
        )


class DroneModel:
    """The drone: position, velocity, angles and rates; thrusts and mass, wind and gust.

    Speeds of rotors follow from the commands. The gust is that of the coming row.
    """

    measured, parameters = 12, slice(12, 19)

    def __init__(self) -> None:
        from oodd_worlds import drone  # noqa: PLC0415  of an extra

        self._drone, self._facts, self._env = drone, read_world("drone"), drone.Drone()
        value, facts = self._facts.value, self._facts.facts
        self._thrust, self._inertia = value("thrust"), value("inertia")
        self._mass = value("mass")
        arm, torque = value("arm"), value("torque")
        # Torque about the body's axes by the rotors' forces.
        turns = np.array([[0, arm, 0, -arm], [-arm, 0, arm, 0], torque * np.array(drone.SPINS)])
        self._turns = turns / self._inertia[:, None]
        self._keep = math.exp(-value("period") / value("gust time"))
        gust = np.repeat(value("gust") ** 2 * (1 - self._keep**2), 2)
        self._drawn = np.diag(np.concatenate([np.zeros(19), gust]))
        low, high = facts["wind"].spread
        # One axis of a wind of uniform strength and direction.
        wind = (low**2 + low * high + high**2) / 6
        spreads = [facts["thrust"].spread ** 2] * 4 + [facts["mass"].spread ** 2] + [wind] * 2
        self._variances = np.concatenate([np.zeros(12), spreads, gust])
        self._variances[:3] = self._facts.noise()[:3] ** 2

    def start(self, row: Floats) -> tuple[Floats, Floats]:
        """Begin at the measured position, at hover and at rest."""
        self._env.speed = [self._drone.hover_speed()] * 4
        return np.concatenate([row[:3], np.zeros(18)]), self._variances

    def step(self, mean: Floats, action: Floats) -> tuple[Floats, Floats, Floats]:
        """Integrate as the world does; the derivative is that of the equations in between."""
        env, value = self._env, self._facts.value
        data, before = env.data, np.array(env.speed)
        data.qpos[:3], data.qpos[3:] = mean[:3], self._drone.quaternion_of(*mean[6:9].tolist())
        data.qvel[:3], data.qvel[3:] = mean[3:6], mean[9:12]
        mass = self._mass * max(1 + mean[16], 0.5)
        env.model.body_mass[1] = mass
        env.thrust = (self._thrust * (1 + mean[12:16])).tolist()
        air = mean[17:19] + mean[19:]
        env.fly(np.clip(action, 0, value("highest rotor speed")).tolist(), (air[0], air[1]))
        after = mean.copy()
        after[:3], after[3:6] = data.qpos[:3], data.qvel[:3]
        after[6:9], after[9:12] = self._drone.euler(data.qpos[3:].tolist()), data.qvel[3:]
        after[19:] *= self._keep
        speed = (before + env.speed) / 2
        slope = self._slope((mean + after) / 2, speed, mass)
        derivative = exponential(slope * value("period"))
        derivative[19:] *= self._keep
        return after, derivative, self._drawn

    def _slope(self, mean: Floats, speed: Floats, mass: float) -> Floats:
        """Return the derivative of the state's change by the state, but for what is tiny."""
        (roll, pitch, yaw), rates = mean[6:9].tolist(), mean[9:12]
        axes = np.array(self._drone.rotation(self._drone.quaternion_of(roll, pitch, yaw)))
        sr, cr, tp, cp = math.sin(roll), math.cos(roll), math.tan(pitch), math.cos(pitch)
        angles = np.array([[1, sr * tp, cr * tp], [0, cr, -sr], [0, sr / cp, cr / cp]])
        # A small turn about the body's axes tilts its z axis.
        tilt = np.stack([-axes[:, 1], axes[:, 0], np.zeros(3)], axis=1) @ np.linalg.inv(angles)
        up = axes[:, 2]
        force = self._thrust * speed**2
        total = float((force * (1 + mean[12:16])).sum())
        drag = self._facts.value("rotor drag") * speed.sum() / mass * (np.eye(3) - np.outer(up, up))
        slope = np.zeros((21, 21))
        slope[:3, 3:6] = np.eye(3)
        slope[3:6, 3:6] = -drag
        slope[3:6, 6:9] = total / mass * tilt
        slope[3:6, 12:16] = np.outer(up, force) / mass
        slope[3:6, 16] = -total / mass * up
        slope[3:6, 17:19] = slope[3:6, 19:] = drag[:, :2]
        slope[6:9, 9:12] = angles
        slope[9:12, 9:12] = self._gyroscopic(rates)
        slope[9:12, 12:16] = self._turns * force
        return slope

    def _gyroscopic(self, rates: Floats) -> Floats:
        """Return the derivative of rates' change, -w x Iw / I, by the rates."""
        (i1, i2, i3), (p, q, r) = self._inertia, rates
        a, b, c = (i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3
        return np.array([[0, a * r, a * q], [b * r, 0, b * p], [c * q, c * p, 0]])

    def drawn(self, env: Any) -> Floats:
        """Return thrusts and mass relative to the nominal, and the mean wind."""
        relative = [*np.divide(env.thrust, self._thrust), env.model.body_mass[1] / self._mass]
        return np.concatenate([np.array(relative) - 1, env.wind])


class ArmModel:
    """The arm: angles and velocities; payload, and frictions relative to the nominal."""

    measured, parameters = 12, slice(12, 25)

    def __init__(self) -> None:
        import mujoco  # noqa: PLC0415  of an extra

        from oodd_worlds import arm  # noqa: PLC0415  of an extra

        self._mujoco, self._arm = mujoco, arm
        self._facts, self._env = read_world("arm"), arm.Arm()
        self._viscous, self._dry = (self._facts.value(f"{x} friction") for x in ("viscous", "dry"))
        self._torque = self._facts.value("highest torque")
        self._ripple = self._facts.value("ripple")

    def start(self, row: Floats) -> tuple[Floats, Floats]:
        """Begin at the measured angles, at rest."""
        facts = self._facts.facts
        low, high = facts["payload"].spread
        frictions = [facts[f"{x} friction"].spread for x in ("viscous", "dry")]
        spreads = [0.0, 0.0, (high - low) / math.sqrt(12), *frictions]
        variances = np.repeat(np.square(spreads), (6, 6, 1, 6, 6))
        variances[:6] = self._facts.noise()[:6] ** 2
        mean = np.concatenate([row[:6], np.zeros(6), [(low + high) / 2], np.zeros(12)])
        return mean, variances

    def step(self, mean: Floats, action: Floats) -> tuple[Floats, Floats, Floats]:
        """Integrate as the world does; the derivative runs along, with inertia as at the end."""
        mujoco, motion, substeps = self._mujoco, self._arm.MOTION, self._arm.SUBSTEPS
        env = self._env
        model, data, seconds = env.model, env.data, env.model.opt.timestep
        env.payload = max(mean[12], 0.01)
        # Beyond these no arm is, and the integration would not be stable.
        viscous, dry = np.clip(1 + mean[13:].reshape(2, 6), 0.1, 4)
        data.qpos[:], data.qvel[:] = mean[:6], np.clip(mean[6:12], -20, 20)
        torque = np.clip(action, -self._torque, self._torque)
        velocities, bends = np.empty((substeps, 6)), np.empty((substeps, 6))
        for i in range(substeps):
            velocities[i] = data.qvel
            bends[i] = np.tanh(velocities[i] / motion)
            friction = self._viscous * viscous * velocities[i] + self._dry * dry * bends[i]
            data.qfrc_applied[:] = torque - friction
            mujoco.mj_step(model, data)
        after = np.concatenate([data.qpos, data.qvel, mean[12:]])
        # Torques that the motion needs, by angle and velocity; they are linear in the payload.
        by_angle, by_velocity, inertia = np.empty((3, 6, 6))
        unused = [None] * 4
        mujoco.mj_inverse(model, data)
        torques = data.qfrc_inverse.copy()
        mujoco.mjd_inverseFD(model, data, 1e-6, 0, by_angle, by_velocity, inertia, *unused)
        inverse = seconds * np.linalg.inv(inertia)
        env.payload += 1
        mujoco.mj_inverse(model, data)
        forces = np.zeros((substeps, 6, 31))
        forces[:, :, 12] = data.qfrc_inverse - torques
        joints = np.arange(6)
        forces[:, joints, 13 + joints] = self._viscous * velocities
        forces[:, joints, 19 + joints] = self._dry * bends
        slopes = self._viscous * viscous + self._dry * dry * (1 - bends**2) / motion
        pulls, drags = inverse @ by_angle.T, inverse @ by_velocity.T + inverse * slopes[:, None]
        # Six more columns: by the ripple of the torques, which stays through a row.
        derivative = np.eye(25, 31)
        forces[:, joints, 25 + joints] = -self._ripple
        angle, velocity = derivative[:6], derivative[6:12]
        for force, drag in zip(inverse @ forces, drags, strict=True):
            velocity -= force + drag @ velocity + pulls @ angle
            angle += seconds * velocity
        ripple = derivative[:, 25:]
        return after, derivative[:, :25], ripple @ ripple.T

    def drawn(self, env: Any) -> Floats:
        """Return the payload, and frictions relative to the nominal."""
        relative = np.concatenate([env.viscous / self._viscous, env.dry / self._dry]) - 1
        return np.concatenate([[env.payload], relative])


def exponential(matrix: Floats) -> Floats:
    """Return the exponential of a small matrix."""
    eye, part = np.eye(len(matrix)), matrix / 16
    power = eye + part @ (eye + part / 2 @ (eye + part / 3 @ (eye + part / 4)))
    for _ in range(4):
        power = power @ power
    return power


class Filter:
    """An extended Kalman filter over one episode.

    Parameters
    ----------
    model
        The world's equations.
    noise
        Standard deviations of the sensors' noise.
    row
        The first row.
    drawn
        The episode's parameters as the state has them, None where they are not known.
    """

    def __init__(
        self, model: Model, noise: Floats, row: Floats, drawn: Floats | None = None
    ) -> None:
        self._model, self._noise = model, np.diag(noise[: model.measured] ** 2)
        self.mean, variances = model.start(row)
        self.covariance = np.diag(variances)
        if drawn is not None:
            self.mean[model.parameters] = drawn
            self.covariance[model.parameters] = 0

    def update(self, row: Floats, action: Floats) -> Floats:
        """Take in a row and the action before it; return the whitened innovation."""
        k = self._model.measured
        mean, slope, drawn = self._model.step(self.mean, action)
        covariance = slope @ self.covariance @ slope.T + drawn
        root = np.linalg.cholesky(covariance[:k, :k] + self._noise)
        white: Floats = np.linalg.solve(root, row[:k] - mean[:k])
        if np.abs(white).max() > JUMP:
            # The parameters stay: a fault is not to be learnt as if the episode had drawn it.
            mean[:k], covariance[:k], covariance[:, :k] = row[:k], 0, 0
            covariance[:k, :k] = self._noise
        else:
            gain = np.linalg.solve(root, covariance[:k])
            mean, covariance = mean + np.clip(white, -CLIP, CLIP) @ gain, covariance - gain.T @ gain
        self.mean, self.covariance = mean, (covariance + covariance.T) / 2
        return white


MODELS: Final[dict[str, Callable[[], Model]]] = {
    "arm": ArmModel,
    "drone": DroneModel,
    "tank": TankModel,
}


def worlds() -> dict[tuple[int, int], str]:
    """Return the worlds' names by their numbers of sensors and of action columns."""
    facts = {name: read_world(name) for name in MODELS}
    return {(len(world.sensors), len(world.actions)): name for name, world in facts.items()}


class WhiteCharts:
    """Whitened innovations of one episode, accumulated with several memories.

    Two charts a weight, both with the same spread in all rows of nominal operation: the length of
    the weighted innovations, and the weighted squared lengths less their mean.

    Parameters
    ----------
    measured
        Length of an innovation.
    """

    def __init__(self, measured: int) -> None:
        self._signed, self._sizes = Smoother(WEIGHTS, measured), Smoother(WEIGHTS, 1)

    def update(self, white: Floats) -> Floats:
        """Return the charts after an innovation, of shape (2 W,)."""
        counted, k = np.clip(white, -LIMIT, LIMIT), len(white)
        lengths = np.sqrt((self._signed(counted[None])[:, 0] ** 2).sum(axis=1))
        size = ((counted**2).sum() - k) / math.sqrt(2 * k)
        return np.concatenate([lengths, self._sizes(np.full((1, 1), size))[:, 0, 0]])


class InnovationCharts:
    """The `WhiteCharts` of a filter's innovations over one episode.

    Parameters
    ----------
    world
        Name of the world.
    row
        The first row.
    drawn
        The episode's parameters, see `Filter`.
    """

    def __init__(self, world: str, row: NDArray[np.float32], drawn: Floats | None = None) -> None:
        model = MODELS[world]()
        noise = read_world(world).noise()
        self._filter = Filter(model, noise, row.astype(np.float64), drawn)
        self._charts = WhiteCharts(model.measured)

    def update(self, row: NDArray[np.float32], action: NDArray[np.float32]) -> Floats:
        """Return the charts after a row and the action before it, of shape (2 W,)."""
        return self._charts.update(
            self._filter.update(row.astype(np.float64), action.astype(np.float64))
        )


def charts_of(world: str, trajectory: Trajectory, drawn: Floats | None = None) -> Floats:
    """Return the `InnovationCharts` after every action of an episode, of shape (T, 2 W)."""
    rows = trajectory.observations
    charts = InnovationCharts(world, rows[0], drawn)
    pairs = zip(rows[1:], trajectory.actions, strict=True)
    return np.array([charts.update(*pair) for pair in pairs]).reshape(-1, 2 * len(WEIGHTS))


def standards_of(charts: Sequence[Floats]) -> Floats:
    """Return mean and spread of each chart's largest value in an episode, of shape (2, 2 W)."""
    largest = np.array([episode.max(axis=0) for episode in charts if len(episode)])
    spread = largest.std(axis=0)
    return np.stack([largest.mean(axis=0), np.where(spread > 0, spread, 1.0)])


def judged(charts: Floats, standards: Floats) -> Floats:
    """Return the largest standardized chart of each row: (..., 2 W) to (...)."""
    mean, spread = standards
    return np.asarray(((charts - mean) / spread).max(axis=-1))


class OracleDetector(StorableWindowDetector):
    r"""Largest chart of the innovations of a filter with the true equations.

    .. math:: s_t = \max_c \frac{c_t - m_c}{q_c}

    over the `InnovationCharts` c, with mean m and standard deviation q of a chart's largest value
    in a training episode. Higher means more anomalous; the score of the first row is NaN. Nothing
    else is learnt, and nothing is random.

    Parameters
    ----------
    name, seed
        See `WindowDetector`.
    horizon
        1, as an innovation is one row ahead.

    Raises
    ------
    NotImplementedError
        For another horizon, and by `fit` for an environment that is none of the worlds.
    """

    kind: ClassVar[str] = "oracle/1"

    def __init__(self, name: str, *, seed: int, horizon: int) -> None:
        if horizon != 1:
            raise NotImplementedError(f"{name} forecasts one row, got horizon {horizon}: use 1")
        super().__init__(name, seed=seed, horizon=horizon, actions=True)

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for the first."""
        self._must_fit(trajectory)
        charts = charts_of(self._world, trajectory)
        return np.concatenate([[np.nan], judged(charts, self.standards_)])

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._charts: InnovationCharts | None = None

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        self._charts = self._charts or InnovationCharts(self._world, window[0])
        return float(judged(self._charts.update(now, self._commands[0]), self.standards_))

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        widths = sorted({self._widths(x) for x in nominal})
        if len(widths) != 1 or widths[0] not in worlds():
            known = ", ".join(f"{name} {shape}" for shape, name in worlds().items())
            raise NotImplementedError(
                f"{self.name} has the equations of {known}, and got trajectories of (sensors, "
                f"action columns) {widths}: run it with --env {','.join(MODELS)}"
            )
        self._take(widths[0])
        self.standards_ = standards_of([charts_of(self._world, x) for x in nominal])
        return scale

    def _take(self, widths: tuple[int, int]) -> None:
        self._world = worlds()[widths]
        self.action_scale_ = FeatureScale(np.zeros(widths[1]), np.ones(widths[1]))

    def _fitted_with(self) -> dict[str, Any]:
        return {}

    def _arrays(self) -> Arrays:
        mean, spread = self.standards_
        actions = np.array(len(self.action_scale_.mean))
        return {"actions": actions, "chart_mean": mean, "chart_spread": spread}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        widths = sensors, int(take(arrays, "actions", (), "i"))
        if widths not in worlds():
            raise FittedStateError(
                f"a fit of {self.name} has (sensors, action columns) {widths}, expected one of "
                f"{sorted(worlds())}: fit again"
            )
        charts = (2 * len(WEIGHTS),)
        mean, spread = take(arrays, "chart_mean", charts), take(arrays, "chart_spread", charts, "+")
        self._take(widths)
        self.standards_ = np.stack([mean, spread])
