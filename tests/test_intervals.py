"""Bootstrap intervals: reproducible, paired, and of the right width."""

import math

import numpy as np
import pytest

from oodd_eval.metrics.auc import Contribution, mean_of
from oodd_eval.metrics.bootstrap import (
    bootstrap_weights,
    difference_interval,
    interval,
    mean_interval,
    mean_value,
    resampled,
)

NAN = math.nan


def test_every_resample_draws_n_trajectories():
    weights = bootstrap_weights(7, resamples=50)
    assert weights.shape == (50, 7)
    assert (weights.sum(axis=1) == 7).all()


def test_same_seed_and_key_same_weights():
    assert np.array_equal(bootstrap_weights(9, key="ant"), bootstrap_weights(9, key="ant"))
    assert not np.array_equal(bootstrap_weights(9, key="ant"), bootstrap_weights(9, key="hopper"))
    assert not np.array_equal(bootstrap_weights(9), bootstrap_weights(9, seed=1))


def test_a_resample_is_the_metric_of_the_drawn_trajectories():
    rate = Contribution(np.array([1.0, 4.0]), np.array([10.0, 20.0]))
    weights = np.array([[2.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    assert resampled(rate, weights).tolist() == [0.1, 5 / 30, 0.2]


def test_interval_of_a_mean_has_the_width_of_theory():
    values = np.random.default_rng(0).normal(size=400)
    low, high = interval(mean_of(values), bootstrap_weights(400, resamples=4000))
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_resamples_in_which_a_metric_is_undefined_are_left_out():
    rare = mean_of([3.0, NAN, NAN])
    assert interval(rare, bootstrap_weights(3)) == (3.0, 3.0)
    assert all(math.isnan(x) for x in interval(mean_of([NAN, NAN]), bootstrap_weights(2)))


def test_an_interval_does_not_depend_on_what_is_computed_beside_it():
    rng = np.random.default_rng(1)
    cells = [mean_of(rng.normal(size=10)) for _ in range(5)]
    weights = bootstrap_weights(10, key="ant")
    alone = [interval(c, weights) for c in cells]
    assert alone[::-1] == [interval(c, weights) for c in cells[::-1]]
    assert mean_interval(cells[:1], [weights]) == alone[0]


def test_differences_are_paired():
    noise = np.random.default_rng(2).normal(size=30)
    first, second = mean_of(noise + 0.1), mean_of(noise)
    weights = bootstrap_weights(30)
    low, high = difference_interval([first], [second], [weights])
    assert low == pytest.approx(0.1)
    assert high == pytest.approx(0.1)


def test_mean_over_cells_leaves_undefined_cells_out():
    assert mean_value([mean_of([1.0]), mean_of([NAN]), mean_of([3.0])]) == 2
    assert math.isnan(mean_value([]))
    assert all(math.isnan(x) for x in mean_interval([], []))


def test_cells_of_one_environment_stay_dependent():
    values = np.random.default_rng(3).normal(size=50)
    cell, weights = mean_of(values), bootstrap_weights(50, key="ant")
    other = bootstrap_weights(50, key="hopper")
    together = mean_interval([cell, cell], [weights, weights])
    apart = mean_interval([cell, cell], [weights, other])
    assert together == interval(cell, weights)
    assert apart[1] - apart[0] < 0.85 * (together[1] - together[0])
