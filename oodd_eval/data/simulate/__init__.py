"""Simulators, anomalies, policies and recording: the only importer of gymnasium and pybullet.

Needs the extra ``sim``; evaluating a frozen split does not come here.
"""
