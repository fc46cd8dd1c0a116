"""Checks that a score uses nothing that was not known at its time."""

from __future__ import annotations

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.causality import TOLERANCE, difference
from oodd_eval.plugins.conformance.bench import (
    Bench,
    CheckFailedError,
    CheckSkipped,
    doing,
    scores_of,
)
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.conformance.problem import altered_from
from oodd_eval.plugins.contract import Scores, StreamingDetector


@check
def causality(bench: Bench) -> None:
    """Another future leaves the scores of the past as they are."""
    detector, trajectory = bench.fitted(), bench.problem.nominal(1)[0]
    expected = scores_of(detector, trajectory)
    for row in _rows(bench):
        found = scores_of(detector, altered_from(trajectory, row))
        if wrong := difference(found[:row], expected[:row], TOLERANCE):
            raise CheckFailedError(
                f"scores before t = {row} change when the episode goes on otherwise from there: "
                f"{wrong}; a score may use nothing after its time"
            )


@check
def prefix(bench: Bench) -> None:
    """The scores of a prefix are the prefix of the scores."""
    detector, trajectory = bench.fitted(), bench.problem.nominal(1)[0]
    expected = scores_of(detector, trajectory)
    for n in (1, 2, *_rows(bench), len(trajectory) - 1):
        found = scores_of(detector, trajectory[:n])
        if wrong := difference(found, expected[:n], TOLERANCE):
            raise CheckFailedError(
                f"the first {n} of {len(trajectory)} observations alone have other scores: {wrong}"
            )


@check
def streaming(bench: Bench) -> None:
    """Scores one observation at a time are those of the whole episode."""
    detector = bench.fitted()
    offered = [callable(getattr(detector, name, None)) for name in ("reset", "update")]
    if not any(offered):
        raise CheckSkipped("has no reset and update")
    if not all(offered) or not isinstance(detector, StreamingDetector):
        raise CheckFailedError("has only one of reset and update: expected both, or none")
    # The second episode is left in the middle, so that the next one has to begin anew.
    first, second, third = bench.problem.nominal(3)
    for trajectory in (first, second[: len(second) // 2], third):
        expected = scores_of(detector, trajectory)
        with doing("reset and update"):
            detector.reset()
            found = _streamed(detector, trajectory)
        if wrong := difference(found, expected, TOLERANCE):
            raise CheckFailedError(f"update differs from score of the whole episode: {wrong}")


def _streamed(detector: StreamingDetector, trajectory: Trajectory) -> Scores:
    actions = [None, *trajectory.actions]
    return np.array(
        [
            detector.update(observation, action)
            for observation, action in zip(trajectory.observations, actions, strict=True)
        ],
        dtype=np.float64,
    )


def _rows(bench: Bench) -> tuple[int, ...]:
    """Return rows at which to cut: around the horizon, and in the middle."""
    return bench.subject.horizon + 1, bench.subject.horizon + 2, bench.problem.rows // 2


CHECKS = (causality, prefix, streaming)
