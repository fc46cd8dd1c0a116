"""A virtual sensor: what named sensors would read, by the others and by nominal operation.

It is a Kalman filter (Kalman 1960) around the forecasts of a `ReadingModel`, the same for all
detectors. A named sensor is not left out but noisier by the size of its fault: a small fault is
better left almost alone. Sensors that nobody names are exact, so that only the named ones have an
uncertain state, and one row costs one linear system of as many equations as there are sensors.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from oodd_common.charts import Floats

from oodd_eval.plugins.explanations import NAMED, Naming
from oodd_interventions.situation import Row, Situation

TRUSTED: Final = 1e-6
"""Variance of a sensor that nobody names, standardized: for numerical safety."""
EARLIER: Final = 10
"""Rows before the onset at which estimates begin: an onset that is found late spoils them all."""
FARTHEST: Final = 10.0
"""Largest distance from the mean that a value may have, in training standard deviations."""
LARGEST: Final = 1e4
"""Largest size of a fault, and variance of an estimate, standardized."""


class VirtualSensor:
    """Readings for the policy, in which those of named sensors are estimates.

    Rows from the onset on are filtered when the first estimate is asked for, and again when the
    situation gets another naming.

    Parameters
    ----------
    situation
        The episode from the alarm on, with the naming to go by.

    Examples
    --------
    >>> command = situation.policy.act(sensor.row(row))  # doctest: +SKIP
    """

    def __init__(self, situation: Situation) -> None:
        self._situation = situation
        dimension = len(situation.model.sensors.mean)
        # Coefficients of the newest row, the one before, the commands and the constant.
        self._parts = np.split(
            situation.model.coefficients.T, [dimension, 2 * dimension, -1], axis=1
        )
        self._naming: Naming | None = None

    def row(self, reported: Row) -> Row:
        """Return the situation's latest row with estimates of the named sensors.

        Parameters
        ----------
        reported : float32 array of shape (D,)
            That row as the sensors report it.

        Returns
        -------
        float32 array of shape (D,)
        """
        if self._naming is not self._situation.naming:
            self._begin()
        while self._next < len(self._situation.rows):
            self._filter(self._next)
            self._next += 1
        estimate, scale, named = reported.copy(), self._situation.model.sensors, self._named
        estimate[named] = scale.mean[named] + scale.std[named] * self._values[: len(named)]
        return estimate

    def _standard(self, t: int) -> Floats:
        """Return row number t, the first one before it, standardized."""
        scale = self._situation.model.sensors
        return np.asarray((self._situation.rows[max(t, 0)] - scale.mean) / scale.std)

    def _command(self, t: int) -> Floats:
        """Return command number t, standardized; the mean before the first."""
        scale = self._situation.model.actions
        if t < 0:
            return np.zeros_like(scale.mean)
        return np.asarray((self._situation.actions[t] - scale.mean) / scale.std)

    def _begin(self) -> None:
        """Begin before the onset, with the sensors that are named now."""
        naming = self._naming = self._situation.naming
        self._named = named = np.flatnonzero(naming.sensors >= NAMED)
        variances = np.full(len(naming.sensors), TRUSTED)
        sizes = naming.sizes[named] / self._situation.model.sensors.std[named]
        # A size that is not known says as little as a reading that says nothing.
        variances[named] = np.where(np.isfinite(sizes), np.minimum(sizes, LARGEST) ** 2, np.inf)
        self._read = np.flatnonzero(np.isfinite(variances))
        self._noise = np.diag(np.maximum(variances[self._read], TRUSTED))
        # Values of the named sensors now and one row before, and their covariance.
        start = max(self._situation.onset - EARLIER, 0)
        self._next = min(start, len(self._situation.rows) - 1)
        self._values = np.concatenate([self._standard(self._next - i)[named] for i in (1, 2)])
        self._covariance = np.zeros((2 * len(named), 2 * len(named)))
        self._forward = np.hstack([self._parts[0][:, named], self._parts[1][:, named]])

    def _filter(self, t: int) -> None:
        """Take in the reading of row t."""
        named, k = self._named, len(self._named)
        if not k or not t:
            return
        latest, older = self._standard(t - 1), self._standard(t - 2)
        latest[named], older[named] = self._values[:k], self._values[k:]
        commands = np.concatenate([self._command(t - 1), self._command(t - 2)])
        by_latest, by_older, by_commands, constant = self._parts
        forecast = by_latest @ latest + by_older @ older + by_commands @ commands + constant[:, 0]
        spread = self._forward @ self._covariance
        uncertain = spread @ self._forward.T + self._situation.model.covariance
        # Values now and before, and how they go along with the readings.
        values = np.concatenate([forecast[named], self._values[:k]])
        newest, across = uncertain[np.ix_(named, named)], spread[named, :k]
        covariance = np.block([[newest, across], [across.T, self._covariance[:k, :k]]])
        joint = np.hstack([uncertain[:, named], spread[:, :k]])[self._read]
        innovation = uncertain[np.ix_(self._read, self._read)] + self._noise
        gain = np.linalg.solve(innovation, joint).T
        values += gain @ (self._standard(t) - forecast)[self._read]
        covariance -= gain @ joint
        self._values = np.clip(values, -FARTHEST, FARTHEST)
        self._covariance = np.clip((covariance + covariance.T) / 2, -LARGEST, LARGEST)
