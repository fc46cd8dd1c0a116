"""Detectors that learn from failed episodes, too: the plug-in `outcomes`."""

from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter

Row = dict[str, bool]
"""Settings of a row that no parameter changes."""


@dataclass(frozen=True, slots=True)
class LogisticParameters:
    """Parameters of `logistic` and `logistic-time`."""

    ridge: float = parameter(30.0, above=0, help="precision of coefficients around 0")


@dataclass(frozen=True, slots=True)
class TdqcParameters:
    """Parameters of `tdqc`."""

    ridge: float = parameter(1.0, above=0, help="precision of coefficients around 0")


def make_outcome_detector(
    name: str, parameters: type, row: Row, *, seed: int = 0, horizon: int = 1, **values: Any
) -> Detector:
    """Return an unfitted detector of this package.

    Parameters
    ----------
    name
        Name of the row, for messages.
    parameters
        The row's parameters, a dataclass.
    row
        Whether there are `time` and `temporal`, see `oodd_outcomes.detector.OutcomeDetector`.
    seed, horizon
        From the harness, without effect.
    values
        Parameters that are set.
    """
    # Listing detectors needs no numpy.
    make = import_module(f"{__name__}.detector").OutcomeDetector
    settings: Any = checked(parameters, name, values)
    detector: Detector = make(name, ridge=settings.ridge, seed=seed, horizon=horizon, **row)
    return detector


def _spec(
    *, name: str, parameters: type, summary: str, reference: str, **row: bool
) -> DetectorSpec:
    kind: Row = {"time": False, "temporal": False}
    return DetectorSpec(
        name=name,
        factory=partial(make_outcome_detector, name, parameters, kind | row),
        parameters=parameters,
        summary=summary,
        reference=reference,
        training="failures",
        alarm="score",
        deterministic=True,
        horizon_decides_fit=False,
        seconds=1,
    )


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the detectors that learn from failed episodes."""
    return [
        _spec(
            name="logistic",
            parameters=LogisticParameters,
            summary="probability of failure by logistic regression on running features",
            reference="inputs of Huang et al. (2026), ActProbe",
        ),
        _spec(
            name="logistic-time",
            parameters=LogisticParameters,
            summary="probability of failure by logistic regression on running features and time",
            reference="inputs of Huang et al. (2026), ActProbe",
            time=True,
        ),
        _spec(
            name="tdqc",
            parameters=TdqcParameters,
            summary="probability of failure, learnt from that of the next row",
            reference="Francis-Meretzki, Mutti, Romano & Tamar (2026), TDQC",
            temporal=True,
        ),
    ]
