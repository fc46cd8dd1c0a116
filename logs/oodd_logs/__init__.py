"""Logs of one's own: readers, inspection, recipes that make splits of them, and scans of episodes.

The names below are imported when first used, so that commands stay quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from oodd_logs.importing import import_frames
    from oodd_logs.kinds import Kind
    from oodd_logs.readers import Reader
    from oodd_logs.recording import Recording, Topic
    from oodd_logs.scanning.scan import scan_episodes

__all__ = ["Kind", "Reader", "Recording", "Topic", "import_frames", "scan_episodes"]

_HOMES = {
    "Kind": "kinds",
    "Reader": "readers",
    "Recording": "recording",
    "Topic": "recording",
    "import_frames": "importing",
    "scan_episodes": "scanning.scan",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
