"""Beside a running robot: a watchdog around any detector, for loops, Gymnasium and terminals.

The names below are imported when first used: only the wrappers need gymnasium.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from oodd_live.reading import Reading
    from oodd_live.terminal import TerminalMonitor
    from oodd_live.watchdog import Watchdog
    from oodd_live.wrappers import VectorWatchdogWrapper, WatchdogWrapper

__all__ = ["Reading", "TerminalMonitor", "VectorWatchdogWrapper", "Watchdog", "WatchdogWrapper"]

_HOMES = {
    "Reading": "reading",
    "TerminalMonitor": "terminal",
    "Watchdog": "watchdog",
    "VectorWatchdogWrapper": "wrappers",
    "WatchdogWrapper": "wrappers",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
