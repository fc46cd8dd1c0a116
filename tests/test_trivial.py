"""The rows that know nothing of dynamics."""

import numpy as np
import pytest
from scipy.stats import binom, kstest

from oodd_eval.data.split import load_split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.auc import auc_contributions, auc_onset, auc_same_times
from oodd_eval.metrics.bootstrap import cell_samples, percentiles, samples
from oodd_eval.plugins.baselines import Clock, Persistence, Random, oodd_detectors


def episode(rows):
    return Trajectory(rows, np.zeros((len(rows) - 1, 1)))


WALK = episode(np.cumsum(np.random.default_rng(0).normal(size=(50, 3)), axis=0))


def test_clock_has_paper_auc_one_and_matched_auc_one_half():
    scores = Clock().score(WALK)
    assert auc_onset(scores, 20) == 1.0
    assert auc_same_times(scores, scores, 20, 50) == 0.5


def test_random_differs_between_seeds_and_between_trajectories():
    first, other = Random(seed=0).score(WALK), Random(seed=1).score(WALK)
    moved = episode(WALK.observations + 1)
    assert not np.array_equal(first, other)
    assert not np.isin(Random(seed=0).score(moved), first).any()


def test_random_is_uniform():
    rows = np.random.default_rng(1).normal(size=(4000, 2))
    scores = Random(seed=0).score(episode(rows))
    assert kstest(scores, "uniform").pvalue > 0.001


@pytest.mark.slow
def test_on_mini_clock_and_random_give_what_theory_says():
    split = load_split("mini")
    cells = []
    for environment in split.environments:
        data = split.environment(environment)
        twins = [Random(seed=0).score(x) for x in data.twins]
        clocks = [Clock().score(x) for x in data.twins]
        for anomaly in data.anomalies:
            part = data.anomalous(anomaly)
            clock = auc_contributions([Clock().score(x) for x in part], clocks, part.onsets)
            assert clock["auc"].value == 1
            assert clock["auc_matched"].value == clock["auc_placebo"].value == 0.5
            found = auc_contributions([Random(seed=0).score(x) for x in part], twins, part.onsets)
            cells.append((environment, found))
    for metric in ("auc", "auc_matched", "auc_placebo"):
        low, high = percentiles(samples([(e, 0, c[metric]) for e, c in cells]))
        assert low <= 0.5 <= high
        # With ten seeds a percentile interval of 95 % covers about 90 %.
        ends = (percentiles(cell_samples(e, c[metric])) for e, c in cells)
        outside = sum(not x <= 0.5 <= y for x, y in ends)
        assert outside <= binom.ppf(0.999, len(cells), 0.1)


def test_persistence_is_the_mean_change_in_training_deviations():
    # Feature 0 has standard deviation 2 in training, feature 1 is constant: its scale stays 1.
    detector = Persistence()
    detector.fit([episode([[0, 5], [4, 5], [0, 5], [4, 5]])])
    # |3 - 0| / 2 = 1.5 and |6 - 5| / 1 = 1: mean 1.25; then no change.
    scores = detector.score(episode([[0, 5], [3, 6], [3, 6]]))
    assert np.array_equal(scores, [np.nan, 1.25, 0.0], equal_nan=True)


def test_persistence_looks_back_by_the_horizon():
    detector = Persistence(horizon=2)
    detector.fit([episode([[-1.0], [1.0]])])
    scores = detector.score(episode([[0.0], [1.0], [3.0], [3.0]]))
    assert np.array_equal(scores, [np.nan, np.nan, 3.0, 2.0], equal_nan=True)


def test_persistence_on_an_episode_shorter_than_the_horizon_is_undefined():
    detector = Persistence(horizon=10)
    detector.fit([WALK])
    assert np.isnan(detector.score(WALK[:4])).all()


def test_the_three_are_offered():
    assert [spec.name for spec in oodd_detectors()] == ["random", "persistence", "clock"]
