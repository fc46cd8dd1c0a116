"""Which parts are at fault, named as a set: sensors and actuators, by the evidence of sets.

A fault of a sensor is a reading that is its state and something else. It shows in the row itself,
and in the forecasts of the next rows, which are made from it: so a faulty sensor is told from
neighbours whose forecasts it spoils.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from oodd_common.charts import Floats
from oodd_common.windows import StandardEpisode, regressors
from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale

ORDER: Final = 2
"""Latest rows, and commands, that a forecast uses."""
RIDGE: Final = 1e-4
"""Penalty of the forecast, relative to the mean square of a standardized sensor."""
FOLDS: Final = 5
"""Parts of the episodes, each forecast by what was fitted on the others."""
FLOOR: Final = 3e-3
"""Least standard deviation of a forecast's error, in training standard deviations."""
FREEDOM: Final = 4.0
"""Degrees of freedom of the errors' Student t distribution: contacts make their tails heavy."""
STEPS: Final = 10
"""Steps in which the errors' covariance is found."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadingModel:
    """How readings follow from the two rows, and commands, before them in nominal operation.

    Attributes
    ----------
    sensors, actions
        Means and standard deviations in training, of shape (D,) and (A,); A may be 0.
    coefficients : float64 array of shape (2 (D + A) + 1, D)
        Of standardized regressors: two rows, newest first, two commands, and 1.
    covariance : float64 array of shape (D, D)
        Of the errors of one forecast, standardized.
    """

    sensors: FeatureScale
    actions: FeatureScale
    coefficients: Floats
    covariance: Floats

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> Self:
        """Fit to nominal episodes; those without actions have forecasts without commands."""
        sensors, actions = (
            _scale([x.observations for x in nominal]),
            _scale([x.actions for x in nominal]),
        )
        bare = cls(sensors, actions, np.empty((0, 0)), np.empty((0, 0)))
        pairs = [(bare.regressors(x), bare.standard(x)[1:]) for x in nominal]
        folds = [pairs[i::FOLDS] for i in range(min(FOLDS, len(pairs)))]
        errors = []
        for i, fold in enumerate(folds):
            others = [pair for j, other in enumerate(folds) if j != i for pair in other] or fold
            coefficients = _ridge(others)
            errors += [y - x @ coefficients for x, y in fold]
        return cls(sensors, actions, _ridge(pairs), _covariance(np.concatenate(errors)))

    def standard(self, x: Trajectory) -> Floats:
        """Return the standardized rows of an episode, (T + 1, D)."""
        standard: Floats = (x.observations - self.sensors.mean) / self.sensors.std
        return standard

    def regressors(self, x: Trajectory) -> Floats:
        """Return what forecasts of the rows 1 to T are made of, (T, K)."""
        commands = (x.actions - self.actions.mean) / self.actions.std
        if not len(self.actions.mean):
            commands = np.empty((x.transitions, 0))
        return regressors(StandardEpisode(self.standard(x), commands), 1, ORDER)

    def errors(self, x: Trajectory) -> Floats:
        """Return the errors of the forecasts of the rows 1 to T, standardized: (T, D)."""
        errors: Floats = self.standard(x)[1:] - self.regressors(x) @ self.coefficients
        return errors


def _scale(arrays: Sequence[NDArray[np.float32]]) -> FeatureScale:
    rows = np.concatenate(arrays).astype(np.float64)
    std = rows.std(axis=0)
    return FeatureScale(rows.mean(axis=0), np.where(std < CONSTANT, 1.0, std))


def _ridge(pairs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return the coefficients of a ridge regression, whose constant goes unpunished."""
    gram = sum(x.T @ x for x, _ in pairs)
    penalty = np.full(len(gram), RIDGE * gram[-1, -1])
    penalty[-1] = 0.0
    return np.asarray(np.linalg.solve(gram + np.diag(penalty), sum(x.T @ y for x, y in pairs)))


def _covariance(errors: Floats) -> Floats:
    """Return the scatter of errors with the weights of a Student t (Lange et al. 1989)."""
    dimensions = errors.shape[1]
    floor = FLOOR**2 * np.eye(dimensions)
    scatter = errors.T @ errors / len(errors) + floor
    for _ in range(STEPS):
        lengths = np.einsum("nd,de,ne->n", errors, np.linalg.inv(scatter), errors)
        weights = (FREEDOM + dimensions) / (FREEDOM + lengths)
        scatter = (errors * weights[:, None]).T @ errors / len(errors) + floor
    return scatter
