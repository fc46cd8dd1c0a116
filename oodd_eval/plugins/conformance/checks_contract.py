"""Checks of how a detector is made, and of the errors it owes its users."""

from __future__ import annotations

import re

from oodd_eval.plugins.causality import difference
from oodd_eval.plugins.conformance.bench import (
    Bench,
    CheckFailedError,
    CheckSkipped,
    scores_of,
)
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.conformance.problem import SENSORS
from oodd_eval.plugins.isolation.worker import reason_of

_UNKNOWN = "no_such_parameter"
_OTHER_SENSORS = 7


@check
def factory(bench: Bench) -> None:
    """The factory takes seed and horizon and returns an object with fit and score."""
    bench.make()


@check
def unknown_parameter(bench: Bench) -> None:
    """The factory refuses a parameter that it does not know."""
    bench.unfitted()
    s = bench.subject
    try:
        s.factory(seed=s.seed, horizon=s.horizon, **s.parameters, **{_UNKNOWN: 1})
    except (TypeError, ValueError):
        return
    raise CheckFailedError(
        f"the factory accepted {_UNKNOWN}=1 without a word: expected a TypeError or ValueError, so "
        "that a misspelt parameter is not taken for a setting"
    )


@check
def declared_parameters(bench: Bench) -> None:
    """The parameters that the spec declares exist, and their defaults are the factory's own."""
    declared = bench.subject.declared
    if not declared:
        raise CheckSkipped("declares no parameters")
    plain = bench.fitted()
    spelt_out = bench.fit(**{**declared, **bench.subject.parameters})
    trajectory = bench.problem.nominal(1)[0]
    wrong = difference(scores_of(spelt_out, trajectory), scores_of(plain, trajectory))
    if wrong:
        values = ", ".join(f"{name}={value!r}" for name, value in declared.items())
        raise CheckFailedError(
            f"scores change when the declared defaults ({values}) are spelt out: {wrong}; expected "
            "the defaults of the spec to be those of the factory"
        )


@check
def fits(bench: Bench) -> None:
    """It can be fitted on nominal trajectories, and score one."""
    bench.first_fit()


@check
def not_fitted(bench: Bench) -> None:
    """Scores before fit are refused with an error that says so."""
    detector = bench.unfitted()
    trajectory = bench.problem.nominal(1)[0]
    try:
        detector.score(trajectory)
    except Exception as error:  # noqa: BLE001  which errors will do is decided here
        told = "NotFitted" in type(error).__name__ or re.search(r"\bfit", str(error))
        if told:
            return
        raise CheckFailedError(
            f"score before fit raised {reason_of(error)}: expected oodd_eval.errors.NotFittedError "
            "or a message that speaks of fit"
        ) from None
    if bench.learns_nothing():
        raise CheckSkipped("learns nothing: scores before fit are those after it")
    raise CheckFailedError(
        "score before fit returned scores, other ones than after it: expected "
        "oodd_eval.errors.NotFittedError"
    )


@check
def wrong_dimension(bench: Bench) -> None:
    """A trajectory of another number of sensors is refused with an error that names both."""
    detector = bench.fitted()
    other = bench.problem.episode(1, sensors=_OTHER_SENSORS)
    asked = f"score, fitted on {SENSORS} sensors and given {_OTHER_SENSORS},"
    try:
        detector.score(other)
    except Exception as error:  # noqa: BLE001  which errors will do is decided here
        numbers = set(re.findall(r"\d+", str(error)))
        if {str(SENSORS), str(_OTHER_SENSORS)} <= numbers and isinstance(error, ValueError):
            return
        raise CheckFailedError(
            f"{asked} raised {reason_of(error)}: expected a ValueError that names both numbers"
        ) from None
    if bench.learns_nothing():
        raise CheckSkipped("learns nothing: no number of sensors is wrong")
    raise CheckFailedError(f"{asked} returned scores: expected a ValueError that names both")


CHECKS = (factory, unknown_parameter, fits, declared_parameters, not_fitted, wrong_dimension)
