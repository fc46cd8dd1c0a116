"""Scoring: from names to a plan, from a plan to scores and records."""
