"""Random forests that predict the next observation: the plug-in `rf`."""

from dataclasses import dataclass
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter


@dataclass(frozen=True, slots=True)
class ForestParameters:
    """Parameters of `rf`."""

    members: int = parameter(5, low=1, help="forests in the ensemble")
    window: int = parameter(4, low=1, help="observations in the longest window")
    trees: int = parameter(10, low=1, help="trees in a forest")
    leaves: int = parameter(2000, low=2, help="leaves of a tree, at most")
    rows: int = parameter(20_000, low=1, help="transitions that a forest learns from, at most")
    draws: int = parameter(6000, low=1, help="bootstrap sample of a tree, at most `rows`")


def make_rf(*, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
    """Return an unfitted `RandomForestDetector`."""
    from oodd_rf.detector import RandomForestDetector  # noqa: PLC0415  keeps the listing quick

    given = checked(ForestParameters, "rf", parameters)
    return RandomForestDetector("rf", given, seed=seed, horizon=horizon)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the ensemble of random forests."""
    return [
        DetectorSpec(
            name="rf",
            factory=make_rf,
            summary="ensemble of random forests on a window of observations",
            reference="Danesh & Fern (2021), section 3; Breiman (2001)",
            parameters=ForestParameters,
            requires=("sklearn",),
            extra="oodd-eval[reference]",
            horizon_decides_fit=False,
        )
    ]
