"""The reading of a watchdog: score, alarm and what is at fault in one row."""

from dataclasses import astuple, dataclass


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
    """

    t: int
    score: float
    statistic: float
    threshold: float
    alarm: bool
    sensors: dict[str, float]
    onset: int | None
    faults: dict[str, str]

    def __eq__(self, other: object) -> bool:
        # Tuples take a NaN, which is always this one, for equal to itself.
        return isinstance(other, Reading) and astuple(self) == astuple(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def sensor(self) -> str:
        """The sensor that is named first; empty where none is."""
        return next(iter(self.sensors), "")

    def __str__(self) -> str:
        """Return one line: the state, and in an alarm what is at fault and since when."""
        told = [f"row {self.t}: {'alarm' if self.alarm else 'nominal'}"]
        told += [f"{name} {fault}" for name, fault in self.faults.items()]
        if self.sensor and self.sensor not in self.faults:
            told.append(f"{self.sensor} {self.sensors[self.sensor]:.0%}")
        if self.onset is not None:
            told.append(f"since row {self.onset}")
        return ", ".join(told)
