"""Checks of trajectories at the edge of what there is: short, constant, of unequal length."""

from __future__ import annotations

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.conformance.bench import Bench, CheckFailedError, doing, scores_of
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.conformance.problem import with_constant_sensor
from oodd_eval.plugins.contract import Detector


@check
def short_trajectories(bench: Bench) -> None:
    """Episodes of one and two observations, and as short as the horizon, are scored."""
    detector = bench.fitted()
    for n in sorted({1, 2, bench.subject.horizon, bench.subject.horizon + 1}):
        episode = bench.problem.episode(7, n)
        what = f"an episode of {n} observation{'s' if n > 1 else ''}"
        with doing(f"score of {what}"):
            _must_not_be_infinite(detector, episode, what)


@check
def constant_trajectory(bench: Bench) -> None:
    """An episode in which nothing moves is scored with finite scores."""
    still = bench.problem.episode(8)
    rows = np.repeat(still.observations[:1], len(still), axis=0)
    what = "an episode in which nothing moves"
    with doing(f"score of {what}"):
        _must_be_finite(bench, bench.fitted(), Trajectory(rows, np.zeros_like(still.actions)), what)


@check
def constant_sensor(bench: Bench) -> None:
    """A sensor that never moved in training is no reason for infinite scores when it does."""
    bench.fitted()
    detector = bench.fit(with_constant_sensor(bench.problem.training()))
    nominal = bench.problem.nominal(1)
    for episode, what in (
        (with_constant_sensor(nominal)[0], "an episode with a sensor that stands still"),
        (nominal[0], "an episode with a sensor that stood still in training only"),
    ):
        with doing(f"score of {what}"):
            _must_be_finite(bench, detector, episode, what)


@check
def unequal_lengths(bench: Bench) -> None:
    """Training episodes may be of unequal length, down to a single observation."""
    bench.fitted()
    lengths = [1, 2, 3, 2 * bench.problem.rows, *(bench.problem.rows - 5 * i for i in range(8))]
    detector = bench.fit([bench.problem.episode(9000 + i, n) for i, n in enumerate(lengths)])
    for trajectory in bench.problem.nominal():
        _must_be_finite(bench, detector, trajectory, "an episode, after such a fit,")


def _must_be_finite(bench: Bench, detector: Detector, trajectory: Trajectory, what: str) -> None:
    """Refuse undefined scores where an ordinary episode, scored by the same fit, has none."""
    _must_not_be_infinite(detector, trajectory, what)
    scores = scores_of(detector, trajectory)
    usual = np.isnan(scores_of(bench.fitted(), bench.problem.episode(0, len(trajectory))))
    wrong = np.flatnonzero(np.isnan(scores) & ~usual)
    if wrong.size:
        raise CheckFailedError(f"{what} has the score nan at t = {wrong[0]}: expected finite ones")


def _must_not_be_infinite(detector: Detector, trajectory: Trajectory, what: str) -> None:
    scores = scores_of(detector, trajectory)
    wrong = np.flatnonzero(np.isinf(scores))
    if wrong.size:
        t = wrong[0]
        raise CheckFailedError(f"{what} has the score {scores[t]} at t = {t}: expected finite ones")


CHECKS = (short_trajectories, constant_trajectory, constant_sensor, unequal_lengths)
