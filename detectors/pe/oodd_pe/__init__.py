"""Probabilistic ensemble of forecasters whose residuals are accumulated with their sign.

Four detectors share two fits: `pe` and `pe-step` look at observations alone, `pe-a` and `pe-step-a`
at the commanded actions too; those called "step" judge every step by itself.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter


@dataclass(frozen=True)
class PeParameters:
    """Parameters of the detectors of this package."""

    members: int = parameter(3, low=1, help="networks in the ensemble, M")
    updates: int = parameter(1800, low=1, help="most gradient steps of each member")
    batch: int = parameter(256, low=1, help="transitions of an update")
    width: int = parameter(128, low=1, help="units of each of the three hidden layers")
    window: int = parameter(2, low=1, help="latest observations that a forecast uses, W")
    memories: list[float] = parameter(  # noqa: RUF009  it is copied
        [0.3, 0.1, 0.03, 0.01],
        above=0,
        high=1,
        help="weights of the newest residual in the accumulated sums",
    )
    forecaster: str = parameter(
        "auto",
        choices=("auto", "ensemble"),
        help="ensemble, or auto: what makes held-out episodes likeliest",
    )
    device: str = parameter(
        "cpu",
        choices=("auto", "cpu", "cuda"),
        decides="nothing",
        help="where torch computes; auto: cuda where there is one",
    )


def make_pe(name: str = "pe", *, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `oodd_pe.detector.ProbabilisticEnsemble`, by the name of its row."""
    # torch takes a second to import, and listing detectors should not.
    from oodd_pe.detector import ProbabilisticEnsemble  # noqa: PLC0415

    return ProbabilisticEnsemble(
        name,
        checked(PeParameters, name, parameters),
        seed=seed,
        horizon=horizon,
        actions=name.endswith("-a"),
        accumulate="step" not in name,
    )


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the ensemble accumulated and per step, without and with actions."""
    return [
        _spec(name="pe", summary="probabilistic ensemble, residuals accumulated with their sign"),
        _spec(name="pe-a", summary="pe whose forecast uses the commanded actions too"),
        _spec(name="pe-step", summary="pe without accumulation, every step judged by itself"),
        _spec(name="pe-step-a", summary="pe-a without accumulation, every step judged by itself"),
    ]


def _spec(*, name: str, summary: str) -> DetectorSpec:
    actions = name.endswith("-a")
    return DetectorSpec(
        name=name,
        factory=partial(make_pe, name),
        summary=summary,
        reference="Chua et al. (2018), PETS (the ensemble); Lowry et al. (1992) (the charts)",
        inputs="observations+actions" if actions else "observations",
        alarm="cusum" if "step" in name else "score",
        parameters=PeParameters,
        requires=("torch", "sklearn"),
        extra="oodd-eval[reference]",
        seconds=30,
        fit_name="pe-a" if actions else "pe",
    )
