"""Checks that the same question gets the same answer, and that asking changes nothing."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.causality import TOLERANCE, difference
from oodd_eval.plugins.conformance.bench import (
    Bench,
    CheckFailedError,
    CheckSkipped,
    as_scores,
    doing,
    scores_of,
)
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.conformance.problem import SENSORS


@check
def same_seed(bench: Bench) -> None:
    """Two detectors of one seed give the same scores, whatever global generators hold."""
    first = bench.fitted()
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002  what must not matter
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    try:
        second = bench.fit()
        for trajectory in bench.problem.nominal(2):
            wrong = difference(scores_of(second, trajectory), scores_of(first, trajectory))
            if wrong:
                raise CheckFailedError(
                    f"a second detector of seed {bench.subject.seed}, fitted on the same "
                    f"trajectories, has other scores: {wrong}; draw all randomness from the seed"
                )
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002


@check
def refit(bench: Bench) -> None:
    """A second fit forgets the first one, also one of another number of sensors."""
    expected = bench.fitted()
    detector = bench.fit(bench.problem.training(sensors=SENSORS + 2, first=5000))
    with doing("a second fit"):
        detector.fit(bench.problem.training(first=6000))
        detector.fit(bench.problem.training())
    for trajectory in bench.problem.nominal(2):
        wrong = difference(scores_of(detector, trajectory), scores_of(expected, trajectory))
        if wrong:
            raise CheckFailedError(
                f"a detector that was fitted on something else before has other scores: {wrong}; "
                "fit has to begin anew"
            )


@check
def order(bench: Bench) -> None:
    """Scores of a trajectory do not depend on what was scored before."""
    detector = bench.fitted()
    trajectories = [*bench.problem.nominal(), bench.problem.anomalous(1)[0][0]]
    first = [scores_of(detector, x) for x in trajectories]
    again = [scores_of(detector, x) for x in reversed(trajectories)][::-1]
    for one, other in zip(first, again, strict=True):
        if wrong := difference(other, one):
            raise CheckFailedError(
                f"scores of a trajectory change with what was scored before: {wrong}; score must "
                "not keep anything"
            )


@check
def score_many(bench: Bench) -> None:
    """score_many gives the scores of score, in whatever company."""
    detector = bench.fitted()
    together = getattr(detector, "score_many", None)
    if together is None:
        raise CheckSkipped("has no score_many")
    trajectories = [*bench.problem.nominal(), bench.problem.anomalous(1)[0][0]]
    alone = [scores_of(detector, x) for x in trajectories]
    for chosen in (range(len(trajectories)), (3, 1), (2,)):
        company = [trajectories[i] for i in chosen]
        with doing("score_many"):
            found = list(together(company))
        if len(found) != len(company):
            raise CheckFailedError(
                f"score_many returned {len(found)} score arrays for {len(company)} trajectories"
            )
        for i, x, scores in zip(chosen, company, found, strict=True):
            if wrong := difference(as_scores(scores, x), alone[i], TOLERANCE):
                raise CheckFailedError(
                    f"score_many of {len(company)} trajectories differs from score: {wrong}"
                )


@check
def inputs_unchanged(bench: Bench) -> None:
    """Trajectories, and the list of them, are left as they were."""
    bench.fitted()
    training, nominal = bench.problem.training(), bench.problem.nominal()
    given, before = list(training), _bytes([*training, *nominal])
    detector = bench.fit(given)
    for x in nominal:
        detector.score(x)
    if [id(x) for x in given] != [id(x) for x in training]:
        raise CheckFailedError("fit changed the list of trajectories that it was given")
    for i, (found, expected) in enumerate(zip(_bytes([*training, *nominal]), before, strict=True)):
        if found != expected:
            raise CheckFailedError(
                f"{'fit' if i < len(training) else 'score'} changed the arrays of a trajectory"
            )


@check
def read_only(bench: Bench) -> None:
    """Trajectories in memory that cannot be written to are accepted."""
    bench.fitted()
    detector = bench.fit([_locked(x) for x in bench.problem.training()])
    with doing("score of an array that cannot be made writeable"):
        detector.score(_locked(bench.problem.nominal(1)[0]))


def _bytes(trajectories: Sequence[Trajectory]) -> list[bytes]:
    return [x.observations.tobytes() + x.actions.tobytes() for x in trajectories]


def _locked(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory whose arrays cannot be made writeable, as those of a mapped file."""
    locked = Trajectory(trajectory.observations, trajectory.actions)
    for name in ("observations", "actions"):
        array = getattr(trajectory, name)
        view = np.frombuffer(array.tobytes(), dtype=array.dtype).reshape(array.shape)
        object.__setattr__(locked, name, view)
    return locked


CHECKS = (same_seed, refit, order, score_many, inputs_unchanged, read_only)
