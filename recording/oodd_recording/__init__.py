"""Simulators, anomalies, policies and recording (extra ``sim``): frozen splits need none."""
