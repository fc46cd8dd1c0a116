"""Train a linear policy that brakes a running robot and stands: random search in its weights.

    python benchmarks/standing.py hopper --iterations 84 --output first.npz
    python benchmarks/standing.py hopper --iterations 24 --start first.npz --output hopper.npz

Augmented random search (Mania, Guy & Recht 2018) from rows of the nominal policy, for 200 rows
under a push of all motors up to .4, motors with .6 to 1 of their power, or another gravity. A row
earns 1 while the robot is up, less its speed and its effort.
"""

import argparse

import numpy as np
from oodd_recording.environments import make
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of
from oodd_recording.values import spread_of

ROWS = 200
STARTS = 24
EPISODES = 6  # of a direction
DIRECTIONS = 12
KEPT = 6  # directions that move the policy
SIZE = 0.15  # of a direction
RATE = 0.06
EVERY = 4  # iterations from a validation to the next
SEED = 66_000_000


class Start:
    """A running robot that standing begins from, again and again."""

    def __init__(self, environment, seed, rows):
        policy = load_policy(environment)
        self.simulator = make(environment)
        self.row, over = self.simulator.reset(seed), False
        while rows and not over:
            self.row, _, over = self.simulator.step(policy.act(self.row))
            rows -= 1
        robot = self.simulator.env.robot
        self.client, self.power = self.simulator.env._p, robot.power
        self.state, self.contacts = self.client.saveState(), robot.feet_contact.copy()

    def reward(self, gain, constant, fault):
        """Return the mean reward of a row."""
        robot, actions = self.simulator.env.robot, len(constant)
        self.client.restoreState(self.state)
        self.client.setGravity(0, 0, -9.8 * fault["gravity"])
        robot.feet_contact[:], robot.power = self.contacts, self.power * fault["power"]
        row, total = self.row, 0.0
        for _ in range(ROWS):
            command = np.clip(gain @ row + constant, -1, 1)
            pushed = np.clip(command + fault["push"], -1, 1).astype(np.float32)
            row, _, over = self.simulator.step(pushed)
            if over:
                break
            effort = 0.03 * np.mean(command**2)
            speeds = np.mean(np.abs(row[9 : 9 + 2 * actions : 2]))
            total += 1.0 - 0.15 * min(abs(row[3]) * 3.33, 3) - effort - 0.05 * speeds
        return total / ROWS


def drawn(rng):
    """Return a fault, or none."""
    kind, fault = rng.random(), {"power": 1.0, "gravity": 1.0, "push": 0.0}
    if kind < 0.4:
        fault["push"] = rng.uniform(-0.4, 0.4)
    elif kind < 0.55:
        fault["power"] = rng.uniform(0.6, 1.0)
    elif kind < 0.65:
        fault["gravity"] = rng.uniform(0.95, 1.08)
    return fault


def train(environment, iterations, first):
    """Return the best weights of standardized sensors and 1, (A, D + 1), and the spread."""
    rng, info = np.random.default_rng(5), info_of(environment)
    starts = [Start(environment, SEED + i, int(rng.integers(60, 400))) for i in range(STARTS)]
    spread = np.maximum(spread_of(environment), 1e-2)
    used = np.append(spread > 1.001e-2, [True])
    weights = np.zeros((info.action_dim, info.observation_dim + 1))
    for j in range(info.action_dim):
        weights[j, 8 + 2 * j : 10 + 2 * j] = np.array([-0.5, -0.3]) * spread[8 + 2 * j : 10 + 2 * j]
    if first is not None:
        weights[:, :-1], weights[:, -1] = first["a0"].T * spread, first["b0"]

    def value(weights, cases):
        rewards = [s.reward(weights[:, :-1] / spread, weights[:, -1], fault) for s, fault in cases]
        return np.mean(rewards)

    validation = [(start, drawn(rng)) for start in starts]
    best = -np.inf, weights
    for iteration in range(1, iterations + 1):
        numbers = rng.choice(STARTS, EPISODES, replace=False)
        cases, tried = [(starts[i], drawn(rng)) for i in numbers], []
        for _ in range(DIRECTIONS):
            direction = rng.normal(size=weights.shape) * used
            ends = [value(weights + sign * SIZE * direction, cases) for sign in (1, -1)]
            tried.append((*ends, direction))
        deviation = np.std([ends for *ends, _ in tried]) + 1e-6
        tried.sort(key=lambda ends: -max(ends[:2]))
        step = sum((a - b) * direction for a, b, direction in tried[:KEPT]) / KEPT / deviation
        weights = weights + RATE * step
        if iteration % EVERY == 0:
            best = max(best, (value(weights, validation), weights), key=lambda pair: pair[0])
            print(iteration, round(best[0], 3), flush=True)
    return best[1], spread


def main():
    """Train, and write the policy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", choices=["hopper", "walker2d"])
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--start", type=np.load, help="policy that it goes on from")
    parser.add_argument("--output", required=True)
    options = parser.parse_args()
    weights, spread = train(options.environment, options.iterations, options.start)
    gain = np.round((weights[:, :-1] / spread).T, 5)
    np.savez(options.output, steps=np.array([0]), a0=gain, b0=np.round(weights[:, -1], 5))


if __name__ == "__main__":
    main()
