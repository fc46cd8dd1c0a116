"""arcade-a: heads against closed forms, coefficients against a known system, and what it finds."""

import numpy as np
import pytest
from helpers_state import assert_zero_scales_are_refused
from oodd_rivals import oodd_detectors
from oodd_rivals.arcade import FOLLOWED, LEARNT, MOST_INPUTS, EpisodeHeads, Pair, features, fitted

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError, TrajectoryError

(SPEC,) = (spec for spec in oodd_detectors() if spec.name == "arcade-a")


def episode(seed, n=200, move=0.0):
    """A sensor that commands push, an episode's own constant push, and from row 120 on one more."""
    rng = np.random.default_rng(seed)
    o, a = np.zeros((n, 2)), rng.normal(size=(n - 1, 1))
    push = rng.normal() + move * (np.arange(n) >= 120)
    for t in range(1, n):
        o[t, 0] = 0.5 * o[t - 1, 0] + a[t - 1, 0] + push[t] + 0.3 * rng.normal()
        o[t, 1] = 0.8 * o[t - 1, 1] + o[t - 1, 0] + 0.3 * rng.normal()
    return Trajectory(np.c_[o, np.full(n, 7.0)], a)


NOMINAL = [episode(seed) for seed in range(20)]


def make(**values):
    return SPEC.factory(**{"seed": 0, "horizon": 1, **values})


@pytest.fixture(scope="module")
def detector():
    return make(lags=6, rank=2).fit(NOMINAL)


def test_heads_have_the_posterior_of_a_ridge_regression():
    rng = np.random.default_rng(0)
    prior, x = rng.normal(size=(3, 2)), rng.normal(size=(LEARNT, 3))
    heads = EpisodeHeads(prior, 1, 1, 0)
    errors = x @ prior @ [0.4, -0.2] + 0.3 * rng.normal(size=LEARNT)
    for row, error in zip(x, errors, strict=True):
        heads(row[None], np.array([[error]]))
    z = x @ prior
    covariance = np.linalg.inv(np.eye(2) + z.T @ z)
    np.testing.assert_allclose(heads._covariance[0, 0], covariance)
    np.testing.assert_allclose(heads._mean[0, 0], covariance @ z.T @ errors)
    assert np.abs(errors).max() < FOLLOWED


def test_later_rows_are_learnt_so_many_rows_late():
    heads, x = EpisodeHeads(np.ones((1, 1)), 1, 1, 0), np.ones((1, 1))
    for _ in range(LEARNT):
        heads(x, np.zeros((1, 1)))
    for _ in range(LEARNT):
        heads(x, np.ones((1, 1)))
    assert heads._mean[0, 0, 0] == 0.0
    heads(x, np.ones((1, 1)))
    assert heads._mean[0, 0, 0] == pytest.approx(1 / (1 + LEARNT + 1))


def test_given_the_prior_of_heads_coefficients_are_those_of_the_system():
    """Without it they are those that an unknown constant push makes the best: near 1."""
    rng = np.random.default_rng(1)
    pairs = []
    for _ in range(40):
        o, push = np.zeros(301), 2.0 * rng.normal()
        for t in range(300):
            o[t + 1] = 0.5 * o[t] + push + 0.5 * rng.normal()
        inputs = np.stack([np.roll(o[:-1], i) for i in range(6)] + [np.ones(300)], axis=1)
        pairs.append(Pair(inputs[10:], o[11:, None]))
    plain, refined = (fitted(pairs, 6, 2, rounds)["forecast"][:6, 0] for rounds in (1, 6))
    assert plain.sum() > 0.9
    assert refined.sum() < 0.7


def test_features_are_means_newest_rows_and_one():
    inputs = np.array([[*range(14), *range(100, 107), 1.0]])  # 7 rows of 2 sensors, 7 commands
    assert features(inputs, 2, 7).tolist() == [[5.0, 6.0, 102.5, 0.0, 1.0, 100.0, 1.0]]


def test_an_episode_that_differs_is_nominal_and_one_that_changes_is_not(detector):
    nominal = [detector.score(episode(seed)) for seed in range(100, 110)]
    changed = [detector.score(episode(seed, move=1.0)) for seed in range(100, 110)]
    threshold = max(np.nanmax(scores) for scores in nominal)
    assert sum(np.nanmax(scores[120:140]) > threshold for scores in changed) >= 9
    np.testing.assert_array_equal([s[:120] for s in nominal], [s[:120] for s in changed])


def test_streams_and_prefixes_have_the_scores_of_the_episode(detector):
    x = episode(50)
    scores = detector.score(x)
    detector.reset()
    rows = zip(x.observations, [None, *x.actions], strict=True)
    np.testing.assert_array_equal([detector.update(*row) for row in rows], scores)
    part = Trajectory(x.observations[:70], x.actions[:69])
    np.testing.assert_array_equal(detector.score(part), scores[:70])


def test_a_state_is_taken_over_and_damaged_ones_are_refused(detector):
    other = make(lags=6, rank=2, seed=3)
    other.restore(detector.state())
    np.testing.assert_array_equal(other.score(NOMINAL[0]), detector.score(NOMINAL[0]))
    assert_zero_scales_are_refused(detector, make(lags=6, rank=2), ["std", "unit", "calibration"])
    with pytest.raises(FittedStateError, match="expected"):
        make(lags=7, rank=2).restore(detector.state())


def test_the_seed_is_without_effect(detector):
    other = make(lags=6, rank=2, seed=1).fit(NOMINAL)
    np.testing.assert_array_equal(other.score(NOMINAL[0]), detector.score(NOMINAL[0]))


def test_a_constant_sensor_that_moves_is_a_surprise(detector):
    x = episode(105)
    rows = x.observations.copy()
    rows[20:, 2] = 8.0
    scores = detector.score(Trajectory(rows, x.actions))
    np.testing.assert_array_equal(scores[1:20], detector.score(x)[1:20])
    assert (scores[20:] >= detector.surprise_).all()


def test_one_episode_is_enough_and_too_many_sensors_are_refused():
    scores = make().fit([NOMINAL[0]]).score(NOMINAL[1])
    assert np.isfinite(scores[1:]).all()
    wide = Trajectory(np.random.default_rng(0).normal(size=(30, MOST_INPUTS)), np.zeros((29, 1)))
    with pytest.raises(TrajectoryError, match="at most"):
        make().fit([wide])
