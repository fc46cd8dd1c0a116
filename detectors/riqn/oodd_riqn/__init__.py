"""Recurrent implicit quantile networks as detector plug-ins: riqn, riqn-ms, riqn-r and n-riqn.

A network forecasts the distribution of each sensor's next value through its quantile function; the
score is the mean absolute distance between an observation and samples of its forecasts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from oodd_torch.parameters import NetworkParameters

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter


@dataclass(frozen=True)
class QuantileParameters(NetworkParameters):
    """Parameters of all four."""

    samples: int = parameter(8, low=1, decides="scores", help="samples of each network, M")
    levels: int = parameter(8, low=1, help="quantile levels of an update, one per equal part")


@dataclass(frozen=True)
class RiqnParameters(QuantileParameters):
    """Parameters of `riqn`, `riqn-ms` and `riqn-r`: a third of the paper's work by default."""

    members: int = parameter(3, low=1, help="networks in the ensemble, e; the paper has 5")
    updates: int = parameter(1250, low=1, help="gradient steps of each member")


@dataclass(frozen=True)
class WindowRiqnParameters(QuantileParameters):
    """Parameters of `n-riqn`."""

    window: int = parameter(4, low=1, help="observations in the input, W")


def riqn(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an `oodd_torch.detector.NetworkDetector` of recurrent quantile networks."""
    return _make("riqn", checked(RiqnParameters, "riqn", parameters), seed, horizon)


def riqn_ms(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return the same with mean sampling: rollouts are fed the mean of M samples."""
    parameters = checked(RiqnParameters, "riqn-ms", values)
    return _make("riqn-ms", parameters, seed, horizon, mean_sampling=True)


def riqn_r(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return `riqn` with another score: the median forecast, and sensors in nominal distances."""
    parameters = checked(RiqnParameters, "riqn-r", values)
    return _make("riqn-r", parameters, seed, horizon, residual_units=True)


def n_riqn(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return the same without memory: a window of observations instead of the GRU."""
    parameters = checked(WindowRiqnParameters, "n-riqn", values)
    return _make("n-riqn", parameters, seed, horizon, window=parameters.window, recurrent=False)


def _make(
    name: str, parameters: QuantileParameters, seed: int, horizon: int, **kind: Any
) -> Detector:
    # torch takes a second to import, and listing detectors should not.
    from oodd_torch.detector import NetworkDetector  # noqa: PLC0415

    return NetworkDetector(
        name,
        parameters,
        seed=seed,
        horizon=horizon,
        samples=parameters.samples,
        levels=parameters.levels,
        **kind,
    )


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the four detectors of this package."""
    common: dict[str, Any] = {
        "reference": "Danesh & Fern (2021), Out-of-Distribution Dynamics Detection, section 3",
        "requires": ("torch",),
        "extra": "oodd-eval[reference]",
        "seconds": 20,
    }
    return [
        DetectorSpec(
            name="riqn",
            factory=riqn,
            summary="recurrent implicit quantile networks, sampled forecasts",
            parameters=RiqnParameters,
            fit_name="riqn",
            **common,
        ),
        DetectorSpec(
            name="riqn-ms",
            factory=riqn_ms,
            summary="RIQN whose rollouts feed back the mean of M samples",
            parameters=RiqnParameters,
            fit_name="riqn",
            **common,
        ),
        DetectorSpec(
            name="riqn-r",
            factory=riqn_r,
            summary="RIQN scored by its median forecast, sensors in nominal distances",
            parameters=RiqnParameters,
            fit_name="riqn",
            **common,
        ),
        DetectorSpec(
            name="n-riqn",
            factory=n_riqn,
            summary="RIQN without memory: a window instead of the GRU",
            parameters=WindowRiqnParameters,
            **common,
        ),
    ]
