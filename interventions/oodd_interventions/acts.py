"""Acts of the benchmark's seven environments, and which episodes failed there."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from oodd_recording.closed_loop import RecordedEpisode
from oodd_recording.policies import CustomPolicy, Policy, load_policy
from oodd_recording.registered import info_of

from oodd_eval import Trajectory
from oodd_interventions.sensor import VirtualSensor
from oodd_interventions.situation import Act, ActSpec, Row, Situation

STANDING: Final = Path(__file__).with_name("standing")
"""Directory of policies that stand: linear, learnt under pushes and with weaker motors."""


def failed(environment: str, episode: RecordedEpisode, cap: int) -> bool:
    """Tell whether an episode counts as a failure.

    Parameters
    ----------
    environment
        Its name.
    episode
        One of its episodes.
    cap
        The longest episode, in transitions.

    Returns
    -------
    bool
        Whether the simulator ended it before the cap, but for three environments: Acrobot fails
        when it does not swing up, LunarLander when it crashes or has not come to rest, and
        HalfCheetah, which the simulator lets go on, when it lies on its back or its nose.
    """
    if environment == "acrobot":
        return not episode.terminated
    if environment == "lunarlander":
        return not episode.terminated or bool(episode.rewards[-1] <= -100)
    if environment == "halfcheetah":
        return bool(abs(episode.trajectory.observations[-1, 7]) >= 1)
    return episode.terminated and len(episode.rewards) < cap


def controlled(command: Callable[[Row], Any], situation: Situation) -> Policy:
    """Let another controller take over: a function of the row."""
    return CustomPolicy(situation.environment, command)


def mask(situation: Situation) -> Policy:
    """Let the policy go on, with estimates for the sensors that are named."""
    sensor = VirtualSensor(situation)
    return controlled(lambda row: situation.policy.act(sensor.row(row)), situation)


def balance(row: Row) -> int:
    """Balance CartPole by linear feedback of its state."""
    return int(row @ np.array([0.03, 0.08, 1.0, 0.25]) > 0)


def land(row: Row) -> int:
    """Land on the pad: Gymnasium's own heuristic for LunarLander (after Klimov)."""
    x, y, vx, vy = row[:4].astype(float)
    return _thrust(row, np.clip(0.5 * x + vx, -0.4, 0.4), 0.5 * (0.55 * abs(x) - y - vy))


def descend(row: Row) -> int:
    """Come down upright and slowly, wherever the lander is."""
    y, vx, vy = row[1:4].astype(float)
    return _thrust(row, np.clip(vx, -0.3, 0.3), -0.5 * (min(0.35, 0.1 + 0.2 * max(y, 0)) + vy))


def _thrust(row: Row, angle: float, up: float) -> int:
    """Return the engine that turns LunarLander towards an angle, or pushes it up."""
    turn = 0.5 * (angle - row[4]) - row[5]
    if row[6:].any():  # a leg has touched the ground
        turn, up = 0.0, -0.5 * row[3]
    if up > max(abs(turn), 0.05):
        return 2
    return 1 if turn > 0.05 else 3 if turn < -0.05 else 0


def brace(situation: Situation) -> Policy:
    """Pull all joints to the middles of their ranges, where Ant stands, and brake them."""
    joints = slice(8, 8 + 2 * situation.actions.shape[1])  # angle and speed of each in turn

    def pull(row: Row) -> Row:
        angles, speeds = row[joints][::2], row[joints][1::2]
        return np.clip(-angles - 0.5 * speeds, -1, 1)

    return controlled(pull, situation)


def stand(situation: Situation) -> Policy:
    """Let a policy take over that has learnt to brake and to stand."""
    return load_policy(situation.environment, STANDING / f"{situation.environment}.npz")


class Compensated:
    """The policy goes on, and what pushes its motors is estimated and taken off its commands.

    Errors of the forecasts tell of pushes through the effects that commands have: a disturbance
    observer (Ohnishi et al. 1996) by Bayesian regression. All motors are pushed alike, and each a
    little on its own.
    """

    common, single = 0.3, 0.03
    """Prior standard deviations of the pushes, in units of the command."""
    least = 0.1
    """A smaller push is left alone: weaker motors and heavier bodies look like one."""
    freedom = 4.0
    """Of the errors' Student t distribution: a contact that comes early tells little."""

    def __init__(self, situation: Situation) -> None:
        self._situation, model = situation, situation.model
        d, a = len(model.sensors.mean), len(model.actions.mean)
        latest, before = model.coefficients[2 * d : 2 * d + a], model.coefficients[-1 - a : -1]
        self._effects = (latest + before) / model.actions.std[:, None]
        self._weight = np.linalg.inv(model.covariance)
        self._precision = np.linalg.inv(self.single**2 * np.eye(a) + self.common**2)
        self._evidence = np.zeros(a)
        self._seen = situation.onset

    def act(self, row: Row) -> Row:
        """Return the policy's command without the push."""
        situation, model = self._situation, self._situation.model
        for t in range(max(self._seen, 3), len(situation.rows)):
            episode = Trajectory(situation.rows[t - 2 : t + 1], situation.actions[t - 2 : t])
            self._learn(model.errors(episode)[-1])
        self._seen = len(situation.rows)
        push = np.linalg.solve(self._precision, self._evidence)
        push[np.abs(push) < self.least] = 0.0
        low, high = info_of(situation.environment).limits
        return np.clip(situation.policy.act(row) - push, low, high).astype(np.float32)

    def _learn(self, error: NDArray[np.float64]) -> None:
        size = error @ self._weight @ error / len(error)
        gain = (self.freedom + 1) / (self.freedom + size) * self._effects @ self._weight
        self._precision += gain @ self._effects.T
        self._evidence += gain @ error


def _of(name: str, make: Callable[[Situation], Act], summary: str, *names: str) -> ActSpec:
    """Return an act for faults of the dynamics in named environments."""
    return ActSpec(name, make, summary, ("dynamics",), names)


_ROBOTS: Final = ("ant", "halfcheetah", "hopper", "walker2d")

ACTS: Final = [
    ActSpec("mask", mask, "the policy gets estimates for the named sensors", ("sensor",)),
    _of("stop", brace, "the joints go to the middles of their ranges", "ant"),
    _of("stop", stand, "a policy that has learnt to stand takes over", "hopper"),
    _of("stop", partial(controlled, descend), "the lander comes down where it is", "lunarlander"),
    _of("switch", partial(controlled, balance), "linear feedback balances the pole", "cartpole"),
    _of("switch", partial(controlled, land), "Gymnasium's heuristic lands it", "lunarlander"),
    _of("switch", Compensated, "a push on the motors is estimated and taken off", *_ROBOTS),
]
"""The acts of the seven."""
