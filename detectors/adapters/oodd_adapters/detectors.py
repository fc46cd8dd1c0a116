"""Detectors that leave the work to a class of another library.

An outlier detector's score is the class's own, of the window of the latest observations. A
forecaster's score is the mean absolute error of its forecast, in training standard deviations.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import StorableWindowDetector

from oodd_adapters.windows import (
    Floats,
    Function,
    compares_rows,
    flat_windows,
    row_by_row,
    sample_windows,
    seeded,
)
from oodd_eval import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.parameters import parameter
from oodd_eval.plugins.state import Arrays, take

PROBE: Final = 200
"""Rows on which a forecaster is tried."""


@dataclass(frozen=True)
class AdapterParameters:
    """Parameters of the adapters themselves. They hide those of the same name of a class."""

    window: int = parameter(4, low=1, help="observations in a row")
    rows: int = parameter(10_000, low=2, help="rows to train on, at most: a random choice of all")


class _Adapter(StorableWindowDetector):
    """Common part of both kinds: windows, seeds, and one row at a time where it has to be.

    The seed decides which rows are taken for training, and whatever the class draws. There is no
    safe way to hand over an object of any class: the state is the rows that it was fitted on, and
    restoring it fits another one on them, with the same seed.

    Parameters
    ----------
    name, seed, horizon, lag
        See `WindowDetector`.
    make
        Returns a new, unfitted object of the class, with keyword arguments beside those of the
        user; called once per fit, and perhaps once to try.
    parameters
        How to feed it.
    """

    kind: ClassVar[str] = "windows/1"
    ahead: ClassVar[int]
    """Rows from the end of a training window to the one that is predicted from it."""

    alone_: bool
    """True for a library that compares the rows of a call: it is given one row at a time."""

    def __init__(
        self,
        name: str,
        make: Callable[..., Any],
        parameters: AdapterParameters,
        *,
        seed: int,
        horizon: int,
        lag: int | None = None,
    ) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window, lag=lag)
        self.make, self.parameters = make, parameters

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < lag."""
        standardized = self._scale()(trajectory)
        scores = np.full(len(standardized), np.nan)
        times = np.arange(self.lag, len(standardized))
        if len(times):
            rows = flat_windows(standardized, times - self.lag, self.window)
            scores[times] = self._scores(rows, standardized[times], alone=self.alone_)
        return scores

    @abstractmethod
    def _scores(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:
        """Return scores (N,) from windows (N, W * D) and the observations to judge (N, D)."""

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        rows = window.reshape(1, -1).astype(np.float64)
        return float(self._scores(rows, now[None], alone=True)[0])

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        rows, later = sample_windows(
            nominal,
            scale,
            length=self.window,
            ahead=self.ahead,
            limit=self.parameters.rows,
            seed=self.seed,
        )
        self._take(rows, later)
        return scale

    def _take(self, rows: NDArray[np.float32], later: NDArray[np.float32]) -> None:
        self.rows_, self.later_ = rows, later
        self._fit_class(rows.astype(np.float64), later.astype(np.float64))

    @abstractmethod
    def _fit_class(self, rows: Floats, later: Floats) -> None:
        """Fit the class on windows (N, W * D) and the rows (N, D) ahead of them."""

    def _fitted_with(self) -> dict[str, Any]:
        return {"name": self.name, "window": self.window, "ahead": self.ahead}

    def _arrays(self) -> Arrays:
        return {"rows": self.rows_, "later": self.later_}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        rows = take(arrays, "rows", (None, self.window * sensors))
        self._take(rows, take(arrays, "later", (len(rows), sensors)))

    def _seeded_call(self, function: Callable[[Floats], Any]) -> Function:
        def call(rows: Floats) -> Floats:
            with seeded(self.seed):
                return np.asarray(function(rows), dtype=np.float64)

        return call


class OutlierDetector(_Adapter):
    r"""Score the window of the latest observations by its distance from training windows.

    .. math:: s_t = \mathrm{sign} \cdot f(o_t, o_{t-1}, \dots, o_{t-W+1})

    with f the method of an outlier detector that was fitted on windows of nominal trajectories, and
    sensors standardized by training statistics. Higher means more anomalous. Defined for all t:
    windows that reach before the beginning repeat the first observation. The horizon is without
    meaning here, since nothing is predicted, and changes nothing.

    Parameters
    ----------
    arguments, more
        Arguments of `_Adapter`.
    method
        Name of the scoring method.
    sign
        1 if higher means more anomalous there, -1 if it is the reverse.
    """

    ahead: ClassVar[int] = 0

    def __init__(self, *arguments: Any, method: str, sign: int, **more: Any) -> None:
        super().__init__(*arguments, **more, lag=0)
        self.method, self.sign = method, sign

    def _fit_class(self, rows: Floats, later: Floats) -> None:  # noqa: ARG002  nothing is predicted
        with seeded(self.seed):  # also the constructor, which may seed the global generators
            model = self.make()
            model.fit(rows)
        call = self._seeded_call(getattr(model, self.method))

        def function(rows: Floats) -> Floats:
            values = call(rows)
            if values.size != len(rows):
                raise ContractError(
                    f"detector {self.name!r} gave an array of shape {values.shape} for "
                    f"{len(rows)} windows, expected one score per window"
                )
            return values.reshape(len(rows))

        self.function_: Function = function
        self.alone_ = compares_rows(function, rows)

    def _scores(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:  # noqa: ARG002  the newest part of the window
        return self.sign * row_by_row(self.function_, rows, alone=alone)


class OnlineDetector(_Adapter):
    r"""Score the window of the latest observations by an online detector that has stopped learning.

    .. math:: s_t = f(o_t, o_{t-1}, \dots, o_{t-W+1})

    with f the ``score_one`` of an object whose ``learn_one`` was given windows of nominal
    trajectories one by one, in an order that the seed decides: what forgets keeps the latest rows,
    which are then from all trajectories. Rows are mappings from the number of a column to its
    value. Scoring teaches it nothing, so that no episode is remembered. Higher means more
    anomalous; defined for all t, and the horizon changes nothing, as of `OutlierDetector`.

    A detector of one variable gets an object per sensor, which learns and scores the sensor's
    newest value; the score is their mean.

    Parameters
    ----------
    arguments, more
        Arguments of `_Adapter`.
    limits
        Whether the constructor takes the range of each column, which is that of training rows.
    one_variable
        Whether it is a detector of one variable, ``score_one(x, y)``.
    """

    ahead: ClassVar[int] = 0

    def __init__(self, *arguments: Any, limits: bool, one_variable: bool, **more: Any) -> None:
        super().__init__(*arguments, **more, lag=0)
        self.limits, self.one_variable = limits, one_variable
        self.alone_ = True  # There is no other way to score them.

    def _fit_class(self, rows: Floats, later: Floats) -> None:
        order = np.random.default_rng(self.seed).permutation(len(rows))
        with seeded(self.seed):
            if self.one_variable:
                function = _score_each(
                    [self._one_of(values) for values in later[order].T], later.shape[1]
                )
            else:
                function = self._of_rows(rows[order])
        self.function_: Function = self._seeded_call(function)
        self._must_not_learn(rows)

    def _of_rows(self, rows: Floats) -> Callable[[Floats], Floats]:
        """Return the scores of windows by an object that has learnt these."""
        more: dict[str, Any] = {}
        if self.limits:
            more["limits"] = dict(enumerate(zip(rows.min(0).tolist(), rows.max(0).tolist())))  # noqa: B905  columns both
        model = self.make(**more)
        for row in rows.tolist():
            model.learn_one(dict(enumerate(row)))
        return lambda rows: np.array([model.score_one(dict(enumerate(r))) for r in rows.tolist()])

    def _one_of(self, values: NDArray[np.float64]) -> Any:
        """Return an object that has learnt the values of one sensor."""
        model = self.make()
        for value in values.tolist():
            model.learn_one(None, value)
        return model

    def _must_not_learn(self, rows: Floats) -> None:
        """Raise `ContractError` where a score changes what later scores are."""
        some = rows[np.linspace(0, len(rows) - 1, num=8).astype(int)]
        some = np.concatenate([some, 3.0 * some])
        first, again = (row_by_row(self.function_, some, alone=True) for _ in range(2))
        if not np.array_equal(first, again, equal_nan=True):
            raise ContractError(
                f"detector {self.name!r} learns from what it scores: the same rows have other "
                "scores the second time, so that it would remember the episodes that it is to "
                "judge; name one that learns in learn_one alone"
            )

    def _scores(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:  # noqa: ARG002  the newest part of the window
        return row_by_row(self.function_, rows, alone=alone)


def _score_each(models: Sequence[Any], sensors: int) -> Callable[[Floats], Floats]:
    """Return the mean of the scores of each sensor's newest value, by a detector of each."""

    def function(rows: Floats) -> Floats:
        newest = rows[:, :sensors].tolist()
        scores = np.array(
            [[m.score_one(None, v) for m, v in zip(models, row, strict=True)] for row in newest]
        )
        return np.asarray(scores.mean(axis=1))

    return function


class ForecastDetector(_Adapter):
    r"""Score an observation by its distance from a forecast of the ones before.

    .. math:: s_t = \frac{1}{D} \sum_{d=1}^{D} \frac{|o_{t,d} - \hat o_{t,d}|}{\sigma_d}

    where the forecaster predicts, from a window of standardized observations, the difference
    between the next one and the newest; for a horizon h that is fed back h times. Scores are
    undefined (NaN) for t < h only: windows that reach before the beginning repeat the first
    observation.

    A class that predicts one number gets one object per sensor. Which of the two it is, is found
    out by trying. Whatever the horizon, it learns one-step transitions.
    """

    ahead: ClassVar[int] = 1

    def _fit_class(self, rows: Floats, later: Floats) -> None:
        sensors = later.shape[1]
        differences = later - rows[:, :sensors]
        with seeded(self.seed):
            if sensors > 1 and self._takes_vectors(rows[:PROBE], differences[:PROBE]):
                model = self.make()
                model.fit(rows, differences)
                predict: Function = model.predict
            else:
                predict = self._one_per_sensor(rows, differences)
        self.predict_: Function = self._seeded_call(predict)
        self.alone_ = compares_rows(self.predict_, rows)

    def _scores(self, rows: Floats, now: NDArray[np.float32], *, alone: bool) -> Floats:
        forecasts = row_by_row(self._forecast, rows, alone=alone)  # (N, D)
        errors: Floats = np.abs(now - forecasts).mean(axis=1)
        return errors

    def _forecast(self, rows: Floats) -> Floats:
        """Return the observation h steps after each window: (n, W * D) to (n, D)."""
        sensors = rows.shape[1] // self.window
        for _ in range(self.lag):
            difference = self.predict_(rows).reshape(len(rows), sensors)
            newest = rows[:, :sensors] + difference
            rows = np.concatenate([newest, rows[:, :-sensors]], axis=1)
        return rows[:, :sensors]

    def _takes_vectors(self, rows: Floats, differences: Floats) -> bool:
        """Return True if the class predicts all sensors at once, tried on a few rows."""
        try:
            model = self.make()
            with warnings.catch_warnings(action="ignore"):
                model.fit(rows, differences)
            return bool(np.shape(model.predict(rows)) == differences.shape)
        except (ValueError, TypeError):
            return False  # If something else was wrong, fitting one per sensor says so.

    def _one_per_sensor(self, rows: Floats, differences: Floats) -> Function:
        models = [self.make() for _ in range(differences.shape[1])]
        for model, target in zip(models, differences.T, strict=True):
            model.fit(rows, target)
        return lambda rows: np.stack([np.ravel(m.predict(rows)) for m in models], axis=1)
