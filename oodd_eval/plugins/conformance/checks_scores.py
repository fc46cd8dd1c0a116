"""Checks of the scores themselves: form, where they are defined, and which way they point."""

from __future__ import annotations

import numpy as np

from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.conformance.bench import Bench, CheckFailedError, CheckSkipped, scores_of
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.contract import MAX_WARM_UP, Detector, Scores

LEAST_AUC = 0.75
"""Least probability that a gross anomaly scores above its nominal twin."""


@check
def shape(bench: Bench) -> None:
    """Scores are one array of one dimension, one score per observation."""
    detector = bench.fitted()
    for trajectory in bench.problem.nominal():
        scores = np.asarray(detector.score(trajectory))
        if scores.shape != (len(trajectory),):
            raise CheckFailedError(
                f"score returned shape {scores.shape} for {len(trajectory)} observations: expected "
                f"({len(trajectory)},), one score per observation"
            )


@check
def dtype(bench: Bench) -> None:
    """Scores are a numpy array of float64."""
    scores: object = bench.fitted().score(bench.problem.nominal(1)[0])
    if not isinstance(scores, np.ndarray):
        raise CheckFailedError(f"score returned {type(scores).__name__}, expected a numpy array")
    if scores.dtype != np.float64:
        raise CheckFailedError(f"score returned {scores.dtype} scores, expected float64")


@check
def finite(bench: Bench) -> None:
    """Scores are finite from the first defined one on, also on a gross anomaly."""
    detector = bench.fitted()
    trajectories = [*bench.problem.nominal(), *(wild for wild, _, _ in bench.problem.anomalous())]
    for trajectory in trajectories:
        scores = scores_of(detector, trajectory)
        first = _undefined(scores)
        wrong = np.flatnonzero(~np.isfinite(scores[first:]))
        if wrong.size:
            t = first + int(wrong[0])
            raise CheckFailedError(
                f"the score at t = {t} of {len(scores)} is {scores[t]}: expected finite scores "
                "but for one leading block of NaN"
            )
        if first == len(scores):
            raise CheckFailedError(
                f"all {len(scores)} scores of an episode are NaN: expected scores after the warm-up"
            )


@check
def warm_up(bench: Bench) -> None:
    """The leading block of NaN is as long as horizon and declared warm-up say."""
    detector = bench.fitted()
    declared: object = getattr(detector, "warm_up", 0)
    if type(declared) is not int or not 0 <= declared <= MAX_WARM_UP:
        raise CheckFailedError(
            f"warm_up is {declared!r}, expected an int between 0 and {MAX_WARM_UP}"
        )
    longest = max(_undefined(scores_of(detector, x)) for x in bench.problem.nominal())
    allowed = max(bench.subject.horizon, declared)
    if longest > allowed:
        raise CheckFailedError(
            f"the first {longest} scores are NaN, but with horizon {bench.subject.horizon} and "
            f"warm_up {declared} at most {allowed} may be: declare warm_up = {longest}, or pad"
        )
    if longest < declared:
        raise CheckFailedError(
            f"warm_up is {declared}, but only the first {longest} scores are NaN: declare what is "
            "left undefined"
        )


@check
def horizon(bench: Bench) -> None:
    """Another horizon is honoured: undefined for no more rows than it, scores beyond them."""
    # Not the one of all the other checks, and long enough to tell from a fixed block.
    other = 4 if bench.subject.horizon != 4 else 2
    bench.fitted()
    detector = bench.fit(horizon=other)
    scores = scores_of(detector, bench.problem.nominal(1)[0])
    allowed = max(other, _warm_up_of(detector))
    if _undefined(scores) > allowed:
        raise CheckFailedError(
            f"with horizon {other} the first {_undefined(scores)} scores are NaN: expected at most "
            f"{allowed}"
        )


@check
def gross_anomaly(bench: Bench) -> None:
    """Scores are higher when every sensor goes wild: higher means more anomalous."""
    detector = bench.fitted()
    areas = [
        auc(scores_of(detector, wild)[onset:], scores_of(detector, twin)[onset:])
        for wild, twin, onset in bench.problem.anomalous()
    ]
    if np.isnan(areas).any():
        raise CheckSkipped("needs defined scores: see check 'finite'")
    mean = float(np.mean(areas))
    if mean < LEAST_AUC:
        advice = (
            "scores seem to point the other way: negate them"
            if mean < 1 - LEAST_AUC
            else "scores do not tell a gross anomaly"
        )
        raise CheckFailedError(
            f"an episode whose sensors go wild scores above its nominal twin in {mean:.0%} of "
            f"pairs, expected at least {LEAST_AUC:.0%}: {advice}"
        )


def _undefined(scores: Scores) -> int:
    """Return the length of the leading block of NaN."""
    defined = np.flatnonzero(~np.isnan(scores))
    return int(defined[0]) if defined.size else len(scores)


def _warm_up_of(detector: Detector) -> int:
    declared = getattr(detector, "warm_up", 0)
    return declared if isinstance(declared, int) else 0


CHECKS = (shape, dtype, finite, warm_up, horizon, gross_anomaly)
