"""Vector autoregression watched by a multivariate EWMA chart: the plug-ins' rival from statistics.

Two detectors, which differ in what they look at: `mewma` at observations alone, `mewma-a` at the
commanded actions too.
"""

from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl

_REFERENCE = "Lowry, Woodall, Champ & Rigdon (1992)"


def _parameters() -> dict[str, Any]:
    return {
        "order": 3,
        "ridge": 1e-4,
        "clip": 3.0,
        "shrinkage": 0.05,
        "weights": [0.3, 0.1, 0.03],
    }


def make_mewma(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `MewmaDetector` that looks at observations."""
    from oodd_mewma.detector import MewmaDetector  # noqa: PLC0415  keeps the listing quick

    return MewmaDetector(seed=seed, horizon=horizon, **parameters)


def make_mewma_a(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `MewmaDetector` that looks at observations and actions."""
    from oodd_mewma.detector import MewmaDetector  # noqa: PLC0415  keeps the listing quick

    return MewmaDetector(seed=seed, horizon=horizon, actions=True, **parameters)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the chart without and with actions."""
    return [
        DetectorSpec(
            name="mewma",
            factory=make_mewma,
            summary="linear forecast, residuals accumulated with their sign",
            reference=_REFERENCE,
            parameters=_parameters(),
        ),
        DetectorSpec(
            name="mewma-a",
            factory=make_mewma_a,
            summary="mewma whose forecast uses the commanded actions too",
            reference=_REFERENCE,
            inputs="observations+actions",
            parameters=_parameters(),
        ),
    ]
