"""Nominal episodes that a watchdog is fitted on: of a split, trajectories, or arrays."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.arrays import as_numbers
from oodd_eval.data.baseline import Baseline, check_baseline, episode_means
from oodd_eval.data.facts import roles_of
from oodd_eval.data.offsets import fit_offsets
from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS, EnvironmentData, columns_named
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.metrics.promise import EpisodeMeans, PromiseFinding, promises
from oodd_eval.names import read, whole_number
from oodd_eval.plugins.state import Arrays, take

Floats = NDArray[np.float64]

Episode: TypeAlias = Trajectory | ArrayLike | tuple[ArrayLike, ArrayLike]
"""A trajectory; observations (T + 1, D); or observations and actions (T, A) as a tuple."""


@dataclass(frozen=True, slots=True, eq=False)
class Nominal:
    """Facts of a machine that a watchdog has besides the fit.

    Attributes
    ----------
    sensors
        Their names.
    offsets
        Subtracted from observations in float64, (D,); 0 where nothing is.
    baseline
        Of the first rows of every episode; None where none are declared.
    roles
        Of the sensors, one each; empty where all are just measured.
    actions
        Names of the actions; empty where they have none.
    """

    sensors: list[str]
    offsets: Floats
    baseline: Baseline | None
    roles: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()

    def judged(self, trajectory: Trajectory) -> Trajectory:
        """Return the rows of an episode that are judged, brought to training's."""
        return trajectory if self.baseline is None else self.baseline.judged(trajectory)

    def arrays(self) -> Arrays:
        """Return what `of` reads."""
        base = self.baseline
        zeros = np.zeros(len(self.offsets))
        return {
            "offsets": self.offsets,
            "baseline_mean": zeros if base is None else base.mean,
            "baseline_std": zeros if base is None else base.std,
        }

    @classmethod
    def of(cls, arrays: Arrays, sensors: list[str], rows: int) -> Self:
        """Return it from what was saved; `FittedStateError` for other arrays."""
        names = ("offsets", "baseline_mean", "baseline_std")
        offsets, mean, std = (take(arrays, name, (len(sensors),)) for name in names)
        return cls(sensors, offsets, Baseline(rows, mean, std) if rows else None)


@dataclass(frozen=True, slots=True, eq=False)
class NominalData:
    """Data that a watchdog is fitted on.

    Attributes
    ----------
    train, calibration, further
        Nominal episodes as detectors may see them, and further ones that are known.
    failures
        Failed episodes.
    nominal
        What holds for all of them.
    rate
        Rows in a second, None where it is not known.
    recorded
        Whether the order of episodes is that in which they were recorded.
    recordings
        For each calibration episode the recording that it is a window of; None where each is one.
    other_recordings
        Those of the training episodes and of the further ones.
    """

    train: list[Trajectory]
    calibration: list[Trajectory]
    further: list[Trajectory]
    failures: list[Trajectory]
    nominal: Nominal
    rate: float | None
    recorded: bool
    recordings: Sequence[Hashable] | None = None
    other_recordings: Sequence[Sequence[Hashable] | None] = (None, None)

    @classmethod
    def of(
        cls,
        train: EnvironmentData | Sequence[Episode],
        calibration: Sequence[Episode] | None,
        *,
        sensors: Sequence[Any] | None,
        offsets: Sequence[float] | None,
        baseline: int | None,
        rate: float | None,
        recordings: Sequence[Hashable] | None = None,
        failures: Sequence[Episode] | None = None,
        columns: Sequence[str] = (),
    ) -> Self:
        """Take the arguments of `Watchdog.fit`; what is None is a split's own, if it has it.

        Episodes have the `columns` in place of the sensors, if there are any.
        """
        further: list[Trajectory] = []
        recorded = True
        others: Sequence[Sequence[Hashable] | None] = (None, None)
        actions: tuple[str, ...] = ()
        if isinstance(train, EnvironmentData):
            if calibration is not None:
                raise UsageError(
                    "calibration episodes beside an environment of a split, expected none: it has "
                    "its own; hand over its train to use others"
                )
            data = train.of_columns(columns) if columns else train
            columns, facts = (), data.logs
            failures = data.failures if failures is None else failures
            train, calibration, sensors = data.train, data.calibration, sensors or data.sensors
            recordings = data.recordings(CALIBRATION) if recordings is None else recordings
            others = data.recordings(TRAIN), data.recordings(TWINS)
            actions = tuple(action.name for action in data.actions)
            recorded = facts is not None and facts.order == "recorded"
            if facts is not None:
                further, rate = list(data.twins), rate or facts.rate
                offsets = offsets or facts.offsets
                baseline = facts.baseline if baseline is None else baseline
        if calibration is None:
            raise UsageError(
                "there are no calibration episodes, expected some, or an environment of a split "
                "in place of training episodes"
            )
        rows = read("baseline", partial(whole_number, least=0), baseline or 0)
        raw = [[_raw(x) for x in part] for part in (train, calibration, failures or ())]
        arrays = [x[0] for x in raw[0] if not isinstance(x, Trajectory)]
        widths = [(x.observations if isinstance(x, Trajectory) else x[0]).shape[1] for x in raw[0]]
        width = widths[0] if widths else 0
        # A recorded score is judged as it is.
        subtracted = _offsets([0.0] * width if columns and not offsets else offsets, arrays, width)
        parts = [[_trajectory(x, subtracted) for x in part] for part in raw]
        names = sensor_names(sensors, width)
        if columns:
            numbers = [i for c in columns for i in columns_named(names, c, "the episodes")]
            names, subtracted = [names[i] for i in numbers], subtracted[numbers]
            sensors = sensors and [sensors[i] for i in numbers]
            parts = [
                [Trajectory(x.observations[:, numbers], x.actions) for x in part] for part in parts
            ]
        training, calibrating, failed = parts
        if rows:
            check_baseline(map(len, calibrating), rows, "calibration")
        base = Baseline.fit(training, rows) if rows else None
        nominal = Nominal(names, subtracted, base, roles_of(sensors or ()), actions)
        episodes = training, calibrating, further, failed
        return cls(*episodes, nominal, rate, recorded, recordings, others)

    def findings(self) -> list[PromiseFinding]:
        """Return what was tested about the promise."""
        base = self.nominal.baseline
        parts = (self.train, self.calibration, self.further)
        recordings = self.other_recordings[0], self.recordings, self.other_recordings[1]
        train, calibration, further = (
            EpisodeMeans(*episode_means(episodes, base), of_part)
            for episodes, of_part in zip(parts, recordings, strict=True)
        )
        tested = promises(
            train, calibration, further, sensors=self.nominal.sensors, recorded=self.recorded
        )
        return [finding for finding in tested if finding.subject != "episodes"]


def sensor_names(sensors: Sequence[Any] | None, width: int) -> list[str]:
    """Return the names of so many sensors or quantities, by default "sensor 0" and so on."""
    if sensors is None:
        return [f"sensor {d}" for d in range(width)]
    names = [str(getattr(s, "name", s)) for s in sensors]
    if len(names) != width or len({*names}) != width:
        raise UsageError(f"{len(names)} names of sensors {names}, expected {width}, all unlike")
    return names


def _raw(episode: Episode) -> Trajectory | tuple[Floats, ArrayLike | None]:
    """Return a trajectory, or observations in float64 with actions."""
    if isinstance(episode, Trajectory):
        return episode
    observations: Any = episode
    actions: ArrayLike | None = None
    if isinstance(episode, tuple) and len(episode) == 2 and np.ndim(episode[0]) == 2:
        observations, actions = episode
    array = as_numbers(observations, "an episode cannot be read as numbers: ")
    if array.ndim != 2 or 0 in array.shape or not np.isfinite(array).all():
        raise TrajectoryError(
            f"an episode has observations of shape {array.shape}, expected a Trajectory, finite "
            "numbers (rows, sensors), none missing or masked, or a tuple of these and of actions"
        )
    return array, actions


def _offsets(offsets: Sequence[float] | None, arrays: Sequence[Floats], width: int) -> Floats:
    """Return the offsets: those that are named, or what arrays of float64 need."""
    if offsets is None or not len(offsets):
        offsets = fit_offsets(arrays) if arrays else ()
    values = np.array(offsets, dtype=np.float64) if len(offsets) else np.zeros(width)
    if values.shape != (width,) or not np.isfinite(values).all():
        raise UsageError(f"offsets={offsets!r:.80}, expected {width} numbers, one a sensor")
    return values


def _trajectory(
    episode: Trajectory | tuple[Floats, ArrayLike | None], offsets: Floats
) -> Trajectory:
    if isinstance(episode, Trajectory):
        return episode
    observations, actions = episode
    if observations.shape[1] != len(offsets):
        raise TrajectoryError(
            f"an episode has {observations.shape[1]} sensors, expected {len(offsets)} as in the "
            "first training episode"
        )
    # Rounded here: what float32 cannot tell is subtracted.
    return Trajectory((observations - offsets).astype(np.float32), actions)
