"""The seam between forecasts and charts: what a forecaster is handed, and what it answers.

The detector cuts its nominal episodes into folds. A forecaster learns from them and judges each by
what has not seen it; from these judgements the charts are learnt, whichever forecaster made them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, limited

from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take

LIMIT: Final = 10.0
"""Inputs are clipped at this many standard deviations. No forecaster is trained on larger ones."""


class Known(NamedTuple):
    """The latest observations, actions and times from which N forecasts are made."""

    window: NDArray[np.float32]  # (N, W, sensors), newest first
    actions: NDArray[np.float32] | None  # (N, W, A), NaN before the beginning
    steps: NDArray[np.int64]  # (N,), times of the newest observations


class Transitions(NamedTuple):
    """N steps of one episode in the order of time.

    Attributes
    ----------
    known
        What forecasts start from: observations up to a horizon before ``now``.
    now
        Observations that are judged, (N, sensors).
    before
        Observations of the step before each of them, (N, sensors).
    """

    known: Known
    now: NDArray[np.float32]
    before: NDArray[np.float32]

    def rows(self, index: NDArray[np.int64] | slice) -> Transitions:
        """Return some of the steps."""
        window, actions, steps = self.known
        known = Known(window[index], None if actions is None else actions[index], steps[index])
        return Transitions(known, self.now[index], self.before[index])


class Assessment(NamedTuple):
    """Distances of N observations from their forecasts.

    Attributes
    ----------
    residuals
        Signed residuals of the varying sensors, about standard normal in nominal operation, (N, D).
    log_tails
        Logarithms of the degrees of freedom that were forecast for each, (N, D): how heavy the
        tail of its distribution is. Residuals are brought to one scale by them.
    """

    residuals: Floats
    log_tails: Floats

    def rows(self, index: NDArray[np.int64] | slice) -> Assessment:
        """Return some of the steps."""
        return Assessment(self.residuals[index], self.log_tails[index])


Judge: TypeAlias = Callable[[Transitions], Assessment]
"""Judges the next steps of one episode: each call continues where the last one ended."""


class Units:
    """The units that forecasters share: varying sensors and actions in training deviations.

    Parameters
    ----------
    sensors
        Training mean and standard deviation of every sensor.
    varying
        Indices of the D sensors that are not constant in training.
    commands
        Training mean and standard deviation of the actions; None where forecasts do without.
    window
        Latest observations that a forecast uses, W.
    """

    _live: tuple[Known, Floats] | None = None

    def __init__(
        self,
        sensors: FeatureScale,
        varying: NDArray[np.int64],
        commands: FeatureScale | None,
        window: int,
    ) -> None:
        self.sensors, self.varying, self.commands = sensors, varying, commands
        self.window = window

    @functools.cached_property
    def constant(self) -> NDArray[np.int64]:
        """Indices of the sensors that are constant in training."""
        return np.setdiff1d(np.arange(len(self.sensors.mean)), self.varying)

    @property
    def width(self) -> int:
        """Number of inputs of a forecast, I."""
        commands = 0 if self.commands is None else len(self.commands.mean)
        return self.window * (len(self.varying) + commands) + 1

    def inputs(self, known: Known) -> Floats:
        """Return what forecasts use, (N, I).

        These are the newest observation, the differences of the window, the actions, and whether
        the window reaches beyond the episode's beginning.
        """
        # Two parts of a detector ask for those of each row of a stream.
        if self._live is not None and self._live[0] is known:
            return self._live[1]
        window, actions, steps = known
        scale, n = self.sensors, len(window)
        z = limited((window - scale.mean) / scale.std, LIMIT)
        if len(self.constant):
            z = z[:, :, self.varying]
        parts = [z[:, 0], (z[:, :-1] - z[:, 1:]).reshape(n, -1)]
        if self.commands is not None and actions is not None:
            a = (actions - self.commands.mean) / self.commands.std
            parts.append(np.where(np.isnan(a), 0.0, a).reshape(n, -1))
        parts.append((steps[:, None] < self.window - 1).astype(np.float64))
        inputs = np.concatenate(parts, axis=1)
        self._live = (known, inputs) if n == 1 else None
        return inputs

    def changes(self, now: NDArray[np.float32], before: NDArray[np.float32]) -> Floats:
        """Return changes of the varying sensors, in training standard deviations: (N, D)."""
        change: Floats = (now.astype(np.float64) - before) / self.sensors.std
        return change[:, self.varying] if len(self.constant) else change

    def arrays(self) -> Arrays:
        """Return what `restored` takes, but for the sensors' scale."""
        scale = self.commands or FeatureScale(np.zeros(0), np.ones(0))
        return {"action_scale": np.stack([scale.mean, scale.std]), "varying": self.varying}

    @classmethod
    def restored(cls, arrays: Arrays, *, actions: bool, window: int) -> Units:
        """Return the units among the arrays of a fit; `FittedStateError` where there are none."""
        commands = FeatureScale.of(arrays, "action_scale")
        varying = take(arrays, "varying", (None,), "i")
        return cls(FeatureScale.of(arrays), varying, commands if actions else None, window)

    @classmethod
    def fit(
        cls,
        sensors: FeatureScale,
        observations: NDArray[np.float32],
        actions: NDArray[np.float32] | None,
        window: int,
    ) -> Units:
        """Return the units of training rows of observations, and of actions where they count."""
        varying = np.flatnonzero(observations.std(axis=0, dtype=np.float64) >= CONSTANT)
        commands = None
        if actions is not None:
            values = actions.astype(np.float64)
            spread = values.std(axis=0)
            commands = FeatureScale(values.mean(axis=0), np.where(spread < CONSTANT, 1.0, spread))
        return cls(sensors, varying, commands, window)


class EpisodeForecaster(Protocol):
    """Forecaster of the varying sensors, which judges the observation that came."""

    def fit(
        self, units: Units, pieces: Sequence[Transitions], folds: Sequence[int]
    ) -> list[Assessment | None]:
        """Learn from nominal pieces of episodes, each in one fold, or in none where it is -1.

        Returns the judgement of each piece by what was not trained on its fold, on the scale that
        fresh rows will have; None for a piece that all of the forecaster has seen.
        """
        ...

    def begin(self) -> Judge:
        """Return what judges a new episode."""
        ...

    def explained(self, steps: Transitions, judged: Assessment) -> Floats:
        """Return by how much each varying sensor alone explains steps, (N, D), at least 0.

        The squared error that would be gone if the reading of that sensor alone were free.
        """
        ...

    def arrays(self) -> Arrays:
        """Return the fit as arrays of numbers, by name."""
        ...

    def restore(self, units: Units, arrays: Arrays) -> None:
        """Take over a fit; raise `FittedStateError` where the arrays are none."""
        ...
