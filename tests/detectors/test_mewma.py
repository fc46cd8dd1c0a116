"""The vector autoregression and its chart, by hand and against slow, obvious forms of them."""

import numpy as np
import pytest
from helpers_state import assert_zero_scales_are_refused
from oodd_common.charts import distance, product, smooth, whitening
from oodd_mewma import make_mewma, make_mewma_a
from oodd_mewma.forecast import Moments, regressors

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError

A1 = np.array([[0.5, 0.2, 0.0], [-0.3, 0.6, 0.1], [0.0, 0.1, 0.4]])
A2 = np.array([[-0.2, 0.0, 0.1], [0.0, -0.3, 0.0], [0.1, 0.0, 0.2]])
PUSH = np.array([[0.0, 0.0, 2.0]])


def episode(seed, n=80, noise=0.1):
    """``o_t = A1 o_{t-1} + A2 o_{t-2} + PUSH a_{t-1} + noise``, with a fourth sensor that is 7."""
    rng = np.random.default_rng(seed)
    before = 30  # steps until the start is forgotten
    n += before
    o, a = np.zeros((n, 3)), rng.normal(size=(n - 1, 1))
    for t in range(2, n):
        o[t] = A1 @ o[t - 1] + A2 @ o[t - 2] + a[t - 1] @ PUSH + noise * rng.normal(size=3)
    return Trajectory(np.c_[o, np.full(n, 7.0)][before:], a[before:])


NOMINAL = [episode(seed) for seed in range(12)]


def shifted(x, onset, by):
    rows = x.observations.copy()
    rows[onset:, 0] += by
    return Trajectory(rows, x.actions)


@pytest.fixture(scope="module")
def chart():
    return make_mewma().fit(NOMINAL)


@pytest.fixture(scope="module")
def chart_a():
    return make_mewma_a().fit(NOMINAL)


# The forecast


def test_regressors_hold_the_latest_times_newest_first_then_actions_then_one():
    o, a = np.array([[1.0], [2.0], [3.0], [4.0]]), np.array([[10.0], [20.0], [30.0]])
    found = regressors(o, a, order=2, horizon=1)
    assert found.tolist() == [[2, 1, 20, 10, 1], [3, 2, 30, 20, 1]]
    assert regressors(o, a, order=1, horizon=3).tolist() == [[1, 10, 1]]
    assert regressors(o, None, order=3, horizon=1).tolist() == [[3, 2, 1, 1]]
    assert regressors(o, None, order=3, horizon=2).shape == (0, 4)
    assert regressors(o[:1], None, order=3, horizon=2).shape == (0, 4)


def test_ridge_by_hand():
    # x = 1, 2, 3 around 2, y = 2, 4, 6 around 4: slope sum(xy) / (sum(xx) + ridge n) = 4 / (2 + 2).
    x, y = np.array([[-1.0, 1], [0.0, 1], [1.0, 1]]), np.array([[2.0], [4.0], [6.0]])
    np.testing.assert_allclose(Moments.of(x, y).solve(2 / 3), [[1.0], [4.0]])
    np.testing.assert_allclose(Moments.of(x, y).solve(1e-12), [[2.0], [4.0]])


def test_autoregression_of_a_known_process_is_recovered():
    detector = make_mewma_a(ridge=1e-9, order=2).fit([episode(s, n=1000) for s in range(20)])
    std, action_std = detector.observation_scale_.std, detector.action_scale_.std
    b = detector.coefficients_
    # Coefficients are those of standardized sensors: back to the process's units.
    unit = std[None, :3] / std[:3, None]
    np.testing.assert_allclose(b[0:3, :3] * unit, A1.T, atol=0.02)
    np.testing.assert_allclose(b[4:7, :3] * unit, A2.T, atol=0.02)
    np.testing.assert_allclose(b[8, :3] * std[:3] / action_std, PUSH[0], atol=0.02)
    np.testing.assert_allclose(b[9, :3], 0.0, atol=0.02)  # the action before has no effect
    np.testing.assert_allclose(detector.residual_scale_[:3] * std[:3], 0.1, rtol=0.05)


def test_longer_horizon_is_the_best_linear_forecast_at_that_distance():
    """Of ``o_t = 0.8 o_{t-1} + e`` the forecast at distance h is ``0.8^h o_{t-h}``."""
    rng = np.random.default_rng(0)
    o = np.zeros((4000, 1))
    for t in range(1, 4000):
        o[t] = 0.8 * o[t - 1] + rng.normal()
    x = Trajectory(o, np.zeros((3999, 1)))
    detector = make_mewma(order=1, horizon=3, ridge=1e-9).fit([x, x])
    assert detector.coefficients_[0, 0] == pytest.approx(0.8**3, abs=0.04)


@pytest.mark.parametrize("n", [0, 1, 63, 64, 65, 200])
def test_product_is_the_matrix_product_and_prefix_exact(n):
    rng = np.random.default_rng(n)
    rows, matrix = rng.normal(size=(n, 37)), rng.normal(size=(37, 5))
    whole = product(rows, matrix)
    np.testing.assert_allclose(whole, rows @ matrix, rtol=1e-12, atol=1e-12)
    for k in range(0, n, 9):
        np.testing.assert_array_equal(product(rows[:k], matrix), whole[:k])


# The chart


def test_smoothing_is_the_weighted_sum_of_all_residuals():
    u = np.random.default_rng(0).normal(size=(30, 2))
    for weight, z in zip((0.3, 0.03), smooth(u, (0.3, 0.03)), strict=True):
        for n in range(30):
            w = weight * (1 - weight) ** np.arange(n, -1, -1)
            np.testing.assert_allclose(z[n], w @ u[: n + 1] / np.sqrt((w**2).sum()), rtol=1e-9)


def test_mahalanobis_distance_by_hand():
    # Without much shrinkage (2, 0) lies 1 away where the variance is 4; (1, 1) against
    # [[1, .5], [.5, 1]]: inverse 4/3 [[1, -.5], [-.5, 1]], squared distance 4/3.
    far = distance(np.array([[2.0, 0.0]]), whitening(np.diag([4.0, 1.0]), 1e-12))
    correlated = whitening(np.array([[1.0, 0.5], [0.5, 1.0]]), 1e-12)
    np.testing.assert_allclose(far, [1.0])
    np.testing.assert_allclose(distance(np.array([[1.0, 1.0]]), correlated), [(4 / 3) ** 0.5])
    # Shrinkage bounds the share of a constant sensor: of variance 0.05 * 1 a residual of 1 is
    # 1 / sqrt(0.05) long.
    root = whitening(np.diag([1.0, 0.0]), 0.05)
    np.testing.assert_allclose(distance(np.array([[0.0, 1.0]]), root), [0.05**-0.5])


# The detector


@pytest.mark.parametrize("make", [make_mewma, make_mewma_a])
@pytest.mark.parametrize("horizon", [1, 3])
def test_scores_are_those_of_a_slow_loop(make, horizon):
    detector = make(horizon=horizon).fit(NOMINAL)
    x = shifted(episode(70, n=30), 15, 2.0)
    scale, action_scale = detector.observation_scale_, detector.action_scale_
    o = (x.observations - scale.mean) / scale.std
    a = (x.actions - action_scale.mean) / action_scale.std
    z = np.zeros((3, 4))
    expected = np.full(len(x), np.nan)
    expected[horizon : horizon + 2] = 0  # a forecast needs three observations
    for n, t in enumerate(range(horizon + 2, len(x)), start=1):
        times = [t - horizon - lag for lag in range(3)]
        known = [o[i] for i in times] + ([a[i] for i in times] if detector.actions else [])
        forecast = np.concatenate([*known, [1.0]]) @ detector.coefficients_
        u = np.clip((o[t] - forecast) / detector.residual_scale_, -3, 3)
        standardized = []
        for i, weight in enumerate((0.3, 0.1, 0.03)):
            z[i] = (1 - weight) * z[i] + weight * u
            scaled = z[i] / np.sqrt(weight / (2 - weight) * (1 - (1 - weight) ** (2 * n)))
            length = np.linalg.norm(scaled @ detector.whitening_[i])
            standardized.append(
                (length - detector.distance_mean_[i, 0]) / detector.distance_std_[i, 0]
            )
        expected[t] = max(standardized)
    np.testing.assert_allclose(detector.score(x), expected, rtol=1e-9, atol=1e-9)


def test_standardization_holds_on_trajectories_that_fit_has_not_seen():
    detector = make_mewma(weights=[0.1]).fit([episode(s) for s in range(60)])
    scores = np.concatenate([detector.score(episode(s))[1:] for s in range(500, 560)])
    assert abs(scores.mean()) < 0.15
    assert abs(scores.std() - 1) < 0.15
    # An episode that starts as it goes on has no trend in time.
    detector = make_mewma(order=2, weights=[0.03]).fit([episode(s) for s in range(40)])
    scores = np.array([detector.score(episode(s)) for s in range(40, 60)])[:, 1:]
    assert abs(np.median(scores[:, 4:14]) - np.median(scores[:, -30:])) < 0.6


def test_small_persistent_change_shows_when_evidence_adds_up(chart_a):
    """A shift of half the noise hides in single residuals and shows in a long memory."""
    memoryless = make_mewma_a(weights=[1.0]).fit(NOMINAL)
    excess = {}
    for name, detector in (("memoryless", memoryless), ("chart", chart_a)):
        differences = [
            detector.score(shifted(episode(s, n=200), 60, 0.15))[120:]
            - detector.score(episode(s, n=200))[120:]
            for s in range(600, 610)
        ]
        excess[name] = np.mean(differences)
    assert excess["chart"] > 1.0
    assert excess["chart"] > 3 * excess["memoryless"]


def test_a_constant_sensor_is_seen_and_actions_explain_what_observations_cannot(chart, chart_a):
    assert chart_a.residual_scale_[2] < 0.4 * chart.residual_scale_[2]
    assert chart.observation_scale_.std[3] == chart.residual_scale_[3] == 1.0
    x = episode(5)
    rows = x.observations.copy()
    rows[50:, 3] = 0.0
    assert chart.score(Trajectory(rows, x.actions))[55] > np.nanmax(chart.score(x)) + 1
    # Residuals are clipped on both sides.
    for sign in (-1, 1):
        assert len({chart.score(shifted(x, 79, sign * by))[-1] for by in (1e3, 1e6)}) == 1


@pytest.mark.parametrize("horizon", [1, 3])
def test_shares_are_parts_of_the_largest_squared_length_and_stream(horizon):
    detector = make_mewma_a(horizon=horizon).fit(NOMINAL)
    x = shifted(episode(71), 40, 1.0)
    shares, onsets, *_ = detector.explain(x)
    first = horizon + 2  # a forecast needs three observations
    assert np.isnan(shares[:horizon]).all()
    assert (shares[horizon:first] == 1 / 4).all()
    np.testing.assert_allclose(shares[horizon:].sum(axis=1), 1.0)
    smoothed = detector._smoothed(x, detector.coefficients_)
    t = 50
    lengths = []
    for i, root in enumerate(detector.whitening_):
        precision = root @ root.T
        z = smoothed[i, t - first]
        length = np.sqrt(z @ precision @ z)
        unusual = (length - detector.distance_mean_[i, 0]) / detector.distance_std_[i, 0]
        lengths.append((unusual, z * (precision @ z)))
    parts = np.maximum(max(lengths, key=lambda pair: pair[0])[1], 0.0)
    np.testing.assert_allclose(shares[t], parts / parts.sum(), rtol=1e-9)

    assert (onsets[:horizon] == -1).all()
    assert onsets[horizon:first].tolist() == [*range(horizon, first)]
    assert shares[45].argmax() == 0
    assert abs(onsets[45] - 40) <= 2
    detector.reset()
    for t, row in enumerate(zip(x.observations, [None, *x.actions], strict=True)):
        detector.update(*row)
        share, onset, *_ = detector.explain_last()
        np.testing.assert_allclose(share, shares[t], rtol=1e-9)
        assert onset == onsets[t]


def test_rows_without_actions_and_scales_of_zero_are_refused(chart_a):
    made = make_mewma_a()
    made.restore(chart_a.state())
    made.update(NOMINAL[0].observations[0])
    with pytest.raises(TrajectoryError, match=r"'mewma-a' was given an action None, expected"):
        made.update(NOMINAL[0].observations[1])
    scales = ["std", "action_scale", "residual_scale", "distance_std"]
    assert_zero_scales_are_refused(chart_a, make_mewma_a(), scales)
