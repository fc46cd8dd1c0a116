"""Windows of observations, and bases of detectors that judge an observation by one.

A subclass says how it learns and how it scores. Its base checks seed and horizon, refuses to score
before `fit`, keeps the latest observations of a live episode, and hands over the fit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import NotFittedError, TrajectoryError
from oodd_eval.plugins.contract import Progress, Scores, ignore_progress
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.parameters import checked, parameter
from oodd_eval.plugins.state import Arrays, State, labelled, unlabelled

Row = NDArray[np.float32]


def windows(
    rows: NDArray[np.float32], last: NDArray[np.int64], length: int, first: ArrayLike = 0
) -> NDArray[np.float32]:
    """Return the windows that end in the given rows, newest first.

    Before the beginning, the first observation is repeated. A window holds nothing after its end.

    Parameters
    ----------
    rows : array of shape (N, D)
        Observations in the order of time.
    last : int64 array of shape (B,)
        Row number of the newest observation of each window.
    length
        Observations in a window, W.
    first : int64 array of shape (B,) or number
        Row number of the first observation of the episode of each window.

    Returns
    -------
    array of shape (B, W, D)

    Examples
    --------
    >>> o = np.array([[0.0], [1.0], [2.0]], np.float32)
    >>> windows(o, np.array([0, 2]), 2)[..., 0].tolist()
    [[0.0, 0.0], [2.0, 1.0]]
    """
    lags = last[:, None] - np.arange(length)
    taken: NDArray[np.float32] = rows[np.maximum(lags, np.reshape(first, (-1, 1)))]
    return taken


@dataclass(frozen=True, slots=True)
class _FactoryArguments:
    """Arguments that the harness gives to every factory."""

    seed: int = parameter(0, low=0)
    horizon: int = parameter(1, low=1)


class WindowDetector(ABC):
    """A detector that judges ``o_t`` by the observations ``o_{t-lag} .. o_{t-lag-window+1}``.

    Before the beginning of an episode, its first observation is repeated. Scores are undefined
    (NaN) for t < lag.

    Parameters
    ----------
    name
        Name for messages.
    seed
        Decides every random draw; at least 0.
    horizon
        Prediction horizon in steps, h; at least 1.
    window
        Observations that a judgement looks at, W.
    lag
        Steps from the newest of them to the observation that is judged; default the horizon.
    actions
        Whether judgements look at the commanded actions, too. Then `_learn` sets `action_scale_`.

    Raises
    ------
    UsageError
        When seed or horizon is no whole number or too small.
    """

    def __init__(
        self,
        name: str,
        *,
        seed: int,
        horizon: int,
        window: int = 1,
        lag: int | None = None,
        actions: bool = False,
    ) -> None:
        checked(_FactoryArguments, name, {"seed": seed, "horizon": horizon})
        self.name, self.seed, self.horizon = name, seed, horizon
        self.window, self.lag = window, horizon if lag is None else lag
        self.actions = actions
        self.scale_: FeatureScale | None = None
        self.action_scale_: FeatureScale
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> Self:
        """Learn from nominal trajectories, forgetting any earlier fit.

        Raises `TrajectoryError` when they cannot be learned from: no transition, say.
        """
        self.scale_ = None
        self.scale_ = self._learn(nominal)
        self.reset()
        return self

    @abstractmethod
    def score(self, trajectory: Trajectory) -> Scores:
        """Return one score per observation.

        Raises `NotFittedError` before `fit`, and `TrajectoryError` when the trajectory has another
        number of sensors than those of `fit`.
        """

    def reset(self) -> None:
        """Begin a new live episode."""
        self._rows: deque[NDArray[Any]] = deque(maxlen=self.window + self.lag)
        self._commands: deque[Row] = deque(maxlen=self.window + self.lag - 1)
        self._now = 0

    def update(self, observation: Row, action: Row | None = None) -> float:
        """Return the score of the next observation of a live episode, NaN for t < lag.

        A detector that looks at actions needs the one commanded since the previous observation from
        the second observation on. Raises as `score` does, and `TrajectoryError` for values that are
        not finite or an action that is missing.
        """
        row = self._row(observation)
        if self.actions and self._now:
            self._commands.appendleft(self._command(action))
        if not self._rows:
            self._rows.extend([row] * (self.window + self.lag))
        self._rows.appendleft(row)
        t, self._now = self._now, self._now + 1
        if t < self.lag:
            return float("nan")
        return self._judge(np.stack(list(self._rows)[self.lag :]), row, t)

    def _row(self, observation: Row) -> NDArray[Any]:
        """Return an observation as windows hold it: standardized."""
        return self._scale().row(observation)

    def _scale(self) -> FeatureScale:
        """Return the scale of the fit, or raise `NotFittedError`."""
        if self.scale_ is None:
            raise NotFittedError(
                f"detector {self.name!r} was asked for scores before fit: fit it on nominal "
                "trajectories"
            )
        return self.scale_

    def _command(self, action: Row | None) -> Row:
        """Return a copy of an action as it is, (A,): loops may write the next one into theirs."""
        width = len(self.action_scale_.mean)
        command = np.array(np.nan if action is None else action, dtype=np.float32)
        if command.shape != (width,) or not np.isfinite(command).all():
            raise TrajectoryError(
                f"detector {self.name!r} was given an action {action}, expected {width} finite "
                "numbers"
            )
        return command

    def _widths(self, x: Trajectory) -> tuple[int, int]:
        """Return the numbers of sensors and of action columns that judgements look at."""
        return x.observation_dim, x.action_dim if self.actions else 0

    def _must_fit(self, trajectory: Trajectory) -> None:
        """Raise `TrajectoryError` for other numbers of sensors or action columns than in `fit`."""
        sensors = len(self._scale().mean)
        fitted = (sensors, len(self.action_scale_.mean) if self.actions else 0)
        if (widths := self._widths(trajectory)) != fitted:
            raise TrajectoryError(
                f"detector {self.name!r} was fitted on (sensors, action columns) {fitted} "
                f"and asked to score a trajectory of {widths}: score trajectories of the "
                "environment that it was fitted on"
            )

    @abstractmethod
    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        """Learn everything; return the scale of the sensors."""

    @abstractmethod
    def _judge(self, window: NDArray[Any], now: NDArray[Any], t: int) -> float:
        """Return the score of the observation of time t, (D,), by the window (W, D) before it."""


class StorableWindowDetector(WindowDetector):
    """A `WindowDetector` whose fit can be handed over as arrays."""

    kind: ClassVar[str]
    """Name of the state, with the version of its layout: ``"rf/1"``."""

    def state(self) -> dict[str, Any]:
        """Return the fit as arrays, with the parameters that it goes with."""
        arrays = {**self._scale().arrays(), **self._arrays()}
        return labelled(self.kind, self._fitted_with(), arrays)

    def restore(self, state: State) -> None:
        """Take over a fit that `state` returned.

        Raises `FittedStateError` when it is damaged, or of a detector with other parameters.
        """
        arrays = unlabelled(state, self.kind, self._fitted_with())
        scale = FeatureScale.of(arrays)
        self.scale_ = None
        self._restore(arrays, len(scale.mean))
        self.scale_ = scale
        self.reset()

    @abstractmethod
    def _fitted_with(self) -> dict[str, Any]:
        """Return the parameters that a detector must share with a fit to take it over, as JSON."""

    @abstractmethod
    def _arrays(self) -> Arrays:
        """Return the fit as arrays of numbers, by name; the scale is not among them."""

    @abstractmethod
    def _restore(self, arrays: Arrays, sensors: int) -> None:
        """Take over the fit from arrays that `_arrays` returned."""


class LongFitDetector(StorableWindowDetector):
    """A `StorableWindowDetector` whose fit takes long, and tells how far it is.

    `_learn` calls `progress` with the share that is done.
    """

    progress: Progress

    def fit(self, nominal: Sequence[Trajectory], progress: Progress | None = None) -> Self:
        """Learn from nominal trajectories, see `WindowDetector.fit`, and tell `progress`."""
        self.progress = progress or ignore_progress
        return super().fit(nominal)


class StandardEpisode(NamedTuple):
    """Standardized rows (T + 1, D) and actions (T, A) of an episode; A may be 0."""

    rows: Scores
    actions: Scores


def regressors(episode: StandardEpisode, horizon: int, order: int) -> Scores:
    """Return what the forecasts of rows h, ..., T use, (T + 1 - h, K).

    The latest `order` rows of sensors and of actions, newest first, with the first observation
    repeated and no action (0, the mean) before the beginning; then 1.

    Examples
    --------
    >>> episode = StandardEpisode(np.array([[1.0], [2.0], [3.0]]), np.empty((2, 0)))
    >>> regressors(episode, 1, order=2).tolist()
    [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
    """
    rows, actions = episode
    n = max(len(rows) - horizon, 0)
    lags = np.arange(n)[:, None] - np.arange(order)
    parts = [rows[np.maximum(lags, 0)].reshape(n, order * rows.shape[1])]
    if actions.shape[1]:
        known = np.where(lags[..., None] >= 0, actions[np.maximum(lags, 0)], 0.0)
        parts.append(known.reshape(n, order * actions.shape[1]))
    return np.concatenate([*parts, np.ones((n, 1))], axis=1)
