"""Non-probabilistic recurrent networks as a detector plug-in."""

from __future__ import annotations

from typing import Any

from oodd_eval import DetectorSpec, hookimpl

PARAMETERS: dict[str, Any] = {
    "members": 5,
    "updates": 600,
    "batch": 16,
    "chunk": 100,
    "scheduled_sampling": 0.0,
    "trunk": "shared",
    "device": "cpu",
}


def npn(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Any:
    """Return a `oodd_torch.ForecastDetector` of recurrent networks with squared error."""
    # torch takes a second to import, and listing detectors should not.
    from oodd_torch import ForecastDetector, Settings  # noqa: PLC0415

    settings = Settings(**(PARAMETERS | parameters), quantiles=False, samples=1)
    return ForecastDetector("npn", settings, seed=seed, horizon=horizon)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the detector of this package."""
    return [
        DetectorSpec(
            name="npn",
            factory=npn,
            summary="recurrent networks without quantiles, one forecast each",
            reference="Danesh & Fern (2021), Out-of-Distribution Dynamics Detection, section 3",
            parameters=dict(PARAMETERS),
            requires=("torch", "safetensors"),
            extra="oodd-eval[reference]",
            fit_ignores=("horizon", "device"),
        )
    ]
