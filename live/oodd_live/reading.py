"""Values that a watchdog gives: a reading after every row, and the promise of its threshold.

The promise is for operation without end, where nominal operation alarms some day. Its statistic
exceeds a high threshold in bursts, rarer than episodes are long; what is promised is the mean time
between them.
"""

import math
from dataclasses import astuple, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import UsageError
from oodd_eval.plugins.explanations import NAMED

Floats = NDArray[np.float64]

FEWEST: Final = 20
"""Nominal episodes that a tail can be estimated from."""
TAIL: Final = 0.25
"""Share of the episodes, those with the largest statistics, that the tail is estimated from."""
OK, WARN, ERROR, STALE = range(4)
"""Levels of ROS 2's DiagnosticStatus."""
_LISTED: Final = 4  # named parts in a line
_NORMAL: Final = 1.96  # a 95 % interval of a normal distribution


@dataclass(frozen=True, slots=True)
class RunLength:
    """A promised mean time between false alarms.

    Attributes
    ----------
    hours
        The promise.
    low, high
        95 % interval of what a threshold from so few episodes may really give, in hours.
    observed
        Nominal operation that it was estimated from, in hours. A promise beyond it rests on the
        shape of the tail.
    """

    hours: float
    low: float
    high: float
    observed: float

    @classmethod
    def fit(
        cls, largest: Floats, rows: int, hours: float, rate: float
    ) -> "tuple[float, RunLength]":
        """Return the threshold that nominal operation exceeds once in so many hours, with that.

        The k largest statistics of n episodes exceed the largest of the others by amounts that
        are taken for exponential, as those of accumulated sums are far out. With their mean b the
        threshold u + b x is exceeded by a share k / n e^-x of the episodes.

        Parameters
        ----------
        largest : float64 array of shape (n,)
            The largest statistic of each nominal episode; at least 20.
        rows
            Observations in all of these episodes together.
        hours, rate
            Mean time between false alarms, and observations in a second.

        Returns
        -------
        threshold : float
            Of the statistic.
        promise : RunLength
            The mean time between false alarms with its interval.

        Raises
        ------
        UsageError
            For fewer than 20 episodes, or a time that they are too long for.

        Examples
        --------
        >>> largest = np.random.default_rng(0).exponential(size=400)
        >>> threshold, promise = RunLength.fit(largest, 400 * 500, hours=10, rate=50)
        >>> round(threshold, 1), round(promise.low, 1), round(promise.high, 1)
        (8.3, 2.6, 38.3)
        """
        n, observed = len(largest), rows / rate / 3600
        if n < FEWEST:
            raise UsageError(
                f"a mean time between false alarms needs {FEWEST} nominal episodes for the "
                f"threshold, got {n}: record more, or cut long ones"
            )
        k = max(FEWEST // 2, round(TAIL * n))
        ordered = np.sort(largest)
        above, start = ordered[n - k :], float(ordered[n - k - 1])
        # Episodes among n that are to alarm, as many as promises fit into what was observed.
        expected = observed / hours
        x = math.log(k / expected)
        if x <= 0:
            raise UsageError(
                f"{hours:g} h between false alarms is less than {observed / k:.3g} h, which is "
                f"what {n} episodes of {observed:.3g} h in all are cut for: promise more"
            )
        # Relative errors of the share k / n, and of the mean of k exponential amounts.
        error = math.exp(_NORMAL * math.sqrt((1 - k / n + x**2) / k))
        promise = cls(hours, hours / error, hours * error, observed)
        return start + x * float((above - start).mean()), promise


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The state of a `Watchdog` after one row.

    Attributes
    ----------
    t
        The row, counted from 0 at the latest ``reset``.
    score, statistic, threshold
        Of the detector, NaN where undefined; what is compared with the threshold.
    alarm
        Whether there is an alarm.
    sensors
        In an alarm, share of each sensor in the evidence, by name, the largest first; empty where
        nothing is known.
    onset
        In an alarm, the row with which the anomaly began, as seen now; None where nothing is known.
    faults
        Sensors with a fault, by name: ``"missing"``, ``"frozen"`` or ``"out of range"``; for all at
        once ``{"observation": "missing"}``, ``"repeated"`` or ``"irregular"``; for actions
        ``{"action": "missing"}`` or ``"late"``.
    parts
        In an alarm, probability of each part of being at fault, the largest first: sensors and
        actuators by name. Parts of one half or more are named, those of 0 are left out; empty where
        nothing is known. Of a detector that gives shares alone, the fewest sensors that carry half.
    kind
        In an alarm, where the fault is: ``"sensor"``, ``"actuator"``, ``"body"`` or
        ``"environment"``; empty where that is not known.
    """

    t: int
    score: float
    statistic: float
    threshold: float
    alarm: bool
    sensors: dict[str, float]
    onset: int | None
    faults: dict[str, str]
    parts: dict[str, float] = field(default_factory=dict)
    kind: str = ""

    def __eq__(self, other: object) -> bool:
        # Tuples take a NaN, which is always this one, for equal to itself.
        return isinstance(other, Reading) and astuple(self) == astuple(other)

    __hash__ = None  # type: ignore[assignment]

    def diagnostics(
        self, name: str = "oodd", hardware_id: str = "", time: float | None = None
    ) -> dict[str, Any]:
        """Return the reading as a ROS 2 ``diagnostic_msgs/DiagnosticArray``, a plain mapping.

        Parameters
        ----------
        name, hardware_id
            Of the one status in it.
        time
            Time stamp in seconds; 0 without one.

        Returns
        -------
        dict
            Fields of the message by name, for JSON as they are. The level is a number, of which
            rclpy takes ``bytes([level])``: ERROR in an alarm, STALE where no observation comes,
            WARN for a fault or a statistic above the threshold without an alarm, else OK. The score
            and the statistic are empty where they are undefined.
        """
        seconds, nanoseconds = divmod(as_nanoseconds(time or 0.0), 10**9)
        level = OK
        if self.alarm:
            level = ERROR
        elif self.faults or self.statistic > self.threshold:
            level = WARN
        if self.faults.get("observation") == "missing":
            level = STALE
        values = {
            "row": str(self.t),
            **{n: _text(getattr(self, n)) for n in ("score", "statistic", "threshold")},
            "alarm": str(self.alarm).lower(),
            "onset": "" if self.onset is None else str(self.onset),
            "kind": self.kind,
        }
        values |= {f"part {part}": f"{p:.3f}" for part, p in self.parts.items()}
        values |= {f"sensor {sensor}": f"{share:.3f}" for sensor, share in self.sensors.items()}
        values |= {f"fault {source}": fault for source, fault in self.faults.items()}
        status = {
            "level": level,
            "name": name,
            "message": str(self),
            "hardware_id": hardware_id,
            "values": [{"key": key, "value": value} for key, value in values.items()],
        }
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        return {"header": {"stamp": stamp, "frame_id": ""}, "status": [status]}

    @property
    def sensor(self) -> str:
        """The sensor that is named first; empty where none is."""
        return next(iter(self.sensors), "")

    def __str__(self) -> str:
        """Return one line: the state, and in an alarm what is at fault and since when."""
        state = "alarm" if self.alarm else "nominal"
        return ", ".join([f"row {self.t}: {state}", *_causes(self)])


@dataclass(frozen=True, slots=True)
class EpisodeAlarm:
    """An alarm in a recorded episode, as `Watchdog.explain` returns it.

    Attributes
    ----------
    first, last
        Rows from 0 that it lasts from and to.
    onset
        The row with which the anomaly began, as seen at the first one; None where nothing is known.
    sensors
        Share of each sensor in the evidence of the first row, by name, the largest first; empty
        where nothing is known.
    faults
        Sensors with a fault in the first row, as those of a `Reading`.
    parts, kind
        What is at fault as seen at the first row, as those of a `Reading`.
    """

    first: int
    last: int
    onset: int | None
    sensors: dict[str, float]
    faults: dict[str, str]
    parts: dict[str, float] = field(default_factory=dict)
    kind: str = ""

    def __str__(self) -> str:
        """Return one line: its rows, what is at fault, and since when."""
        return ", ".join([f"rows {self.first} to {self.last}: alarm", *_causes(self)])


def _causes(alarm: Reading | EpisodeAlarm) -> list[str]:
    """Return what is at fault and since when, in words."""
    causes = [f"{name} {fault}" for name, fault in alarm.faults.items()]
    if alarm.kind and not causes:
        causes.append(f"{alarm.kind} fault")
    named = [name for name, p in alarm.parts.items() if p >= NAMED] or [*alarm.sensors][:1]
    shares = {name: f"{name} {share:.0%}" for name, share in alarm.sensors.items()}
    causes += [shares.get(name, name) for name in named if name not in alarm.faults][:_LISTED]
    return causes if alarm.onset is None else [*causes, f"since row {alarm.onset}"]


def _text(number: float) -> str:
    return repr(float(number)) if math.isfinite(number) else ""


def as_nanoseconds(time: float) -> int:
    """Return seconds since whenever as nanoseconds, without the product that rounds.

    >>> as_nanoseconds(1.5e9 + 0.25)
    1500000000250000000
    """
    seconds = math.floor(time)
    return seconds * 10**9 + round((time - seconds) * 1e9)
