"""The rows that know nothing of dynamics."""

import numpy as np
import pytest
from oodd_trivial import Clock, Comb, Mahalanobis, Manifold, Persistence, Random, Range
from scipy.stats import binom, kstest

from oodd_eval.data.split import load_split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, FittedStateError
from oodd_eval.metrics.auc import auc_contributions, auc_onset, auc_same_times
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval
from oodd_eval.metrics.cusum import Standardization


def episode(rows):
    return Trajectory(rows, np.zeros((len(rows) - 1, 1)))


WALK = episode(np.cumsum(np.random.default_rng(0).normal(size=(50, 3)), axis=0))


def test_clock_has_paper_auc_one_and_matched_auc_one_half():
    scores = Clock().score(WALK)
    assert auc_onset(scores, 20) == 1.0
    assert auc_same_times(scores, scores, 20, 50) == 0.5


def test_random_is_uniform():
    rows = np.random.default_rng(1).normal(size=(4000, 2))
    scores = Random(seed=0).score(episode(rows))
    assert kstest(scores, "uniform").pvalue > 0.001


PLAIN = Standardization(0.0, 1.0)


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
            clock = auc_contributions(
                [Clock().score(x) for x in part], clocks, part.onsets, part.effects, PLAIN
            )
            assert clock["auc"].value == 1
            assert clock["auc_matched"].value == clock["auc_placebo"].value == 0.5
            found = auc_contributions(
                [Random(seed=0).score(x) for x in part], twins, part.onsets, part.effects, PLAIN
            )
            cells.append((environment, found))
    for metric in ("auc", "auc_matched", "auc_placebo"):
        drawn = [drawn_cell(e, 0, c[metric]) for e, c in cells]
        low, high = mean_interval(drawn, kind="share")
        assert low <= 0.5 <= high
        ends = (mean_interval([one], kind="share") for one in drawn)
        outside = sum(not x <= 0.5 <= y for x, y in ends)
        assert outside <= binom.ppf(0.999, len(cells), 0.08)


def test_persistence_is_the_mean_change_in_training_deviations():
    # Feature 0 has standard deviation 2 in training, feature 1 is constant: its scale stays 1.
    detector = Persistence()
    detector.fit([episode([[0, 5], [4, 5], [0, 5], [4, 5]])])
    # |3 - 0| / 2 = 1.5 and |6 - 5| / 1 = 1: mean 1.25; then no change.
    scores = detector.score(episode([[0, 5], [3, 6], [3, 6]]))
    assert np.array_equal(scores, [np.nan, 1.25, 0.0], equal_nan=True)
    # It looks back by the horizon.
    detector = Persistence(horizon=2)
    detector.fit([episode([[-1.0], [1.0]])])
    scores = detector.score(episode([[0.0], [1.0], [3.0], [3.0]]))
    assert np.array_equal(scores, [np.nan, np.nan, 3.0, 2.0], equal_nan=True)


def test_comb_spikes_once_in_every_hundred_rows():
    scores = Comb().score(episode(np.zeros((301, 1))))
    assert np.flatnonzero(scores).tolist() == [99, 199, 299]
    assert scores.max() == 1
    assert auc_same_times(scores, scores, 40, 301) == 0.5


# Sensor 0 has the 17 values -8 .. 8 and never stands still; sensor 1 has the two values 0 and 1 and
# stands still for two rows at most; sensor 2 is constant.
SEEN = np.stack([np.arange(-8, 9), np.array([0, 0, 1] * 5 + [0, 0]), np.full(17, 3.0)], axis=1)
SPREAD = np.sqrt(24)  # (17^2 - 1) / 12


def fitted_range():
    return Range().fit([episode(SEEN), episode(SEEN[::-1])])


def scores_of(detector, *rows):
    return detector.score(episode(rows)).tolist()


def test_range_adds_excess_in_spreads_and_values_never_seen():
    detector = fitted_range()
    assert not detector.score(episode(SEEN)).any()
    found = scores_of(detector, [8.5, 0, 3], [-10, 1, 3], [7.5, 0, 3])
    assert found == pytest.approx([0.5 / SPREAD, 2 / SPREAD, 0])  # 7.5 was never seen, and may be
    std = SEEN[:, 1].std()
    # A discrete sensor inside its range, outside of it, and a constant one that moves by 1.
    assert scores_of(detector, [0, 0.5, 3]) == [1]
    assert scores_of(detector, [0, 2, 3]) == pytest.approx([1 + 1 / std])
    assert scores_of(detector, [0, 1, 4]) == [2]
    # A sensor of nine values is not discrete.
    eight, nine = (np.arange(n, dtype=float)[:, None] for n in (8, 9))
    assert scores_of(Range().fit([episode(eight)]), [2.5]) == [1]
    assert scores_of(Range().fit([episode(nine)]), [2.5]) == [0]


def test_range_tells_what_stands_still_for_longer_than_in_training():
    detector = fitted_range()
    rows = [[k % 8, 0, 3] for k in range(5)]
    # Two rows of 0 in a row in training, and the constant sensor may stand still.
    assert scores_of(detector, *rows) == [0, 0, 1, 1, 1]
    # Two sensors at once; a change begins anew.
    rows = [[5, 0, 3], [5, 0, 3], [5, 0, 3], [6, 1, 3], [6, 1, 3]]
    assert scores_of(detector, *rows) == [0, 1, 2, 0, 1]


def test_mahalanobis_is_the_length_of_the_whitened_row():
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(400, 3)) @ rng.normal(size=(3, 3)) * [1, 10, 0.1] + [0, 5, -2]
    train = [episode(rows[:150]), episode(rows[150:])]
    stored = np.concatenate([x.observations for x in train]).astype(np.float64)
    inverse = np.linalg.inv(np.cov(stored.T, bias=True))
    far = WALK.observations - stored.mean(axis=0)
    expected = [np.sqrt(d @ inverse @ d) for d in far]
    detector = Mahalanobis().fit(train)
    np.testing.assert_allclose(detector.score(WALK), expected, rtol=1e-6)
    squares = np.concatenate([detector.score(x) for x in train]) ** 2
    assert squares.mean() == pytest.approx(3)  # the number of directions that vary


def test_mahalanobis_leaves_out_what_did_not_vary():
    rng = np.random.default_rng(6)
    one = rng.normal(size=200)
    rows = np.stack([one, 3 * one, np.full(200, 7.0)], axis=1)
    detector = Mahalanobis().fit([episode(rows)])
    # One direction: the copy adds nothing, a constant sensor that moves is not seen.
    mean, std = np.float32(one).mean(dtype=np.float64), np.float32(one).std(dtype=np.float64)
    found = scores_of(detector, [2, 6, 7], [2, 6, 9])
    assert found == pytest.approx(2 * [abs(2 - mean) / std], rel=1e-5)
    still = Mahalanobis().fit([episode(np.ones((9, 2)))])
    assert scores_of(still, [1, 1], [5, 5]) == [0, 0]


def circle(seed, rows=400):
    angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, size=rows)
    return np.stack([np.cos(angles), np.sin(angles), np.full(rows, 3.0)], axis=1)


def test_manifold_sees_what_leaves_a_surface_and_no_single_sensor_shows():
    train = [episode(circle(7)), episode(circle(8))]
    inside, point = Manifold().fit(train), [0.5, 0.5, 3]
    nominal = inside.score(episode(circle(9)))
    assert scores_of(inside, point)[0] > 50 * nominal.max()
    plain = Mahalanobis().fit(train)
    assert scores_of(plain, point)[0] < plain.score(episode(circle(9))).max()
    # A constant sensor that moves is not seen.
    assert scores_of(inside, [1, 0, 3]) == scores_of(inside, [1, 0, 4])
    rows = np.random.default_rng(0).normal(size=(70, 61))
    with pytest.raises(ContractError, match="got 61 sensors"):
        Manifold().fit([episode(rows)])
    with pytest.raises(FittedStateError, match="'range/1'"):
        Mahalanobis().restore(Range().fit([WALK]).state())


def test_manifold_is_the_length_of_whitened_products():
    train, detector = [episode(circle(7)), WALK], Manifold()
    detector.fit(train)
    rows = np.concatenate([x.observations for x in train]).astype(np.float64)
    z = (rows - rows.mean(axis=0)) / rows.std(axis=0)

    def products(x):
        return np.array([*x, *(x[i] * x[j] for i in range(3) for j in range(i, 3))])

    features = np.array([products(x) for x in z])
    mean, std = features.mean(axis=0), features.std(axis=0)
    covariance = np.corrcoef(features.T) + 1e-6 * np.eye(9)
    row = WALK.observations[20].astype(np.float64)
    far = (products((row - rows.mean(axis=0)) / rows.std(axis=0)) - mean) / std
    expected = np.sqrt(far @ np.linalg.solve(covariance, far))
    assert scores_of(detector, row)[0] == pytest.approx(expected, rel=1e-4)
