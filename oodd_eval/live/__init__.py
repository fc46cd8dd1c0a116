"""Beside a running robot: a watchdog around any detector, for loops, Gymnasium and terminals.

The classes that are not in this module are imported when first used: only wrappers need gymnasium.
"""

from dataclasses import astuple, dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from oodd_eval.live.terminal import TerminalMonitor
    from oodd_eval.live.watchdog import Watchdog
    from oodd_eval.live.wrappers import VectorWatchdogWrapper, WatchdogWrapper

__all__ = ["Reading", "TerminalMonitor", "VectorWatchdogWrapper", "Watchdog", "WatchdogWrapper"]

_HOMES = {
    "TerminalMonitor": "terminal",
    "Watchdog": "watchdog",
    "VectorWatchdogWrapper": "wrappers",
    "WatchdogWrapper": "wrappers",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


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
        parts = [f"row {self.t}: {'alarm' if self.alarm else 'nominal'}"]
        parts += [f"{name} {fault}" for name, fault in self.faults.items()]
        if self.sensor and self.sensor not in self.faults:
            parts.append(f"{self.sensor} {self.sensors[self.sensor]:.0%}")
        if self.onset is not None:
            parts.append(f"since row {self.onset}")
        return ", ".join(parts)
