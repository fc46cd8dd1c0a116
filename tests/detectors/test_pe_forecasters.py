"""Forecasters beside the ensemble: against textbook formulas, and the choice among them."""

import math

import numpy as np
import pytest
import torch
from oodd_pe import PeParameters, make_pe
from oodd_pe.choice import ChosenForecaster
from oodd_pe.forecaster import Transitions, Units
from oodd_pe.gaussian import (
    GaussianForecaster,
    Kernel,
    Process,
    landmarks,
    root_of,
    solved,
    surprise,
    tuned,
    without,
)
from oodd_pe.kalman import FilterModel, KalmanForecaster, linear, noise_shows
from oodd_pe.likelihood import student
from scipy import stats

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.forecasting import FeatureScale

KERNEL = Kernel(np.array([0.7, 1.5, 3.0]), 2.0, 1e-3)
SMALL = {"updates": 100, "width": 16, "batch": 64}


# Systems: an exact map, a noisy linear one, and one whose dynamics are noisy


def exact(seed, n=60):
    """A pendulum without noise, pushed by an action."""
    rng = np.random.default_rng(seed)
    o, a = np.zeros((n, 2)), rng.normal(size=(n - 1, 1))
    o[0] = rng.normal(size=2)
    for t in range(1, n):
        angle, speed = o[t - 1]
        speed += 0.2 * (-math.sin(2 * angle) - 0.3 * speed + 2 * a[t - 1, 0])
        o[t] = angle + 0.2 * speed, speed
    return Trajectory(o, a)


DYNAMICS = np.array([[0.99, 0.1], [-0.1, 0.97]])
PUSH = np.array([[0.0], [0.1]])
SENSOR_NOISE, STATE_NOISE = 0.3, 0.02


def noisy_sensors(seed, n=100):
    """An oscillator whose sensors have more noise than its dynamics."""
    rng = np.random.default_rng(seed)
    x, a = rng.normal(size=2), rng.normal(size=(n - 1, 1))
    rows = [x]
    for action in a:
        x = DYNAMICS @ x + PUSH @ action + STATE_NOISE * rng.normal(size=2)
        rows.append(x)
    return Trajectory(np.array(rows) + SENSOR_NOISE * rng.normal(size=(n, 2)), a)


def noisy_dynamics(seed, n=60):
    """The same oscillator with exact sensors, and noise that grows with its speed."""
    rng = np.random.default_rng(seed)
    x, a = rng.normal(size=2), rng.normal(size=(n - 1, 1))
    rows = [x]
    for action in a:
        size = 0.05 + 0.3 * abs(x[1])
        x = DYNAMICS @ x + PUSH @ action + size * rng.standard_t(4, size=2)
        rows.append(x)
    return Trajectory(np.array(rows), a)


def posed(system, episodes=12, window=2):
    """Return units, pieces and folds of a system's nominal episodes."""
    nominal = [system(seed) for seed in range(episodes)]
    rows, actions = (
        np.concatenate([getattr(t, n) for t in nominal]) for n in ("observations", "actions")
    )
    units = Units.fit(FeatureScale.fit(nominal), rows, actions, window)
    detector = make_pe("pe-a", window=window)
    pieces = [detector._transitions(t) for t in nominal]
    return units, pieces, [n % 3 for n in range(episodes)]


def drawn(n, inputs=3, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, inputs))
    return x, np.sin(x[:, 0]) * x[:, 1] + 0.1 * rng.normal(size=n)


# Gaussian processes


def test_surprise_is_the_density_of_scipys_normal_distribution():
    x, y = drawn(30)
    theta = np.log([0.7, 1.5, 3.0, 2.0, 0.1])
    covariance = Kernel(np.exp(theta[:3]), 2.0, 0.1)(x, x) + 0.1 * np.eye(30)
    density = stats.multivariate_normal(np.zeros(30), covariance).logpdf(y)
    value, _ = surprise(theta, x, y)
    assert -30 * (value + 0.5 * math.log(2 * math.pi)) == pytest.approx(density, rel=1e-6)


def test_the_gradient_of_surprise_is_that_of_differences():
    x, y = drawn(40)
    theta = np.array([0.3, 0.1, 0.5, 0.2, -4.0])
    _, gradient = surprise(theta, x, y)
    for n, step in enumerate(1e-5 * np.eye(5)):
        slope = (surprise(theta + step, x, y)[0] - surprise(theta - step, x, y)[0]) / 2e-5
        assert gradient[n] == pytest.approx(slope, rel=1e-5)


def test_search_finds_the_noise_and_which_inputs_matter():
    x, y = drawn(300)
    kernel, likelihood = tuned(x, y)
    assert math.sqrt(kernel.noise) == pytest.approx(0.1, rel=0.2)
    assert kernel.lengths[2] > 5 * kernel.lengths[:2].max()
    # Noise of .1 alone allows -log(.1) - (1 + log(2 pi)) / 2 = .88 a row.
    assert 0.3 < likelihood < 0.95


@pytest.mark.parametrize("left_out", [[0], [3, 4, 5, 6], [0, 39], []])
def test_leaving_rows_out_by_the_closed_form_is_fitting_again_without_them(left_out):
    x, y = drawn(40)
    kernel, every, inverse = solved(KERNEL, x, y)
    weights = without(inverse, every, np.array(left_out, int))
    kept = np.setdiff1d(np.arange(40), left_out)
    covariance = kernel(x[kept], x[kept]) + kernel.noise * np.eye(len(kept))
    np.testing.assert_allclose(weights[kept], np.linalg.solve(covariance, y[kept]), rtol=1e-6)
    assert not weights[left_out].any()


def test_mean_and_deviation_from_all_rows_are_those_of_the_posterior():
    x, y = drawn(40)
    kernel, weights, _ = solved(KERNEL, x, y)
    at = drawn(7, seed=1)[0]
    every = np.arange(40)
    mean, log_deviation = Process(kernel, weights, every, root_of(kernel, x))(x, at)
    prior = Kernel(kernel.lengths, kernel.signal, 0.0)
    covariance = prior(x, x) + kernel.noise * np.eye(40)
    np.testing.assert_allclose(mean, prior(at, x) @ np.linalg.solve(covariance, y), rtol=1e-6)
    variance = prior(at, at) - prior(at, x) @ np.linalg.solve(covariance, prior(x, at))
    expected = np.diag(variance) + kernel.noise
    np.testing.assert_allclose(np.exp(2 * log_deviation), expected, rtol=1e-5)


def test_each_landmark_is_the_least_certain_row_given_those_before():
    x, _ = drawn(30)
    chosen = landmarks(KERNEL, x, 8)
    for n, pivot in enumerate(chosen[1:], start=1):
        before = chosen[:n]
        across = KERNEL(x, x[before])
        explained = across @ np.linalg.solve(KERNEL(x[before], x[before]), across.T)
        left = KERNEL.signal - np.diag(explained)
        assert left[pivot] == pytest.approx(left.max(), rel=1e-8)


def test_landmarks_end_where_nothing_is_uncertain():
    x = np.repeat(drawn(3)[0], 10, axis=0)
    assert len(landmarks(KERNEL, x, 20)) == 3


def test_pieces_are_judged_by_processes_of_the_other_pieces():
    units, pieces, folds = posed(exact, episodes=5)
    forecaster = GaussianForecaster(seed=0)
    judged = forecaster.fit(units, pieces, folds)
    wide = [forecaster._posed_steps(p) for p in pieces]
    x = np.concatenate([part for part, _ in wide[1:]])
    y = np.concatenate([part for _, part in wide[1:]])
    process = forecaster.processes_[0]
    covariance = process.kernel(x, x) + process.kernel.noise * np.eye(len(x))
    mean = process.kernel(wide[0][0], x) @ np.linalg.solve(covariance, y[:, 0])
    errors = wide[0][1][:, 0] - mean
    # Deviance residuals of 64 degrees of freedom, undone, and the forecast deviation.
    residuals = judged[0].residuals[:, 0]
    scaled = np.sign(residuals) * np.sqrt(64 * np.expm1(residuals**2 / 65))
    np.testing.assert_allclose(
        scaled * np.exp(judged[0].log_tails[:, 0]), errors, atol=1e-3 * np.abs(errors).max()
    )


# The filter


def model_of(a, b, noise, state_noise):
    model = FilterModel(a, b, np.zeros(len(a)), np.full(len(a), noise), seed=0).double()
    with torch.no_grad():
        model.log_q.fill_(math.log(state_noise))
    return model


def test_gains_are_those_of_the_information_form():
    model = model_of(DYNAMICS, PUSH, 0.09, 4e-4)
    gains = model.gains(6)
    a, covariance = model.a[0].detach().numpy(), 0.09 * np.eye(2)
    for gain, root in zip(*(v.detach().numpy() for v in gains), strict=True):
        before = a @ covariance @ a.T + 4e-4 * np.eye(2)
        covariance = np.linalg.inv(np.linalg.inv(before) + np.eye(2) / 0.09)
        np.testing.assert_allclose(gain, covariance / 0.09, rtol=1e-5)
        np.testing.assert_allclose(root @ root.T, before + 0.09 * np.eye(2), rtol=1e-5)


def test_surprise_is_the_joint_density_of_all_rows_given_the_first():
    model = model_of(DYNAMICS, PUSH, 0.09, 4e-4).float()
    t = noisy_sensors(0, n=6)
    y, u = (torch.from_numpy(v.copy())[:, None] for v in (t.observations, t.actions))
    value = model.surprise(y, u, torch.ones(5, 1, dtype=torch.float64)).item()
    # The state starts at the first row with the covariance R, and every later row is linear in it.
    mean, state, powers = t.observations[0].astype(float), [], [np.eye(2)]
    for action in t.actions:
        mean = DYNAMICS @ mean + PUSH @ action
        state.append(mean)
        powers.append(DYNAMICS @ powers[-1])
    covariance = np.zeros((10, 10))
    for i in range(5):
        for j in range(5):
            block = 0.09 * powers[i + 1] @ powers[j + 1].T
            block += sum(4e-4 * powers[i - k] @ powers[j - k].T for k in range(min(i, j) + 1))
            covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = block
    covariance += 0.09 * np.eye(10)
    density = stats.multivariate_normal(np.ravel(state), covariance).logpdf(
        t.observations[1:].ravel()
    )
    assert -10 * (value + 0.5 * math.log(2 * math.pi)) == pytest.approx(density, rel=1e-4)


def density_of_the_true_filter(pieces, units):
    """Return the mean log density of a row's sensor by the equations, in standardized units."""
    densities, scale = [], units.sensors.std
    for piece in pieces:
        state, covariance = piece.before[0].astype(float), SENSOR_NOISE**2 * np.eye(2)
        for row, action in zip(piece.now, piece.known.actions[:, 0], strict=True):
            state = DYNAMICS @ state + PUSH @ action
            covariance = DYNAMICS @ covariance @ DYNAMICS.T + STATE_NOISE**2 * np.eye(2)
            total = covariance + SENSOR_NOISE**2 * np.eye(2)
            densities.append(stats.multivariate_normal(state, total).logpdf(row))
            gain = covariance @ np.linalg.inv(total)
            state, covariance = state + gain @ (row - state), covariance - gain @ covariance
    return np.mean(densities) / 2 + np.log(scale).mean()


@pytest.fixture(scope="module")
def learned():
    units, pieces, folds = posed(noisy_sensors, episodes=30)
    forecaster = KalmanForecaster(seed=0, updates=150)
    return forecaster, forecaster.fit(units, pieces, folds), units, pieces, folds


def test_the_learned_filter_is_nearly_as_likely_as_the_true_one(learned):
    forecaster, judged, units, pieces, folds = learned
    held_out = [p for p, fold in zip(pieces, folds, strict=True) if not fold]
    limit = density_of_the_true_filter(held_out, units)
    two_rows = np.concatenate([p.now - p.before for p in held_out]) / units.sensors.std
    worse = stats.norm(scale=two_rows.std(axis=0)).logpdf(two_rows).mean()
    assert worse < limit - 0.15
    assert forecaster.log_density_ == pytest.approx(limit, abs=0.03)
    assert [j is None for j in judged] == [fold > 0 for fold in folds]

    # White: neither correlated with the row before, nor of another size than 1.
    r = np.concatenate([j.residuals for j in judged if j is not None])
    assert r.std() == pytest.approx(1.0, abs=0.05)
    assert abs((r[1:] * r[:-1]).mean(axis=0)).max() < 0.15
    changes = two_rows / two_rows.std(axis=0)
    assert (changes[1:] * changes[:-1]).mean(axis=0).max() < -0.35


def test_a_filter_judges_every_third_fold_and_is_as_likely_as_the_first_is():
    units, pieces, folds = posed(noisy_sensors, episodes=12)
    folds = [n % 6 for n in range(len(folds))]
    forecaster = KalmanForecaster(seed=0, updates=3)
    judged = forecaster.fit(units, pieces, folds)
    assert [j is not None for j in judged] == [fold in (0, 3) for fold in folds]
    likely = forecaster.log_density_
    moved = [
        Transitions(p.known, p.now + np.float32(50.0), p.before + np.float32(50.0))
        if fold == 3
        else p
        for p, fold in zip(pieces, folds, strict=True)
    ]
    forecaster.fit(units, moved, folds)
    assert forecaster.log_density_ == likely


def test_a_filter_in_parts_is_the_filter_at_once(learned):
    forecaster, judged, _, pieces, _ = learned
    judge = forecaster.begin()
    parts = [judge(pieces[0].rows(slice(n, n + 1))) for n in range(len(pieces[0].now))]
    rows = np.concatenate([part.residuals for part in parts])
    np.testing.assert_array_equal(rows, judged[0].residuals)


def test_what_a_sensor_explains_is_that_of_the_covariance_of_innovations(learned):
    forecaster, judged, _, pieces, _ = learned
    last = forecaster.arrays()["filter.root"][-1]
    steps, said = pieces[0].rows(slice(80, 81)), judged[0].rows(slice(80, 81))
    precision = np.linalg.inv(last @ last.T)
    error = last @ said.residuals[0]
    expected = (precision @ error) ** 2 / np.diag(precision)
    np.testing.assert_allclose(forecaster.explained(steps, said)[0], expected)


@pytest.mark.parametrize(
    ("system", "expected"), [(exact, False), (noisy_sensors, True), (noisy_dynamics, False)]
)
def test_noise_shows_where_sensors_have_it(system, expected):
    units, pieces, _ = posed(system)
    assert noise_shows(units, pieces) is expected


# Likelihoods


@pytest.mark.parametrize("nu", [4.0, 64.0])
def test_student_reaches_the_density_that_residuals_were_drawn_from(nu):
    residuals = np.stack(
        [3.0 * stats.t(nu).rvs(5000, random_state=0), 0.1 * stats.t(nu).rvs(5000, random_state=1)],
        1,
    )
    expected = [
        stats.t(nu, scale=s).logpdf(r).mean() for s, r in zip((3.0, 0.1), residuals.T, strict=True)
    ]
    np.testing.assert_allclose(student(residuals).mean(axis=0), expected, atol=0.005)


# The choice


SYSTEMS = {"processes": exact, "filter": noisy_sensors, "ensemble": noisy_dynamics}


@pytest.fixture(scope="module")
def detectors():
    return {
        name: make_pe("pe-a", **SMALL).fit([system(seed) for seed in range(12)])
        for name, system in SYSTEMS.items()
    }


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_system_gets_its_forecaster(detectors, name):
    forecaster = detectors[name].forecaster
    assert forecaster.name_ == name
    assert max(forecaster.log_densities_, key=forecaster.log_densities_.get) == name


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_restored_fit_scores_explains_and_streams_the_same(detectors, name):
    detector, fresh = detectors[name], SYSTEMS[name](99)
    restored = make_pe("pe-a", **SMALL)
    restored.restore(detector.state())
    np.testing.assert_array_equal(restored.score(fresh), detector.score(fresh))
    for part, expected in zip(restored.explain(fresh), detector.explain(fresh), strict=True):
        np.testing.assert_array_equal(part, expected)
    restored.reset()
    actions = [None, *fresh.actions]
    streamed = [restored.update(o, a) for o, a in zip(fresh.observations, actions, strict=True)]
    np.testing.assert_allclose(streamed, detector.score(fresh), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_shifted_sensor_is_found_whatever_forecasts(detectors, name):
    detector, fresh = detectors[name], SYSTEMS[name](99)
    rows = fresh.observations.copy()
    rows[30:, 0] += 30.0
    scores = detector.score(Trajectory(rows, fresh.actions))
    np.testing.assert_array_equal(scores[:30], detector.score(fresh)[:30])
    assert scores[30:33].max() > 1.5 * np.nanmax(detector.score(fresh))


def test_a_fit_of_an_unknown_forecaster_is_refused(detectors):
    units, *_ = posed(exact, episodes=3)
    forecaster = ChosenForecaster(PeParameters(**SMALL), seed=0, horizon=1, device="cpu")
    with pytest.raises(FittedStateError, match="forecaster 7"):
        forecaster.restore(units, {"forecaster": np.array(7)})


def test_a_filter_does_without_actions_and_with_one_step_alone():
    nominal = [noisy_sensors(seed) for seed in range(12)]
    detector = make_pe("pe", **{**SMALL, "updates": 300}).fit(nominal)
    assert detector.forecaster.name_ == "filter"
    assert np.isfinite(detector.score(nominal[0])[1:]).all()
    farther = make_pe("pe-a", horizon=2, **{**SMALL, "updates": 20}).fit(nominal[:4])
    assert "filter" not in farther.forecaster.log_densities_
    assert np.isfinite(farther.score(nominal[0])[2:]).all()


@pytest.mark.parametrize(
    ("system", "episodes", "n"),
    [(exact, 1, 2), (exact, 3, 3), (noisy_sensors, 1, 3), (noisy_sensors, 3, 12)],
)
def test_few_data_are_enough_for_a_score(system, episodes, n):
    nominal = [system(seed, n=n) for seed in range(episodes)]
    detector = make_pe("pe-a", **{**SMALL, "updates": 20}).fit(nominal)
    assert np.isfinite(detector.score(system(9))[1:]).all()


def test_the_linear_start_of_a_filter_is_that_of_least_squares():
    t = noisy_sensors(0)
    y, u = t.observations.astype(float), t.actions.astype(float)
    a, b, c, left = linear([(y[:40], u[:39]), (y[39:], u[39:])])
    x = np.c_[y[:-1], u, np.ones(len(u))]
    slope, squares, *_ = np.linalg.lstsq(x, y[1:])
    np.testing.assert_allclose(np.c_[a, b, c], slope.T, atol=1e-4)
    np.testing.assert_allclose(left, squares / len(u), rtol=1e-4)
