"""Detectors that leave the work to a class of another library."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_adapters.windows import (
    Floats,
    Function,
    compares_rows,
    row_by_row,
    sample_windows,
    seeded,
    windows,
)
from oodd_eval import Trajectory
from oodd_eval.errors import ContractError, NotFittedError, UsageError
from oodd_eval.plugins.forecasting import FeatureScale

PROBE: Final = 200
"""Rows on which a forecaster is tried."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the adapters themselves are told.

    Attributes
    ----------
    name
        Of the detector, for messages.
    seed
        Decides which rows are taken for training, and whatever the class draws.
    horizon
        Prediction horizon in steps, h.
    window
        Observations in a window, W.
    rows
        Windows to train on, at most: a random choice of all.

    Raises
    ------
    UsageError
        When a number is not an integer in its range.
    """

    name: str
    seed: int
    horizon: int
    window: int
    rows: int

    def __post_init__(self) -> None:
        for parameter, least in (("seed", 0), ("horizon", 1), ("window", 1), ("rows", 2)):
            value = getattr(self, parameter)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise UsageError(
                    f"parameter {parameter} of detector {self.name!r}: expected an integer of at "
                    f"least {least}, got {value!r}"
                )


class _Adapter(ABC):
    """What both kinds share: windows, seeds, streaming, and one row at a time where it has to be.

    Parameters
    ----------
    make
        Returns a new, unfitted object of the class; called once per fit, and perhaps once to try.
    settings
        How to feed it.
    lag
        Steps from the window that a score looks at to the observation that is judged.
    """

    def __init__(self, make: Callable[[], Any], settings: Settings, lag: int) -> None:
        self.make, self.settings, self.lag = make, settings, lag
        self.scale_: FeatureScale | None = None
        self._recent: list[NDArray[np.float32]] = []

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < lag.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            When the trajectory has another number of sensors than those of `fit`.
        """
        standardized = self._standardized(trajectory)
        scores = np.full(len(standardized), np.nan)
        times = np.arange(self.lag, len(standardized))
        if len(times):
            rows = windows(standardized, times - self.lag, self.settings.window)
            scores[times] = self._judge(rows, standardized[times], alone=self.alone_)
        return scores

    def reset(self) -> None:
        """Begin a new episode."""
        self._recent = []

    def update(self, observation: ArrayLike, action: ArrayLike | None = None) -> float:  # noqa: ARG002  the contract's name
        """Return the score of the next observation of the episode; actions are not looked at.

        Raises
        ------
        NotFittedError, TrajectoryError
            As `score` does.
        """
        self._recent.append(np.array(observation, dtype=np.float32))
        del self._recent[: -self.settings.window - self.lag]
        n = len(self._recent)
        standardized = self._standardized(Trajectory(self._recent, np.zeros((n - 1, 1))))
        if n <= self.lag:
            return np.nan
        last = np.array([n - 1])
        rows = windows(standardized, last - self.lag, self.settings.window)
        return float(self._judge(rows, standardized[last], alone=True)[0])

    @abstractmethod
    def _judge(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:
        """Return scores (N,) from windows (N, W * D) and the observations to judge (N, D)."""

    def _sample(self, nominal: Sequence[Trajectory], ahead: int) -> tuple[Floats, Floats]:
        self.reset()
        self.scale_ = FeatureScale.fit(nominal)
        s = self.settings
        return sample_windows(
            nominal, self.scale_, length=s.window, ahead=ahead, limit=s.rows, seed=s.seed
        )

    def _standardized(self, trajectory: Trajectory) -> NDArray[np.float32]:
        if self.scale_ is None:
            raise NotFittedError(
                f"detector {self.settings.name!r} was asked for scores before fit: fit it on "
                "nominal trajectories"
            )
        return self.scale_(trajectory)

    alone_: bool
    """Whether the library compares the rows of a call, so that it is given one at a time."""


class OutlierDetector(_Adapter):
    r"""How far out of training the window of the latest observations lies.

    .. math:: s_t = \mathrm{sign} \cdot f(o_t, o_{t-1}, \dots, o_{t-W+1})

    with f the method of an outlier detector that was fitted on windows of nominal trajectories, and
    sensors standardized by training statistics. Higher means more anomalous. Defined for all t:
    windows that reach before the beginning repeat the first observation. The horizon is without
    meaning here, since nothing is predicted, and changes nothing.

    Parameters
    ----------
    make
        Returns a new, unfitted object of the class.
    method
        Name of the scoring method.
    sign
        1 if higher means more anomalous there, -1 if it is the reverse.
    settings
        How to feed it.
    """

    def __init__(self, make: Callable[[], Any], method: str, sign: int, settings: Settings) -> None:
        super().__init__(make, settings, lag=0)
        self.method, self.sign = method, sign

    def fit(self, nominal: Sequence[Trajectory]) -> OutlierDetector:
        """Fit a new object of the class on windows of nominal trajectories.

        Raises
        ------
        TrajectoryError
            When there is no transition, or the trajectories differ in their number of sensors.
        """
        rows, _ = self._sample(nominal, ahead=0)
        model, seed = self.make(), self.settings.seed
        with seeded(seed):
            model.fit(rows)
        self.function_: Function = _scored(getattr(model, self.method), seed, self.settings.name)
        self.alone_ = compares_rows(self.function_, rows)
        return self

    def _judge(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:  # noqa: ARG002  the newest part of the window
        return self.sign * row_by_row(self.function_, rows, alone=alone)


class ForecastDetector(_Adapter):
    r"""How far the observation is from what a forecaster makes of the ones before.

    .. math:: s_t = \frac{1}{D} \sum_{d=1}^{D} \frac{|o_{t,d} - \hat o_{t,d}|}{\sigma_d}

    where the forecaster predicts, from a window of standardized observations, the difference
    between the next one and the newest; for a horizon h that is fed back h times. Scores are
    undefined (NaN) for t < h only: windows that reach before the beginning repeat the first
    observation.

    A class that predicts one number gets one object per sensor. Which of the two it is, is found
    out by trying.

    Parameters
    ----------
    make
        Returns a new, unfitted object of the class.
    settings
        How to feed it.
    """

    def __init__(self, make: Callable[[], Any], settings: Settings) -> None:
        super().__init__(make, settings, lag=settings.horizon)

    def fit(self, nominal: Sequence[Trajectory]) -> ForecastDetector:
        """Fit the forecaster to one-step transitions, whatever the horizon.

        Raises
        ------
        TrajectoryError
            When there is no transition, or the trajectories differ in their number of sensors.
        """
        rows, later = self._sample(nominal, ahead=1)
        sensors = later.shape[1]
        differences = later - rows[:, :sensors]
        with seeded(self.settings.seed):
            if sensors > 1 and self._takes_vectors(rows[:PROBE], differences[:PROBE]):
                model = self.make()
                model.fit(rows, differences)
                predict: Function = model.predict
            else:
                predict = _stacked(self._one_per_sensor(rows, differences))
        self.predict_: Function = _seeded_call(predict, self.settings.seed)
        self.alone_ = compares_rows(self.predict_, rows)
        return self

    def _judge(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:
        forecasts = row_by_row(self._forecast, rows, alone=alone)  # (N, D)
        errors: Floats = np.abs(now - forecasts).mean(axis=1)
        return errors

    def _forecast(self, rows: Floats) -> Floats:
        """Return the observation h steps after each window: (n, W * D) to (n, D)."""
        sensors = rows.shape[1] // self.settings.window
        for _ in range(self.lag):
            difference = self.predict_(rows).reshape(len(rows), sensors)
            newest = rows[:, :sensors] + difference
            rows = np.concatenate([newest, rows[:, :-sensors]], axis=1)
        return rows[:, :sensors]

    def _takes_vectors(self, rows: Floats, differences: Floats) -> bool:
        """Whether the class predicts all sensors at once: try it on a few rows."""
        try:
            model = self.make()
            with warnings.catch_warnings(action="ignore"):
                model.fit(rows, differences)
            return bool(np.shape(model.predict(rows)) == differences.shape)
        except (ValueError, TypeError):
            return False  # If something else was wrong, fitting one per sensor says so.

    def _one_per_sensor(self, rows: Floats, differences: Floats) -> list[Function]:
        models = [self.make() for _ in range(differences.shape[1])]
        for model, target in zip(models, differences.T, strict=True):
            model.fit(rows, target)
        return [model.predict for model in models]


def _seeded_call(function: Callable[[Floats], Any], seed: int) -> Function:
    def call(rows: Floats) -> Floats:
        with seeded(seed):
            return np.asarray(function(rows), dtype=np.float64)

    return call


def _scored(function: Callable[[Floats], Any], seed: int, name: str) -> Function:
    """Return the function with a check that it gives one number per row."""
    call = _seeded_call(function, seed)

    def checked(rows: Floats) -> Floats:
        values = call(rows)
        if values.size != len(rows):
            raise ContractError(
                f"detector {name!r} gave an array of shape {values.shape} for {len(rows)} windows, "
                "expected one score per window"
            )
        return values.reshape(len(rows))

    return checked


def _stacked(predictions: Sequence[Function]) -> Function:
    return lambda rows: np.stack([np.ravel(predict(rows)) for predict in predictions], axis=1)
