"""Metrics: pure functions of score arrays, their catalogue, intervals and ranks."""
