"""Bootstrap intervals: reproducible, paired, and of the right width."""

import math

import numpy as np
import pytest

from oodd_eval.metrics.auc import Contribution, mean_of
from oodd_eval.metrics.bootstrap import (
    bootstrap_weights,
    cell_samples,
    interval,
    mean_value,
    percentiles,
    resampled,
    samples,
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
    assert percentiles(samples([("ant", 0, cells[0])])) == alone[0]


def test_differences_are_paired():
    noise = np.random.default_rng(2).normal(size=30)
    first, second = (samples([("ant", 0, mean_of(noise + shift))]) for shift in (0.1, 0.0))
    assert percentiles(first - second) == pytest.approx((0.1, 0.1))


def test_differences_over_several_seeds_are_paired():
    rng = np.random.default_rng(2)
    noise = [(seed, rng.normal(size=30)) for seed in (4, 0, 2)]
    first, second = (
        samples([("ant", seed, mean_of(values + shift)) for seed, values in noise])
        for shift in (0.1, 0.0)
    )
    assert percentiles(first - second) == pytest.approx((0.1, 0.1))


def test_the_mean_of_one_seeds_cells_is_resampled_with_the_weights_of_their_environments():
    rng = np.random.default_rng(3)
    cells = [("ant", 0, mean_of(rng.normal(size=9))), ("hopper", 0, mean_of([1.0, NAN, 5.0]))]
    parts = [resampled(c, bootstrap_weights(len(c.numerator), key=e)) for e, _, c in cells]
    assert np.array_equal(samples(cells), np.nanmean(parts, axis=0))
    assert np.array_equal(samples(cells[:1]), cell_samples("ant", cells[0][2]))


def test_detector_seeds_are_drawn_with_replacement():
    # Trajectories agree, so that the spread is the seeds' alone: 0 or 1, or both in the mean.
    cells = [("ant", seed, mean_of([float(seed)] * 4)) for seed in (1, 0)]
    found, counts = np.unique(samples(cells), return_counts=True)
    assert found.tolist() == [0.0, 0.5, 1.0]
    assert counts / 2000 == pytest.approx([0.25, 0.5, 0.25], abs=0.03)


def test_undefined_cells_are_left_out_of_a_mean_and_undefined_seeds_leave_out_the_resample():
    nothing, two = mean_of([NAN, NAN]), mean_of([2.0, 2.0])
    assert np.isnan(samples([("ant", 0, nothing)])).all()
    assert set(samples([("ant", 0, nothing), ("ant", 0, two)])) == {2.0}
    seeds = samples([("ant", 0, nothing), ("ant", 1, two)])
    assert set(seeds[~np.isnan(seeds)]) == {2.0}
    assert np.isnan(seeds).mean() == pytest.approx(0.75, abs=0.03)


def test_mean_over_cells_leaves_undefined_cells_out():
    assert mean_value([mean_of([1.0]), mean_of([NAN]), mean_of([3.0])]) == 2
    assert math.isnan(mean_value([]))


def test_cells_of_one_environment_stay_dependent():
    values = np.random.default_rng(3).normal(size=50)
    cell = mean_of(values)
    together = percentiles(samples([("ant", 0, cell), ("ant", 0, cell)]))
    apart = percentiles(samples([("ant", 0, cell), ("hopper", 0, cell)]))
    assert together == interval(cell, bootstrap_weights(50, key="ant"))
    assert apart[1] - apart[0] < 0.85 * (together[1] - together[0])
