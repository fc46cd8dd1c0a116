"""Effects of an engine's impulse on LunarLander, and the ranges that its dispersion leaves.

In flight each row's velocities change by gravity and by at most one engine (Gymnasium's
LunarLander, after Klimov). In the lander's own axes the engine's impulse is its power times a
direction that two uniform draws shift, so that its parts are *bounded*, and since a force acts at a
known point, two of them tell the third. Positions and angle follow from velocities exactly. In the
first rows the legs swing out against their joints, and after a leg has touched the ground its
contacts push: there ranges are wide. All ranges are those of training.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval import Trajectory

Floats = NDArray[np.float64]

SECONDS: Final = 1 / 50
"""Between two rows."""

GRAVITY: Final = 10.0
"""In m/s², downwards."""

UNITS: Final = np.array([10.0, 20 / 3, 5.0, 7.5, 1.0, 2.5])
"""Of the number 1 of the first six sensors, in metres, radians and seconds."""

SWING: Final = 30
"""Rows at the start of an episode in which the legs swing out."""

CLASSES: Final = 12
"""Each of four actions: in flight, after a leg has touched, and as the legs swing out."""

PARTS: Final = 8
"""Numbers that an episode's rows are judged by, see `changes`."""

RELATION: Final = 5
"""Coefficients of the turn that an impulse gives."""

ROUNDING: Final = 1e-7
"""Of a part, by rows in single precision."""

LEAST: Final = 1e-3
"""Smallest unit of an excess, as a share of a range."""


def changes(
    rows: Floats, actions: Floats, row: int = 0, *, touched: bool = False
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Return what changes from row to row that equations do not tell.

    Parameters
    ----------
    rows : float64 array of shape (T + 1, 8)
        Observations.
    actions : float64 array of shape (T, 4)
        One-hot actions.
    row
        Number of the first of them in its episode.
    touched
        Whether a leg has touched the ground before it.

    Returns
    -------
    parts : float64 array of shape (T, 8)
        What positions and angle do beyond their velocities; the change of velocity beyond gravity
        along the lander's own axes, up and to the right; that of the rate of turning; how far the
        contacts of the legs are from 0 and 1.
    causes : float64 array of shape (T, 5)
        What the change of the rate of turning is linear in, while it flies.
    classes : int array of shape (T,)
        Number of the action, plus 4 once a leg has touched the ground, or 8 as the legs swing out.
    """
    states = rows[:, :6] * UNITS
    before, after = states[:-1], states[1:]
    places, speeds = after[:, [0, 1, 4]] - before[:, [0, 1, 4]], after[:, [2, 3, 5]]
    jumps = speeds - before[:, [2, 3, 5]]
    jumps[:, 1] += GRAVITY * SECONDS
    sine, cosine = np.sin(before[:, 4]), np.cos(before[:, 4])
    up = -sine * jumps[:, 0] + cosine * jumps[:, 1]
    right = cosine * jumps[:, 0] + sine * jumps[:, 1]
    contacts = rows[1:, 6:]
    odd = np.minimum(np.abs(contacts), np.abs(contacts - 1))
    parts = np.column_stack([places - SECONDS * speeds, up, right, jumps[:, 2], odd])
    causes = np.column_stack(
        [np.ones(len(up)), up, right, sine * jumps[:, 1], cosine * jumps[:, 0]]
    )
    down = np.logical_or.accumulate(np.append(touched, touches(rows[1:])))[1:]
    swing = np.arange(row, row + len(actions)) < SWING
    return parts, causes, actions.argmax(axis=1) + np.where(down, 4, 8 * swing)


def touches(rows: Floats) -> NDArray[np.bool_]:
    """Return whether a leg touches the ground, row by row."""
    return np.asarray((rows[:, 6:] > 0.5).any(axis=1))


class LanderEquations:
    """The lander's equations for a filter, where sensors are too noisy for ranges.

    The state is a row in metres, radians and seconds. Engines give what they give on average; what
    their dispersion, the legs' swing and contacts add is chance. Impulses are those of Box2D, which
    shares them between the lander and its legs.
    """

    MAIN = (0.35, 0.101, 0.0501, 0.485)
    """Of the main engine, in m/s: mean and standard deviation upwards, standard deviation to the
    right, and the turn in rad/s by the change to the right."""
    SIDE = (0.0495, 0.0022, 0.0071, -2.01)
    """Of a side engine: mean to the right, standard deviations upwards and to the right, turn."""
    SWUNG = (0.003, 0.0005, 0.003)
    """Standard deviations, upwards, to the right and of the turn, as the legs swing out."""
    TOUCHED = (0.3, 0.1, 0.5)
    """The same once a leg has touched the ground."""
    UNTOLD = (5e-4, 1e-4)
    """Standard deviations of positions in m and of the angle in rad beyond their velocities."""

    def __init__(self) -> None:
        self._row, self._touched = 0, False

    def start(self, rows: Floats) -> Floats:
        """Return rows in units."""
        return np.column_stack([rows[:, :6] * UNITS, rows[:, 6:]])

    def measure(self, states: Floats) -> Floats:
        """Return states in the sensors' units."""
        return np.column_stack([states[:, :6] / UNITS, states[:, 6:]])

    def step(self, states: Floats, action: Floats) -> Floats:
        """Fall, fly and turn for a row."""
        after, engine = states.copy(), int(np.argmax(action))
        sine, cosine = np.sin(states[:, 4]), np.cos(states[:, 4])
        up = self.MAIN[0] if engine == 2 else 0.0
        right = self.SIDE[0] * {1: -1, 3: 1}.get(engine, 0)
        after[:, 2] += -sine * up + cosine * right
        after[:, 3] += cosine * up + sine * right - GRAVITY * SECONDS
        after[:, 5] += self.SIDE[3] * right
        after[:, [0, 1, 4]] += SECONDS * after[:, [2, 3, 5]]
        return after

    def drawn(self, state: Floats, action: Floats, row: Floats) -> Floats:
        """Return the covariance of what the engine's dispersion, legs and ground add."""
        self._row += 1
        self._touched = self._touched or bool(touches(row[None])[0])
        engine = int(np.argmax(action))
        covariance = np.zeros((3, 3))
        if engine == 2:
            _, upwards, sideways, turn = self.MAIN
        else:
            _, upwards, sideways, turn = self.SIDE if engine else (0.0, 0.0, 0.0, 0.0)
        covariance[0, 0] = upwards**2
        covariance[1:, 1:] = sideways**2 * np.array([[1.0, turn], [turn, turn**2]])
        if self._touched or self._row <= SWING:
            covariance += np.diag(np.square(self.TOUCHED if self._touched else self.SWUNG))
        sine, cosine = np.sin(state[4]), np.cos(state[4])
        speeds = np.array([[-sine, cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, 1.0]])
        onto = np.zeros((8, 3))
        onto[[2, 3, 5]], onto[[0, 1, 4]] = speeds, SECONDS * speeds
        chance = onto @ covariance @ onto.T + 1e-12 * np.eye(8)
        chance[[0, 1, 4], [0, 1, 4]] += np.square([self.UNTOLD[0]] * 2 + [self.UNTOLD[1]])
        if self._touched:
            chance[[6, 7], [6, 7]] += 1.0
        return chance


class Ranges(NamedTuple):
    """Ranges of training, by class and part.

    Attributes
    ----------
    low, high, unit
        Smallest and largest value, and what an excess is measured in: each of shape (12, 8). The
        unit is infinite where two episodes at most have the class.
    relation
        Coefficients of the turn by class, (12, 5).
    """

    low: Floats
    high: Floats
    unit: Floats
    relation: Floats

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> Ranges:
        """Take the ranges of nominal episodes.

        In flight the unit of an excess is the largest by which an episode leaves the range of all
        others. Elsewhere nothing is bounded, and it is the range.
        """
        episodes = [
            changes(x.observations.astype(np.float64), x.actions.astype(np.float64))
            for x in nominal
        ]
        parts, causes, classes = (np.concatenate(every) for every in zip(*episodes, strict=True))
        relation = np.zeros((CLASSES, RELATION))
        for k in np.unique(classes):
            of_class = classes == k
            relation[k] = np.linalg.lstsq(causes[of_class], parts[of_class, 5], rcond=None)[0]
        ends = np.full((2, len(episodes), CLASSES, PARTS), np.nan)
        for i, (p, c, k) in enumerate(episodes):
            remaining = complete(p, c, relation[k])
            for one in np.unique(k):
                ends[:, i, one] = remaining[k == one].min(axis=0), remaining[k == one].max(axis=0)
        lows, highs = np.nan_to_num(ends[0], nan=np.inf), np.nan_to_num(ends[1], nan=-np.inf)
        low, high = lows.min(axis=0), highs.max(axis=0)
        second_low, second_high = np.sort(lows, axis=0)[1], np.sort(highs, axis=0)[-2]
        with np.errstate(invalid="ignore"):
            unit = np.maximum(second_low - low, high - second_high)
            unit[4:] = high[4:] - low[4:]
            unit = np.maximum(unit, LEAST * (high - low) + ROUNDING)
        few = (np.isfinite(lows).sum(axis=0) < 3) | ~np.isfinite(unit)
        low, high = np.where(few, 0.0, low), np.where(few, 0.0, high)
        return cls(low, high, np.where(few, np.inf, unit), relation)

    def excess(self, parts: Floats, causes: Floats, classes: NDArray[np.intp]) -> Floats:
        """Return by how many units rows leave their range most; below 0 inside."""
        remaining = complete(parts, causes, self.relation[classes])
        low, high, unit = (ends[classes] for ends in (self.low, self.high, self.unit))
        return np.asarray((np.maximum(remaining - high, low - remaining) / unit).max(axis=1))


def complete(parts: Floats, causes: Floats, relation: Floats) -> Floats:
    """Return the parts without what the impulse tells of the turn."""
    remaining = parts.copy()
    remaining[:, 5] -= (causes * relation).sum(axis=1)
    return remaining


def jitter(nominal: Sequence[Trajectory]) -> float:
    """Return the median change of the rate of turning in rows without an engine, in rad/s."""
    turns = [
        np.diff(x.observations[:, 5].astype(np.float64))[x.actions[:, 0] > 0.5] for x in nominal
    ]
    every = np.abs(np.concatenate(turns)) * UNITS[5]
    return float(np.median(every)) if len(every) else 0.0
