"""riqn, riqn-ms, n-riqn and npn: loss, learned distributions, rollouts, and the score contract."""

import copy

import numpy as np
import pytest
import torch
from helpers_forecast import one_step, slow_errors
from helpers_state import assert_zero_scales_are_refused
from oodd_npn import npn
from oodd_riqn import n_riqn, riqn, riqn_ms, riqn_r
from oodd_torch import forecast
from oodd_torch.forecast import Forecaster, arrange, rollouts
from oodd_torch.gru import Sequence
from oodd_torch.network import GRID, Architecture, Ensemble
from oodd_torch.training import (
    SAMPLED,
    Schedule,
    batches,
    corrections,
    descend,
    feed_back,
    hidden,
    linear_forecast,
    quantile_huber,
    quantile_huber_slope,
    train,
    transitions,
)
from scipy.stats import ks_2samp

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import pack

pytestmark = pytest.mark.slow

FACTORIES = {"riqn": riqn, "riqn-ms": riqn_ms, "riqn-r": riqn_r, "n-riqn": n_riqn, "npn": npn}
SMALL = {"members": 2, "updates": 15, "batch": 8}


def waves(count=6, length=60, sensors=3, seed=0, noise=0.05):
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, (count, 1, sensors))
    t = np.arange(length)[None, :, None]
    rows = np.sin(0.3 * t + phases) + rng.normal(0, noise, (count, length, sensors))
    return [Trajectory(r, np.zeros((length - 1, 1))) for r in rows]


def heteroscedastic(count, length, seed):
    """o' = 0.8 o + (0.1 + 0.3 |o|) e, so that the spread depends on the state."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((count, length, 1), np.float32)
    for t in range(1, length):
        rows[:, t] = step(rows[:, t - 1], rng)
    return list(rows)


def step(o, rng):
    return 0.8 * o + (0.1 + 0.3 * np.abs(o)) * rng.normal(size=o.shape)


def network(members=1, *, seed=0, random_head=False, **architecture):
    generators = [torch.Generator().manual_seed(seed + i) for i in range(members)]
    a = Architecture(**architecture)
    rng = np.random.default_rng(seed)
    rows = (a.window * a.features + 1, a.features)
    base = rng.normal(0, 0.3, rows) if random_head else np.zeros(rows)
    made = Ensemble(a, generators, base.astype(np.float32), np.full(a.features, 0.5, np.float32))
    if random_head:
        with torch.no_grad():
            made.out.normal_(0, 0.3, generator=generators[0])
            made.out_bias.normal_(0, 0.1, generator=generators[0])
    return made.requires_grad_(requires_grad=False)


@pytest.mark.parametrize(
    ("error", "tau", "kappa", "expected"),
    [
        (2.0, 0.25, 1.0, 0.25 * 1.5),  # outside: kappa (|u| - kappa / 2) = 1.5
        (-2.0, 0.25, 1.0, 0.75 * 1.5),
        (0.5, 0.25, 1.0, 0.25 * 0.125),  # inside: u^2 / 2
        (-0.5, 0.9, 1.0, 0.1 * 0.125),
        (2.0, 0.5, 4.0, 0.5 * 2 / 4),
    ],
)
def test_quantile_huber_loss_by_hand(error, tau, kappa, expected):
    u = torch.tensor(error, requires_grad=True)
    loss = quantile_huber(u, torch.tensor(tau), kappa)
    assert loss.item() == pytest.approx(expected)
    loss.backward()
    assert torch.allclose(quantile_huber_slope(u.detach(), torch.tensor(tau), kappa), u.grad)


@pytest.fixture(scope="module")
def learned():
    episodes = heteroscedastic(120, 100, seed=1)
    made = Ensemble(
        Architecture(features=1), [torch.Generator().manual_seed(0)], *linear_forecast(episodes, 1)
    )
    schedule = Schedule(updates=500, batch=32, chunk=10, levels=16, widths=(0.1,))
    train(made, episodes[:108], episodes[108:], schedule, [np.random.default_rng(0)])
    return made.requires_grad_(requires_grad=False)


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
def test_learned_quantiles_cover_within_two_points(learned, level):
    rows = arrange(heteroscedastic(200, 100, seed=2), 1)[None]
    x, y = rows[:, :-1], rows[:, 1:]
    heads = learned.heads_at(torch.full((1, 1), level))
    change = corrections(learned, hidden(learned, x, learned.start(200))[0], heads)
    below = y <= learned.linear(x) + learned.unit * change[..., 0, :]
    assert below.float().mean().item() == pytest.approx(level, abs=0.02)


def sampled_after(learned, history, horizon, samples, width):
    rng = np.random.default_rng(5)
    levels = torch.from_numpy(rng.integers(GRID, size=(horizon, 1, len(history), samples, 1)))
    x = arrange([history], 1)[None]
    out, _ = rollouts(
        learned, x, learned.start(1), levels, learned.table(), horizon=horizon, width=width
    )
    return out[0, -1, 0, :, 0].numpy()


def test_sampled_rollouts_have_the_distribution_of_the_process(learned):
    history = heteroscedastic(1, 40, seed=3)[0]
    found = sampled_after(learned, history, horizon=5, samples=600, width=600)
    rng = np.random.default_rng(6)
    exact = np.repeat(history[-1:], 600, axis=0)
    for _ in range(5):
        exact = step(exact, rng)
    assert ks_2samp(found, exact[:, 0]).pvalue > 0.001
    # Mean sampling collapses towards the mean.
    mean = sampled_after(learned, history, horizon=5, samples=600, width=1)
    assert mean.std() < 0.85 * found.std()


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize(
    ("architecture", "mean_sampling"),
    [
        ({}, False),
        ({}, True),
        ({"recurrent": False, "window": 3}, False),
        ({"quantiles": False}, False),
        ({"per_feature": True}, False),
        ({"per_feature": True}, True),
        ({"per_feature": True, "quantiles": False}, False),
    ],
    ids=["riqn", "riqn-ms", "n-riqn", "npn", "per-feature", "per-feature-ms", "per-feature-npn"],
)
def test_rollouts_equal_a_slow_loop_sample_for_sample(architecture, mean_sampling, horizon):
    made = network(2, features=2, random_head=True, units=8, cosines=5, **architecture)
    rows = [w.observations for w in waves(2, 9, 2)]
    samples = 1 if not made.architecture.quantiles else 3
    options = {"horizon": horizon, "samples": samples, "mean_sampling": mean_sampling, "seed": 7}
    fast = Forecaster(made, **options).errors(rows)
    for found, episode in zip(fast, rows, strict=True):
        assert np.allclose(found, slow_errors(made, episode, **options), atol=1e-5)


@pytest.mark.parametrize("architecture", [{}, {"recurrent": False}, {"per_feature": True}])
def test_forecasts_are_the_same_whether_output_layers_are_kept(monkeypatch, architecture):
    made = network(2, features=2, random_head=True, units=8, cosines=5, **architecture)
    rows = [w.observations for w in waves(3, 20, 2)]

    def found(longest):
        monkeypatch.setattr(forecast, "LONGEST", longest)
        monkeypatch.setattr(forecast, "ROWS", 6)  # Chunks of two times: some cross the last kept.
        forecaster = Forecaster(made, horizon=1, samples=3, mean_sampling=False, seed=7)
        assert len(forecaster.kept) == longest
        return np.array(forecaster.errors(rows))

    assert np.array_equal(found(1000), found(0))
    assert np.array_equal(found(1000), found(9))


@pytest.fixture(scope="module")
def nonparametric():
    return npn(seed=1, horizon=1, **SMALL).fit(waves())


def test_an_update_sees_pieces_of_whole_episodes_in_turn_without_padding():
    """Readers together see every transition once a round; the first step of each is marked."""
    episodes = [w.observations for n in (30, 10, 21) for w in waves(1, n, 2, seed=n)]
    x, y, starts = transitions(episodes, 2)
    assert len(x) == 29 + 9 + 20
    assert torch.nonzero(starts)[:, 0].tolist() == [0, 29, 38]
    schedule = Schedule(updates=1, batch=2, chunk=29, levels=1, widths=(0.2,) * 2)
    rngs = [np.random.default_rng(e) for e in range(2)]
    seen = batches(episodes, rngs, 2, schedule)
    read = [next(seen) for _ in range(2)]
    for e in range(2):
        # 58 transitions, and two readers that are 29 apart, give or take one.
        inputs = torch.cat([one[0][e] for one in read])[:, 0]
        targets, begun = (torch.cat([one[i][e] for one in read])[:, 0] for i in (1, 2))
        assert begun.sum() == 3
        assert torch.equal(inputs[1:, :2][~begun[1:]], targets[:-1][~begun[1:]])
        found = sorted(map(tuple, inputs.tolist()))
        assert found == sorted(map(tuple, x.tolist()))
    assert y.shape == (58, 2)
    assert not torch.equal(read[0][0][0], read[0][0][1])


def test_the_linear_forecast_of_a_linear_system_is_exact_and_leaves_nothing():
    rng = np.random.default_rng(0)
    turn = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 1.0]])
    rows = [rng.normal(size=3)]
    for _ in range(99):
        rows.append(turn @ rows[-1] + 0.05)
    base, unit = linear_forecast([np.array(rows, np.float32)[:50]], 1)
    assert np.allclose(base, np.vstack([turn.T, np.full(3, 0.05)]), atol=1e-3)
    assert unit.max() < 1e-3
    made = npn(seed=0, horizon=1, **SMALL).fit([Trajectory(np.array(rows), np.zeros((99, 1)))])
    assert np.nanmax(made.score(Trajectory(np.array(rows), np.zeros((99, 1))))) < 1e-2


def test_an_untrained_network_is_the_linear_forecast():
    made = network(2, features=3)
    made.base.normal_(generator=torch.Generator().manual_seed(0))
    rows = waves(1, 12)[0].observations
    options = {"horizon": 1, "samples": 4, "mean_sampling": False, "seed": 7}
    expected = np.abs(rows[1:] - (rows[:-1] @ made.base[:-1].numpy() + made.base[-1].numpy()))
    assert np.allclose(Forecaster(made, **options).errors([rows])[0], expected.mean(1), atol=1e-5)


def test_gradients_of_the_recurrent_layer_are_those_of_differentiation():
    g = torch.Generator().manual_seed(0)
    shapes = [(2, 6, 3, 12), (2, 3, 4), (2, 4, 12), (2, 1, 12)]
    projected, memory, weights, bias = (
        torch.randn(s, generator=g, dtype=torch.float64) for s in shapes
    )
    kept = (torch.rand(2, 6, 3, 1, generator=g) > 0.3).double()
    for p in (projected, weights, bias):
        p.requires_grad_()
    assert torch.autograd.gradcheck(Sequence.apply, (projected, memory, weights, bias, kept))
    assert torch.autograd.gradcheck(Sequence.apply, (projected, memory, weights, bias, None))


def test_memory_is_forgotten_where_an_episode_begins():
    made = network(2, features=3, random_head=True)
    x = torch.tensor(waves(1, 20)[0].observations)[None, :, None].expand(2, -1, -1, -1)
    kept = torch.ones(2, 20, 1)
    kept[:, 8] = 0
    heads = made.heads_at(torch.full((2, 1), 0.5))
    both = corrections(made, hidden(made, x, made.start(1), kept)[0], heads)
    alone = corrections(made, hidden(made, x[:, 8:], made.start(1))[0], heads)
    assert torch.allclose(both[:, 8:], alone, atol=1e-6)


def slow_feeding(made, rows, share, rngs):
    """One member, one episode, one step after the other, each fed what came before."""
    a, steps = made.architecture, len(rows[0]) - 1
    fed = np.zeros((made.members, len(rows), steps, a.features), np.float32)
    for e, rng in enumerate(rngs):
        replaced, levels, index = rng.random((steps, len(rows))) < share, None, None
        if a.quantiles:
            levels = (np.arange(SAMPLED) + rng.random(SAMPLED)) / SAMPLED
            index = rng.integers(SAMPLED, size=(steps, 1, a.features))
        for b, episode in enumerate(rows):
            stream = [episode[0]]
            for t in range(1, steps):
                # The oracle counts levels in steps of the forecasts' grid.
                now = None if levels is None else levels[index[t - 1, 0]] * GRID - 0.5
                sample = one_step(made, e, stream, now)
                stream.append(sample if replaced[t, b] else episode[t])
            fed[e, b] = stream
    return fed


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    "architecture",
    [{}, {"recurrent": False, "window": 3}, {"quantiles": False}, {"per_feature": True}],
    ids=["riqn", "n-riqn", "npn", "per-feature"],
)
def test_scheduled_sampling_feeds_back_what_a_slow_loop_does(architecture, share):
    made = network(2, features=2, random_head=True, units=8, cosines=5, **architecture)
    rows = [w.observations for w in waves(3, 12, 2)]
    x = arrange(rows, made.architecture.window)[:-1].expand(2, -1, -1, -1)
    starts = torch.zeros(x.shape[:3], dtype=torch.bool)
    rngs = [np.random.default_rng(e) for e in (4, 5)]
    found = feed_back(made, x, starts, made.start(3), share, rngs)
    expected = slow_feeding(made, rows, share, [np.random.default_rng(e) for e in (4, 5)])
    for w in range(made.architecture.window):
        past = found[..., 2 * w : 2 * w + 2].transpose(1, 2).numpy()
        # A window reaches back over what was fed, and repeats the first row before it.
        lagged = expected[:, :, np.maximum(np.arange(expected.shape[2]) - w, 0)]
        assert np.allclose(past, lagged, atol=1e-5)
    replaced = (found[..., :2] != x[..., :2]).any(-1)[:, 1:].float().mean().item()
    assert replaced == pytest.approx(share, abs=0.2)


def test_no_sample_crosses_into_the_next_episode():
    made = network(2, features=2, random_head=True, units=8, cosines=5, recurrent=False, window=3)
    rows = [w.observations for w in waves(3, 12, 2)]
    x = arrange(rows, 3)[:-1].expand(2, -1, -1, -1)
    starts = torch.zeros(x.shape[:3], dtype=torch.bool)
    starts[:, 5] = True
    fed = feed_back(made, x, starts, made.start(3), 1.0, [np.random.default_rng(e) for e in (4, 5)])
    assert torch.equal(fed[:, 5], x[:, 5])
    assert not (fed[:, 6:, :, :2] == x[:, 6:, :, :2]).any()


def test_the_probability_of_a_sample_rises_to_its_end_value(monkeypatch):
    shares = []

    def spy(network, x, starts, memory, share, rngs):
        shares.append(share)
        return feed_back(network, x, starts, memory, share, rngs)

    monkeypatch.setattr("oodd_torch.training.feed_back", spy)
    given = {"members": 2, "updates": 6, "scheduled_sampling": 0.6}
    riqn(seed=0, horizon=2, **given).fit(waves())
    # The held-out loss, before the training and after it, is looked at with the end value.
    assert shares[1:-1] == pytest.approx([0.6 * u / 6 for u in range(1, 7)])
    assert shares[0] == shares[-1] == 0.6


@pytest.mark.parametrize("name", FACTORIES)
def test_scheduled_sampling_is_on_beyond_one_step_and_off_at_one(name):
    def losses(horizon, **given):
        return FACTORIES[name](seed=0, horizon=horizon, **SMALL, **given).fit(waves()).history_

    true = losses(1, scheduled_sampling=0.0)
    assert losses(1) == losses(1, scheduled_sampling=1.0) == losses(4, scheduled_sampling=0.0)
    assert losses(1) == true
    assert losses(4) == losses(9) != true


def test_riqn_r_scores_by_the_median_in_nominal_distances():
    """One fit serves both; the score of nominal data is about 1."""
    episodes = waves(20)
    made = riqn(seed=0, horizon=1, **SMALL).fit(episodes)
    other = riqn_r(seed=0, horizon=1, **SMALL)
    other.restore(made.state())
    x = waves(1, 40, seed=9)[0]
    rows = made.scale_(x)
    inputs = arrange([rows[:-1]], 1).expand(2, -1, -1, -1)
    samples, _ = made._forecaster.forecast(inputs, made.network_.start(1), range(1, 40))
    middle = np.sort(samples[:, :, 0].permute(1, 3, 0, 2).flatten(2).numpy(), axis=2)[..., 7]
    expected = (np.abs(rows[1:] - middle) / made.residual_).mean(1)
    assert np.allclose(other.score(x)[1:], expected, rtol=1e-4)
    assert np.nanmean(np.concatenate(other.score_many(waves(9, seed=5)))) == pytest.approx(
        1, abs=0.3
    )


def test_one_fit_serves_other_horizons_beyond_one_and_samples():
    episode = waves(1, 30, seed=9)[0]
    other = {**SMALL, "samples": 3}
    state = riqn(seed=1, horizon=2, **SMALL).fit(waves()).state()
    restored = riqn_ms(seed=1, horizon=4, **other)
    restored.restore(state)
    fresh = riqn_ms(seed=1, horizon=4, **other).fit(waves())
    assert np.array_equal(restored.score(episode), fresh.score(episode), equal_nan=True)
    with pytest.raises(FittedStateError, match=r"'scheduled_sampling': 0\.5"):
        riqn(seed=1, horizon=1, **SMALL).restore(state)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: s.pop("weights.out"), "'weights.out' of the state is nothing"),
        (lambda s: s.update({"weights.out": s["weights.out"][..., :1]}), "'weights.out'"),
        (lambda s: s["weights.out"].fill(np.nan), "'weights.out'"),
        (lambda s: s.update({"weights.out": s["weights.out"].astype(int)}), "'weights.out'"),
        (lambda s: s.update(kind="networks/0"), "'networks/0'"),
        (lambda s: s.update(kind=np.zeros(3)), "the state is of"),
        (lambda s: s.update(settings={"members": 3}), "'members': 3"),
        (lambda s: s.update(mean=np.zeros(1)), "array 'std'"),
    ],
)
def test_damaged_fits_are_refused(damage, message, nonparametric):
    state = copy.deepcopy(pack(nonparametric.state()).state())
    damage(state)
    with pytest.raises(FittedStateError, match=message):
        npn(seed=1, horizon=1, **SMALL).restore(state)
    fresh = npn(seed=1, horizon=1, **SMALL)
    assert_zero_scales_are_refused(nonparametric, fresh, ["std", "residual"])


@pytest.mark.parametrize("trunk", ["shared", "per-feature"])
def test_no_tensor_is_left_behind_on_the_cpu(trunk):
    # The meta device refuses to mix with the CPU's tensors, as a GPU does, and is on any machine.
    made = network(2, features=3, per_feature=trunk == "per-feature").to("meta").requires_grad_()
    assert made.device.type == "meta"
    assert made.table().is_meta
    x = torch.empty(2, 5, 4, 3, device="meta")
    tau = torch.empty(2, 8, device="meta")
    kept = torch.ones(2, 5, 4, device="meta")
    memory = descend(made, x, x, kept, made.start(4), tau, torch.ones(2, device="meta"))
    assert memory.is_meta
    assert all(p.grad is not None and p.grad.is_meta for p in made.parameters())
