"""Random forests that predict the next observation: the plug-in `rf`."""

from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl


def make_rf(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `RandomForestDetector`."""
    from oodd_rf.detector import RandomForestDetector  # noqa: PLC0415  keeps the listing quick

    return RandomForestDetector(seed=seed, horizon=horizon, **parameters)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the ensemble of random forests."""
    return [
        DetectorSpec(
            name="rf",
            factory=make_rf,
            summary="ensemble of random forests on a window of observations",
            reference="Danesh & Fern (2021), section 3; Breiman (2001)",
            parameters={
                "members": 5,
                "window": 4,
                "trees": 10,
                "leaves": 2000,
                "rows": 20_000,
                "draws": 6000,
            },
            requires=("sklearn",),
            extra="oodd-eval[reference]",
            fit_ignores=("horizon",),
        )
    ]
