"""The rivals that train networks: closed forms, torch against NumPy, and what all promise."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers_state import assert_zero_scales_are_refused
from oodd_rivals import oodd_detectors
from oodd_rivals.flow import FlowNorm, of_transitions
from oodd_rivals.mixture import WIDTHS, _mixture, encoded, energy
from oodd_rivals.network_parameters import (
    FlowParameters,
    LstmParameters,
    RaptParameters,
    TransitionFlowParameters,
    WorldModelParameters,
)
from oodd_rivals.network_training import draw, ridge
from oodd_rivals.networks import gru_step
from oodd_rivals.rapt import RecurrentForecast, _forecast
from oodd_rivals.stacked_lstm import SHRINKAGE, StackedLstm, _outputs
from oodd_rivals.world_model import Belief, WorldModel
from oodd_torch.gru import GruCell
from scipy import stats

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError

SMALL = {"updates": 120, "units": 8, "batch": 16}
SETTINGS = dict.fromkeys(("rpt-a", "logpzo", "logpzo-a", "wm-kl-a", "lstm"), SMALL)
SETTINGS["dagmm"] = {"updates": 120, "batch": 64}


def episode(seed, n=60):
    """Two sensors that an action pushes, and one that is always 7."""
    rng = np.random.default_rng(seed)
    o, a = np.zeros((n, 2)), rng.normal(size=(n - 1, 1))
    for t in range(1, n):
        o[t] = 0.7 * o[t - 1] + [a[t - 1, 0], o[t - 1, 0]] + 0.1 * rng.normal(size=2)
    return Trajectory(np.c_[o, np.full(n, 7.0)], a)


def pushed(seed, n=300, noise=lambda action: np.full_like(action, 0.5)):
    """One sensor that is an action plus normal noise whose deviation the action decides."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n - 1, 1))
    o = rng.normal(size=(n, 1))
    o[1:] = 2.0 * a + noise(a) * rng.normal(size=(n - 1, 1))
    return Trajectory(o, a)


SPECS = {spec.name: spec for spec in oodd_detectors()}


def make(name, **parameters):
    return SPECS[name].factory(**parameters)


NOMINAL = [episode(seed) for seed in range(8)]


@pytest.fixture(scope="module")
def fitted():
    return {name: make(name, **settings).fit(NOMINAL) for name, settings in SETTINGS.items()}


# What all of them promise


@pytest.mark.parametrize("name", SETTINGS)
def test_zero_scales_in_a_state_are_refused(fitted, name):
    scales = {"rpt-a": ["unit", "calibration"], "wm-kl-a": ["unit"]}
    scales["lstm"] = scales["rpt-a"]
    unfitted = make(name, **SETTINGS[name])
    assert_zero_scales_are_refused(fitted[name], unfitted, ["std", *scales.get(name, [])])


@pytest.mark.parametrize("name", SETTINGS)
def test_the_seed_decides_what_is_learnt(fitted, name):
    other = make(name, **SETTINGS[name], seed=1).fit(NOMINAL).score(NOMINAL[0])
    assert not np.allclose(other[1:], fitted[name].score(NOMINAL[0])[1:])


@pytest.mark.parametrize("name", SETTINGS)
def test_a_constant_sensor_that_moves_adds_a_bounded_surprise(fitted, name):
    x = episode(105)
    rows = x.observations.copy()
    rows[20:, 2] = 1e6
    more = fitted[name].score(Trajectory(rows, x.actions)) - fitted[name].score(x)
    terms = {"wm-kl-a": 6, "dagmm": 2}.get(name, 3)  # half a square, a sensor; an energy's is whole
    np.testing.assert_array_equal(more[1:20], 0.0)
    np.testing.assert_allclose(more[20:], 2 * math.log(len(NOMINAL) + 1) / terms)


@pytest.mark.parametrize("name", SETTINGS)
def test_episodes_without_a_transition_cannot_be_learned_from(name):
    with pytest.raises(TrajectoryError, match="cannot be fitted"):
        make(name, **SETTINGS[name]).fit([Trajectory(np.zeros((1, 2)), np.zeros((0, 1)))])


# What they share


def test_ridge_finds_a_linear_system_and_the_size_of_what_it_leaves():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4000, 2))
    y = np.c_[x @ [1.0, -2.0] + 3.0 + 0.5 * rng.normal(size=4000), np.full(4000, 9.0)]
    coefficients, unit = ridge(x, y)
    np.testing.assert_allclose(coefficients[:, 0], [1.0, -2.0, 3.0], atol=0.05)
    np.testing.assert_allclose(unit, [[0.5, 1.0]], rtol=0.05)


def test_a_step_of_the_recurrent_layer_is_that_of_torch():
    shapes = {"gru_in": (4, 12), "gru_in_bias": (1, 12), "gru": (4, 12), "gru_bias": (1, 12)}
    w = {name: t.detach() + 0.1 for name, t in draw(shapes, 0).items()}
    x, memory = torch.randn(2, 1, 1, 4, generator=torch.Generator().manual_seed(1))
    h = slice(0, 8)
    cell = GruCell(
        gates=torch.cat([w["gru_in"][..., h], w["gru"][..., h]], 1),
        gates_bias=(w["gru_in_bias"] + w["gru_bias"])[..., h],
        new=w["gru_in"][..., 8:].contiguous(),
        new_bias=w["gru_in_bias"][..., 8:],
        old=w["gru"][..., 8:].contiguous(),
        old_bias=w["gru_bias"][..., 8:],
    )
    weights = {name: t[0].double().numpy() for name, t in w.items()}
    after = gru_step(weights, x[0].double().numpy(), memory[0].double().numpy())
    np.testing.assert_allclose(after, cell(x, memory)[0].numpy(), atol=1e-6)


# rpt-a


def test_the_forecast_reaches_the_likelihood_of_the_true_noise():
    def noise(action):
        return 0.4 * np.exp(0.8 * action)

    training = [pushed(seed, noise=noise) for seed in range(20)]
    parameters = RaptParameters(updates=400, units=16)
    detector = RecurrentForecast("rpt-a", parameters, seed=0, horizon=1).fit(training)
    test = [pushed(seed, noise=noise) for seed in range(50, 60)]
    episodes = [detector._standard(x) for x in test]
    residuals, log_scales = (
        np.concatenate(v) for v in zip(*map(detector._forecasts, episodes), strict=True)
    )
    loss = float((0.5 * residuals**2 + log_scales).mean())
    unit = detector.weights_["unit"][0, 0] * detector.observation_scale_.std[0]
    actions = np.concatenate([x.actions for x in test])
    truth = 0.5 + float(np.log(noise(actions) / unit).mean())
    # What one scale for all rows would reach.
    constant = 0.5 + 0.5 * float(np.log((noise(actions) ** 2).mean() / unit**2))
    assert truth < constant - 0.3
    assert loss == pytest.approx(truth, abs=0.05)
    assert detector.loss_ == pytest.approx(truth, abs=0.1)


def test_the_forecast_of_torch_is_that_of_numpy(fitted):
    detector = fitted["rpt-a"]
    x, _ = detector._pairs(detector._standard(episode(107)))
    weights = {n: torch.from_numpy(w).float()[None] for n, w in detector.weights_.items()}
    starts = torch.zeros(1, len(x), 1, dtype=torch.bool)
    inputs = torch.from_numpy(x).float()[None, :, None]
    mean, log_scale, _ = _forecast(weights, inputs, torch.zeros(1, 1, SMALL["units"]), starts)
    memory = np.zeros((1, SMALL["units"]))
    for n, row in enumerate(x):
        memory, expected, scale = detector._network(row[None], memory)
        np.testing.assert_allclose(mean[0, n].numpy(), expected, atol=1e-4)
        limited = np.minimum(log_scale[0, n].numpy(), detector.weights_["widest"])
        np.testing.assert_allclose(limited, scale, atol=1e-4)


def test_deviations_are_calibrated_to_a_mean_square_of_one_on_held_out_episodes():
    parameters = RaptParameters(**SMALL)
    detector = RecurrentForecast("rpt-a", parameters, seed=0, horizon=1).fit(NOMINAL)
    # One of eight episodes is held out; the seed says which.
    held_out = NOMINAL[np.random.default_rng([0, 0]).permutation(8)[0]]
    scores = detector.score(held_out)[1:]
    assert scores.mean() * 3 / 2 == pytest.approx(1.0)


def test_the_largest_deviation_is_that_of_one_sensor():
    parameters = RaptParameters(**SMALL, statistic="largest")
    detector = RecurrentForecast("rpt-a", parameters, seed=0, horizon=1).fit(NOMINAL)
    observations = np.array([[0, 0, 7], [0, 0, 8]], np.float32)
    scores = detector._statistic(detector.weights_["calibration"] * [[1, -3], [2, 0]], observations)
    np.testing.assert_allclose(scores, [9.0, max(4.0, 2 * math.log(9))])


# logpzo


def flow_of(rows, **parameters):
    """Return a flow fitted to rows of episodes of 100."""
    episodes = [Trajectory(r, np.zeros((len(r) - 1, 1))) for r in np.array_split(rows, 20)]
    settings = FlowParameters(units=32, batch=256, **parameters)
    return FlowNorm("logpzo", settings, seed=0, horizon=1, actions=False).fit(episodes)


def test_on_normal_rows_the_norm_is_the_mahalanobis_distance():
    rng = np.random.default_rng(0)
    root = np.array([[2.0, 0.0], [1.5, 0.1]])
    detector = flow_of(rng.normal(size=(4000, 2)) @ root.T + 5.0, updates=300, steps=32)
    test = rng.normal(size=(500, 2)) @ (1.5 * root.T) + 5.0
    squares = (np.linalg.solve(root, (test - 5.0).T) ** 2).mean(axis=0)
    scores = detector.score(Trajectory(test, np.zeros((499, 1))))
    assert stats.spearmanr(scores, squares).statistic > 0.99
    np.testing.assert_allclose(scores, squares, atol=0.25, rtol=0.25)


def test_one_step_reaches_the_mean_of_the_noise_which_knows_nothing_of_the_row():
    # At time 0 the best velocity is E[z] - x: one step leads from every row to 0, and what is left
    # is what the network has not learned.
    rows = np.random.default_rng(0).normal(size=(4000, 2))
    detector = flow_of(rows, updates=300, steps=1)
    assert detector.score(Trajectory(rows[:500], np.zeros((499, 1)))).mean() < 0.05


def test_in_one_dimension_the_flow_is_the_quantile_transform():
    # A flow in one dimension keeps the order; what carries a law to a normal one and keeps the
    # order is unique.
    rng = np.random.default_rng(0)
    detector = flow_of(rng.exponential(size=(8000, 1)), updates=1000, steps=50)
    x = stats.expon.ppf([[0.1], [0.3], [0.5], [0.7], [0.9], [0.97]])
    latents = detector.latents(np.empty((6, 0)), (x - detector.scale_.mean) / detector.scale_.std)
    expected = stats.norm.ppf(stats.expon.cdf(x))
    np.testing.assert_allclose(latents * np.sign(latents[-1]), expected, atol=0.15)


@pytest.mark.parametrize("conditional", [False, True])
def test_flows_of_transitions_see_what_flows_of_rows_cannot(conditional):
    settings = TransitionFlowParameters(updates=200, units=16, batch=128, conditional=conditional)
    detector = of_transitions("logpzo-a", settings, seed=0, horizon=1).fit(NOMINAL)
    x = episode(108)
    # Every row is nominal by itself; the actions are those of another episode.
    swapped = Trajectory(x.observations, episode(109).actions)
    assert detector.score(swapped)[1:].mean() > 3 * detector.score(x)[1:].mean()


# wm-kl-a


def test_divergence_is_that_of_torch_distributions(fitted):
    model = fitted["wm-kl-a"]
    unit = model.weights_["unit"]
    one = Belief(np.array([[0.3, -1.0]]) * unit, np.array([[0.1, -2.0]]))
    other = Belief(np.array([[0.1, 0.5]]) * unit, np.array([[0.4, 0.3]]))

    def normal(belief):
        return torch.distributions.Normal(
            torch.from_numpy(belief.mean), torch.from_numpy(unit * np.exp(belief.log_scale))
        )

    expected = torch.distributions.kl_divergence(normal(one), normal(other)).sum()
    assert model.divergence(one, other) == pytest.approx(float(expected))
    assert model.divergence(one, one) == 0.0


@pytest.mark.parametrize(("noise", "nats"), [(0.5, math.log(2)), (2.0, 0.0)])
def test_surprise_is_the_information_in_an_observation(noise, nats):
    # The sensor's variance about its forecast is 1 unit. Decoding explains noise^2 of it, so that
    # the latent carries the rest: log(1 / noise) nats, or none where decoding explains it all.
    parameters = WorldModelParameters(updates=400, units=16, batch=32, noise=noise)
    training = [pushed(seed) for seed in range(20)]
    model = WorldModel("wm-kl-a", parameters, seed=0, horizon=1).fit(training)
    scores = np.concatenate([model.score(pushed(seed))[1:] for seed in range(50, 55)])
    assert scores.mean() == pytest.approx(nats, abs=0.03)


def test_the_bound_compares_with_a_belief_without_memory(fitted):
    parameters = WorldModelParameters(**SMALL, statistic="bound")
    bound = WorldModel("wm-kl-a", parameters, seed=0, horizon=1).fit(NOMINAL)
    x = episode(110)
    surprise, rows = fitted["wm-kl-a"].score(x), bound._standard_rows(x.observations)
    beliefs = [posterior for _, posterior in bound._beliefs(bound._standard(x))]
    empty = np.zeros((1, SMALL["units"]))
    expected = [
        s - bound.divergence(b, bound.posterior(empty, row[None], row[None])) / 3
        for s, b, row in zip(surprise[1:], beliefs, rows[1:], strict=True)
    ]
    np.testing.assert_allclose(bound.score(x)[1:], expected)


def test_beyond_one_step_the_prior_is_rolled_out_with_the_actions_commanded(fitted):
    one = fitted["wm-kl-a"]
    three = WorldModel("wm-kl-a", WorldModelParameters(**SMALL), seed=0, horizon=3)
    three.restore(one.state())
    x = episode(111)
    beliefs = [posterior for _, posterior in one._beliefs(one._standard(x))]
    memory, z = np.zeros((1, SMALL["units"])), one._standard_rows(x.observations[:1])
    z = one.posterior(memory, z, z).mean
    for action in x.actions[:3]:
        memory, prior = one.advance(memory, z, one._standard_action(action[None]))
        z = prior.mean
    expected = one.divergence(beliefs[2], prior) / 3
    assert three.score(x)[3] == pytest.approx(expected)


# lstm


def lstm(**parameters):
    settings = {"units": 16, "batch": 16, "updates": 300, **parameters}
    horizon = settings.pop("horizon", 1)
    return StackedLstm("lstm", LstmParameters(**settings), seed=0, horizon=horizon)


def beats(seed, n=120, every=7):
    """A pulse every seven rows, from a row of its own on, with little noise."""
    rng = np.random.default_rng(seed)
    pulse = (np.arange(n) % every == rng.integers(every)).astype(float)
    return Trajectory((pulse + 0.05 * rng.normal(size=n))[:, None], np.zeros((n - 1, 0)))


def test_the_stacked_network_of_torch_is_that_of_numpy(fitted):
    detector = fitted["lstm"]
    rows = detector._standard(episode(112))
    weights = {n: torch.from_numpy(w).float()[None] for n, w in detector.weights_.items()}
    starts = torch.zeros(len(rows), 1, dtype=torch.bool)
    starts[30] = True  # what the first 30 rows left behind is forgotten
    x = torch.from_numpy(rows).float()[:, None]
    outputs, _ = _outputs(weights, x, torch.zeros(2, 2, 1, SMALL["units"]), starts)
    w, expected = detector.weights_, []
    for part in (rows[:30], rows[30:]):
        carried = detector._beginning()
        for row in part:
            _, carried = detector._next(row[None], row[None], carried)
            linear = row[None] @ w["base"][:-1] + w["base"][-1]
            changes = (carried[1][0] - row).reshape(1, -1)
            expected.append((changes - linear) / w["unit"])
    np.testing.assert_allclose(outputs[:, 0], np.concatenate(expected), atol=1e-4)


@pytest.mark.parametrize("horizon", [1, 2])
def test_errors_are_of_the_forecasts_that_were_made_of_the_same_row(horizon):
    detector = lstm(updates=5, steps=3, horizon=horizon).fit(NOMINAL)
    rows = detector._standard(episode(113))[:9]
    carried, forecasts = detector._beginning(), []
    for row in rows:
        _, carried = detector._next(row[None], row[None], carried)
        forecasts.append(carried[1][0])
    errors = detector._errors(rows).reshape(-1, 3, 2)
    assert len(errors) == 9 - horizon
    for t in range(horizon, 9):
        for j in range(3):
            made = t - horizon - j  # when o_t was step j of the forecast
            expected = rows[t] - forecasts[made][j] if made >= 0 else [np.nan] * 2
            np.testing.assert_array_equal(errors[t - horizon, j], expected)


def test_the_stacked_network_remembers_what_a_row_does_not_show():
    detector = lstm(updates=300).fit([beats(seed) for seed in range(20)])
    assert detector.loss_ < 0.1  # of what a linear forecast of the newest row leaves
    x = beats(99)
    rows = x.observations.copy()
    late = int(np.flatnonzero(rows[60:, 0] > 0.5)[0]) + 60
    rows[[late, late + 1]] = rows[[late + 1, late]]
    scores = detector.score(Trajectory(rows, x.actions))
    assert scores[late] > 20 * np.median(scores[40:])


def test_the_score_is_the_mahalanobis_distance_of_errors_of_held_out_episodes(fitted):
    detector = fitted["lstm"]
    held_out = NOMINAL[np.random.default_rng([0, 0]).permutation(8)[0]]
    errors = detector._errors(detector._standard(held_out))
    whole = errors[2:]  # before, forecasts two and three steps ahead are from nowhere
    spread = whole.std(axis=0)
    correlation = np.corrcoef(whole.T)
    shrunk = (1 - SHRINKAGE) * correlation + SHRINKAGE * np.eye(6)
    centred = (whole - whole.mean(axis=0)) / spread
    lengths = np.einsum("ni,ij,nj->n", centred, np.linalg.inv(shrunk), centred)
    np.testing.assert_allclose(detector.score(held_out)[3:], lengths / 9, rtol=1e-6)
    first = np.r_[(errors[0, :2] - whole.mean(axis=0)[:2]) / spread[:2], np.zeros(4)]
    expected = first @ np.linalg.solve(shrunk, first) / 9
    assert detector.score(held_out)[1] == pytest.approx(expected)


def test_episodes_without_a_whole_forecast_are_left_out():
    short = Trajectory(np.full((3, 3), 99.0), np.zeros((2, 0)))
    alone, beside = (lstm(updates=3).fit(x) for x in (NOMINAL, [*NOMINAL, short]))
    np.testing.assert_array_equal(alone.score(NOMINAL[0]), beside.score(NOMINAL[0]))
    with pytest.raises(TrajectoryError, match="0 have at least 5 transitions"):
        lstm(steps=5).fit([short])


# dagmm


def test_a_mixture_of_two_groups_is_their_means_and_covariances():
    rng = np.random.default_rng(0)
    groups = rng.normal(size=(30, 2)) @ [[2, 1], [0, 1]], rng.normal(size=(90, 2)) - 9
    z = torch.from_numpy(np.concatenate(groups))
    members = torch.from_numpy(np.repeat(np.eye(2), [30, 90], axis=0))
    shares, centres, roots, inverse = _mixture(z, members)
    laws = [stats.multivariate_normal(g.mean(0), np.cov(g.T, bias=True)) for g in groups]
    density = 0.25 * laws[0].pdf(z) + 0.75 * laws[1].pdf(z)
    found = energy(z.numpy(), shares.numpy(), centres.numpy(), roots.numpy(), np)
    np.testing.assert_allclose(found, -np.log(density), rtol=1e-4)
    assert float(inverse) == pytest.approx(sum((1 / g.var(axis=0)).sum() for g in groups), rel=1e-4)


def test_features_of_a_reconstruction_by_hand():
    # The code is the first column, and what is decoded is (code, 0).
    shapes = {"encode": (2, *WIDTHS, 1), "decode": (1, *WIDTHS[::-1], 2)}
    w = {}
    for name, sizes in shapes.items():
        for n, shape in enumerate(pairwise(sizes)):
            w[f"{name}_{n}"], w[f"{name}_{n}_bias"] = np.zeros(shape), np.zeros(shape[1])
            w[f"{name}_{n}"][0, 0] = 1.0
    z, again = encoded(np.array([[3.0, 4.0]]), w, np)
    code = np.tanh(np.tanh(np.tanh(3.0)))
    decoded = np.tanh(np.tanh(np.tanh(code)))
    np.testing.assert_allclose(again, [[decoded, 0.0]])
    far = np.hypot(3 - decoded, 4) / 5
    np.testing.assert_allclose(z, [[code, far, 0.6]])


def test_the_energy_of_a_window_is_that_of_torch(fitted):
    detector = make("dagmm", updates=60, batch=64, window=3, code=2, components=2).fit(NOMINAL)
    x = episode(114)
    rows = (x.observations[:, :2] - detector.scale_.mean[:2]) / detector.scale_.std[:2]
    latest = np.hstack([rows[np.maximum(np.arange(60) - k, 0)] for k in range(3)])
    w = {n: torch.from_numpy(v) for n, v in detector.weights_.items()}
    z, _ = encoded(torch.from_numpy(latest), w, torch)
    roots = w["roots"].reshape(2, 4, 4)
    expected = energy(z, w["shares"][0], w["centres"], roots, torch)
    np.testing.assert_allclose(detector.score(x), expected, rtol=1e-5, atol=1e-5)


def test_training_lowers_the_whole_loss():
    losses = [make("dagmm", updates=n, batch=64).fit(NOMINAL).loss_ for n in (1, 200)]
    assert losses[1] < losses[0] - 0.3
