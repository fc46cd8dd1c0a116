"""Equations of Acrobot and CartPole, and a filter that has them: nothing but NumPy.

A filter knows the equations and the parameters; it does not know the state, nor how noisy the
sensors are. The noise is that with which its innovations in training have the size that the filter
expects (Mehra, IEEE Trans. Autom. Control 15, 1970).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from oodd_eval import Trajectory

Floats = NDArray[np.float64]

STEP: Final = 1e-5
"""Distance of the states of a numerical derivative, in rad, m, rad/s, m/s."""

DRIVEN: Final = 1e-9
"""Standard deviation of what is added to a state in a row."""

CLIP: Final = 4.0
"""Standard deviations of an innovation that the state follows at most."""

JUMP: Final = 100.0
"""Standard deviations of an innovation from which on the state begins anew at the row."""

ROUNDS: Final = 5
"""Rounds in which the noise is brought to what innovations say."""

ENOUGH: Final = 10
"""Training episodes that the noise is from, at most."""


class Equations(Protocol):
    """A plant whose state has N numbers, of which a row of S sensors tells without loss."""

    def start(self, rows: Floats) -> Floats:
        """Return the states, (B, N), that rows (B, S) show."""

    def step(self, states: Floats, action: Floats) -> Floats:
        """Return the states, (B, N), one row after states (B, N) under an action, (A,)."""

    def measure(self, states: Floats) -> Floats:
        """Return the rows, (B, S), that states (B, N) show."""

    def drawn(self, state: Floats, action: Floats, row: Floats) -> Floats:
        """Return the covariance, (N, N), of what chance adds to a state until a row, (S,)."""


class Certain:
    """A plant in which nothing is left to chance."""

    def drawn(self, state: Floats, action: Floats, row: Floats) -> Floats:
        """Return next to nothing: what is far below any noise, and far above 0."""
        return np.diag(np.full(len(state), DRIVEN**2))


class AcrobotEquations(Certain):
    """Two links of 1 m and 1 kg, with a motor between them (Sutton, NeurIPS 8, 1996).

    The state is both angles, the first from hanging down, the second from the first link's
    direction, in rad, and their rates in rad/s. One step is one of Runge and Kutta's of 0.2 s.
    """

    SECONDS = 0.2
    GRAVITY = 9.8
    LIMITS = (4 * math.pi, 9 * math.pi)
    """Largest rates of both angles, in rad/s."""

    def start(self, rows: Floats) -> Floats:
        """Return angles and rates."""
        angles = np.arctan2(rows[:, [1, 3]], rows[:, [0, 2]])
        return np.concatenate([angles, rows[:, 4:]], axis=1)

    def measure(self, states: Floats) -> Floats:
        """Return cosines and sines of both angles, and their rates."""
        (a, b), rates = states[:, :2].T, states[:, 2:]
        return np.column_stack([np.cos(a), np.sin(a), np.cos(b), np.sin(b), rates])

    def step(self, states: Floats, action: Floats) -> Floats:
        """Integrate under a torque of -1, 0 or 1 N m."""
        torque, h = float(np.argmax(action)) - 1.0, self.SECONDS
        k1 = self._rates(states, torque)
        k2 = self._rates(states + h / 2 * k1, torque)
        k3 = self._rates(states + h / 2 * k2, torque)
        k4 = self._rates(states + h * k3, torque)
        after = states + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        after[:, 2:] = np.clip(after[:, 2:], np.negative(self.LIMITS), self.LIMITS)
        return after

    def _rates(self, states: Floats, torque: float) -> Floats:
        """Solve Lagrange's equations: masses and lengths are 1, centres of mass half-way."""
        a, b, va, vb = states.T
        inertia = 1.0  # of each link about its centre of mass, in kg m²
        m22 = 0.25 + inertia
        m12 = m22 + 0.5 * np.cos(b)
        m11 = 0.25 + inertia + 1.0 + m12 + 0.5 * np.cos(b)
        weight = 0.5 * self.GRAVITY * np.sin(a + b)
        swirl = 0.5 * np.sin(b)
        f1 = swirl * vb * (vb + 2 * va) - 1.5 * self.GRAVITY * np.sin(a) - weight
        f2 = torque - swirl * va**2 - weight
        determinant = m11 * m22 - m12**2
        return np.column_stack(
            [va, vb, (m22 * f1 - m12 * f2) / determinant, (m11 * f2 - m12 * f1) / determinant]
        )


class CartPoleEquations(Certain):
    """A cart of 1 kg with a pole of 1 m and 0.1 kg (Barto et al., IEEE Trans. SMC 13, 1983).

    The state is a row: position in m, speed in m/s, angle from upright in rad, and its rate in
    rad/s. One step is one of Euler's of 0.02 s; there is no friction.
    """

    SECONDS = 0.02
    GRAVITY = 9.8
    FORCE = 10.0
    POLE, HALF, TOTAL = 0.1, 0.5, 1.1
    """The pole's mass in kg and half its length in m; both masses in kg."""

    def start(self, rows: Floats) -> Floats:
        """Return the rows."""
        return rows.copy()

    def measure(self, states: Floats) -> Floats:
        """Return the states."""
        return states.copy()

    def step(self, states: Floats, action: Floats) -> Floats:
        """Integrate under a push of 10 N to the left or to the right."""
        _, speed, angle, rate = states.T
        force = self.FORCE * (2.0 * np.argmax(action) - 1.0)
        sine, cosine = np.sin(angle), np.cos(angle)
        moment = self.POLE * self.HALF
        thrust = (force + moment * rate**2 * sine) / self.TOTAL
        inertia = self.HALF * (4 / 3 - self.POLE * cosine**2 / self.TOTAL)
        turning = (self.GRAVITY * sine - cosine * thrust) / inertia
        pushing = thrust - moment * turning * cosine / self.TOTAL
        return states + self.SECONDS * np.column_stack([speed, pushing, rate, turning])


class ExtendedFilter:
    """Extended Kalman filter that follows an episode.

    Parameters
    ----------
    equations
        The plant's.
    noise
        Variances of the sensors' noise, (S,).
    row
        The first row, (S,).
    """

    def __init__(self, equations: Equations, noise: Floats, row: Floats) -> None:
        self._equations, self._noise = equations, np.diag(noise)
        self._begin(row)

    def _begin(self, row: Floats) -> None:
        """Take the state that a row shows, and the noise's effect on it."""
        slope = derivative(self._equations.start, row)
        self.mean = self._equations.start(row[None])[0]
        self.covariance = slope @ self._noise @ slope.T

    def update(self, row: Floats, action: Floats) -> tuple[Floats, Floats]:
        """Take in a row and the action before it.

        Returns
        -------
        white : float64 array of shape (S,)
            The innovation, with unit covariance in nominal operation.
        ratios : float64 array of shape (S,)
            Its squares before whitening, by sensor, over what the filter expects of them.
        """
        slope = derivative(lambda states: self._equations.step(states, action), self.mean)
        mean = self._equations.step(self.mean[None], action)[0]
        chance = self._equations.drawn(self.mean, action, row)
        covariance = slope @ self.covariance @ slope.T + chance
        seen = derivative(self._equations.measure, mean)
        residual = row - self._equations.measure(mean[None])[0]
        expected = seen @ covariance @ seen.T + self._noise
        root = np.linalg.cholesky(expected)
        white: Floats = np.linalg.solve(root, residual)
        if np.abs(white).max() > JUMP:
            self._begin(row)
        else:
            gain = np.linalg.solve(root, seen @ covariance)
            mean = mean + np.clip(white, -CLIP, CLIP) @ gain
            covariance = covariance - gain.T @ gain
            self.mean, self.covariance = mean, (covariance + covariance.T) / 2
        return white, residual**2 / np.diag(expected)


def derivative(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Return the derivative of a function of states at one, (M, N), by central differences."""
    shifts = STEP * np.eye(len(at))
    values = function(np.concatenate([at + shifts, at - shifts]))
    return np.asarray((values[: len(at)] - values[len(at) :]).T / (2 * STEP))


def noise_of(make: Callable[[], Equations], nominal: Sequence[Trajectory]) -> Floats:
    """Return the variances of the sensors' noise in nominal episodes, (S,).

    They begin with half of the variance of one-row residuals, by their median, and are multiplied
    by the mean of what squared innovations are over what the filter expects of them.

    Parameters
    ----------
    make
        Returns the equations for an episode.
    nominal
        Episodes, of which the first `ENOUGH` are taken.
    """
    equations = make()
    chosen = [x for x in nominal if len(x) > 1][:ENOUGH]
    residuals = [
        x.observations[t + 1]
        - equations.measure(
            equations.step(equations.start(x.observations[t : t + 1].astype(np.float64)), a)
        )[0]
        for x in chosen
        for t, a in enumerate(x.actions)
    ]
    floor = (1e-8 * np.abs(np.concatenate([x.observations for x in chosen])).max(axis=0)) ** 2
    noise = np.maximum((1.48 * np.median(np.abs(residuals), axis=0)) ** 2 / 2, floor + 1e-18)
    for _ in range(ROUNDS):
        ratios = []
        for x in chosen:
            rows = x.observations.astype(np.float64)
            tracker = ExtendedFilter(make(), noise, rows[0])
            ratios += [
                tracker.update(row, a)[1] for row, a in zip(rows[1:], x.actions, strict=True)
            ]
        noise = np.maximum(noise * np.mean(ratios, axis=0), floor + 1e-18)
    return np.asarray(noise)
