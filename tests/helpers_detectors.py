"""Detectors with parameters that make them quick enough to be tried."""

NETWORK = {"updates": 3, "members": 2}
ENSEMBLE = {"updates": 20, "width": 16}
FEW_UNITS = {"updates": 20, "units": 16}
QUANTILES = {**NETWORK, "samples": 2, "levels": 2}
SMALL = {
    "rf": {"members": 2, "trees": 2},
    "rf-ewma": {"members": 2, "trees": 2},
    "riqn": QUANTILES,
    "riqn-ms": QUANTILES,
    "riqn-r": QUANTILES,
    "n-riqn": QUANTILES,
    "npn": NETWORK,
    "pe": ENSEMBLE,
    "pe-a": ENSEMBLE,
    "pe-step": ENSEMBLE,
    "pe-step-a": ENSEMBLE,
    "rnd": ENSEMBLE,
    "rpt-a": FEW_UNITS,
    "logpzo": FEW_UNITS,
    "logpzo-a": FEW_UNITS,
    "wm-kl-a": FEW_UNITS,
    "lstm": FEW_UNITS,
    "dagmm": {"updates": 120, "batch": 64},
    "paano": {**ENSEMBLE, "window": 8, "batch": 16},
    "sklearn:IsolationForest": {"n_estimators": 10},
}
"""What makes a slow detector quick enough to be tried."""
