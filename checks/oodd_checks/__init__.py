"""Checks of detectors: conformance, a test per cell, and a plug-in project to begin with.

`check_detector` is imported when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from oodd_checks.testing import check_detector

__all__ = ["check_detector"]


def __getattr__(name: str) -> object:
    if name != "check_detector":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.testing").check_detector
