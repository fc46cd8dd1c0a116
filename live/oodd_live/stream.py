"""Faults of sensors row by row: readings that are missing, frozen, out of range, repeated or late.

They are counted as `oodd_eval.metrics.faults` counts those of whole episodes. In place of what is
no reading the detector is handed the last good one.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.arrays import as_numbers
from oodd_eval.data.baseline import Baseline, Shift
from oodd_eval.errors import TrajectoryError
from oodd_eval.metrics.faults import FAR, KINDS, ROWS, ParetoTail, StreamScale, counted, repeated

Floats = NDArray[np.float64]

OBSERVATION: Final = "observation"
"""Name of what is at fault when all sensors are missing or repeated at once."""
ACTION: Final = "action"
"""Name of what is at fault when no usable action came."""

TOLERANCE: Final = 0.5
"""Share of the interval between two rows by which a time stamp may be off."""
ODD: Final = 3.0
"""Surprise of a sensor from which on it is suspected where there is an alarm."""

_NEVER: Final = np.iinfo(np.int64).max
_SENSOR_KINDS: Final = KINDS[:-1]
_COUNTED: Final = (
    (OBSERVATION, "missing"),
    (OBSERVATION, "irregular"),
    (ACTION, "missing"),
    (ACTION, "late"),
)
_REPEATED: Final = OBSERVATION, "repeated"


class Stream:
    """Counts of faults in one episode so far.

    Attributes
    ----------
    surprise
        Of the last row, as `StreamScale.surprise` has it for whole episodes.
    shift
        What brings this episode to training's, once its baseline rows were taken; None before, and
        without any.
    since
        Row since when each sensor does what is unusual, (D,); a large number for all others.
    suspects
        Numbers of sensors that do what they hardly ever did in nominal episodes.
    """

    def __init__(
        self,
        scale: StreamScale,
        rest: ArrayLike = (),
        rate: float | None = None,
        baseline: Baseline | None = None,
    ) -> None:
        self.scale, self.rate, self.baseline = scale, rate, baseline
        self._rest = np.asarray(rest, np.float32)  # the mean action
        self._far = FAR * scale.limits.std
        self._active = scale.limits.moving > 0
        # Distance from the middle beyond which a sensor alone is unusual.
        self._usual = scale.start[3] + scale.tails.start[3] / scale.per_unit[3]
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        width = len(self.scale.limits.mean)
        self.surprise, self.suspects = 0.0, list[int]()
        self._t = -1
        self._good = self.scale.limits.mean.astype(np.float32)
        self._action = self._rest
        # Before the first good reading, which equals no other.
        self._last = np.full(width, np.nan, np.float32)
        self._runs, self._missing = np.zeros((2, width))
        self._far_rows = np.zeros((ROWS, width))
        self._counts = dict.fromkeys([*_COUNTED, _REPEATED], 0.0)
        self._kinds = np.zeros((len(_SENSOR_KINDS), width))  # surprise by kind and sensor
        self._stamp: float | None = None
        self._since_stamp = 0
        self._quiet = True
        self.since = np.full(width, _NEVER)
        self.shift: Shift | None = None
        self._gathered: list[NDArray[np.float32]] = []

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
        self._t += 1
        self._since_stamp += 1
        if time is not None and self.rate is not None:
            self._compare_stamps(time, acted, self.rate)
        row = self._read("observation", observation, len(self._good))
        command = self._command(action)
        self._count_row(row)
        if self.baseline is not None and self.shift is None:
            self._gathered.append(self._good)
            if len(self._gathered) == self.baseline.rows:
                self.shift = self.baseline.shift(np.stack(self._gathered))
        return self._good, command

    def faults(self, tail: ParetoTail, threshold: float) -> dict[int | str, str]:
        """Return what raises an alarm in this row, by number of a sensor, or name.

        ``"missing"``, ``"frozen"``, ``"saturated"`` or ``"out of range"`` of a sensor,
        ``"missing"``, ``"repeated"``, ``"irregular"`` or ``"late"`` of `OBSERVATION` or `ACTION`.

        Parameters
        ----------
        tail, threshold
            Of the statistic of the detector's scores, see `Calibration`.
        """
        above = tail.value(self._kinds) > threshold
        faults: dict[int | str, str] = {
            int(d): _SENSOR_KINDS[above[:, d].argmax()] for d in np.flatnonzero(above.any(axis=0))
        }
        for source in (*_COUNTED, _REPEATED):
            kind = 0 if source in _COUNTED else -1
            if tail.value(self._of_kind(self._counts[source], kind)) > threshold:
                faults.setdefault(*source)
        return faults

    def _of_kind(self, count: float, kind: int) -> float:
        values = np.full(len(KINDS), -np.inf)
        values[kind] = count
        return float(self.scale.of_kinds(values)[kind])

    def _count_row(self, row: NDArray[np.float32]) -> None:
        limits = self.scale.limits
        # False for NaN, too.
        near = np.abs(row - limits.mean) <= self._far
        everything = bool(near.all())
        if everything:
            self._good = row
        elif near.any():
            self._good = np.where(near, row, self._good)
        equal = row == self._last
        far = self._distance(near)
        self._far_rows = np.concatenate([self._far_rows[1:], far[None]])
        within = not (far > self._usual).any()
        if self._quiet and everything and within and not (equal & self._active).any():
            self._last = row
            return
        silent = len(near) > 1 and not near.any()
        again = bool(repeated(equal & near, near, limits.moving))
        self._last = np.where(near, row, self._last)
        self._count(OBSERVATION, "missing", happened=silent)
        self._count(*_REPEATED, happened=again)
        # What all sensors do at once is no fault of any.
        if not silent:
            self._missing = counted(self._missing, ~near)
        if not again:
            self._runs = np.where(equal & near, self._runs + 1, np.where(near, 0.0, self._runs))
        self._judge()

    def _distance(self, near: NDArray[np.bool_]) -> Floats:
        """Return distances from the middle of the range, 0 where they are not known."""
        if self.baseline is not None and self.shift is None:
            return np.zeros(len(near))
        judged = self._good if self.shift is None else self.shift(self._good)
        return np.where(near, self.scale.limits.distance(judged), 0.0)

    def _judge(self) -> None:
        """Scale what is counted."""
        scale = self.scale
        at_end = scale.limits.at_end(self._last)
        least = self._far_rows.min(axis=0)
        values = np.stack([self._missing, self._runs * ~at_end, self._runs * at_end, least])
        units = scale.units(values)
        kinds = np.append(units.max(axis=1), self._counts[_REPEATED])
        kinds[0] = max(kinds[0], *(self._counts[source] for source in _COUNTED))
        self.surprise = float(scale.of_kinds(kinds).max())
        each = np.concatenate([units, np.full((1, len(at_end)), -np.inf)])
        self._kinds = scale.of_kinds(each.T).T[:-1]
        largest, missing = self._kinds.max(axis=0), self._missing > 0
        # Longer than usual by half, or by a row.
        still = units[1:3].max(axis=0) >= 1
        unusual = (largest > 0) | missing | still
        self.since = np.where(unusual, np.minimum(self.since, self._t), _NEVER)
        self.suspects = np.flatnonzero((largest > ODD) | missing | still).tolist()
        counts = *self._counts.values(), *self._missing, *(self._runs * self._active)
        self._quiet = not (any(counts) or self.surprise)

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
            off = abs(rate * (time - self._stamp) - self._since_stamp)
            self._count(OBSERVATION, "irregular", happened=not off <= TOLERANCE)
        if math.isfinite(time):
            self._stamp, self._since_stamp = time, 0
        if acted is not None and len(self._action):
            # Commanded since the row before.
            late = not rate * (time - acted) <= 1 + TOLERANCE
            self._count(ACTION, "late", happened=late)

    def _count(self, source: str, fault: str, *, happened: bool) -> None:
        count = float(counted(self._counts[source, fault], happened))
        self._counts[source, fault] = count
        self._quiet = self._quiet and not count

    def _read(self, source: str, values: ArrayLike | None, width: int) -> NDArray[np.float32]:
        """Return values as float32, NaN for what is missing or masked."""
        if values is None:
            return np.full(width, np.nan, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            row = as_numbers(values).astype(np.float32)
        if row.shape != (width,):
            raise TrajectoryError(
                f"the watchdog got an {source} of shape {row.shape}, expected ({width},) as "
                "in its nominal trajectories: hand over NaN for what is missing, None for all"
            )
        return row
