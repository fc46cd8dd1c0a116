"""Detectors that learn from failed episodes, too: the plug-in `outcomes`."""

from oodd_eval import DetectorSpec, hookimpl


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the supervised detectors."""
    return []
