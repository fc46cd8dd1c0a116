"""The probabilistic ensemble: its density against SciPy, its charts by hand, and what it finds."""

import math

import numpy as np
import pytest
import torch
from helpers_state import assert_zero_scales_are_refused
from oodd_common.charts import Onset
from oodd_pe import make_pe
from oodd_pe.detector import REFERENCE
from oodd_pe.ensemble import BLOCK, DensityEnsemble
from oodd_pe.forecaster import Transitions
from oodd_pe.network import LEAST_SCALES, DensityNetworks, rounds, train
from oodd_pe.rare import COUNTS, LARGEST, STEEP, Leaks, RareEvents, Regions, Tails
from oodd_pe.rare import NOMINAL as NOMINAL_SUM
from oodd_pe.statistic import RETURN, Charts, Evidence, Running, deviance
from scipy import stats
from scipy.signal import lfilter
from sklearn.tree import DecisionTreeRegressor

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import pack

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
    # Members judge outcomes of their own linear forecasts.
    each = np.stack([y, 2 * y])
    with torch.no_grad():
        found = network(torch.from_numpy(x).expand(2, -1, -1), torch.from_numpy(each))
    expected = found.residual, found.log_tail
    for part, member, values in zip(
        ensemble(x, each), ensemble.each(x, each), expected, strict=True
    ):
        np.testing.assert_allclose(part, values.mean(0), atol=1e-12)
        np.testing.assert_allclose(member, values, atol=1e-12)
    row = ensemble(x[-1:], each[:, -1:])
    np.testing.assert_allclose(row[0], ensemble(x, each)[0][-1:], atol=1e-12)
    assert rounds(240) == [30, 60, 120, 240]
    assert rounds(7) == [7]


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
    found = DensityEnsemble(network.arrays()).of_sensors(x.numpy(), np.stack([y, y]))
    np.testing.assert_allclose(found, expected)


def trained(network, x, y, **settings):
    """Train all members on the same rows, of which none is held out."""
    inputs, outcomes = (a.astype(np.float32) for a in (x, y))
    rows, none = [np.arange(len(x))] * network.members, [np.arange(0)] * network.members
    each = np.stack([outcomes] * network.members)
    train(network, inputs, each, rows, none, seed=0, device="cpu", **settings)


def test_a_member_learns_from_its_rows_alone():
    random = np.random.default_rng(0)
    x, noise = random.normal(size=(2000, 1)), 0.1 * random.normal(size=(2000, 1))
    y = np.where(np.arange(2000)[:, None] < 1000, 1.0, -1.0) + noise
    network, rows = DensityNetworks(2, 1, 1, 16, seed=0), [np.arange(1000), np.arange(1000, 2000)]
    inputs, outcomes = (a.astype(np.float32) for a in (x, np.stack([y, y])))
    none = [np.arange(0)] * 2
    train(network, inputs, outcomes, rows, none, updates=200, batch=64, seed=0, device="cpu")
    means = said(network, torch.zeros(1, 1), torch.zeros(1, 1)).mean[:, 0, 0]
    np.testing.assert_allclose(means, [1.0, -1.0], atol=0.1)


def test_training_finds_means_scales_dependence_and_tails():
    random = np.random.default_rng(0)
    x = random.normal(size=(8000, 1))
    first = x[:, 0] + (0.5 + 0.4 * (x[:, 0] > 0)) * random.standard_t(3, size=8000)
    second = 0.8 * first + 0.1 * random.normal(size=8000)
    network = DensityNetworks(2, 1, 2, 32, seed=0)
    trained(network, x, np.c_[first, second], updates=600, batch=256)
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


def test_the_likelihood_of_held_out_rows_is_that_of_each_members_own():
    random = np.random.default_rng(0)
    x, y = random.normal(size=(12, 3)), random.normal(size=(2, 12, 2))
    network = DensityNetworks(2, 3, 2, 8, seed=0).double()
    rows = [np.array([0, 3, 5]), np.array([7, 8, 11])]
    densities = DensityEnsemble(network.arrays()).log_densities(x, y)
    expected = (densities[0, rows[0]].mean() + densities[1, rows[1]].mean()) / 2 / 2
    likelihood = network.likelihood(torch.from_numpy(x), torch.from_numpy(y), rows)
    assert likelihood == pytest.approx(expected)
    assert math.isnan(
        network.likelihood(torch.from_numpy(x), torch.from_numpy(y), [rows[0], rows[0][:0]])
    )


def test_what_is_learnt_by_heart_is_taken_back_where_rows_are_held_out():
    random = np.random.default_rng(0)
    x, y = (random.normal(size=(90, 4)).astype(np.float32) for _ in range(2))
    rows, held_out = [np.arange(60)] * 2, [np.arange(60, 90)] * 2
    likelihoods = {}
    for name, unseen in {"stopped": held_out, "all": [np.arange(0)] * 2}.items():
        network = DensityNetworks(2, 4, 4, 32, seed=0)
        train(
            network, x, np.stack([y, y]), rows, unseen, updates=400, batch=64, seed=0, device="cpu"
        )
        outcomes = torch.from_numpy(np.stack([y, y]))
        likelihoods[name] = network.likelihood(torch.from_numpy(x), outcomes, held_out)
    # The entropy of standard normal outcomes, which cannot be forecast from these inputs, is 1.42.
    assert likelihoods["stopped"] > -1.8
    assert likelihoods["all"] < -3.0


def test_no_error_is_forecast_to_be_wider_than_those_in_training():
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 1))
    y = np.exp(x) * random.normal(size=(2000, 1))  # the wider, the larger x
    network = DensityNetworks(2, 1, 1, 16, seed=0)
    trained(network, x, y, updates=300, batch=128)
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
    """Return the lengths of steps and of their sums."""
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


def test_sums_are_exponentially_weighted_means_by_hand(charts):
    steps = evidence(30, seed=3, movement=np.inf)
    columns = charts.columns(steps)
    z = np.zeros(columns.shape[1])
    assert len(columns) == 30
    for n, column in enumerate(columns):
        z = 0.9 * z + 0.1 * column
        size = math.sqrt(0.1 / 1.9 * (1 - 0.81 ** (n + 1)))
    expected = np.linalg.norm(z / size @ charts.roots_[1])
    assert sums(charts, steps)[1, -1] == pytest.approx(expected)
    # In parts they are those of the whole.
    steps = evidence(60, residuals=np.r_[np.full((30, 2), 20.0), np.zeros((30, 2))])
    running, whole = Running(charts), sums(charts, steps)
    parts = [sums(charts, Evidence(*(v[n : n + 7] for v in steps)), running)
             for n in range(0, 60, 7)]  # fmt: skip
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole)


@pytest.mark.parametrize("size", [10.0, 1e4])
def test_sums_come_down_when_a_fault_has_ended(size):
    charts = Charts([0.1, 0.03, 0.01])
    charts.fit([evidence(200, seed=s) for s in range(10)])
    random = np.random.default_rng(3)
    residuals = np.r_[np.full((300, 2), size), random.normal(size=(RETURN, 2))]
    statistic = charts.statistic(sums(charts, evidence(300 + RETURN, residuals=residuals)))
    assert (statistic[:, 299] > 2.0).all()
    assert (statistic[:, -1] < 1.6).all()


def test_onsets_by_hand(charts):
    r = np.zeros((30, 2))
    r[20:] = 6.0
    energies = charts.columns(evidence(30, residuals=r))[:, -1]
    onset = Onset(REFERENCE * float(charts.spread_), 0)
    assert [*map(onset, energies.tolist())] == [*range(20), *[20] * 10]


# Rare events


def test_regions_are_the_leaves_of_scikit_learns_tree():
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 3)).astype(np.float32)
    y = np.c_[np.sign(x[:, 0]), x[:, 1] ** 2]
    regions = Regions.fit(x, y, 100)
    tree = DecisionTreeRegressor(min_samples_leaf=100, random_state=0).fit(x, y)
    fresh = random.normal(size=(500, 3)).astype(np.float32)
    pairs = set(zip(regions(fresh).tolist(), tree.apply(fresh).tolist(), strict=True))
    assert len(pairs) == len({leaf for _, leaf in pairs}) == regions.count
    again = Regions.restored(regions.arrays("r"), "r", 3)
    np.testing.assert_array_equal(again(fresh), regions(fresh))


@pytest.mark.parametrize(
    ("name", "node", "value"),
    [("left", 0, 0), ("right", 0, 99), ("feature", 0, 3), ("right", -1, 0)],
)
def test_regions_that_are_no_tree_are_refused(name, node, value):
    random = np.random.default_rng(0)
    x = random.normal(size=(400, 3)).astype(np.float32)
    arrays = {n: a.copy() for n, a in Regions.fit(x, np.sign(x[:, :1]), 100).arrays("r").items()}
    arrays[f"r.{name}"][node] = value
    with pytest.raises(FittedStateError, match="no tree"):
        Regions.restored(arrays, "r", 3)


def test_tails_by_hand():
    values = np.array([[0.0], [1.0], [2.0], [3.0], [10.0], [5.0]])
    tails = Tails.fit(values, np.array([0, 0, 0, 0, 0, 1]), 0.5)
    np.testing.assert_allclose(tails.start, [[2.0], [5.0]])
    np.testing.assert_allclose(tails.length, [[(1 + 8) / 2], [1e-6]])


@pytest.fixture(scope="module")
def events():
    """Fit on episodes whose residuals are five times as large where the input is positive."""
    learnt = RareEvents([0.1, 0.01])
    learnt.fit(*zip(*(landing(s) for s in range(20)), strict=True))
    return learnt


def landing(seed, n=500, size=1.0):
    random = np.random.default_rng(seed)
    inputs = random.choice([-1.0, 1.0], size=(n, 1))
    scale = size * np.where(inputs > 0, 5.0, 1.0)
    return inputs, scale * random.standard_exponential((n, 3)), np.ones(n)


def test_one_step_of_a_hundred_counts_wherever_it_is(events):
    inputs, residuals, shares = (np.concatenate(v) for v in zip(*map(landing, range(50, 90)),
                                                                strict=True))  # fmt: skip
    counting = events.counts(inputs, residuals, shares) > 0
    for sign in (-1, 1):
        assert counting[inputs[:, 0] == sign].mean() == pytest.approx(0.01, abs=0.004)


def test_residuals_that_are_usual_elsewhere_count(events):
    still = np.array([[3.0, 3.0, 3.0]])
    assert events.counts(np.array([[1.0]]), still, np.ones(1)) == 0
    assert events.counts(np.array([[-1.0]]), 10 * still, np.ones(1)) == LARGEST
    assert events.counts(np.array([[-1.0]]), 10 * still, np.zeros(1)) == 0


def test_improbability_is_that_of_exponential_tails():
    events = RareEvents([0.1])
    events.regions_ = events.wide_regions_ = Regions(*(np.array([n]) for n in (-1, 0.0, -1, 0)))
    events.tails_ = Tails(np.array([[2.0]]), np.array([[0.5]]))
    events.wide_tails_ = Tails(np.array([[0.7]]), np.array([[0.2]]))
    found = events.counts(np.zeros((1, 1)), np.array([[-4.0]]), np.ones(1))
    length = math.sqrt(1.645**2 + 2 * (4.0 - 2.0) / 0.5)
    expected = -math.log(0.05) + (math.log(length) - 0.7) / 0.2 - COUNTS
    assert found == pytest.approx(expected)
    assert 0 < expected < LARGEST


def test_leaky_sums_by_hand():
    leaks = Leaks([0.5, 0.1], np.array([1.0, 4.0]), np.array([3.0, 50.0]))
    # Sums of 2 and 3 (of 5), of 2 and 5.8, each less 1, over usual ones less 1.
    squeezed = STEEP * (1 + math.log(2.0 / STEEP))
    np.testing.assert_allclose(leaks(np.array([2.0, 4.0])), [[1.0, squeezed], [0.25, 1.2]])
    np.testing.assert_allclose(leaks(np.array([0.0])), [[0.5], [1.055]])


def test_a_unit_is_how_far_the_sums_of_an_episode_get():
    # Every tenth episode has runs of steps that count: sums of many units.
    episodes = [
        (
            inputs,
            residuals * np.where(np.arange(500) % 100 < 5 * (seed % 10 == 0), 9, 1)[:, None],
            shares,
        )
        for seed, (inputs, residuals, shares) in enumerate(map(landing, range(20)))
    ]
    events = RareEvents([0.1, 0.01])
    events.fit(*zip(*episodes, strict=True))
    counts = [events.counts(*episode) for episode in episodes]
    largest = [[lfilter([1], [1, w - 1], c).max() for w in events.memories] for c in counts]
    reached = np.mean(largest, axis=0) + np.std(largest, axis=0) - NOMINAL_SUM
    assert (reached > 2 * STEEP).all()
    np.testing.assert_allclose(events.excess_, reached)


def test_leaky_sums_come_down_when_a_fault_has_ended(events):
    leaks = events.running()
    highest = leaks(np.full(300, LARGEST))[:, -1]
    assert (highest > 1.2).all()
    assert (leaks(np.zeros(RETURN))[:, -1] <= 1 + 1e-9).all()


def test_no_sum_is_so_large_that_a_larger_one_is_not_told_from_it(events):
    units = events.running()(np.full(60, LARGEST)).max(axis=0)
    assert units[-1] > 2 * STEEP
    assert (np.diff(units[units > STEEP]) > 0).all()


def test_rare_faults_that_no_covariance_tells_are_found(events):
    nominal = [events.running()(events.counts(*landing(s))).max() for s in range(100, 120)]
    inputs, residuals, shares = landing(7)
    residuals[250::8] *= 2.5
    assert events.running()(events.counts(inputs, residuals, shares)).max() > max(nominal)


# The detector


def test_a_linear_forecast_has_not_seen_its_fold(fitted):
    detector = fitted["pe-a"]
    pieces, folds = detector.pieces(NOMINAL)
    assert sorted(set(folds)) == [0, 1, 2]
    unseen, ridges = np.arange(3), []
    for by in (0.0, 5.0):
        other = [
            Transitions(p.known, p.now + np.float32(by), p.before) if fold == 1 else p
            for p, fold in zip(pieces, folds, strict=True)
        ]
        forecaster = type(detector.forecaster.chosen)(detector.parameters, seed=0, device="cpu")
        forecaster.units_ = detector.units_
        forecaster._examples(other, folds, unseen)
        ridges.append(forecaster.ridge_)
    same = [np.array_equal(*pair) for pair in zip(*ridges, strict=True)]
    assert same == [False, True, False]


def test_each_episode_is_judged_by_the_member_that_has_not_seen_it(fitted):
    detector = fitted["pe-a"]
    pieces, folds = detector.pieces(NOMINAL)
    forecaster = detector.forecaster.chosen
    judged = forecaster.out_of_fold(pieces, folds)
    for piece, fold, found in zip(pieces, folds, judged, strict=True):
        residual, tail = forecaster.ensemble_.each(*forecaster._posed(piece))
        np.testing.assert_array_equal(found.residuals, deviance(residual[fold], tail[fold]))


@pytest.mark.parametrize(("members", "count"), [(1, 3), (2, 4), (3, 6)])
def test_half_of_many_episodes_are_judged_and_each_member_has_seen_the_others(members, count):
    nominal = [episode(seed) for seed in range(30)]
    detector = make_pe("pe-a", **{**SMALL, "updates": 5, "members": members}, forecaster="ensemble")
    _, few = detector.fit(nominal).pieces(nominal[:29])
    pieces, folds = detector.pieces(nominal)
    assert (max(few) + 1, max(folds) + 1) == (3, count)
    judged = detector.forecaster.chosen.out_of_fold(pieces, folds)
    assert [j is not None for j in judged] == [fold < members for fold in folds]


def test_folds_are_blocks_of_few_episodes_and_no_more_than_charts_need(fitted, monkeypatch):
    pieces, folds = fitted["pe-a"].pieces(NOMINAL[:2])
    assert folds == [0, 1, 2, 0, 1, 2]
    steps = [p.known.steps for p in pieces[:3]]
    np.testing.assert_array_equal(np.concatenate(steps), np.arange(149))
    monkeypatch.setattr("oodd_pe.detector.CHARTED", 149 * 4)
    pieces, folds = fitted["pe-a"].pieces(NOMINAL[:7])
    assert folds == [0, 1, 2, 0, -1, -1, -1]
    judged = fitted["pe-a"].forecaster.chosen.out_of_fold(pieces, folds)
    assert [j is None for j in judged] == [fold < 0 for fold in folds]


def walk(seed, rows, sensors):
    random = np.random.default_rng(seed)
    x = np.zeros((rows, sensors))
    for t in range(1, rows):
        x[t] = 0.9 * x[t - 1] + random.normal(size=sensors)
    return Trajectory(x, random.normal(size=(rows - 1, 2)))


@pytest.mark.parametrize(
    ("nominal", "horizon", "members"),
    [
        ([walk(s, 120, 3) for s in range(3)], 1, 3),
        ([walk(s, 120, 3) for s in range(3)], 3, 4),
        ([walk(0, 300, 8)], 1, 1),
        ([walk(0, 5, 2)], 3, 3),
        ([walk(0, 5, 2)], 1, 4),
    ],
)
def test_few_data_are_enough(nominal, horizon, members):
    settings = {"updates": 20, "width": 8, "batch": 16, "members": members, "horizon": horizon}
    detector = make_pe("pe-a", **settings).fit(nominal)
    fresh = walk(9, 60, nominal[0].observation_dim)
    scores = detector.score(fresh)
    assert np.isfinite(scores[horizon:]).all()
    again = make_pe("pe-a", **settings)
    again.restore(pack(detector.state()).state())
    np.testing.assert_array_equal(again.score(fresh), scores)
    again.reset()
    live, shares = [], []
    for row, action in zip(fresh.observations, [None, *fresh.actions], strict=True):
        live.append(again.update(row, action))
        shares.append(again.explain_last()[0])
    np.testing.assert_allclose(live, scores, rtol=1e-9)
    np.testing.assert_allclose(shares, detector.explain(fresh).shares, rtol=1e-9)


def test_the_score_comes_down_when_a_fault_has_ended(fitted):
    detector, x = fitted["pe-a"], episode(100, n=300)
    rows = x.observations.copy()
    rows[80:200, 1] += 1.0
    limit = max(np.nanmax(detector.score(episode(s, n=300))) for s in range(100, 110))
    scores = detector.score(Trajectory(rows, x.actions))
    assert scores[100:200].min() > limit
    assert scores[200 + RETURN] < limit


@pytest.mark.parametrize("name", ["pe", "pe-a"])
@pytest.mark.parametrize("sensor", [0, 1, 2])
def test_a_corrupted_sensor_is_found_named_and_dated(fitted, name, sensor):
    detector, x = fitted[name], episode(100)
    wild = corrupted(x, 80, sensor, 2.0)
    limit = max(np.nanmax(detector.score(episode(s))) for s in range(100, 110))
    # A change of the constant sensor is weak evidence after twenty episodes, and adds up.
    within = 5 if sensor == 2 else 2
    assert detector.score(wild)[80 : 80 + within].max() > limit
    found = detector.explain(wild)
    assert found.shares[85].argmax() == sensor
    if sensor != 2:
        assert found.shares[80].argmax() == sensor
        assert found.onsets[85] in range(78, 82)


def test_a_change_of_a_constant_sensor_is_no_stronger_than_so_few_episodes_can_tell(fitted):
    detector, x = fitted["pe-a"], episode(100)
    evidence = []
    for by in (0.0, 1e-3, 50.0, -50.0):
        steps = detector._transitions(corrupted(x, 80, 2, by))
        evidence.append(detector._evidence(steps, detector.forecaster.begin()(steps)))
    columns = np.stack([e.residuals[:, -1] for e in evidence])
    # Twenty episodes: the normal deviate of density 1/21 of that in the middle.
    expected = np.array([0, 1, 1, -1]) * math.sqrt(2 * math.log(21))
    np.testing.assert_allclose(columns[:, 79:], expected[:, None] + np.zeros(70))
    np.testing.assert_array_equal(columns[:, :79], 0.0)
    size = np.abs(fitted["pe-a"].charts_.columns(evidence[2])[79:, 2])
    np.testing.assert_allclose(size, expected[2])


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
    steps = step._transitions(x)
    evidence = step._evidence(steps, step.forecaster.begin()(steps))
    first = charts.statistic(sums(charts, evidence))[0]
    np.testing.assert_array_equal(step.score(x)[1:], first)


def test_a_scale_of_zero_is_refused(fitted):
    scales = ["std", "action_scale", "error_scale", "input_scale"]
    assert_zero_scales_are_refused(fitted["pe-a"], make_pe("pe-a", **SMALL), scales)
