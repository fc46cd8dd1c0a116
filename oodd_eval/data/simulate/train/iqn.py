"""Implicit quantile networks (Dabney et al. 2018) for the environments with discrete actions.

Double-Q target selection, n-step returns and eight simulators stepped side by side. The network is
the one `oodd_eval.data.simulate.policies.IQNPolicy` runs: two state layers, a cosine embedding of the
quantile level multiplied in, one hidden layer, a return per action.
"""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.simulate.environments import make
from oodd_eval.data.simulate.train import Progress
from oodd_eval.data.simulate.train.common import Journal

HYPER_PARAMETERS: dict[str, Any] = {
    "width": 64,
    "cosines": 64,
    "batch": 64,
    "quantiles_loss": 8,
    "quantiles_acting": 32,
    "discount": 0.99,
    "n_step": 3,
    "learning_rate": 1e-3,
    "final_learning_rate": 1e-4,
    "target_rate": 0.005,
    "replay": 200_000,
    "environments": 8,
    "steps_per_update": 2,
    "warm_up": 2_000,
    "exploration": [1.0, 0.02, 0.15],  # from, to, over this share of the steps
    "exploration_hold": 1,  # steps for which a random action is kept up
    "reward_scale": 0.1,  # returns of a few units against the Huber loss's unit of 1
    "evaluate_every": 5_000,
}

OVERRIDES: dict[str, dict[str, Any]] = {
    # Single random torques cancel out and never swing the links up to the first reward.
    "acrobot": {"exploration_hold": 6, "exploration": [1.0, 0.02, 0.4]},
    "lunarlander": {"width": 96, "evaluate_every": 20_000, "exploration": [1.0, 0.02, 0.2]},
}


class Network(nn.Module):
    """Return quantiles: (B, D) observations and (B, N) levels to (B, N, A) returns."""

    def __init__(self, observations: int, actions: int, width: int, cosines: int) -> None:
        super().__init__()
        self.state = nn.Sequential(
            nn.Linear(observations, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.embedding = nn.Linear(cosines, width)
        self.head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, actions))
        self.frequencies = math.pi * torch.arange(cosines)

    def forward(self, rows: Tensor, tau: Tensor) -> Tensor:
        """Return quantiles of the return of every action at levels `tau`."""
        phi = torch.relu(self.embedding(torch.cos(tau[..., None] * self.frequencies)))  # (B, N, H)
        out: Tensor = self.head(self.state(rows)[:, None] * phi)
        return out  # (B, N, A)

    def arrays(self, quantiles: int) -> dict[str, np.ndarray[Any, Any]]:
        """Return the weights as a policy file holds them."""
        layers: dict[str, Any] = {"W1": self.state[0], "W2": self.state[2], "C": self.embedding,
                  "W3": self.head[0], "W4": self.head[2]}  # fmt: skip
        biases = {"W1": "b1", "W2": "b2", "C": "c", "W3": "b3", "W4": "b4"}
        found: dict[str, np.ndarray[Any, Any]] = {"quantiles": np.array(quantiles)}
        for name, layer in layers.items():
            found[name] = layer.weight.detach().numpy().T.copy()
            found[biases[name]] = layer.bias.detach().numpy().copy()
        return found


def quantile_huber(predicted: Tensor, target: Tensor, tau: Tensor) -> Tensor:
    """Quantile Huber loss, kappa 1: levels (B, N) of predictions (B, N) against targets (B, M).

    ``rho = |tau - [u < 0]| * Huber(u)``, ``u = target - predicted``, summed over N, mean over M, B.
    """
    u = target[:, None, :] - predicted[:, :, None]  # (B, N, M)
    huber = torch.where(u.abs() <= 1, 0.5 * u * u, u.abs() - 0.5)
    return ((tau[:, :, None] - (u < 0).float()).abs() * huber).mean(2).sum(1).mean()


class _Replay:
    """Ring buffer of n-step transitions as flat float32 arrays."""

    def __init__(self, size: int, observations: int) -> None:
        self.size, self.count = size, 0
        self.rows = torch.zeros(size, observations)
        self.next_rows = torch.zeros(size, observations)
        self.actions = torch.zeros(size, dtype=torch.int64)
        self.rewards = torch.zeros(size)
        self.discounts = torch.zeros(size)

    def add(self, row: Any, action: int, reward: float, next_row: Any, discount: float) -> None:
        i = self.count % self.size
        self.rows[i] = torch.from_numpy(row)
        self.next_rows[i] = torch.from_numpy(next_row)
        self.actions[i], self.rewards[i], self.discounts[i] = action, reward, discount
        self.count += 1

    def sample(self, batch: int, rng: np.random.Generator) -> tuple[Tensor, ...]:
        i = torch.from_numpy(rng.integers(0, min(self.count, self.size), batch))
        return self.rows[i], self.actions[i], self.rewards[i], self.next_rows[i], self.discounts[i]


class _Actor:
    """One simulator, started anew after each episode, feeding n-step transitions to the replay."""

    def __init__(
        self, environment: str, first_seed: int, replay: _Replay, p: dict[str, Any]
    ) -> None:
        self.environment, self.seed, self.replay, self.p = environment, first_seed, replay, p
        self.cap = ENVIRONMENTS[environment].episode_cap
        self.actions = ENVIRONMENTS[environment].action_dim
        self.held, self.random = 0, 0
        self.restart()

    def restart(self) -> None:
        self.simulator = make(self.environment)
        self.row = self.simulator.reset(self.seed)
        self.seed += 1
        self.length = 0
        self.window: deque[tuple[Any, int, float]] = deque()

    def explore(self, greedy: int, epsilon: float, rng: np.random.Generator) -> int:
        """Return the greedy action or, for a share epsilon of the steps, a random one, held."""
        hold = self.p["exploration_hold"]
        if self.held == 0 and rng.random() < epsilon / (hold - (hold - 1) * epsilon):
            self.held, self.random = hold, int(rng.integers(self.actions))
        if self.held == 0:
            return greedy
        self.held -= 1
        return self.random

    def step(self, action: int) -> None:
        row, reward, over = self.simulator.step(action)
        self.window.append((self.row, action, reward * self.p["reward_scale"]))
        self.row, self.length = row, self.length + 1
        # Only a termination ends the return; at the cap the value of the last row stands in.
        if len(self.window) == self.p["n_step"]:
            self._emit(over)
        if over or self.length >= self.cap:
            while self.window:
                self._emit(over)
            self.simulator.close()
            self.restart()

    def _emit(self, over: bool) -> None:
        gamma = self.p["discount"]
        total = sum(gamma**k * r for k, (_, _, r) in enumerate(self.window))
        discount = 0.0 if over else gamma ** len(self.window)
        row, action, _ = self.window.popleft()
        self.replay.add(row, action, total, self.row, discount)


def train(environment: str, *, out: Path, steps: int, seed: int, progress: Progress) -> None:
    """Train an IQN policy on one thread; see `oodd_eval.data.simulate.train.train_policy`."""
    p = HYPER_PARAMETERS | OVERRIDES.get(environment, {})
    info = ENVIRONMENTS[environment]
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    shape = (info.observation_dim, info.action_dim, p["width"], p["cosines"])
    online, target = Network(*shape), Network(*shape)
    target.load_state_dict(online.state_dict())
    optimiser = torch.optim.Adam(online.parameters(), lr=p["learning_rate"], fused=True)
    journal = Journal(
        environment, out,
        {"algorithm": "IQN", "hyper_parameters": p, "seed": seed}, progress,
    )  # fmt: skip
    state, step = journal.resume(), 0
    if state is not None:
        online.load_state_dict(state["online"])
        target.load_state_dict(state["target"])
        optimiser.load_state_dict(state["optimiser"])
        step = int(state["step"])
    replay = _Replay(p["replay"], info.observation_dim)
    seeds = [seed * 10**7 + i * 10**6 + step for i in range(p["environments"])]
    actors = [_Actor(environment, s, replay, p) for s in seeds]
    start, end, share = p["exploration"]
    while step < steps:
        done = step / steps
        epsilon = max(end, start + (end - start) * done / share)
        rate = p["learning_rate"] + (p["final_learning_rate"] - p["learning_rate"]) * done
        optimiser.param_groups[0]["lr"] = rate
        with torch.no_grad():
            rows = torch.from_numpy(np.stack([a.row for a in actors]))
            tau = torch.rand(len(actors), p["quantiles_acting"])
            greedy = online(rows, tau).mean(1).argmax(1).tolist()
        for actor, action in zip(actors, greedy, strict=True):
            actor.step(actor.explore(action, epsilon, rng))
        before, step = step, step + len(actors)
        if replay.count >= p["warm_up"]:
            for _ in range(len(actors) // p["steps_per_update"]):
                _update(online, target, optimiser, replay.sample(p["batch"], rng), p)
        if before // p["evaluate_every"] != step // p["evaluate_every"] or step >= steps:
            journal.evaluate(
                step,
                online.arrays(p["quantiles_acting"]),
                {"online": online.state_dict(), "target": target.state_dict(),
                 "optimiser": optimiser.state_dict()},
            )  # fmt: skip
    for actor in actors:
        actor.simulator.close()


def _update(
    online: Network,
    target: Network,
    optimiser: torch.optim.Optimizer,
    batch: tuple[Tensor, ...],
    p: dict[str, Any],
) -> None:
    rows, actions, rewards, next_rows, discounts = batch
    count, levels = len(rows), p["quantiles_loss"]
    with torch.no_grad():
        chosen = online(next_rows, torch.rand(count, levels)).mean(1).argmax(1)  # (B,)
        future = target(next_rows, torch.rand(count, levels))
        future = future.gather(2, chosen[:, None, None].expand(-1, levels, 1))[..., 0]  # (B, M)
        goal = rewards[:, None] + discounts[:, None] * future
    tau = torch.rand(count, levels)
    predicted = online(rows, tau).gather(2, actions[:, None, None].expand(-1, levels, 1))[..., 0]
    loss = quantile_huber(predicted, goal, tau)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(online.parameters(), 10.0)
    optimiser.step()
    with torch.no_grad():
        torch._foreach_lerp_(  # the fused form of the target update
            list(target.parameters()), list(online.parameters()), p["target_rate"]
        )
