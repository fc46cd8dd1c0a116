"""Faults of sensors: readings that are missing, no numbers, frozen, repeated or late.

Such readings are evidence by themselves and nothing that a detector can judge. They are counted,
and in their place the detector is handed the last good reading.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from itertools import chain
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.baseline import Baseline, Shift
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take

Floats = NDArray[np.float64]

OBSERVATION: Final = "observation"
"""Name of what is at fault when all sensors are missing or repeated at once."""
ACTION: Final = "action"
"""Name of what is at fault when no usable action came."""

MISSING: Final = 3.0
"""Unusable readings of a sensor that are no alarm yet."""
FORGOTTEN: Final = 0.05
"""Taken off a count by a good reading: faults that come and go are counted, too."""
FAR: Final = 1e6
"""Training standard deviations beyond which a reading is no measurement but a broken number."""
MARGIN: Final = 0.25
"""Share of its range in training by which a reading may leave it."""
CONSTANT: Final = 0.5
"""Share of an episode that a sensor stands still for, from which on standing still is normal."""

TOLERANCE: Final = 0.5
"""Share of the interval between two rows by which a time stamp may be off."""

NEVER: Final = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True, eq=False)
class StreamLimits:
    """Limits of what D sensors and A actions do in nominal episodes; arrays of float64.

    Attributes
    ----------
    mean, std
        Of the sensors, (D,).
    low, high
        Of the range of readings with a margin, (D,); infinite for constants.
    still
        Longest run of readings that equal the one before, (D,); infinite for sensors that may
        stand still for as long as they like: contacts, constants.
    repeated
        Largest count of whole observations equal to the one before, ().
    rest
        Mean action, (A,), in place of an action that never came.
    """

    mean: Floats
    std: Floats
    low: Floats
    high: Floats
    still: Floats
    repeated: Floats
    rest: Floats

    @classmethod
    def fit(
        cls,
        nominal: Iterable[Trajectory],
        judged: Iterable[Trajectory] | None = None,
        margin: float = MARGIN,
    ) -> "StreamLimits":
        """Learn from nominal trajectories; the range from what is judged of them, if that differs.

        With baseline rows that is what is behind them, brought to training's. A reading may leave
        the range by the share `margin` of it.
        """
        episodes = list(nominal)
        inside = episodes if judged is None else list(judged)
        scale = FeatureScale.fit(episodes)
        equal = [x.observations[1:] == x.observations[:-1] for x in episodes]
        longest = np.stack([_longest_runs(e) for e in equal])
        lengths = np.array([max(1, len(e)) for e in equal])[:, None]
        constant = (longest >= CONSTANT * lengths).any(axis=0)
        moving = np.array(~constant)
        repeats = [_repeats(e, moving) for e in equal]
        runs = [_longest_runs(e[~r]) for e, r in zip(equal, repeats, strict=True)]
        still = np.where(constant, np.inf, np.max(runs, axis=0))
        repeated = max(map(_largest_count, repeats))
        rest = np.concatenate([x.actions for x in episodes]).mean(axis=0, dtype=np.float64)
        low = np.min([x.observations.min(axis=0) for x in inside], axis=0).astype(np.float64)
        high = np.max([x.observations.max(axis=0) for x in inside], axis=0)
        # A span of 0 is that of a constant, which has no range.
        beyond = np.where(high > low, margin * np.where(high > low, high - low, 1.0), np.inf)
        return cls(
            scale.mean, scale.std, low - beyond, high + beyond, still, np.array(repeated), rest
        )

    def arrays(self) -> Arrays:
        """Return what `of` reads, which is finite."""
        finite = {f.name: np.nan_to_num(getattr(self, f.name)) for f in fields(self)}
        return {name: np.asarray(value) for name, value in finite.items()}

    @classmethod
    def of(cls, arrays: Arrays) -> "StreamLimits":
        """Return the limits among saved arrays; `FittedStateError` where there are none."""
        mean = take(arrays, "mean", (None,))
        vectors = [take(arrays, name, mean.shape) for name in ("std", "low", "high", "still")]
        largest = np.finfo(np.float64).max  # what an infinity was written as
        std, low, high, still = (
            np.where(np.abs(v) == largest, np.copysign(np.inf, v), v) for v in vectors
        )
        rest = take(arrays, "rest", (None,))
        return cls(mean, std, low, high, still, take(arrays, "repeated", ()), rest)

    def faults(
        self, trajectory: Trajectory, baseline: Baseline | None = None
    ) -> "dict[int | str, StreamFault]":
        """Return what raises an alarm of the stream in an episode, by sensor."""
        stream = Stream(self, baseline=baseline)
        faults: dict[int | str, StreamFault] = {}
        for t in stream.through(trajectory.observations, trajectory.actions):
            for source, fault in stream.faults.items():
                first = faults[source].first if source in faults else t
                faults[source] = StreamFault(fault, first, t)
        return faults


class StreamFault(NamedTuple):
    """A fault of a sensor in a recorded episode, and the rows in which it was above its limit."""

    fault: str
    first: int
    last: int


class Stream:
    """Counts of faults in one episode so far.

    Attributes
    ----------
    faults
        What is beyond its limit: ``"missing"``, ``"frozen"``, ``"out of range"``, ``"repeated"``,
        ``"irregular"`` or ``"late"`` by the number of a sensor, `OBSERVATION` or `ACTION`.
    shift
        What brings this episode to training's, once its baseline rows were taken; None before, and
        without any.
    suspects
        Rows since when a sensor does what it never did in nominal episodes, by its number: below
        the limit, but where it would be found if there is an alarm.
    """

    def __init__(
        self, limits: StreamLimits, rate: float | None = None, baseline: Baseline | None = None
    ) -> None:
        self.limits, self.rate, self.baseline = limits, rate, baseline
        self._moving = np.isfinite(limits.still)
        # Limits of whole-row faults; the first exceeded is reported.
        self._most = {
            (OBSERVATION, "missing"): MISSING,
            (OBSERVATION, "repeated"): 2 * float(limits.repeated) + 1,
            (OBSERVATION, "irregular"): MISSING,
            (ACTION, "missing"): MISSING,
            (ACTION, "late"): MISSING,
        }
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        limits = self.limits
        self.faults: dict[int | str, str] = {}
        self.suspects: dict[int, int] = {}
        self._t = -1
        self._good = limits.mean.astype(np.float32)
        self._action = limits.rest.astype(np.float32)
        # Infinite before the first good reading, which equals no other.
        self._last = np.full(len(limits.mean), np.inf, np.float32)
        self._runs, self._missing, self._beyond = np.zeros((3, len(limits.mean)))
        self._counts = dict.fromkeys(self._most, 0.0)
        self._stamp: float | None = None
        self._rows = 0  # since that stamp
        self._quiet = True
        self._since = np.full(len(limits.mean), NEVER)
        self.shift: Shift | None = None
        self._gathered: list[NDArray[np.float32]] = []
        if self.baseline is None:
            self._bound(limits.low, limits.high)
        else:  # A range that is relative to the baseline is not known yet.
            self._bound(*np.array([[-np.inf], [np.inf]]))

    def _bound(self, low: Floats, high: Floats) -> None:
        """Take readings between these for measurements that training had."""
        limits = self.limits
        self._low = np.maximum(low, limits.mean - FAR * limits.std)
        self._high = np.minimum(high, limits.mean + FAR * limits.std)

    def through(self, rows: Iterable[ArrayLike], actions: Iterable[ArrayLike]) -> Iterator[int]:
        """Take all rows of an episode and the actions between them; yield each row's number."""
        for t, (row, action) in enumerate(zip(rows, chain([None], actions), strict=True)):
            self.take(row, action)
            yield t

    def take(
        self,
        observation: ArrayLike | None,
        action: ArrayLike | None = None,
        time: float | None = None,
        acted: float | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Take the next row; return finite values for a detector: (D,), and (A,) or None.

        `time` and `acted` are the time stamps of the two in seconds, compared with the rate.
        """
        row, command = self._take(observation, action, time, acted)
        if self.baseline is not None and self.shift is None:
            self._gathered.append(row)
            if len(self._gathered) == self.baseline.rows:
                self.shift = self.baseline.shift(np.stack(self._gathered))
                self._bound(*map(self.shift.inverse, (self.limits.low, self.limits.high)))
        return row, command

    def _take(
        self,
        observation: ArrayLike | None,
        action: ArrayLike | None,
        time: float | None,
        acted: float | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        self._t += 1
        self._rows += 1
        if time is not None and self.rate is not None:
            self._compare_stamps(time, acted, self.rate)
        row = self._read("observation", observation, len(self._good))
        command = self._command(action)
        limits = self.limits
        # False for NaN, too.
        inside = (row >= self._low) & (row <= self._high)
        equal = (row == self._last) & self._moving
        if self._quiet and inside.all() and not equal.any():
            self._good = self._last = row
            return row, command
        near = np.abs(row - limits.mean) <= FAR * limits.std
        beyond = near & ~inside
        equal &= near
        self._beyond = np.where(beyond, self._beyond + 1, np.maximum(self._beyond - FORGOTTEN, 0))
        self._good = np.where(near, row, self._good)
        self._last = np.where(near, row, self._last)
        silent = len(near) > 1 and not near.any()
        repeated = not silent and bool(_repeats((equal | ~near)[None], self._moving)[0])
        self._count(OBSERVATION, "missing", happened=silent)
        self._count(OBSERVATION, "repeated", happened=repeated)
        # What all sensors do at once is no fault of any.
        if not silent and not repeated:
            self._runs = np.where(equal, self._runs + 1, np.where(near, 0.0, self._runs))
        if not silent:
            fewer = np.maximum(self._missing - FORGOTTEN, 0.0)
            self._missing = np.where(near, fewer, self._missing + 1)
        self._judge()
        return self._good, command

    def _command(self, action: ArrayLike | None) -> NDArray[np.float32] | None:
        if not self._t or not len(self._action):
            return None
        command = self._read("action", action, len(self._action))
        usable = bool(np.isfinite(command).all())
        self._count(ACTION, "missing", happened=not usable)
        self._action = command if usable else self._action
        return self._action

    def _compare_stamps(self, time: float, acted: float | None, rate: float) -> None:
        """Count what does not come one row after the other; NaN is never in time."""
        if self._stamp is not None:
            off = abs(rate * (time - self._stamp) - self._rows)
            self._count(OBSERVATION, "irregular", happened=not off <= TOLERANCE)
        if math.isfinite(time):
            self._stamp, self._rows = time, 0
        if acted is not None:
            # Commanded since the row before.
            late = not rate * (time - acted) <= 1 + TOLERANCE
            self._count(ACTION, "late", happened=late)

    def _count(self, source: str, fault: str, *, happened: bool) -> None:
        count = _counted(self._counts[source, fault], happened)
        self._counts[source, fault] = count
        self._quiet = self._quiet and not count

    def _read(self, source: str, values: ArrayLike | None, width: int) -> NDArray[np.float32]:
        """Return values as float32, NaN for what is missing."""
        if values is None:
            return np.full(width, np.nan, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            row = np.asarray(values, dtype=np.float64).astype(np.float32)
        if row.shape != (width,):
            raise TrajectoryError(
                f"the watchdog got an {source} of shape {row.shape}, expected ({width},) as "
                "in its nominal trajectories: hand over NaN for what is missing, None for all"
            )
        return row

    def _judge(self) -> None:
        """Compare the counts with their limits."""
        limits = self.limits
        counts = *self._counts.values(), *self._runs, *self._missing, *self._beyond
        self._quiet = not any(counts)
        wild = self._beyond > MISSING
        odd = (self._missing > 0) | (self._runs > limits.still) | wild
        self._since = np.where(odd, np.minimum(self._since, self._t), NEVER)
        row_faults: dict[int | str, str] = {}
        for (source, fault), count in self._counts.items():
            if count > self._most[source, fault]:
                row_faults.setdefault(source, fault)
        self.suspects, self.faults = {}, row_faults
        if not odd.any():
            return
        self.suspects = {int(d): int(self._since[d]) for d in np.flatnonzero(odd)}
        lost, frozen = self._missing > MISSING, self._runs > 2 * limits.still + 3
        sensors: dict[int | str, str] = {
            int(d): "missing" if lost[d] else "frozen" if frozen[d] else "out of range"
            for d in np.flatnonzero(lost | frozen | wild)
        }
        self.faults = {**sensors, **row_faults}


def _repeats(equal: NDArray[np.bool_], moving: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the rows, (T,), in which all of several moving sensors equal the row before."""
    repeats: NDArray[np.bool_] = equal[:, moving].all(axis=1) & (moving.sum() > 1)
    return repeats


def _counted(count: float, happened: bool) -> float:
    return count + 1 if happened else max(count - FORGOTTEN, 0.0)


def _longest_runs(equal: NDArray[np.bool_]) -> Floats:
    """Return the longest run of True in each column, (D,), of an array (T, D)."""
    total = np.cumsum(equal, axis=0)
    before = np.maximum.accumulate(np.where(equal, 0, total), axis=0)
    longest: Floats = (total - before).max(axis=0, initial=0).astype(np.float64)
    return longest


def _largest_count(happened: NDArray[np.bool_]) -> float:
    count = largest = 0.0
    for flag in happened.tolist():
        count = _counted(count, flag)
        largest = max(largest, count)
    return largest
