"""Recorded columns as detectors: the plug-in `columns`."""

from oodd_eval import DetectorSpec, hookimpl


@hookimpl
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """column:NAME, flag:NAME, mean:NAME: a recorded score, alarm, or score's running mean."""
    del spec
    return None
