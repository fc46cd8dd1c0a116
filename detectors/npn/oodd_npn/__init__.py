"""Non-probabilistic recurrent networks as a detector plug-in.

A network forecasts one value of each sensor instead of a distribution, and is trained on squared
errors; the score is the mean absolute error of the ensemble's forecasts.
"""

from __future__ import annotations

from typing import Any

from oodd_torch.parameters import NetworkParameters

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked


def npn(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return an `oodd_torch.detector.NetworkDetector` of networks without quantiles."""
    # torch takes a second to import, and listing detectors should not.
    from oodd_torch.detector import NetworkDetector  # noqa: PLC0415

    parameters = checked(NetworkParameters, "npn", values)
    return NetworkDetector("npn", parameters, seed=seed, horizon=horizon, quantiles=False)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the detector of this package."""
    return [
        DetectorSpec(
            name="npn",
            factory=npn,
            summary="recurrent networks without quantiles, one forecast each",
            reference="Danesh & Fern (2021), Out-of-Distribution Dynamics Detection, section 3",
            parameters=NetworkParameters,
            requires=("torch",),
            extra="oodd-eval[reference]",
            seconds=40,
        )
    ]
