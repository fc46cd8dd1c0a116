"""Checks of how a detector is made, the errors it owes its users, and the form of its scores."""

import re

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.conformance.trial import SENSORS, CheckFailedError, CheckSkipped, Trial
from oodd_eval.plugins.contract import MAX_WARM_UP, Detector, Scores
from oodd_eval.plugins.isolation.worker import reason_of
from oodd_eval.plugins.parameters import parameters_of

LEAST_AUC = 0.75  # least probability that a gross anomaly scores above its nominal twin

_OTHER_SENSORS = 7


def check_factory(trial: Trial) -> None:
    """The factory takes seed and horizon and returns an object with fit and score."""
    trial.make()


def check_unknown_parameter(trial: Trial) -> None:
    """The factory refuses a parameter that it does not know."""
    trial.unfitted()
    try:
        trial.spec.factory(**trial.arguments, no_such_parameter=1)
    except (TypeError, ValueError):
        return
    raise CheckFailedError(
        "the factory accepted no_such_parameter=1 without a word: expected a TypeError or "
        "ValueError, so that a misspelt parameter is not taken for a setting"
    )


def check_fits(trial: Trial) -> None:
    """It can be fitted on nominal trajectories, and score one."""
    if isinstance(trial.first_fit, CheckFailedError):
        if trial.needs_actions():
            raise CheckSkipped("needs actions: see check 'inputs'")
        raise trial.first_fit


def check_inputs(trial: Trial) -> None:
    """It can do without actions where the spec declares observations alone."""
    if trial.actions:
        raise CheckSkipped("may look at actions")
    if trial.needs_actions():
        raise CheckFailedError(
            f"without actions, {trial.first_fit}; with them it works: expected "
            'inputs="observations+actions" in the spec, as a detector that declares observations '
            "is handed actions of width 0"
        )
    trial.fitted()


def check_declared_parameters(trial: Trial) -> None:
    """The parameters that the spec declares exist, and their defaults are the factory's own."""
    known = parameters_of(trial.spec.parameters)
    declared = {name: p.default for name, p in known.items()}
    if not declared:
        raise CheckSkipped("declares no parameters")
    trial.fitted()
    spelt_out = trial.fit(**{**declared, **trial.parameters})
    values = ", ".join(f"{name}={value!r}" for name, value in declared.items())
    what = f"scores change when the declared defaults ({values}) are spelt out"
    advice = "expected the defaults of the spec to be those of the factory"
    trial.must_agree(spelt_out, what, advice, n=1)


def check_not_fitted(trial: Trial) -> None:
    """Scores before fit are refused with an error that says so."""
    what, wanted = "score before fit", "expected oodd_eval.errors.NotFittedError"
    same = "scores before fit are those after it"
    error = _refusal(trial, trial.unfitted(), trial.nominal(1)[0], same)
    if error is None:
        raise CheckFailedError(f"{what} returned scores, other ones than after it: {wanted}")
    if "NotFitted" not in type(error).__name__ and not re.search(r"\bfit", str(error)):
        wanted += " or a message that speaks of fit"
        raise CheckFailedError(f"{what} raised {reason_of(error)}: {wanted}")


def check_wrong_dimension(trial: Trial) -> None:
    """A trajectory of another number of sensors is refused with an error that names both."""
    what = f"score, fitted on {SENSORS} sensors and given {_OTHER_SENSORS},"
    wanted = "expected a ValueError that names both"
    wrong = trial.episode(1, sensors=_OTHER_SENSORS)
    error = _refusal(trial, trial.fitted(), wrong, "no number of sensors is wrong")
    if error is None:
        raise CheckFailedError(f"{what} returned scores: {wanted}")
    named = {str(SENSORS), str(_OTHER_SENSORS)} <= set(re.findall(r"\d+", str(error)))
    if not (named and isinstance(error, ValueError)):
        raise CheckFailedError(f"{what} raised {reason_of(error)}: {wanted} numbers")


def _refusal(
    trial: Trial, detector: Detector, trajectory: Trajectory, nothing_wrong: str
) -> Exception | None:
    """Return the error of a score, or None; skip when a detector that learns nothing has none."""
    try:
        detector.score(trajectory)
    except Exception as error:  # noqa: BLE001  the checks decide which errors will do
        return error
    if trial.learns_nothing():
        raise CheckSkipped(f"learns nothing: {nothing_wrong}")
    return None


def check_shape(trial: Trial) -> None:
    """Scores are one array of one dimension, one score per observation."""
    for trajectory in trial.nominal():
        shape, n = np.asarray(trial.fitted().score(trajectory)).shape, len(trajectory)
        if shape != (n,):
            expected = f"expected ({n},), one score per observation"
            raise CheckFailedError(f"score returned shape {shape} for {n} observations: {expected}")


def check_dtype(trial: Trial) -> None:
    """Scores are a numpy array of float64."""
    scores: object = trial.fitted().score(trial.nominal(1)[0])
    if not isinstance(scores, np.ndarray):
        raise CheckFailedError(f"score returned {type(scores).__name__}, expected a numpy array")
    if scores.dtype != np.float64:
        raise CheckFailedError(f"score returned {scores.dtype} scores, expected float64")


def check_finite(trial: Trial) -> None:
    """Scores are finite from the first defined one on, also on a gross anomaly."""
    for trajectory in [*trial.nominal(), *(wild for wild, _, _ in trial.anomalous())]:
        scores = trial.scores(trajectory)
        first, n = _undefined(scores), len(scores)
        if first == n:
            expected = "expected scores after the warm-up"
            raise CheckFailedError(f"all {n} scores of an episode are NaN: {expected}")
        wrong = first + np.flatnonzero(~np.isfinite(scores[first:]))
        if wrong.size:
            t, expected = wrong[0], "expected finite scores but for one leading block of NaN"
            raise CheckFailedError(f"the score at t = {t} of {n} is {scores[t]}: {expected}")


def check_warm_up(trial: Trial) -> None:
    """The leading block of NaN is as long as horizon and declared warm-up say."""
    declared: object = getattr(trial.fitted(), "warm_up", 0)
    if type(declared) is not int or not 0 <= declared <= MAX_WARM_UP:
        wanted = f"expected an int between 0 and {MAX_WARM_UP}"
        raise CheckFailedError(f"warm_up is {declared!r}, {wanted}")
    longest = max(_undefined(trial.scores(x)) for x in trial.nominal())
    allowed = max(trial.horizon, declared)
    if longest > allowed:
        most = f"with horizon {trial.horizon} and warm_up {declared} at most {allowed} may be"
        advice = f"declare warm_up = {longest}, or pad"
        raise CheckFailedError(f"the first {longest} scores are NaN, but {most}: {advice}")
    if longest < declared:
        found = f"only the first {longest} scores are NaN: declare what is left undefined"
        raise CheckFailedError(f"warm_up is {declared}, but {found}")


def check_horizon(trial: Trial) -> None:
    """Another horizon is honoured: undefined for no more rows than it, scores beyond them."""
    # Not the one of all the other checks, and long enough to tell from a fixed block.
    other = 4 if trial.horizon != 4 else 2
    trial.fitted()
    detector = trial.fit(horizon=other)
    n = _undefined(trial.scores(trial.nominal(1)[0], detector))
    declared = getattr(detector, "warm_up", 0)
    allowed = max(other, declared if isinstance(declared, int) else 0)
    if n > allowed:
        what = f"with horizon {other} the first {n} scores are NaN"
        raise CheckFailedError(f"{what}: expected at most {allowed}")


def check_gross_anomaly(trial: Trial) -> None:
    """Scores are higher when every sensor goes wild: higher means more anomalous."""
    areas = [
        auc(trial.scores(wild)[onset:], trial.scores(twin)[onset:])
        for wild, twin, onset in trial.anomalous()
    ]
    if np.isnan(areas).any():
        raise CheckSkipped("needs defined scores: see check 'finite'")
    mean = float(np.mean(areas))
    if mean < LEAST_AUC:
        scores = "do not tell a gross anomaly"
        if mean < 1 - LEAST_AUC:
            scores = "seem to point the other way: negate them"
        raise CheckFailedError(
            f"an episode whose sensors go wild scores above its nominal twin in {mean:.0%} of "
            f"pairs, expected at least {LEAST_AUC:.0%}: scores {scores}"
        )


def _undefined(scores: Scores) -> int:
    """Return the length of the leading block of NaN."""
    return int(np.argmin([*np.isnan(scores), False]))
