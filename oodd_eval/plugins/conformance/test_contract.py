"""Tests of how a detector is made, the errors that it owes users, and the form of its scores.

PYTEST_DONT_REWRITE: messages are whole sentences.
"""

import re
from collections.abc import Sequence

import numpy as np
import pytest

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.conformance.trial import SENSORS, RaisedError, Trial, shared_trial, trial
from oodd_eval.plugins.contract import Detector, check_scores
from oodd_eval.plugins.isolation.worker import reason_of
from oodd_eval.plugins.parameters import parameters_of

__all__ = ["shared_trial", "trial"]  # fixtures

LEAST_AUC = 0.75  # least probability that a gross anomaly scores above its nominal twin

_OTHER_SENSORS = 7


def test_factory(trial: Trial) -> None:
    """The factory takes seed and horizon and returns an object with fit and score."""
    trial.make()


def test_unknown_parameter(trial: Trial) -> None:
    """The factory refuses a parameter that it does not know."""
    trial.unfitted()
    try:
        trial.spec.factory(**trial.arguments, no_such_parameter=1)
    except (TypeError, ValueError):
        return
    raise AssertionError(
        "the factory accepted no_such_parameter=1 without a word: expected a TypeError or "
        "ValueError, so that a misspelt parameter is not taken for a setting"
    )


def test_fits(trial: Trial) -> None:
    """It can be fitted on nominal trajectories, and score one."""
    error = trial.first_fit
    hint = "" if trial.actions else "; its spec declares no actions, so their width was 0"
    if isinstance(error, AssertionError):
        raise RaisedError(f"{error}{hint}") from error.__cause__


def test_declared_parameters(trial: Trial) -> None:
    """The parameters that the spec declares exist, and their defaults are the factory's own."""
    declared = {name: p.default for name, p in parameters_of(trial.spec.parameters).items()}
    if not declared:
        pytest.skip("declares no parameters")
    trial.fitted()
    detector = trial.fit(**{**declared, **trial.parameters})
    values = ", ".join(f"{name}={value!r}" for name, value in declared.items())
    problem = f"scores change when the declared defaults ({values}) are spelt out"
    advice = "expected the defaults of the spec to be those of the factory"
    trial.must_agree(detector, problem, advice, n=1)


def test_not_fitted(trial: Trial) -> None:
    """Scores before fit are refused with an error that says so."""
    expected = "expected oodd_eval.errors.NotFittedError"
    error = _refusal(
        trial, trial.unfitted(), trial.nominal(1)[0], "scores before fit are those after it"
    )
    assert error, f"score before fit returned scores, other ones than after it: {expected}"
    assert "NotFitted" in type(error).__name__ or re.search(r"\bfit", str(error)), (
        f"score before fit raised {reason_of(error)}: {expected} or a message that speaks of fit"
    )


def test_wrong_dimension(trial: Trial) -> None:
    """A trajectory of another number of sensors is refused with an error that names both."""
    call = f"score, fitted on {SENSORS} sensors and given {_OTHER_SENSORS},"
    expected = "expected a ValueError that names both"
    trajectory = trial.episode(1, sensors=_OTHER_SENSORS)
    error = _refusal(trial, trial.fitted(), trajectory, "no number of sensors is wrong")
    assert error, f"{call} returned scores: {expected}"
    both_named = {str(SENSORS), str(_OTHER_SENSORS)} <= set(re.findall(r"\d+", str(error)))
    assert both_named and isinstance(error, ValueError), (
        f"{call} raised {reason_of(error)}: {expected} numbers"
    )


def _refusal(
    trial: Trial, detector: Detector, trajectory: Trajectory, nothing_wrong: str
) -> Exception | None:
    """Return the error of a score, or None; skip when a detector that learns nothing has none."""
    try:
        detector.score(trajectory)
    except Exception as error:  # noqa: BLE001  the tests decide which errors will do
        return error
    if trial.learns_nothing():
        pytest.skip(f"learns nothing: {nothing_wrong}")
    return None


def test_scores(trial: Trial) -> None:
    """Scores are one float64 per observation, finite from the first defined one on."""
    trajectories = [*trial.nominal(), *(wild for wild, _, _ in trial.anomalous())]
    _check_scores(trial, trial.fitted(), trial.horizon, trajectories)


def test_warm_up(trial: Trial) -> None:
    """No more rows are declared undefined than are."""
    declared = getattr(trial.fitted(), "warm_up", 0)
    undefined = max(int(np.isnan(trial.scores(x)).sum()) for x in trial.nominal())
    assert undefined >= declared, (
        f"warm_up is {declared}, but only {undefined} scores are NaN: declare what is left so"
    )


def test_horizon(trial: Trial) -> None:
    """Another horizon is honoured: undefined for no more rows than it, scores beyond them."""
    # Not the one of all the other checks, and long enough to tell from a fixed block.
    horizon = 4 if trial.horizon != 4 else 2
    trial.fitted()
    _check_scores(trial, trial.fit(horizon=horizon), horizon, trial.nominal(1))


def _check_scores(
    trial: Trial, detector: Detector, horizon: int, trajectories: Sequence[Trajectory]
) -> None:
    """Check scores as a run does."""
    for trajectory in trajectories:
        check_scores(
            detector.score(trajectory),
            trajectory,
            horizon=horizon,
            warm_up=getattr(detector, "warm_up", 0),
            detector=trial.spec.name or type(detector).__name__,
            where=f"an episode, fitted with horizon {horizon}",
        )


def test_gross_anomaly(trial: Trial) -> None:
    """Scores are higher when every sensor goes wild: higher means more anomalous."""
    areas = [
        auc(trial.scores(wild)[onset:], trial.scores(twin)[onset:])
        for wild, twin, onset in trial.anomalous()
    ]
    if np.isnan(areas).any():
        pytest.skip("needs defined scores: see check 'scores'")
    mean = float(np.mean(areas))
    advice = "do not tell a gross anomaly"
    if mean < 1 - LEAST_AUC:
        advice = "seem to point the other way: negate them"
    assert mean >= LEAST_AUC, (
        f"an episode whose sensors go wild scores above its nominal twin in {mean:.0%} of pairs, "
        f"expected at least {LEAST_AUC:.0%}: scores {advice}"
    )
