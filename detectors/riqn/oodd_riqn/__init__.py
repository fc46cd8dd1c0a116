"""Recurrent implicit quantile networks as detector plug-ins: riqn, riqn-ms and n-riqn."""

from __future__ import annotations

from typing import Any

from oodd_eval import DetectorSpec, hookimpl

REFERENCE = "Danesh & Fern (2021), Out-of-Distribution Dynamics Detection, section 3"

PARAMETERS: dict[str, Any] = {
    "members": 5,
    "samples": 8,
    "updates": 600,
    "batch": 16,
    "chunk": 100,
    "levels": 8,
    "scheduled_sampling": 0.0,
    "trunk": "shared",
    "device": "cpu",
}


def riqn(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Any:
    """Return a `oodd_torch.ForecastDetector` of recurrent quantile networks."""
    # torch takes a second to import, and listing detectors should not.
    from oodd_torch import ForecastDetector, Settings  # noqa: PLC0415

    settings = Settings(**(PARAMETERS | parameters))
    return ForecastDetector("riqn", settings, seed=seed, horizon=horizon)


def riqn_ms(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Any:
    """Return the same with mean sampling: rollouts are fed the mean of M samples."""
    from oodd_torch import ForecastDetector, Settings  # noqa: PLC0415

    settings = Settings(**(PARAMETERS | parameters), mean_sampling=True)
    return ForecastDetector("riqn-ms", settings, seed=seed, horizon=horizon)


def n_riqn(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Any:
    """Return the same without memory: a window of observations instead of the GRU."""
    from oodd_torch import ForecastDetector, Settings  # noqa: PLC0415

    settings = Settings(**({"window": 4} | PARAMETERS | parameters), recurrent=False)
    return ForecastDetector("n-riqn", settings, seed=seed, horizon=horizon)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the three detectors of this package."""
    common: dict[str, Any] = {
        "reference": REFERENCE,
        "requires": ("torch", "safetensors"),
        "extra": "oodd-eval[reference]",
        "fit_ignores": ("horizon", "samples", "device"),
    }
    return [
        DetectorSpec(
            name="riqn",
            factory=riqn,
            summary="recurrent implicit quantile networks, sampled forecasts",
            parameters=dict(PARAMETERS),
            fit_name="riqn",
            **common,
        ),
        DetectorSpec(
            name="riqn-ms",
            factory=riqn_ms,
            summary="RIQN whose rollouts feed back the mean of M samples",
            parameters=dict(PARAMETERS),
            fit_name="riqn",
            **common,
        ),
        DetectorSpec(
            name="n-riqn",
            factory=n_riqn,
            summary="RIQN without memory: a window instead of the GRU",
            parameters={"window": 4} | PARAMETERS,
            **common,
        ),
    ]
