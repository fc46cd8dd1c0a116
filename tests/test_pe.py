"""The probabilistic ensemble: its density against SciPy, its charts by hand, and what it finds."""

import math

import numpy as np
import pytest
import torch
from helpers_state import assert_zero_scales_are_refused
from oodd_pe import make_pe
from oodd_pe.ensemble import BLOCK, DensityEnsemble
from oodd_pe.network import LEAST_SCALES, DensityNetworks, train
from oodd_pe.statistic import Charts, Evidence, Onsets, Running, deviance
from scipy import stats

from oodd_eval import Trajectory

SMALL = {"updates": 300, "width": 16, "batch": 64}


def episode(seed, n=150, noise=0.05, pushed=0.0):
    """Two sensors of a pendulum pushed by an action, and one that is always 7."""
    rng = np.random.default_rng(seed)
    o, a = np.zeros((n, 2)), rng.normal(size=(n - 1, 1))
    o[0] = rng.normal(size=2)
    for t in range(1, n):
        angle, speed = o[t - 1]
        speed += 0.1 * (-math.sin(angle) - 0.3 * speed + 2 * a[t - 1, 0] + pushed)
        o[t] = angle + 0.1 * speed, speed + noise * rng.normal()
    return Trajectory(np.c_[o, np.full(n, 7.0)], a)


NOMINAL = [episode(seed) for seed in range(20)]


def corrupted(x, onset, sensor, by):
    rows = x.observations.copy()
    rows[onset:, sensor] += by
    return Trajectory(rows, x.actions)


@pytest.fixture(scope="module")
def fitted():
    return {name: make_pe(name, **SMALL).fit(NOMINAL) for name in ("pe", "pe-a")}


ROWS = BLOCK + 5


@pytest.fixture
def drawn():
    """Two networks with weights drawn large, inputs and outcomes of three sensors."""
    network = DensityNetworks(2, 4, 3, 8, seed=3).double()
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        network.out.mul_(10)
        network.floor.fill_(-0.5)
    x, y = (torch.randn(ROWS, n, generator=random, dtype=torch.float64) for n in (4, 3))
    return network, x, y


def said(network, x, y):
    """Return the forecasts of all members for the same rows."""
    with torch.no_grad():
        return network(*(v.expand(network.members, -1, -1) for v in (x, y)))


# The density


def matrices(network, x):
    """Return L = s (I + U) as matrices, (M, N, D, D): what errors of single sensors become."""
    ones = torch.eye(network.sensors, dtype=torch.float64)
    nothing = torch.zeros(len(x), network.sensors, dtype=torch.float64)
    start = said(network, x, nothing).residual
    return torch.stack([said(network, x, nothing + one).residual - start for one in ones], dim=-1)


def test_residuals_are_errors_times_a_triangular_matrix_of_scales(drawn):
    network, x, y = drawn
    found, matrix = said(network, x, y), matrices(network, x)
    expected = (matrix @ (y - found.mean)[..., None])[..., 0]
    torch.testing.assert_close(found.residual, expected)
    torch.testing.assert_close(matrix.triu(1), torch.zeros_like(matrix))
    torch.testing.assert_close(matrix.diagonal(dim1=-2, dim2=-1), found.log_scale.exp())


def test_surprise_is_that_of_scipys_t_distributions(drawn):
    network, x, y = drawn
    found = said(network, x, y)
    density = stats.t(df=found.log_tail.exp().numpy()).logpdf(found.residual.numpy()).sum(-1)
    volume = np.linalg.slogdet(matrices(network, x).numpy())[1]
    np.testing.assert_allclose(found.surprise().numpy(), -(density + volume))


@pytest.mark.parametrize("sensors", [0, 1, 3])
def test_the_ensemble_judges_as_its_networks_do(sensors):
    network = DensityNetworks(2, 4, sensors, 8, seed=3).double()
    with torch.no_grad():
        network.out.mul_(10)
        network.floor.fill_(-0.5)
    random = np.random.default_rng(0)
    x, y = random.normal(size=(ROWS, 4)), random.normal(size=(ROWS, sensors))
    ensemble = DensityEnsemble(network.arrays())
    found = said(network, *map(torch.from_numpy, (x, y)))
    for part, expected in zip(ensemble(x, y), (found.residual, found.log_tail), strict=True):
        np.testing.assert_allclose(part, expected.mean(0), atol=1e-12)
    row = ensemble(x[-1:], y[-1:])
    np.testing.assert_allclose(row[0], ensemble(x, y)[0][-1:], atol=1e-12)


@pytest.mark.parametrize(("nu", "std"), [(4.0, 1.19), (16.0, 1.05), (64.0, 1.01)])
def test_deviance_residuals_of_a_t_distribution_are_about_standard_normal(nu, std):
    e = stats.t(df=nu).ppf(np.arange(1, 2000) / 2000)
    r = deviance(e, np.full_like(e, math.log(nu)))
    assert r.std() == pytest.approx(std, abs=0.01)
    assert (np.sign(r) == np.sign(e)).all()


def test_what_an_error_of_one_sensor_explains_is_that_of_the_precision_matrix(drawn):
    network, x, y = drawn
    m, e = matrices(network, x), said(network, x, y).residual[..., None]
    slope = (m.mT @ e)[..., 0]
    expected = (slope.square() / (m.mT @ m).diagonal(dim1=-2, dim2=-1)).mean(0)
    found = DensityEnsemble(network.arrays()).of_sensors(x.numpy(), y.numpy())
    np.testing.assert_allclose(found, expected)


def singles(*arrays):
    return [a.astype(np.float32) for a in arrays]


def test_training_finds_means_scales_dependence_and_tails():
    random = np.random.default_rng(0)
    x = random.normal(size=(8000, 1))
    first = x[:, 0] + (0.5 + 0.4 * (x[:, 0] > 0)) * random.standard_t(3, size=8000)
    second = 0.8 * first + 0.1 * random.normal(size=8000)
    network = DensityNetworks(2, 1, 2, 32, seed=0)
    train(network, *singles(x, np.c_[first, second]), updates=600, batch=256, seed=0, device="cpu")
    at = torch.tensor([[-1.0], [1.0]])
    found = said(network, at, torch.zeros(2, 2))
    np.testing.assert_allclose(found.mean[..., 0].mean(0), [-1, 1], atol=0.2)
    scale = (-found.log_scale).exp().mean(0)
    np.testing.assert_allclose(scale[:, 0], [0.5, 0.9], rtol=0.3)
    np.testing.assert_allclose(scale[:, 1], 0.1, rtol=0.3)
    matrix = matrices(network.double(), at.double()).mean((0, 1))
    assert matrix[1, 0] / matrix[1, 1] == pytest.approx(-0.8, abs=0.1)
    tails = found.log_tail.exp().mean((0, 1))
    assert tails[0] < 8 < tails[1]


def test_no_error_is_forecast_to_be_wider_than_those_in_training():
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 1))
    y = np.exp(x) * random.normal(size=(2000, 1))  # the wider, the larger x
    network = DensityNetworks(2, 1, 1, 16, seed=0)
    train(network, *singles(x, y), updates=300, batch=128, seed=0, device="cpu")
    network.double()

    def scales(x):
        given = torch.from_numpy(x)
        return said(network, given, torch.zeros_like(given)).log_scale

    seen, far = scales(x), scales(np.full((1, 1), 10.0))
    torch.testing.assert_close(far, seen.min(dim=1, keepdim=True).values)
    at_least = (seen == far).double().mean(dim=1)
    np.testing.assert_allclose(at_least, LEAST_SCALES, atol=2e-3)


# The charts


def evidence(n, d=2, seed=0, residuals=None, movement=1.0):
    random = np.random.default_rng(seed)
    r = random.normal(size=(n, d)) if residuals is None else residuals
    return Evidence(np.c_[r, np.zeros(n)], random.normal(size=(n, d)), np.full(n, movement))


def sums(charts, steps, running=None):
    """Return the smoothed columns of steps."""
    return (running or Running(charts))(charts.columns(steps), steps.movement)


@pytest.fixture(scope="module")
def charts():
    made = Charts([0.1])
    made.fit([evidence(200, seed=s) for s in range(10)])
    return made


def test_residuals_are_brought_to_one_scale_by_the_tail_that_was_forecast():
    random = np.random.default_rng(0)
    tails = random.uniform(0, 4, size=(20_000, 1))
    r = np.where(tails < 2, 3.0, 0.5) * random.normal(size=tails.shape)
    whole = Evidence(r, tails, np.ones(len(r)))
    charts = Charts([])
    charts.fit([whole])
    u = charts.standardized(whole)
    for low in (0, 3):
        part = (tails >= low) & (tails < low + 1)
        assert u[part].std() == pytest.approx(1.0, abs=0.1)


def test_statistic_is_zero_in_the_middle_and_about_one_at_an_episodes_largest(charts):
    fresh = [charts.statistic(sums(charts, evidence(200, seed=s))) for s in range(50, 80)]
    middle = np.median(np.concatenate(fresh, axis=1), axis=1)
    np.testing.assert_allclose(middle, 0.0, atol=0.1)
    largest = np.stack([x.max(axis=1) for x in fresh])
    np.testing.assert_allclose(largest.mean(axis=0), 0.8, atol=0.2)


def test_a_small_shift_is_seen_by_the_memory_and_not_by_a_single_step(charts):
    shifted = evidence(200, residuals=np.random.default_rng(9).normal(size=(200, 2)) + 0.7)
    newest, memory = charts.statistic(sums(charts, shifted))
    assert newest[100:].mean() < 0.5
    assert memory[100:].mean() > 1.0


def test_sums_count_less_while_the_sensors_stand_still(charts):
    r = np.full((100, 2), 1.5)
    moving = charts.statistic(sums(charts, evidence(100, residuals=r)))
    still = charts.statistic(sums(charts, evidence(100, residuals=r, movement=1e-3)))
    np.testing.assert_array_equal(moving[0], still[0])
    assert still[1, -1] < 0.2
    assert moving[1, -1] > 2


def test_onsets_by_hand(charts):
    r = np.zeros((30, 2))
    r[20:] = 6.0
    columns, onsets = charts.columns(evidence(30, residuals=r)), Onsets(charts)
    np.testing.assert_array_equal(onsets(columns[:20]), np.arange(20))
    np.testing.assert_array_equal(onsets(columns[20:]), 20)


# The detector


@pytest.mark.parametrize("name", ["pe", "pe-a"])
@pytest.mark.parametrize("sensor", [0, 1, 2])
def test_a_corrupted_sensor_is_found_named_and_dated(fitted, name, sensor):
    detector, x = fitted[name], episode(100)
    wild = corrupted(x, 80, sensor, 2.0)
    limit = max(np.nanmax(detector.score(episode(s))) for s in range(100, 110))
    assert detector.score(wild)[80] > limit
    found = detector.explain(wild)
    assert found.shares[80].argmax() == sensor
    assert found.onsets[85] in range(78, 82)


def test_the_sensor_that_is_named_stays_that_of_the_onset(fitted):
    wild = corrupted(corrupted(episode(100), 80, 1, 2.0), 83, 0, 50.0)
    found = fitted["pe-a"].explain(wild)
    assert set(found.onsets[80:84]) == {80}
    assert (found.shares[80:84].argmax(axis=1) == 1).all()
    np.testing.assert_allclose(np.nansum(found.shares[1:], axis=1), 1.0)


def test_a_robot_may_reuse_the_arrays_of_its_readings_and_commands(fitted):
    detector, x = fitted["pe-a"], episode(100)
    reading, command = np.empty(3, np.float32), np.empty(1, np.float32)
    detector.reset()
    found = []
    for t, row in enumerate(x.observations):
        reading[:], command[:] = row, x.actions[t - 1]
        found.append(detector.update(reading, command))
    np.testing.assert_allclose(found[1:], detector.score(x)[1:])


def test_a_weak_push_is_found_with_memory_and_with_actions(fitted):
    def shift(detector):
        twin, pushed = (np.stack([detector.score(episode(s, pushed=p))[30:] for s in range(60, 70)])
                        for p in (0.0, 0.3))  # fmt: skip
        return (pushed.mean() - twin.mean()) / twin.std()

    step = make_pe("pe-step-a", **SMALL)
    step.fit(NOMINAL)
    assert shift(fitted["pe-a"]) > 1.5 * max(shift(step), shift(fitted["pe"]))


def test_the_step_row_is_the_chart_without_memory_of_the_same_fit(fitted):
    step = make_pe("pe-step-a", **SMALL)
    step.restore(fitted["pe-a"].state())
    x = NOMINAL[0]
    charts = fitted["pe-a"].charts_
    first = charts.statistic(sums(charts, fitted["pe-a"]._evidence(x)))[0]
    np.testing.assert_array_equal(step.score(x)[1:], first)


def test_a_scale_of_zero_is_refused(fitted):
    scales = ["std", "action_scale", "error_scale", "input_scale"]
    assert_zero_scales_are_refused(fitted["pe-a"], make_pe("pe-a", **SMALL), scales)
