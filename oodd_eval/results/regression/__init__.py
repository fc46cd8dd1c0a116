"""Regression checks: results against a reference, with tolerances per metric."""
