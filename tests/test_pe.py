"""The probabilistic ensemble: its density against SciPy, its charts by hand, and what it finds."""

import math

import numpy as np
import pytest
import torch
from oodd_pe import make_pe
from oodd_pe.network import LEAST_SCALES, DensityNetworks, deviance, train
from oodd_pe.statistic import Attribution, Charts, Evidence, Running
from scipy import stats

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError, TrajectoryError, UsageError

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


@pytest.fixture
def forecast():
    """What two networks with weights drawn large say of five rows of three sensors."""
    network = DensityNetworks(2, 4, 3, 8, seed=3).double()
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        network.out.mul_(10)
        x = torch.randn(2, 5, 4, generator=random, dtype=torch.float64)
        y = torch.randn(2, 5, 3, generator=random, dtype=torch.float64)
        return network, y, network(x, y)


# The density


def matrices(network, forecast):
    """Return L = s (I + U) as matrices, (M, N, D, D)."""
    m, n, d = forecast.residual.shape
    u = torch.zeros(m, n, d, d, dtype=torch.float64)
    u[..., network.row, network.column] = forecast.dependence
    return forecast.log_scale.exp()[..., None] * (torch.eye(d, dtype=torch.float64) + u)


def test_residuals_are_errors_times_the_triangular_matrix(forecast):
    network, y, found = forecast
    expected = (matrices(network, found) @ (y - found.mean)[..., None])[..., 0]
    torch.testing.assert_close(found.residual, expected)


def test_surprise_is_that_of_scipys_t_distributions(forecast):
    network, _, found = forecast
    density = stats.t(df=found.log_tail.exp().numpy()).logpdf(found.residual.numpy()).sum(-1)
    volume = np.linalg.slogdet(matrices(network, found).numpy())[1]
    np.testing.assert_allclose(found.surprise().numpy(), -(density + volume))


@pytest.mark.parametrize(("nu", "std"), [(4.0, 1.19), (16.0, 1.05), (64.0, 1.01)])
def test_deviance_residuals_of_a_t_distribution_are_about_standard_normal(nu, std):
    e = stats.t(df=nu).ppf(np.arange(1, 2000) / 2000)
    r = deviance(e, np.full_like(e, math.log(nu)))
    assert r.std() == pytest.approx(std, abs=0.01)
    assert (np.sign(r) == np.sign(e)).all()


def test_an_error_of_one_sensor_is_explained_by_that_sensor_alone(forecast):
    network, _, found = forecast
    shift = torch.zeros_like(found.mean)
    shift[..., 1] = 2.5
    e = (matrices(network, found) @ shift[..., None])[..., 0]
    z = found._replace(residual=e).of_sensors(network.row, network.column)
    assert (z.abs().argmax(-1) == 1).all()
    torch.testing.assert_close(z[..., 1].square(), e.square().sum(-1))


def test_training_finds_means_scales_dependence_and_tails():
    random = np.random.default_rng(0)
    x = random.normal(size=(8000, 1))
    first = x[:, 0] + (0.5 + 0.4 * (x[:, 0] > 0)) * random.standard_t(3, size=8000)
    second = 0.8 * first + 0.1 * random.normal(size=8000)
    network = DensityNetworks(2, 1, 2, 32, seed=0)
    y = np.c_[first, second]
    train(network, x, y, updates=600, batch=256, seed=0, device="cpu")
    network.frozen()
    at = torch.tensor([[-1.0], [1.0]], dtype=torch.float64).expand(2, -1, -1)
    found = network(at, torch.zeros(2, 2, 2, dtype=torch.float64))
    np.testing.assert_allclose(found.mean[..., 0].mean(0), [-1, 1], atol=0.2)
    scale = (-found.log_scale).exp().mean(0)
    np.testing.assert_allclose(scale[:, 0], [0.5, 0.9], rtol=0.3)
    np.testing.assert_allclose(scale[:, 1], 0.1, rtol=0.3)
    np.testing.assert_allclose(found.dependence[..., 0].mean(0), -0.8, atol=0.1)
    tails = found.log_tail.exp().mean((0, 1))
    assert tails[0] < 8 < tails[1]


def test_no_error_is_forecast_to_be_wider_than_those_in_training():
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 1))
    y = np.exp(x) * random.normal(size=(2000, 1))  # the wider, the larger x
    network = DensityNetworks(2, 1, 1, 16, seed=0)
    train(network, x, y, updates=300, batch=128, seed=0, device="cpu")
    network.frozen()

    def scales(x):
        given = torch.from_numpy(x).expand(2, -1, -1)
        return network(given, torch.zeros_like(given)).log_scale

    seen, far = scales(x), scales(np.full((1, 1), 10.0))
    torch.testing.assert_close(far, seen.min(dim=1, keepdim=True).values)
    at_least = (seen == far).double().mean(dim=1)
    np.testing.assert_allclose(at_least, LEAST_SCALES, atol=2e-3)


def test_training_is_the_same_twice_and_differs_by_seed():
    random = np.random.default_rng(0)
    x, y = random.normal(size=(200, 2)), random.normal(size=(200, 1))

    def weights(seed):
        network = DensityNetworks(2, 2, 1, 8, seed=seed)
        train(network, x, y, updates=5, batch=16, seed=seed, device="cpu")
        return network.out.detach().numpy()

    np.testing.assert_array_equal(weights(1), weights(1))
    assert (weights(1) != weights(2)).any()


# The charts


def evidence(n, d=2, seed=0, residuals=None, movement=1.0):
    random = np.random.default_rng(seed)
    r = random.normal(size=(n, d)) if residuals is None else residuals
    of_sensors = np.c_[r**2, np.zeros(n)]
    return Evidence(
        np.c_[r, np.zeros(n)], random.normal(size=(n, d)), np.full(n, movement), of_sensors
    )


@pytest.fixture(scope="module")
def charts():
    made = Charts([0.1])
    made.fit([evidence(200, seed=s) for s in range(10)])
    return made


def test_residuals_are_brought_to_one_scale_by_the_tail_that_was_forecast():
    random = np.random.default_rng(0)
    tails = random.uniform(0, 4, size=(20_000, 1))
    r = np.where(tails < 2, 3.0, 0.5) * random.normal(size=tails.shape)
    whole = Evidence(r, tails, np.ones(len(r)), np.zeros((len(r), 0)))
    charts = Charts([])
    charts.fit([whole])
    u = charts.standardized(whole)
    for low in (0, 3):
        part = (tails >= low) & (tails < low + 1)
        assert u[part].std() == pytest.approx(1.0, abs=0.1)


def test_statistic_is_zero_in_the_middle_and_about_one_at_an_episodes_largest(charts):
    fresh = [charts.statistic(Running(charts)(evidence(200, seed=s))) for s in range(50, 80)]
    middle = np.median(np.concatenate(fresh, axis=1), axis=1)
    np.testing.assert_allclose(middle, 0.0, atol=0.1)
    largest = np.stack([x.max(axis=1) for x in fresh])
    np.testing.assert_allclose(largest.mean(axis=0), 0.8, atol=0.2)


def test_a_small_shift_is_seen_by_the_memory_and_not_by_a_single_step(charts):
    shifted = evidence(200, residuals=np.random.default_rng(9).normal(size=(200, 2)) + 0.7)
    newest, memory = charts.statistic(Running(charts)(shifted))
    assert newest[100:].mean() < 0.5
    assert memory[100:].mean() > 1.0


def test_sums_count_less_while_the_sensors_stand_still(charts):
    r = np.full((100, 2), 1.5)
    moving = charts.statistic(Running(charts)(evidence(100, residuals=r)))
    still = charts.statistic(Running(charts)(evidence(100, residuals=r, movement=1e-3)))
    np.testing.assert_array_equal(moving[0], still[0])
    assert still[1, -1] < 0.2
    assert moving[1, -1] > 2


def test_running_charts_continue_where_they_ended(charts):
    whole = evidence(60)
    running = Running(charts)
    parts = [running(Evidence(*(v[i : i + 7] for v in whole))) for i in range(0, 60, 7)]
    np.testing.assert_allclose(np.concatenate(parts, axis=1), Running(charts)(whole))


def test_onset_and_shares_by_hand(charts):
    r = np.zeros((30, 2))
    r[20:, 1] = 6.0
    r[21:, 0] = 30.0  # what the first corrupted row does to later forecasts
    shares, onsets = Attribution(charts, 1)(evidence(30, residuals=r))
    np.testing.assert_array_equal(onsets[:21], np.arange(1, 22))
    np.testing.assert_array_equal(onsets[20:], 21)  # the first of these rows is that of time 1
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert (shares[20:].argmax(axis=1) == 1).all()


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


def test_a_weak_push_is_found_with_memory_and_with_actions(fitted):
    def shift(detector):
        twin, pushed = (np.stack([detector.score(episode(s, pushed=p))[30:] for s in range(60, 70)])
                        for p in (0.0, 0.3))  # fmt: skip
        return (pushed.mean() - twin.mean()) / twin.std()

    step = make_pe("pe-step-a", **SMALL)
    step.fit(NOMINAL)
    assert shift(fitted["pe-a"]) > 1.5 * max(shift(step), shift(fitted["pe"]))


def test_the_step_row_is_the_chart_without_memory_of_the_same_fit(fitted, tmp_path):
    fitted["pe-a"].save(tmp_path)
    step = make_pe("pe-step-a", **SMALL)
    step.load(tmp_path)
    x = NOMINAL[0]
    charts = fitted["pe-a"].charts_
    first = charts.statistic(Running(charts)(fitted["pe-a"]._evidence(x)))[0]
    np.testing.assert_array_equal(step.score(x)[1:], first)


def test_no_score_depends_on_actions_without_them(fitted):
    x = NOMINAL[0]
    np.testing.assert_array_equal(fitted["pe"].score(x), fitted["pe"].score(x.without_actions()))
    other = Trajectory(x.observations, x.actions + 1)
    assert (fitted["pe-a"].score(x)[5:] != fitted["pe-a"].score(other)[5:]).any()


def test_more_memories_is_another_fit(fitted, tmp_path):
    fitted["pe"].save(tmp_path)
    with pytest.raises(FittedStateError, match="memories"):
        make_pe("pe", **SMALL, memories=[0.5]).load(tmp_path)


def test_sensors_that_never_vary_are_no_obstacle():
    still = [Trajectory(np.ones((20, 2)), np.zeros((19, 1)))] * 3
    detector = make_pe("pe", **SMALL).fit(still)
    scores = detector.score(corrupted(still[0], 10, 1, 0.5))
    assert np.isfinite(scores[1:]).all()
    assert scores[10] > 10 * np.abs(scores[1:10]).max()


@pytest.mark.parametrize("n", [1, 2])
def test_few_trajectories_suffice(n):
    detector = make_pe("pe", **SMALL).fit(NOMINAL[:n])
    x = episode(30)
    assert detector.score(corrupted(x, 40, 0, 5.0))[40] > detector.score(x)[40]


@pytest.mark.parametrize(
    ("nominal", "message"),
    [
        ([], "0 trajectories, of which 0 have at least 1 transitions"),
        ([x[:1] for x in NOMINAL], "20 trajectories, of which 0 have"),
        ([NOMINAL[0], Trajectory(np.zeros((9, 2)), np.zeros((8, 1)))], r"\[\(2, 0\), \(3, 0\)\]"),
    ],
)
def test_unusable_training_data_are_refused(nominal, message):
    with pytest.raises(TrajectoryError, match=message):
        make_pe("pe").fit(nominal)


def test_another_width_is_refused(fitted):
    x = NOMINAL[0]
    with pytest.raises(TrajectoryError, match=r"fitted on .*\(3, 1\) .* trajectory of \(3, 0\)"):
        fitted["pe-a"].score(x.without_actions())


@pytest.mark.parametrize(
    ("parameter", "value"),
    [("members", 0), ("updates", 1.5), ("memories", []), ("memories", [2]), ("device", "tpu")],
)
def test_wrong_parameters_are_named(parameter, value):
    with pytest.raises(UsageError, match=rf"parameter '{parameter}' of pe is .*, expected"):
        make_pe("pe", **{parameter: value})
