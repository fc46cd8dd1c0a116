"""Monitors of other people: a threshold with a reason for a score that was computed elsewhere."""

from oodd_monitors.calibrating import ScoreCalibration, calibrate

__all__ = ["ScoreCalibration", "calibrate"]
