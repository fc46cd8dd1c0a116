"""Vector autoregression watched by a multivariate EWMA chart: the rival from process control.

Two detectors, which differ in what they look at: `mewma` at observations alone, `mewma-a` at the
commanded actions too.
"""

from dataclasses import dataclass
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter

_REFERENCE = "Lowry, Woodall, Champ & Rigdon (1992)"


@dataclass(frozen=True, slots=True)
class MewmaParameters:
    """Parameters of `mewma` and `mewma-a`."""

    order: int = parameter(3, low=1, help="latest observations that a forecast uses")
    ridge: float = parameter(
        1e-4, above=0, help="penalty, relative to the mean squared error of standardized sensors"
    )
    clip: float = parameter(3.0, above=0, help="limit of a residual, in root mean squares")
    shrinkage: float = parameter(
        0.05, above=0, high=1, help="share of the identity in every covariance"
    )
    weights: list[float] = parameter(  # noqa: RUF009  it is copied
        [0.3, 0.1, 0.03], above=0, high=1, help="weights of the newest residual, one per chart"
    )


def make_mewma(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `MewmaDetector` that looks at observations."""
    return _make("mewma", seed, horizon, parameters, actions=False)


def make_mewma_a(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `MewmaDetector` that looks at observations and actions."""
    return _make("mewma-a", seed, horizon, parameters, actions=True)


def _make(name: str, seed: int, horizon: int, values: dict[str, Any], *, actions: bool) -> Detector:
    from oodd_mewma.detector import MewmaDetector  # noqa: PLC0415  keeps the listing quick

    parameters = checked(MewmaParameters, name, values)
    return MewmaDetector(name, parameters, seed=seed, horizon=horizon, actions=actions)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the chart without and with actions."""
    return [
        DetectorSpec(
            name="mewma",
            factory=make_mewma,
            summary="linear forecast, residuals accumulated with their sign",
            reference=_REFERENCE,
            deterministic=True,
            alarm="score",
            parameters=MewmaParameters,
        ),
        DetectorSpec(
            name="mewma-a",
            factory=make_mewma_a,
            summary="mewma whose forecast uses the commanded actions too",
            reference=_REFERENCE,
            inputs="observations+actions",
            deterministic=True,
            alarm="score",
            parameters=MewmaParameters,
        ),
    ]
