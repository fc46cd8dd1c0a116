"""Monitors of other people: a threshold with a reason for a score that was computed elsewhere."""

from oodd_monitors.calibrating import (
    Detections,
    LabelledScores,
    ScoreCalibration,
    ScoreGroup,
    calibrate,
)

__all__ = ["Detections", "LabelledScores", "ScoreCalibration", "ScoreGroup", "calibrate"]
