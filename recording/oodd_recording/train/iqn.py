"""Implicit quantile networks (Dabney et al. 2018) for the environments with discrete actions.

Double-Q target selection, n-step returns and eight simulators stepped side by side. The network is
that of `oodd_recording.policies.IQNPolicy`: two state layers, a cosine embedding of the
quantile level multiplied in, one hidden layer, a return per action.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from oodd_recording.environments import make
from oodd_recording.registered import info_of
from oodd_recording.train.replay import Replay

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
        layers: dict[str, Any] = {
            "W1": self.state[0],
            "W2": self.state[2],
            "C": self.embedding,
            "W3": self.head[0],
            "W4": self.head[2],
        }
        biases = {"W1": "b1", "W2": "b2", "C": "c", "W3": "b3", "W4": "b4"}
        arrays: dict[str, np.ndarray[Any, Any]] = {"quantiles": np.array(quantiles)}
        for name, layer in layers.items():
            arrays[name] = layer.weight.detach().numpy().T.copy()
            arrays[biases[name]] = layer.bias.detach().numpy().copy()
        return arrays


def quantile_huber(predicted: Tensor, target: Tensor, tau: Tensor) -> Tensor:
    """Quantile Huber loss, kappa 1: levels (B, N) of predictions (B, N) against targets (B, M).

    ``rho = |tau - [u < 0]| * Huber(u)``, ``u = target - predicted``, summed over N, mean over M, B.
    """
    u = target[:, None, :] - predicted[:, :, None]  # (B, N, M)
    huber = torch.where(u.abs() <= 1, 0.5 * u * u, u.abs() - 0.5)
    return ((tau[:, :, None] - (u < 0).float()).abs() * huber).mean(2).sum(1).mean()


class _Actor:
    """One simulator, started anew after each episode, feeding n-step transitions to the replay."""

    def __init__(
        self, environment: str, first_seed: int, replay: Replay, p: dict[str, Any]
    ) -> None:
        self.environment, self.seed, self.replay, self.p = environment, first_seed, replay, p
        self.cap = info_of(environment).episode_cap
        self.actions = info_of(environment).action_dim
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
        self.replay.add(row, self.row, [action, total, discount])


class IQN:
    """Network, target and optimiser for one environment."""

    def __init__(self, environment: str) -> None:
        p = self.hyper_parameters = HYPER_PARAMETERS | OVERRIDES.get(environment, {})
        self.environment, info = environment, info_of(environment)
        shape = (info.observation_dim, info.action_dim, p["width"], p["cosines"])
        self.online, self.target = Network(*shape), Network(*shape)
        self.target.load_state_dict(self.online.state_dict())
        self.optimiser = torch.optim.Adam(
            self.online.parameters(), lr=p["learning_rate"], fused=True
        )

    def state(self) -> dict[str, Any]:
        """Return networks and optimiser for a checkpoint."""
        names = ("online", "target", "optimiser")
        return {name: getattr(self, name).state_dict() for name in names}

    def load(self, state: dict[str, Any]) -> None:
        """Take over the state of a checkpoint."""
        for name in ("online", "target", "optimiser"):
            getattr(self, name).load_state_dict(state[name])

    def arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the network as a policy file holds it."""
        return self.online.arrays(self.hyper_parameters["quantiles_acting"])

    def run(self, seed: int, start: int, steps: int) -> Iterator[int]:
        """Train from one step to another; yield the step whenever an evaluation is due."""
        p, step = self.hyper_parameters, start
        rng = np.random.default_rng(seed)
        replay = Replay(p["replay"], 2 * info_of(self.environment).observation_dim + 3)
        seeds = [seed * 10**7 + i * 10**6 + step for i in range(p["environments"])]
        actors = [_Actor(self.environment, s, replay, p) for s in seeds]
        first, last, share = p["exploration"]
        while step < steps:
            done = step / steps
            epsilon = max(last, first + (last - first) * done / share)
            rate = p["learning_rate"] + (p["final_learning_rate"] - p["learning_rate"]) * done
            self.optimiser.param_groups[0]["lr"] = rate
            with torch.no_grad():
                rows = torch.from_numpy(np.stack([a.row for a in actors]))
                tau = torch.rand(len(actors), p["quantiles_acting"])
                greedy = self.online(rows, tau).mean(1).argmax(1).tolist()
            for actor, action in zip(actors, greedy, strict=True):
                actor.step(actor.explore(action, epsilon, rng))
            before, step = step, step + len(actors)
            if replay.count >= p["warm_up"]:
                for _ in range(len(actors) // p["steps_per_update"]):
                    self.update(torch.from_numpy(replay.sample(p["batch"], rng)))
            if before // p["evaluate_every"] != step // p["evaluate_every"] or step >= steps:
                yield step
        for actor in actors:
            actor.simulator.close()

    def update(self, batch: Tensor) -> None:
        """Take one gradient step from flat transitions (o, o', a, n-step reward, discount)."""
        rows, next_rows = (x.contiguous() for x in batch[:, :-3].chunk(2, dim=1))
        actions, rewards, discounts = batch[:, -3].long(), batch[:, -2], batch[:, -1]
        online, target, levels = self.online, self.target, self.hyper_parameters["quantiles_loss"]
        count = len(rows)
        with torch.no_grad():
            chosen = online(next_rows, torch.rand(count, levels)).mean(1).argmax(1)  # (B,)
            future = target(next_rows, torch.rand(count, levels))
            goal = rewards[:, None] + discounts[:, None] * _of_action(future, chosen)
        tau = torch.rand(count, levels)
        loss = quantile_huber(_of_action(online(rows, tau), actions), goal, tau)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(online.parameters(), 10.0)
        self.optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(  # the fused form of the target update
                list(target.parameters()),
                list(online.parameters()),
                self.hyper_parameters["target_rate"],
            )


def _of_action(quantiles: Tensor, actions: Tensor) -> Tensor:
    """Return the quantiles (B, N) of one action each from those of all, (B, N, A)."""
    index = actions[:, None, None].expand(-1, quantiles.shape[1], 1)
    return quantiles.gather(2, index)[..., 0]
