"""The rows that know nothing of dynamics."""

import numpy as np
import pytest

from oodd_eval.detector import Detector
from oodd_eval.errors import NotFittedError
from oodd_eval.metrics import auc_onset, auc_same_times
from oodd_eval.trajectory import Trajectory
from oodd_eval.trivial import Clock, Persistence, Random, oodd_detectors


def episode(rows):
    return Trajectory(rows, np.zeros((len(rows) - 1, 1)))


WALK = episode(np.cumsum(np.random.default_rng(0).normal(size=(50, 3)), axis=0))


@pytest.mark.parametrize("kind", [Clock, Persistence, Random])
@pytest.mark.parametrize("rows", [1, 2, 17])
def test_scores_use_nothing_that_comes_later(kind, rows):
    detector = kind(seed=3, horizon=2)
    detector.fit([WALK])
    assert isinstance(detector, Detector)
    assert np.array_equal(detector.score(WALK)[:rows], detector.score(WALK[:rows]), equal_nan=True)


def test_clock_has_paper_auc_one_and_matched_auc_one_half():
    scores = Clock().score(WALK)
    assert auc_onset(scores, 20) == 1.0
    assert auc_same_times(scores, scores, 20, 50) == 0.5


def test_random_differs_between_seeds_and_not_between_trajectories():
    other = episode(np.zeros((50, 3)))
    assert np.array_equal(Random(seed=1).score(WALK), Random(seed=1).score(other))
    assert not np.array_equal(Random(seed=1).score(WALK), Random(seed=2).score(WALK))


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


def test_persistence_before_fit_says_so():
    with pytest.raises(NotFittedError, match="before fit"):
        Persistence().score(WALK)


def test_the_three_are_offered():
    assert [spec.name for spec in oodd_detectors()] == ["random", "persistence", "clock"]
