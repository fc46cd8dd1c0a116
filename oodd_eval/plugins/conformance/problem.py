"""A small problem to try detectors on: a seeded linear-Gaussian system with actions.

A two-dimensional state turns and decays, the actions push it, and every sensor sees a combination
of it in units of its own:

``x_{t+1} = A x_t + B a_t + 0.1 w_t``, ``o_t = scale * (C x_t + 0.05 v_t)``

with w, v standard normal and ``a_t`` uniform on [-1, 1]. Nothing is simulated by a library, so the
checks run anywhere, in seconds.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.auc import Floats

SENSORS: Final = 3
ACTIONS: Final = 2
EPISODES: Final = 12
ROWS: Final = 80
"""Observations of an episode, beyond the horizon."""

_TURN: Final = 0.3
_DECAY: Final = 0.97


@dataclass(frozen=True, slots=True)
class Problem:
    """Trajectories of the system, the same for the same arguments.

    Parameters
    ----------
    horizon
        Prediction horizon of the detector: episodes are longer by as much.
    """

    horizon: int = 1

    @property
    def rows(self) -> int:
        """Observations of an ordinary episode."""
        return ROWS + self.horizon

    def episode(self, key: int, rows: int | None = None, sensors: int = SENSORS) -> Trajectory:
        """Return one nominal episode.

        Parameters
        ----------
        key
            Decides every draw; episodes of different keys are independent.
        rows
            Observations; None means the ordinary number.
        sensors
            Sensors, D. Another number is another system.
        """
        return Trajectory(*_system(key, self.rows if rows is None else rows, sensors))

    def training(self, sensors: int = SENSORS, first: int = 1000) -> list[Trajectory]:
        """Return nominal episodes of equal length to fit on."""
        return [self.episode(first + i, sensors=sensors) for i in range(EPISODES)]

    def nominal(self, n: int = 4) -> list[Trajectory]:
        """Return nominal episodes to score, of unequal lengths, not among the training ones."""
        return [self.episode(2000 + i, self.rows - 7 * i) for i in range(n)]

    def anomalous(self, n: int = 4) -> list[tuple[Trajectory, Trajectory, int]]:
        """Return episodes whose sensors go wild, with their nominal twins and onsets.

        From the onset on, every sensor gets fresh noise of ten times its own spread: nothing that
        a detector may look at stays as it was.
        """
        found = []
        for i in range(n):
            twin = self.episode(3000 + i)
            onset = self.rows // 2 + i
            noise = np.random.default_rng([3000 + i, 1]).normal(size=twin.observations.shape)
            noise[:onset] = 0.0
            spread = 10 * twin.observations.std(axis=0, dtype=np.float64)
            wild = twin.observations + spread * noise
            found.append((Trajectory(wild, twin.actions), twin, onset))
        return found


@functools.lru_cache(maxsize=256)
def _system(key: int, rows: int, sensors: int) -> tuple[Floats, Floats]:
    """Return observations (rows, D) and actions (rows - 1, A) of one nominal episode."""
    system = np.random.default_rng(sensors)
    mixing = system.normal(size=(2, sensors))
    scale = 10.0 ** system.integers(-1, 2, size=sensors)
    turn = np.array([[np.cos(_TURN), -np.sin(_TURN)], [np.sin(_TURN), np.cos(_TURN)]])
    push = np.array([[0.2, 0.0], [0.1, 0.2]])
    rng = np.random.default_rng([key, sensors])
    actions = rng.uniform(-1, 1, size=(rows - 1, ACTIONS))
    states = [rng.normal(size=2)]
    for action in actions:
        states.append(_DECAY * turn @ states[-1] + push @ action + 0.1 * rng.normal(size=2))
    noise = 0.05 * rng.normal(size=(rows, sensors))
    return scale * (np.array(states) @ mixing + noise), actions


def altered_from(trajectory: Trajectory, row: int) -> Trajectory:
    """Return the episode with another future: all that was not yet known when ``o_row-1`` came.

    Observations change from `row` on, and actions from the one that was chosen at ``row - 1`` on.
    """
    rng = np.random.default_rng(row)
    observations, actions = trajectory.observations.copy(), trajectory.actions.copy()
    spread = 20 * observations.std(axis=0, dtype=np.float64)
    observations[row:] += spread * rng.normal(size=observations[row:].shape)
    actions[row - 1 :] = -actions[row - 1 :]
    return Trajectory(observations, actions)


def with_constant_sensor(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the episodes with sensor 0 standing still at 1."""
    found = []
    for trajectory in trajectories:
        observations = trajectory.observations.copy()
        observations[:, 0] = 1.0
        found.append(Trajectory(observations, trajectory.actions))
    return found
