"""Random forests that predict the next observation: `rf`, and its running mean `rf-ewma`."""

from dataclasses import dataclass
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter


@dataclass(frozen=True)
class ForestParameters:
    """Parameters of `rf`."""

    members: int = parameter(5, low=1, help="forests in the ensemble")
    window: int = parameter(4, low=1, help="observations in the longest window")
    trees: int = parameter(10, low=1, help="trees in a forest")
    leaves: int = parameter(2000, low=2, help="leaves of a tree, at most")
    rows: int = parameter(20_000, low=1, help="transitions that a forest learns from, at most")
    draws: int = parameter(6000, low=1, help="bootstrap sample of a tree, at most `rows`")


@dataclass(frozen=True)
class SmoothedForestParameters(ForestParameters):
    """Parameters of `rf-ewma`."""

    weight: float = parameter(
        0.03, above=0, high=1, decides="scores", help="weight of the newest score"
    )


def make_rf(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return an unfitted `RandomForestDetector`."""
    from oodd_rf.detector import RandomForestDetector  # noqa: PLC0415  keeps the listing quick

    parameters = checked(ForestParameters, "rf", values)
    return RandomForestDetector("rf", parameters, seed=seed, horizon=horizon)


def make_rf_ewma(*, seed: int = 0, horizon: int = 1, **values: Any) -> Detector:
    """Return an unfitted `SmoothedForestDetector`."""
    from oodd_rf.smoothed import SmoothedForestDetector  # noqa: PLC0415  keeps the listing quick

    parameters = checked(SmoothedForestParameters, "rf-ewma", values)
    return SmoothedForestDetector("rf-ewma", parameters, seed=seed, horizon=horizon)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the ensemble of random forests, by its score and by a running mean of it."""
    common: dict[str, Any] = {
        "reference": "Danesh & Fern (2021), section 3; Breiman (2001)",
        "requires": ("sklearn",),
        "extra": "oodd-eval[reference]",
        "horizon_decides_fit": False,
        "fit_name": "rf",
    }
    return [
        DetectorSpec(
            name="rf",
            factory=make_rf,
            summary="ensemble of random forests on a window of observations",
            parameters=ForestParameters,
            **common,
        ),
        DetectorSpec(
            name="rf-ewma",
            factory=make_rf_ewma,
            summary="exponentially weighted running mean of rf's score",
            alarm="score",
            parameters=SmoothedForestParameters,
            **common,
        ),
    ]
