"""TD3 (Fujimoto et al. 2018) for the four PyBullet robots, on one thread.

The hyper-parameters are those published for these environments: layers of 400 and 300, batch 100,
discount 0.98, learning rate 1e-3, replay of 200 000, 10 000 random steps, exploration noise 0.1.
Ours is the end: the learning rate falls linearly to 1e-4 over the last three tenths of the steps,
and the actor that is judged and kept is an average over its last 10 000 steps (updates weighted by
an exponential). A policy that still changes with every update falls in some starts.

Both critics are one batched matrix product, about twice as fast on a CPU as two networks.

A checkpoint holds networks and optimisers. A resumed run first refills the replay with the policy
that it found, without updates; these steps are not counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from oodd_recording.environments import make
from oodd_recording.policies import LAYERS, scaled
from oodd_recording.registered import info_of
from oodd_recording.train.replay import Replay

HYPER_PARAMETERS: dict[str, Any] = {
    "layers": [400, 300],
    "batch": 100,
    "discount": 0.98,
    "learning_rate": 1e-3,
    "final_learning_rate": 1e-4,
    "decay_share": 0.3,
    "target_rate": 0.005,
    "average_rate": 2e-4,
    "exploration_noise": 0.1,
    "target_noise": 0.2,
    "target_noise_clip": 0.5,
    "policy_delay": 2,
    "warm_up": 10_000,
    "replay": 200_000,
    "refill": 100_000,
    "evaluate_every": 10_000,
}

Layers = list[Tensor]


def initial(inputs: int, outputs: int, networks: int | None, layers: list[int]) -> Layers:
    """Return weights and biases, uniform in ±1/sqrt(inputs); `networks` of them side by side."""
    sizes = [inputs, *layers, outputs]
    lead = (networks,) if networks else ()
    weights: Layers = []
    for rows, columns in itertools.pairwise(sizes):
        bound = rows**-0.5
        bias = (*lead, 1, columns) if networks else (columns,)
        weights += [
            torch.empty(*shape).uniform_(-bound, bound).requires_grad_()
            for shape in ((*lead, rows, columns), bias)
        ]
    return weights


def actor(p: Layers, rows: Tensor) -> Tensor:
    """Actions in [-1, 1] for observations: (B, D) to (B, A)."""
    hidden = torch.addmm(p[1], rows, p[0]).relu_()
    hidden = torch.addmm(p[3], hidden, p[2]).relu_()
    return torch.addmm(p[5], hidden, p[4]).tanh_()


def critic(p: Layers, pairs: Tensor) -> Tensor:
    """Return values of observation-action pairs by K critics: (B, D + A) to (K, B)."""
    pairs = pairs.expand(p[0].shape[0], -1, -1)
    hidden = torch.baddbmm(p[1], pairs, p[0]).relu_()
    hidden = torch.baddbmm(p[3], hidden, p[2]).relu_()
    return torch.baddbmm(p[5], hidden, p[4]).squeeze(-1)


class TD3:
    """Networks, their targets and optimisers for one environment."""

    def __init__(self, environment: str) -> None:
        self.environment, self.hyper_parameters = environment, HYPER_PARAMETERS
        p, info = HYPER_PARAMETERS, info_of(environment)
        observations, actions = info.observation_dim, info.action_dim
        self.observations, self.actions = observations, actions
        self.networks: dict[str, Layers] = {
            "pi": initial(observations, actions, None, p["layers"]),
            "q": initial(observations + actions, 1, 2, p["layers"]),
        }
        for name in ("pi", "q"):
            self.networks[f"{name}_t"] = [x.detach().clone() for x in self.networks[name]]
        # An average of the iterates varies less than the last one (Polyak and Juditsky 1992).
        self.networks["pi_mean"] = [x.detach().clone() for x in self.networks["pi"]]
        self.optimisers = {
            name: torch.optim.Adam(self.networks[name], lr=p["learning_rate"], fused=True)
            for name in ("pi", "q")
        }

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        checkpoint: dict[str, Any] = {
            name: [x.detach() for x in layers] for name, layers in self.networks.items()
        }
        return checkpoint | {f"opt_{n}": o.state_dict() for n, o in self.optimisers.items()}

    def load(self, state: dict[str, Any]) -> None:
        """Take over the state of a checkpoint."""
        for name, layers in self.networks.items():
            for mine, stored in zip(layers, state[name], strict=True):
                mine.data.copy_(stored)
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state[f"opt_{name}"])

    def arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the actor, averaged over its last updates, as a policy file holds it."""
        layers = (x.detach().numpy().copy() for x in self.networks["pi_mean"])
        return dict(zip(LAYERS["TD3"], layers, strict=True))

    def update(self, batch: Tensor, *, policy_too: bool) -> None:
        """Take one gradient step from flat transitions (o, o', a, reward, terminated)."""
        p, o, n = HYPER_PARAMETERS, self.observations, self.networks
        rows, next_rows = batch[:, :o], batch[:, o : 2 * o]
        actions, reward, over = batch[:, 2 * o : -2], batch[:, -2], batch[:, -1]
        with torch.no_grad():
            noise = torch.randn(len(batch), self.actions).mul_(p["target_noise"])
            noise.clamp_(-p["target_noise_clip"], p["target_noise_clip"])
            following = (actor(n["pi_t"], next_rows) + noise).clamp_(-1, 1)
            worst = critic(n["q_t"], torch.cat([next_rows, following], 1)).amin(0)
            goal = reward + p["discount"] * (1 - over) * worst
        values = critic(n["q"], torch.cat([rows, actions], 1))
        # Times two: a sum over the two critics, of the mean over the batch.
        self._descend("q", functional.mse_loss(values, goal.expand(2, -1)) * 2)
        if policy_too:
            first = [x.detach()[:1] for x in n["q"]]
            self._descend("pi", -critic(first, torch.cat([rows, actor(n["pi"], rows)], 1)).mean())
            with torch.no_grad():
                for name in ("pi", "q"):
                    online = [x.detach() for x in n[name]]
                    torch._foreach_lerp_(n[f"{name}_t"], online, p["target_rate"])
                online = [x.detach() for x in n["pi"]]
                torch._foreach_lerp_(n["pi_mean"], online, p["average_rate"])

    def _set_learning_rate(self, done: float) -> None:
        """Set the learning rate for a share of all steps that is done."""
        p = HYPER_PARAMETERS
        left = min(1.0, (1.0 - done) / p["decay_share"])
        rate = p["final_learning_rate"] + left * (p["learning_rate"] - p["final_learning_rate"])
        for optimiser in self.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = rate

    def _descend(self, name: str, loss: Tensor) -> None:
        self.optimisers[name].zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimisers[name].step()

    def run(self, seed: int, start: int, steps: int) -> Iterator[int]:
        """Train from one step to another; yield the step whenever an evaluation is due."""
        p, info = HYPER_PARAMETERS, info_of(self.environment)
        rng = np.random.default_rng([seed, start])
        replay = Replay(p["replay"], 2 * self.observations + self.actions + 2)
        simulator, length = make(self.environment), 0
        row = simulator.reset(int(rng.integers(2**31)))
        refill = p["refill"] if start else 0
        for step in range(start - refill, steps):
            if step < p["warm_up"] and not start:
                action = rng.uniform(-1, 1, self.actions).astype(np.float32)
            else:
                with torch.no_grad():
                    greedy = actor(self.networks["pi"], torch.from_numpy(row)[None])[0].numpy()
                noise = rng.normal(0, p["exploration_noise"], self.actions)
                action = np.clip(greedy + noise, -1, 1).astype(np.float32)
            following, reward, over = simulator.step(scaled(action, info))
            replay.add(row, following, action, [reward, over])
            row, length = following, length + 1
            if over or length >= info.episode_cap:
                # The client is kept while training: a fresh one costs as much as a hundred steps.
                row, length = simulator.reset(int(rng.integers(2**31))), 0
            if step >= max(start, p["warm_up"]):
                self._set_learning_rate(step / steps)
                batch = torch.from_numpy(replay.sample(p["batch"], rng))
                self.update(batch, policy_too=step % p["policy_delay"] == 0)
            if step >= start and ((step + 1) % p["evaluate_every"] == 0 or step + 1 == steps):
                yield step + 1
        simulator.close()
