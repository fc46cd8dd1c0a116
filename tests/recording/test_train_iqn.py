"""Implicit quantile networks: loss, transitions and updates by hand."""

import numpy as np
import pytest
from oodd_recording.policies import IQNPolicy
from oodd_recording.train.replay import Replay

pytestmark = pytest.mark.slow

torch = pytest.importorskip("torch")
pytest.importorskip("gymnasium")
iqn = pytest.importorskip("oodd_recording.train.iqn")


def test_quantile_huber_by_hand():
    # errors of prediction 0: 0.5 and -2; of prediction 1: -0.5 and -3
    # Huber: 0.125, 1.5; 0.125, 2.5; weights at 0.25: 0.25, 0.75; at 0.5: 0.5, 0.5
    # means over targets: (0.03125 + 1.125) / 2 and (0.0625 + 1.25) / 2; their sum
    predicted, target = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.5, -2.0]])
    found = iqn.quantile_huber(predicted, target, torch.tensor([[0.25, 0.5]]))
    assert found.item() == pytest.approx((0.03125 + 1.125 + 0.0625 + 1.25) / 2)


def test_the_network_and_the_policy_file_agree():
    torch.manual_seed(1)
    network = iqn.Network(4, 3, 8, 5)
    policy = IQNPolicy(network.arrays(6))
    rows = np.random.default_rng(2).normal(size=(7, 4)).astype("f4")
    tau = ((2 * torch.arange(6) + 1) / 12).expand(7, 6)
    with torch.no_grad():
        expected = network(torch.from_numpy(rows), tau).mean(1).numpy()
    np.testing.assert_allclose([policy.values(r) for r in rows], expected, atol=1e-5)


class Counting:
    """Simulator whose observation is the step number and whose rewards are 1, 10, 100, …"""

    def __init__(self, length):
        self.length, self.t, self.closed = length, 0, False

    def reset(self, seed):
        self.t = 0
        return np.zeros(4, "f4")

    def step(self, action):
        self.t += 1
        return np.full(4, self.t, "f4"), 10.0 ** (self.t - 1), self.t == self.length

    def close(self):
        self.closed = True


def transitions(monkeypatch, length, steps):
    monkeypatch.setattr(iqn, "make", lambda environment: Counting(length))
    replay = Replay(1000, 2 * 4 + 3)
    p = {"n_step": 3, "discount": 0.5, "reward_scale": 1.0, "exploration_hold": 1}
    actor = iqn._Actor("cartpole", 0, replay, p)
    for t in range(steps):
        actor.step(t % 2)
    rows = replay.rows[: replay.count].tolist()
    return [(row[0], row[8], row[9], row[4], row[10]) for row in rows]


def test_n_step_transitions_of_an_episode_that_terminates(monkeypatch):
    # 1 + 10/2 + 100/4 = 31; 10 + 100/2 + 1000/4 = 310; 100 + 1000/2 = 600; 1000
    assert transitions(monkeypatch, length=4, steps=4) == [
        (0, 0, 31.0, 3, 0.125), (1, 1, 310.0, 4, 0.0), (2, 0, 600.0, 4, 0.0),
        (3, 1, 1000.0, 4, 0.0),
    ]  # fmt: skip


def test_at_the_cap_the_value_of_the_last_row_stands_in(monkeypatch):
    # An episode longer than CartPole's cap of 500 is cut without a termination.
    monkeypatch.setattr(Counting, "step", lambda s, a: (s.reset(0), 1.0, False))
    found = transitions(monkeypatch, length=10**6, steps=500)
    assert len(found) == 500
    assert [discount for *_, discount in found[-3:]] == [0.125, 0.25, 0.5]
    assert found[-1][2] == 1.0


def test_transitions_do_not_reach_into_the_next_episode(monkeypatch):
    found = transitions(monkeypatch, length=2, steps=6)
    assert found == [(0, 0, 6.0, 2, 0.0), (1, 1, 10.0, 2, 0.0)] * 3


def test_the_replay_overwrites_the_oldest():
    replay = Replay(3, 2)
    for i in range(5):
        replay.add(np.array([i], "f4"), [2.0])
    assert sorted(replay.rows[:, 0].tolist()) == [2.0, 3.0, 4.0]
    picked = replay.sample(200, np.random.default_rng(0))
    assert set(picked[:, 0].tolist()) == {2.0, 3.0, 4.0}


def test_updates_learn_the_quantiles_of_a_return_and_the_value_behind_it():
    # Action 0 ends with a return of -1 or 1, action 1 leads to the same choice again at 0.5 of it.
    torch.manual_seed(5)
    learner = iqn.IQN("cartpole")
    learner.hyper_parameters["target_rate"] = 0.05
    learner.online, learner.target = online, _ = (
        iqn.Network(1, 2, 32, 16),
        iqn.Network(1, 2, 32, 16),
    )
    learner.optimiser = torch.optim.Adam(online.parameters(), lr=3e-3)
    rng = np.random.default_rng(5)
    for _ in range(1000):
        actions = torch.from_numpy(rng.integers(0, 2, 64))
        coin = torch.from_numpy(rng.choice([-1.0, 3.0], 64).astype("f4"))
        ends = actions == 0
        rows = torch.ones(64, 1)
        columns = actions, coin * ends, 0.5 * (~ends).float()
        learner.update(torch.cat([rows, rows, torch.stack(columns, 1)], 1))
    with torch.no_grad():
        levels = ((2 * torch.arange(32) + 1) / 64)[None]
        found = online(torch.ones(1, 1), levels)[0]
    np.testing.assert_allclose(found.mean(0), [1.0, 0.5], atol=0.15)  # action 0: (-1 + 3) / 2
    assert found[:12, 0].mean() < -0.5
    assert found[20:, 0].mean() > 2.5
