"""The choice among forecasters by how likely they make episodes that they were not trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from oodd_common.charts import Floats

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.state import Arrays, take
from oodd_pe import PeParameters
from oodd_pe.density import DensityForecaster
from oodd_pe.forecaster import Assessment, EpisodeForecaster, Judge, Transitions, Units
from oodd_pe.gaussian import GaussianForecaster
from oodd_pe.kalman import UPDATES, KalmanForecaster, noise_shows

SENSORS: Final = 64
"""Most varying sensors with which others than the ensemble are tried: their cost is cubic."""
NAMES: Final = ("ensemble", "processes", "filter")
"""Forecasters, in the order in which a stored fit counts them."""


class ChosenForecaster:
    """The ensemble, Gaussian processes or the filter, whichever held-out episodes are likeliest by.

    All densities are of standardized changes, a mean over rows and sensors of held-out episodes.
    The processes are fitted only where they explain a few rows well, the filter only where the
    errors of a linear forecast show noise of the sensors.

    Parameters
    ----------
    parameters
        See `oodd_pe.PeParameters`.
    seed
        Decides everything that is drawn.
    horizon
        Steps that are forecast; a filter is tried only for one.
    device
        Where torch trains the ensemble, ``cpu`` or ``cuda``.
    """

    def __init__(self, parameters: PeParameters, *, seed: int, horizon: int, device: str) -> None:
        self.parameters, self.horizon = parameters, horizon
        self.processes = GaussianForecaster(seed=seed)
        self.ensemble = DensityForecaster(parameters, seed=seed, device=device)
        self._all: dict[str, DensityForecaster | GaussianForecaster | KalmanForecaster] = {
            "ensemble": self.ensemble,
            "processes": self.processes,
            "filter": KalmanForecaster(seed=seed, updates=min(UPDATES, parameters.updates)),
        }
        self.name_ = "ensemble"
        self.log_densities_: dict[str, float] = {}

    @property
    def chosen(self) -> EpisodeForecaster:
        """The forecaster that is used."""
        return self._all[self.name_]

    def fit(
        self,
        units: Units,
        pieces: Sequence[Transitions],
        folds: Sequence[int],
        progress: Progress = ignore_progress,
    ) -> list[Assessment | None]:
        """Fit those that are worth it, and keep the likeliest: see `EpisodeForecaster.fit`.

        `progress` hears of the ensemble's updates, which take most of the time.
        """
        _, *others = self._candidates(units, pieces, folds)
        judged = {"ensemble": self.ensemble.fit(units, pieces, folds, progress)}
        for name in others:
            judged[name] = self._all[name].fit(units, pieces, folds)
        self.log_densities_ = {name: self._all[name].log_density_ for name in judged}
        self.name_ = "ensemble"
        if len(judged) > 1:
            self.name_ = max(judged, key=lambda name: _number(self.log_densities_[name]))
        return judged[self.name_]

    def begin(self) -> Judge:
        """Return what judges a new episode."""
        return self.chosen.begin()

    def explained(self, steps: Transitions, judged: Assessment) -> Floats:
        """Return by how much each varying sensor alone explains steps, (N, D)."""
        return self.chosen.explained(steps, judged)

    def arrays(self) -> Arrays:
        """Return the fit of the chosen one as arrays of numbers, by name."""
        return {"forecaster": np.array(NAMES.index(self.name_)), **self.chosen.arrays()}

    def restore(self, units: Units, arrays: Arrays) -> None:
        """Take over a fit; raise `FittedStateError` where the arrays are none."""
        number = int(take(arrays, "forecaster", (), "i"))
        if number not in range(len(NAMES)):
            raise FittedStateError(
                f"a fit names forecaster {number}, expected 0 to {len(NAMES) - 1}: it is damaged, "
                "or of a later version; fit again"
            )
        self.name_, self.log_densities_ = NAMES[number], {}
        self.chosen.restore(units, arrays)

    def _candidates(
        self, units: Units, pieces: Sequence[Transitions], folds: Sequence[int]
    ) -> list[str]:
        """Return the names of the forecasters that are worth a fit, the ensemble's first."""
        names = ["ensemble"]
        # Without other folds nothing is held out, and likelihoods say nothing.
        comparable = max(folds) > 0 and 0 < len(units.varying) <= SENSORS
        if self.parameters.forecaster == "ensemble" or not comparable:
            return names
        if self.processes.tune(units, pieces):
            names.append("processes")
        if self.horizon == 1 and noise_shows(units, pieces):
            names.append("filter")
        return names


def _number(log_density: float) -> float:
    return log_density if math.isfinite(log_density) else -math.inf
