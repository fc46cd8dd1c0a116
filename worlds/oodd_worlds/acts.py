"""Acts of the worlds: their controllers go on, and follow another way."""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from oodd_interventions.situation import Act, ActSpec, Situation
from oodd_recording.policies import Policy

Row = NDArray[np.float32]

ARM_WAY: Final = slice(12, 18)
DRONE_WAY: Final = slice(12, 15)
DESCENT: Final = 0.4
"""Speed in m/s at which the drone comes down."""
PERIOD: Final = 0.02
"""Seconds a row, of arm and drone."""
SAFE_LEVELS: Final = (6.0, 6.0)
"""Set points in cm: half of the usual ones, far from both ends of the tanks."""


class Steered:
    """The policy goes on, with rows that `change` has written into."""

    def __init__(self, policy: Policy, change: Callable[[Row], None]) -> None:
        self._policy, self._change = policy, change

    def act(self, row: Row) -> Any:
        """Return the policy's command for the changed row."""
        changed = row.copy()
        self._change(changed)
        return self._policy.act(changed)


def hold(situation: Situation) -> Steered:
    """Hold the arm at the angles of the alarm's row."""
    angles = situation.rows[-1, :6].copy()

    def change(row: Row) -> None:
        row[ARM_WAY], row[18:] = angles, 0.0

    return Steered(situation.policy, change)


def land(situation: Situation) -> Steered:
    """Let the drone come down where it is to the height 0, and stay there."""
    target = situation.rows[-1, :3].copy()

    def change(row: Row) -> None:
        target[2] = max(0.0, target[2] - DESCENT * PERIOD)
        row[DRONE_WAY], row[15:] = target, (0.0, 0.0, -DESCENT if target[2] else 0.0)

    return Steered(situation.policy, change)


def drain(situation: Situation) -> Steered:
    """Let the levels of the tanks go to their fail-safe set points."""

    def change(row: Row) -> None:
        row[4:] = SAFE_LEVELS

    return Steered(situation.policy, change)


def integral(way: slice, rate: float, situation: Situation) -> Steered:
    """Add an integral of the error to a controller: `rate` in 1/s."""
    measured = slice(way.stop - way.start)
    total = np.zeros(way.stop - way.start)

    def change(row: Row) -> None:
        total[:] += rate * PERIOD * (row[way] - row[measured])
        row[way] += total

    return Steered(situation.policy, change)


def stiffen(factor: float, situation: Situation) -> Steered:
    """Multiply the gains of the tanks' controllers."""

    def change(row: Row) -> None:
        row[:2] = row[4:] - factor * (row[4:] - row[:2])

    return Steered(situation.policy, change)


def _of(name: str, make: Callable[[Situation], Act], summary: str, world: str) -> ActSpec:
    """Return an act for faults of the dynamics in a world."""
    return ActSpec(name, make, summary, ("dynamics",), (world,))


ACTS: Final = [
    _of("stop", hold, "the arm holds its angles", "arm"),
    _of("stop", land, "the drone comes down where it is", "drone"),
    _of("stop", drain, "levels go to fail-safe set points", "tank"),
    _of("switch", partial(integral, ARM_WAY, 4.0), "the controller gets an integral", "arm"),
    _of("switch", partial(integral, DRONE_WAY, 1.0), "the controller gets an integral", "drone"),
    _of("switch", partial(stiffen, 1.5), "the controllers get higher gains", "tank"),
]
"""The acts of the worlds."""
