"""Simulators, anomalies, policies and recording (extra ``sim``): frozen splits need none."""

from oodd_eval.data.registry import register
from oodd_recording.benchmark import oodd_anomalies, oodd_environments

register([*oodd_environments(), *oodd_anomalies()])
