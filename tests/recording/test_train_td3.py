"""TD3: gradients and updates against second formulas written out in numpy."""

import copy
from types import SimpleNamespace

import numpy as np
import pytest
from oodd_recording.policies import TD3Policy

from oodd_eval.data.facts import ENVIRONMENTS

pytestmark = pytest.mark.slow

torch = pytest.importorskip("torch")
pytest.importorskip("gymnasium")
td3 = pytest.importorskip("oodd_recording.train.td3")


OBSERVATIONS, ACTIONS, BATCH = 4, 2, 6


@pytest.fixture
def learner(monkeypatch):
    monkeypatch.setitem(td3.HYPER_PARAMETERS, "layers", [7, 5])
    tiny = SimpleNamespace(observation_dim=OBSERVATIONS, action_dim=ACTIONS)
    monkeypatch.setattr(td3, "info_of", {"tiny": tiny}.get)
    torch.manual_seed(3)
    return td3.TD3("tiny")


@pytest.fixture
def batch():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(BATCH, 2 * OBSERVATIONS)), rng.uniform(-1, 1, (BATCH, ACTIONS))
    ends = rng.normal(size=(BATCH, 1)), np.array([[0], [1], [0], [0], [1], [0]])
    return torch.from_numpy(np.hstack([*rows, *ends]).astype("f4"))


def weights(layers, network=None):
    """Weights and biases in float64, of one of the networks that lie side by side."""
    found = [x.detach().numpy().astype(float) for x in layers]
    return found if network is None else [x[network] for x in found]


def forward(p, rows):
    first = np.maximum(rows @ p[0] + p[1], 0)
    second = np.maximum(first @ p[2] + p[3], 0)
    return first, second, second @ p[4] + p[5]


def backward(p, rows, upstream):
    """Gradients of the weights, and of the rows, for the gradient of the output."""
    first, second, _ = forward(p, rows)
    at_second = (upstream @ p[4].T) * (second > 0)
    at_first = (at_second @ p[2].T) * (first > 0)
    found = []
    for signal, gradient in ((rows, at_first), (first, at_second), (second, upstream)):
        found += [signal.T @ gradient, gradient.sum(0)]
    return found, at_first @ p[0].T


def split_up(batch):
    b = batch.numpy().astype(float)
    o, a = OBSERVATIONS, ACTIONS
    return b[:, :o], b[:, o : 2 * o], b[:, 2 * o : 2 * o + a], b[:, -2], b[:, -1]


def goals(learner, batch, noise):
    """reward + 0.98 (1 - over) min over the target critics at the smoothed target action."""
    _, following, _, reward, over = split_up(batch)
    n = learner.networks
    action = np.tanh(forward(weights(n["pi_t"]), following)[2]) + np.clip(0.2 * noise, -0.5, 0.5)
    pairs = np.hstack([following, np.clip(action, -1, 1)])
    worst = np.min([forward(weights(n["q_t"], k), pairs)[2][:, 0] for k in (0, 1)], axis=0)
    return reward + 0.98 * (1 - over) * worst


def captured(learner, batch, *, policy_too):
    """Gradients that an update hands to its optimisers, which are not stepped."""
    for optimiser in learner.optimisers.values():
        optimiser.step = lambda: None
    learner.update(batch, policy_too=policy_too)
    return {n: [x.grad for x in learner.networks[n]] for n in ("pi", "q")}


def test_critics_follow_the_gradient_of_their_squared_errors(learner, batch):
    torch.manual_seed(9)
    noise = torch.randn(BATCH, ACTIONS).numpy().astype(float)
    goal = goals(learner, batch, noise)
    rows, _, actions, _, _ = split_up(batch)
    pairs = np.hstack([rows, actions])
    torch.manual_seed(9)
    found = captured(learner, batch, policy_too=False)
    assert all(g is None for g in found["pi"])
    for k in (0, 1):
        p = weights(learner.networks["q"], k)
        # d/dv of mean over the batch of (v - goal)^2
        upstream = 2 * (forward(p, pairs)[2][:, 0] - goal)[:, None] / BATCH
        for mine, gradient in zip(backward(p, pairs, upstream)[0], found["q"], strict=True):
            np.testing.assert_allclose(gradient[k].numpy().squeeze(), mine.squeeze(), atol=1e-5)


def test_the_actor_follows_the_first_critic_uphill(learner, batch):
    found = captured(learner, batch, policy_too=True)["pi"]
    rows = split_up(batch)[0]
    p, q = weights(learner.networks["pi"]), weights(learner.networks["q"], 0)
    actions = np.tanh(forward(p, rows)[2])
    upstream = np.full((BATCH, 1), -1 / BATCH)  # d/dv of minus the mean
    at_actions = backward(q, np.hstack([rows, actions]), upstream)[1][:, OBSERVATIONS:]
    expected = backward(p, rows, at_actions * (1 - actions**2))[0]
    assert max(np.abs(g).max() for g in expected) > 1e-3
    for mine, gradient in zip(expected, found, strict=True):
        np.testing.assert_allclose(gradient.numpy(), mine, atol=1e-5)


def test_targets_and_actor_move_only_on_policy_updates(learner, batch):
    names = ("pi", "pi_t", "q_t")
    before = {n: copy.deepcopy(weights(learner.networks[n])) for n in names}
    learner.update(batch, policy_too=False)
    for name in names:
        np.testing.assert_equal(weights(learner.networks[name]), before[name])
    learner.update(batch, policy_too=True)
    for name in ("pi", "q"):
        online, target = (weights(learner.networks[n]) for n in (name, f"{name}_t"))
        start = before[f"{name}_t"]
        for mine, now, was in zip(online, target, start, strict=True):
            np.testing.assert_allclose(now, 0.995 * was + 0.005 * mine, atol=1e-6)
            assert (now != was).any()


def test_the_actor_and_the_policy_file_agree(learner):
    rows = np.random.default_rng(2).normal(size=(20, OBSERVATIONS)).astype("f4")
    policy = TD3Policy(ENVIRONMENTS["hopper"], learner.arrays())
    with torch.no_grad():
        trained = td3.actor(learner.networks["pi"], torch.from_numpy(rows)).numpy()
    np.testing.assert_allclose([policy.act(r) for r in rows], trained, atol=2.0**-17 + 1e-6)


def test_a_state_restores_networks_and_optimisers(learner, batch):
    learner.update(batch, policy_too=True)
    other = td3.TD3("tiny")
    other.load(copy.deepcopy(learner.state()))
    for one in (learner, other):
        torch.manual_seed(4)
        one.update(batch, policy_too=True)
    for name, layers in learner.networks.items():
        for mine, theirs in zip(layers, other.networks[name], strict=True):
            assert torch.equal(mine, theirs), name
