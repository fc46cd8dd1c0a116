"""Faults of the stream as evidence: missing, frozen, saturated, out of range or repeated readings.

What is counted in a row is scaled on nominal calibration episodes, by sensor. Of each kind the
sensor that is farthest beyond its usual value speaks, and the largest value in each calibration
episode gives it a p-value. The surprise of a row is the largest ``-log p`` of all kinds. By the
tail of a detector's own statistic it becomes the score that would be as rare, so that one threshold
serves both.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.baseline import Baseline
from oodd_eval.data.trajectory import Trajectory

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

KINDS: Final = ("missing", "frozen", "saturated", "out of range", "repeated")
"""Faults that are counted: the first four by sensor, the last of all sensors at once."""

FORGOTTEN: Final = 0.05
"""Taken off a count by a good reading: faults that come and go are counted, too."""
FAR: Final = 1e6
"""Training standard deviations beyond which a reading is no measurement but a broken number."""
CONSTANT: Final = 0.5
"""Share of an episode that a sensor stands still for, from which on standing still is normal."""
ROWS: Final = 3
"""Rows, the least of which says how far a sensor is beyond its range."""
UPPER: Final = 0.3
"""Share of the episodes, those with the largest values, that a tail is estimated from."""

_LIMIT: Final = 0.001  # of a range: what is as near to its end is at the end
_RANGE: Final = 0.04  # least scale of distances, in halves of a range
_RUN: Final = 0.5  # least scale of runs, of the usual one
# Least shapes by kind: of levels, as machines drift beyond what few episodes show.
_SHAPES: Final = (0.0, 0.0, 0.25, 0.25, 0.0)
_SHAPED: Final = 20  # values from which on a tail's shape is estimated
_HEAVIEST: Final = 0.5
_SPREAD: Final = 1e-6  # a standard deviation below this is a sensor that does not vary
_TINY: Final = 1e-9  # least scale of a tail, of its start
_BLOCK: Final = 1 << 20  # readings at once


class ParetoTail(NamedTuple):
    """A generalized Pareto tail of the largest values of nominal episodes; or several, as arrays.

    Attributes
    ----------
    start, scale, shape
        Where the tail begins, and its parameters; the shape is 0 (exponential) to 0.5.
    share
        Chance that a further episode has a value in the tail.

    Examples
    --------
    >>> tail = ParetoTail.fit(np.arange(1.0, 11.0))
    >>> tail.start, tail.scale, round(tail.share, 3)
    (7.0, 2.0, 0.364)
    >>> tail.surprise(7.0).item(), tail.value(tail.surprise(9.0)).round(9).item()
    (0.0, 9.0)
    """

    start: Any
    scale: Any
    shape: Any
    share: Any

    @classmethod
    def fit(
        cls, largest: ArrayLike, least: float = 0.0, odd: float = 0.0, heavy: float = 0.0
    ) -> "ParetoTail":
        """Estimate a tail by probability-weighted moments (Hosking & Wallis 1987).

        Parameters
        ----------
        largest
            The largest value of each episode; those that are not finite are left out.
        least
            Smallest scale.
        odd
            Share of the episodes, those with the largest values, that may not be nominal.
        heavy
            Smallest shape.
        """
        values = np.asarray(largest, np.float64)
        values = np.sort(values[np.isfinite(values)])
        if not (n := len(values)):
            return cls(math.inf, 1.0, 0.0, 1.0)
        m = min(max(1, math.floor(UPPER * n)), n - 1)
        start = float(values[n - m - 1])
        # Of those that may be odd is known that they are at least the largest other.
        seen = max(1, m - math.floor(odd * n))
        above = np.minimum(values[n - m :] - start, values[n - m + seen - 1 : n - m + seen] - start)
        mean, shape = float(above.sum() / seen) if m else 0.0, 0.0
        if n >= _SHAPED and mean > 0 and not odd:
            weighted = float((above * (1 - (np.arange(1, m + 1) - 0.35) / m)).mean())
            left = mean - 2 * weighted
            shape = min(max(2 - mean / left, 0.0), _HEAVIEST) if left > 0 else 0.0
        shape = max(shape, heavy)
        scale = max(mean * (1 - shape), least, _TINY * max(1.0, abs(start)))
        return cls(start, scale, shape, (m + 1) / (n + 1))

    def surprise(self, values: ArrayLike) -> Floats:
        """Return ``-log p`` of values; 0 for those that are not in the tail."""
        beyond = (np.asarray(values, np.float64) - self.start) / self.scale
        heavy = np.where(self.shape > 0, self.shape, 1.0)
        above = np.maximum(beyond, 0.0)
        logs = np.where(self.shape > 0, np.log1p(heavy * above) / heavy, above)
        surprise: Floats = np.where(beyond > 0, logs - np.log(self.share), 0.0)
        return surprise

    def value(self, surprise: ArrayLike) -> Floats:
        """Return the values with such a surprise; minus infinity for those before the tail."""
        excess = np.asarray(surprise, np.float64) + np.log(self.share)
        heavy = np.where(self.shape > 0, self.shape, 1.0)
        above = np.maximum(excess, 0.0)
        with np.errstate(over="ignore"):
            beyond = np.where(self.shape > 0, np.expm1(heavy * above) / heavy, above)
        value: Floats = np.where(excess > 0, self.start + self.scale * beyond, -np.inf)
        return value


@dataclass(frozen=True, slots=True, eq=False)
class StreamLimits:
    """Ranges of D sensors in training; arrays of shape (D,).

    Attributes
    ----------
    mean, std
        Of the readings.
    low, high
        Ends of their range.
    middle, per_range
        Middle of the range of what is judged, and 1 over half of its width; 0 for constants.
    moving
        1 for sensors that do not stand still for half of an episode, else 0.
    usual
        Longest run of equal readings in most episodes.
    repeated
        Largest count of repeated rows in most episodes, ().
    """

    mean: Floats
    std: Floats
    low: Floats
    high: Floats
    middle: Floats
    per_range: Floats
    moving: Floats
    usual: Floats
    repeated: Floats

    @classmethod
    def fit(
        cls, episodes: Iterable[ArrayLike], judged: Sequence[ArrayLike] = (), odd: float = 0.0
    ) -> "StreamLimits":
        """Learn from the rows of nominal episodes.

        Parameters
        ----------
        episodes
            Readings by episode, (R, D); NaN where there is none.
        judged
            What is judged of them, if that differs: the rows behind the baseline's.
        odd
            Share of the episodes that may not be nominal, whatever their range.
        """
        sums, ends, still, equals = [], [], [], []
        origin: Any = None
        for rows in episodes:
            array = np.asarray(rows)
            origin = np.nan_to_num(array[0].astype(np.float64)) if origin is None else origin
            sums.append(_moments(array - origin))
            ends.append(_ends(array))
            equal = array[1:] == array[:-1]
            equals.append(equal)
            still.append(_runs(equal, ~equal).max(axis=0, initial=0))
        inside = [_ends(np.asarray(rows)) for rows in judged]
        n, total, squares = np.sum(sums, axis=0)
        n = np.maximum(n, 1.0)
        std = np.sqrt(np.maximum(squares / n - (total / n) ** 2, 0.0))
        low, high = _inner(ends, odd)
        first, last = _inner(inside, odd) if inside else (low, high)
        width = np.where(last > first, last - first, np.inf)
        lengths = np.array([max(1, len(equal)) for equal in equals])
        moving = _largest(np.stack(still) / lengths[:, None], odd) < CONSTANT
        again = [repeated(equal, np.ones_like(equal), moving) for equal in equals]
        counts = [_counted_rows(x, np.zeros_like(x)).max(initial=0) for x in again]
        most = 1 - (1 - UPPER) * (1 - odd)
        return cls(
            total / n + origin,
            np.where(std < _SPREAD, 1.0, std),
            low,
            high,
            (first + last) / 2,
            2 / width,
            moving.astype(np.float64),
            _largest(np.stack(still), most),
            _largest(np.array(counts), most),
        )

    def near(self, rows: NDArray[Any]) -> Mask:
        """Return which readings are measurements: finite, and not broken numbers."""
        near: Mask = np.abs(rows - self.mean) <= FAR * self.std
        return near

    def at_end(self, rows: NDArray[Any]) -> Mask:
        """Return which readings are at an end of their range."""
        slack = _LIMIT * (self.high - self.low)
        ends: Mask = (rows <= self.low + slack) | (rows >= self.high - slack)
        return ends

    def distance(self, judged: NDArray[Any]) -> Floats:
        """Return how far from the middle of their range readings are, in halves of it."""
        distance: Floats = np.abs(judged - self.middle) * self.per_range
        return distance

    def columns(self, some: slice) -> "StreamLimits":
        """Return the limits of some sensors."""
        parts = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "repeated"}
        return replace(self, **{name: values[some] for name, values in parts.items()})


def repeated(equal: Mask, near: Mask, moving: NDArray[Any]) -> Mask:
    """Return which rows, (...,), are the row before once more, of at least two moving sensors."""
    among = moving > 0
    again: Mask = (equal | ~near)[..., among].all(axis=-1) & near.any(axis=-1) & (among.sum() > 1)
    return again


def counted(count: Any, happened: Any) -> Any:
    """Return counts after one more row."""
    return np.where(happened, count + 1, np.maximum(count - FORGOTTEN, 0.0))


class _Counts(NamedTuple):
    """Counts of faults in the rows of an episode."""

    # `by_sensor` yields sensors with counts of the first four kinds, (4, R, sensors).

    by_sensor: Iterator[tuple[slice, Floats]]
    lost: Floats
    repeated: Floats


def _count(limits: StreamLimits, rows: NDArray[Any], judged: NDArray[Any] | None) -> _Counts:
    size, width = rows.shape
    near = limits.near(rows)
    held = _held(rows, near)
    equal = np.zeros_like(near)
    equal[1:] = near[1:] & (rows[1:] == held[:-1])
    lost = ~near.any(axis=1) & (width > 1)
    again = repeated(equal, near, limits.moving)

    def by_sensor() -> Iterator[tuple[slice, Floats]]:
        step = max(1, _BLOCK // size)
        for start in range(0, width, step):
            some = slice(start, start + step)
            part, ok = limits.columns(some), near[:, some]
            counting = ~again[:, None]
            runs = _runs(equal[:, some] & counting, ok & ~equal[:, some] & counting)
            at_end = part.at_end(held[:, some])
            compared = rows if judged is None else judged
            far = np.where(ok, part.distance(compared[:, some]), 0.0)
            far = np.where(np.isnan(far), 0.0, far)
            least = far.copy()
            for back in range(1, ROWS):
                least[back:] = np.minimum(least[back:], far[:-back])
                least[:back] = 0.0
            missing = _counted_rows(~ok, lost)
            yield some, np.stack([missing, runs * ~at_end, runs * at_end, least])

    nothing = np.zeros(size, dtype=bool)
    return _Counts(by_sensor(), _counted_rows(lost, nothing), _counted_rows(again, nothing))


@dataclass(frozen=True, slots=True, eq=False)
class StreamScale:
    """Scales of the faults of D sensors, from nominal calibration episodes.

    Attributes
    ----------
    limits
        Of the sensors, from training.
    start, per_unit
        Usual largest value in an episode, and 1 over the scale beyond it, by kind and sensor:
        (4, D). The latter is 0 for what a sensor may do for as long as it likes.
    tails
        Of the largest value of any sensor in an episode, a tail each kind: arrays of shape (5,).
    largest, floors
        Largest value of each kind in the n calibration episodes, (n, 5), and least scales of their
        tails, (5,); these are not saved.
    """

    limits: StreamLimits
    start: Floats
    per_unit: Floats
    tails: ParetoTail
    largest: Floats = field(default_factory=lambda: np.zeros((0, len(KINDS))))
    floors: Floats = field(default_factory=lambda: np.ones(len(KINDS)))

    @classmethod
    def of_episodes(
        cls,
        train: Iterable[Trajectory],
        calibration: Iterable[Trajectory],
        base: Baseline | None = None,
    ) -> "StreamScale":
        """Take ranges from training episodes, and scales from calibration episodes.

        Parameters
        ----------
        train, calibration
            Nominal episodes as they were recorded.
        base
            Baseline rows; None where none are declared.

        Returns
        -------
        StreamScale
            Whose tails are those of the calibration episodes.
        """
        rows, judged = [], []
        for x in train:
            rows.append(x.observations)
            judged.append(x.observations if base is None else base.judged(x).observations)
        return cls.fit(StreamLimits.fit(rows, judged), (readings(x, base) for x in calibration))

    @classmethod
    def fit(
        cls,
        limits: StreamLimits,
        episodes: Iterable[tuple[NDArray[Any], NDArray[Any] | None]],
        odd: float = 0.0,
    ) -> "StreamScale":
        """Scale what is counted in nominal episodes.

        Parameters
        ----------
        limits
            From training.
        episodes
            Readings of each calibration episode and, if that differs, what is judged of them in the
            same rows, NaN in those of a baseline.
        odd
            Share of the episodes that may not be nominal.

        Returns
        -------
        StreamScale
            Whose tails are those of the episodes.
        """
        sensors, lost, again, lengths = [], [], [], []
        for rows, judged in episodes:
            counts = _count(limits, rows, judged)
            parts = [values.max(axis=1) for _, values in counts.by_sensor]
            sensors.append(np.concatenate(parts, axis=1))
            lost.append(counts.lost.max())
            again.append(counts.repeated.max())
            lengths.append(max(1, len(rows) - 1))
        largest = np.stack(sensors)
        start = np.zeros(largest.shape[1:])
        most = 1 - (1 - UPPER) * (1 - odd)
        # Of all runs, as a sensor may be where it is at an end on other days.
        start[1:3] = np.maximum(_largest(largest[:, 1:3].max(axis=1), most), limits.usual)
        per_unit = 1 / np.maximum(_RUN * start, 1.0)
        shares = largest[:, 1:3] / np.array(lengths)[:, None, None]
        still = _largest(shares, odd) >= CONSTANT
        per_unit[1:3] *= ~still & (limits.moving > 0)
        beyond = ((largest - start) * per_unit).max(axis=2)
        beyond[:, 0] = np.maximum(beyond[:, 0], lost)
        usual = max(float(_largest(np.array(again), most)), float(limits.repeated))
        floors = np.array([1.0, 1.0, 1.0, _RANGE, _RUN * max(1.0, usual)])
        columns = np.column_stack([beyond, again])
        tails = _tails(columns, floors, odd)
        return cls(limits, start, per_unit, tails, columns, floors)

    def without(self, i: int) -> "StreamScale":
        """Return the scale for calibration episode i: its tails are those of all others.

        So a calibration episode is as surprising as a further one would be.

        Parameters
        ----------
        i
            Number of the episode, from 0.

        Returns
        -------
        StreamScale
            With the same ranges and units.
        """
        return replace(self, tails=_tails(np.delete(self.largest, i, axis=0), self.floors))

    def surprise(self, rows: NDArray[Any], judged: NDArray[Any] | None = None) -> Floats:
        """Return the surprise of every row of an episode.

        Parameters
        ----------
        rows
            Readings, (R, D), NaN where there is none.
        judged
            As in `fit`.

        Returns
        -------
        array of shape (R,)
            In nats; 0 where nothing is unusual.
        """
        counts = _count(self.limits, rows, judged)
        largest = np.full((len(rows), len(KINDS)), -np.inf)
        for some, values in counts.by_sensor:
            units = self.units(values, some).max(axis=2)
            largest[:, :-1] = np.maximum(largest[:, :-1], units.T)
        largest[:, 0] = np.maximum(largest[:, 0], counts.lost)
        largest[:, -1] = counts.repeated
        surprise: Floats = self.of_kinds(largest).max(axis=1)
        return surprise

    def faults(
        self, rows: NDArray[Any], judged: NDArray[Any] | None, least: float
    ) -> list[tuple[int, str, int]]:
        """Return what is at least as surprising in an episode.

        Parameters
        ----------
        rows, judged
            As in `surprise`.
        least
            The surprise.

        Returns
        -------
        list of tuple
            The number of a sensor, -1 for all at once, its fault, and the row in which that began.
        """
        counts = _count(self.limits, rows, judged)
        sources = [(-1, 0, counts.lost), (-1, len(KINDS) - 1, counts.repeated)]
        for some, values in counts.by_sensor:
            units = self.units(values, some)
            for k, d in np.argwhere(units.max(axis=1) > self.tails.start[:-1, None]).tolist():
                sources.append((some.start + d, k, units[k, :, d]))
        named = []
        for number, k, values in sources:
            kinds = np.full((len(rows), len(KINDS)), -np.inf)
            kinds[:, k] = values
            surprise = self.of_kinds(kinds)[:, k]
            if surprise.max() >= least > 0:
                row = int((surprise >= least).argmax())
                quiet = np.flatnonzero(surprise[:row] <= 0)
                named.append((number, KINDS[k], int(quiet[-1]) + 1 if len(quiet) else 0))
        return named

    def units(self, values: Floats, some: slice = slice(None)) -> Floats:
        """Return counts of the first four kinds in units beyond what is usual.

        Parameters
        ----------
        values
            Counts by kind and sensor, (4, ..., D).
        some
            Sensors that these are of; by default all.

        Returns
        -------
        array of shape (4, ..., D)
            Negative where a count is below its usual largest value.
        """
        between = (slice(None), *(None,) * (values.ndim - 2), some)
        units: Floats = (values - self.start[between]) * self.per_unit[between]
        return units

    def of_kinds(self, values: Floats) -> Floats:
        """Return the surprise of values of the five kinds, each as one of the five.

        Parameters
        ----------
        values
            Largest of all sensors by kind, (..., 5), in the units of `units`; rows repeated last.

        Returns
        -------
        array of shape (..., 5)
            In nats, less log 5 for the choice of a kind; at least 0.
        """
        surprise: Floats = np.maximum(self.tails.surprise(values) - math.log(len(KINDS)), 0.0)
        return surprise

    def arrays(self) -> dict[str, Floats]:
        """Return what `of` reads.

        Returns
        -------
        dict of str to array
            By name: ranges of sensors, and their scales.
        """
        limits = {f.name: getattr(self.limits, f.name) for f in fields(self.limits)}
        tails = np.array(self.tails)
        return limits | {"start": self.start, "per_unit": self.per_unit, "tails": tails}

    @classmethod
    def of(cls, arrays: Mapping[str, Floats]) -> "StreamScale":
        """Return the scales that `arrays` were of.

        Parameters
        ----------
        arrays
            What `StreamScale.arrays` returned.

        Returns
        -------
        StreamScale
            Without the calibration episodes' largest values.
        """
        limits = StreamLimits(*(arrays[f.name] for f in fields(StreamLimits)))
        return cls(limits, arrays["start"], arrays["per_unit"], ParetoTail(*arrays["tails"]))


def readings(
    episode: Trajectory, base: Baseline | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the rows of an episode, and what is judged of them, NaN in baseline rows."""
    rows = episode.observations
    if base is None:
        return rows, None
    judged = np.full_like(rows, np.nan)
    judged[base.rows :] = base.judged(episode).observations
    return rows, judged


def _tails(largest: Floats, floors: Floats, odd: float = 0.0) -> ParetoTail:
    """Return the tails of the largest values of each kind, (n, 5)."""
    parts = zip(largest.T, floors.tolist(), _SHAPES, strict=True)
    tails = [ParetoTail.fit(column, least, odd, heavy) for column, least, heavy in parts]
    return ParetoTail(*np.array(tails).T)


def _held(rows: NDArray[Any], near: Mask) -> NDArray[Any]:
    """Return rows with the last measurement in place of what is none, NaN before the first."""
    if near.all():
        return rows
    last = np.maximum.accumulate(np.where(near, np.arange(len(rows))[:, None], -1), axis=0)
    held = np.take_along_axis(rows, np.maximum(last, 0), axis=0)
    return np.where(last < 0, np.nan, held)


def _runs(equal: Mask, ended: Mask) -> Floats:
    """Return how many rows in a row are equal so far, (R, D), others neither count nor end it."""
    total = np.cumsum(equal, axis=0)
    before = np.maximum.accumulate(np.where(ended, total, 0), axis=0)
    runs: Floats = np.asarray(total - before, np.float64)
    return runs


def _counted_rows(happened: Mask, kept: Mask) -> Floats:
    """Return counts by row, (R, ...), which stay what they are in rows that are `kept`."""
    counts = np.zeros(happened.shape)
    if not (happened.any()):
        return counts
    count = counts[0]
    for t in range(int(happened.reshape(len(happened), -1).any(axis=1).argmax()), len(counts)):
        count = count if kept[t] else counted(count, happened[t])
        counts[t] = count
    return counts


def _moments(rows: NDArray[Any]) -> Floats:
    """Return number, sum and sum of squares of readings, (3, D)."""
    good = np.isfinite(rows)
    values = np.where(good, rows, 0.0).astype(np.float64)
    return np.stack([good.sum(axis=0), values.sum(axis=0), (values**2).sum(axis=0)])


def _ends(rows: NDArray[Any]) -> Floats:
    """Return the least reading of each sensor, and the largest one negated, (2, D)."""
    low = np.where(np.isfinite(rows), rows, np.inf).min(axis=0)
    high = np.where(np.isfinite(rows), rows, -np.inf).max(axis=0)
    return np.stack([low, -high]).astype(np.float64)


def _inner(ends: Sequence[Floats], odd: float) -> tuple[Floats, Floats]:
    """Return the range of most episodes; 0 for a sensor without readings."""
    low, high = -_largest(-np.stack(ends), odd) * [[1.0], [-1.0]]
    return np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)


def _largest(values: Floats, odd: float) -> Floats:
    """Return the largest of values (n, ...) but for a share of the n."""
    n = len(values)
    largest: Floats = np.sort(values, axis=0)[math.ceil((1 - odd) * n) - 1]
    return largest
