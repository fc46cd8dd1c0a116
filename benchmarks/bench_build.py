"""Recording: the share of a simulator's stepping rate that is left when trajectories are recorded.

For each environment the unit of a build's work is timed, a chunk of seeds: policy, fresh simulator
per episode, reset, anomalies, checks, stacking and writing. Against it, the same actions are
stepped through the bare simulator as its authors made it: one simulator, no policy, nothing kept,
its reset not counted.
Both are CPU time of this process and interleaved, so that a busy machine slows both alike.

Run it with ``python benchmarks/bench_build.py [--rounds N] [ENV ...]``; ENV may also be a world.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from oodd_recording.build import Chunk, record_chunk
from oodd_recording.environments import make
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of
from oodd_recording.simulator import quiet_streams
from oodd_worlds import oodd_anomalies, oodd_environments

from oodd_eval.data.condition import conditions_of
from oodd_eval.data.facts import ENVIRONMENTS, WORLDS
from oodd_eval.data.registry import register

FIRST_SEED = 990 * 10**6
SHARE = 0.75
"""Bounds for the four PyBullet robots."""


def recorded(environment, part, seed, work):
    """Record one seed as a build does; return steps, CPU seconds and the nominal actions."""
    policy = load_policy(environment).digest
    suite = "ladder" if environment in WORLDS else "table1"
    conditions = tuple(conditions_of(suite, environment).items()) if part == "test" else ()
    chunk = Chunk(environment, part, seed, 1, None, 0.0, conditions, None, policy, "")
    start = time.process_time()
    record_chunk(chunk, work)
    seconds = time.process_time() - start
    with np.load(work / chunk.file_name, allow_pickle=False) as stored:
        if not stored.files:
            return 0, seconds, None  # a test seed whose twin is too short
        steps = sum(int(stored[key].sum()) for key in stored.files if key.endswith(":lengths"))
        nominal = "test/nominal" if part == "test" else part
        return steps, seconds, stored[f"{nominal}:actions"]


def stepped(environment, seed, actions):
    """Step the bare simulator through an episode's actions; return CPU seconds."""
    simulator = type(make(environment).env)()
    with quiet_streams():
        simulator.reset(seed=seed)
    if info_of(environment).discrete:
        actions = actions.argmax(axis=1).tolist()
    step = simulator.step
    start = time.process_time()
    for action in actions:
        step(action)
    seconds = time.process_time() - start
    with quiet_streams():
        simulator.close()
    return seconds


def shares(environment, part, rounds):
    """Return rates of both in steps per CPU second and their ratio, medians over the rounds."""
    found = []
    with tempfile.TemporaryDirectory() as work:
        seed = FIRST_SEED
        while len(found) < rounds:
            seed += 1
            steps, seconds, actions = recorded(environment, part, seed, Path(work))
            if not steps:
                continue
            # An episode of a classic control problem is short: step it several times.
            times = max(1, 1000 // len(actions))
            bare = sum(stepped(environment, seed, actions) for _ in range(times)) / times
            found.append((steps / seconds, len(actions) / bare))
    own, simulators = (statistics.median(x) for x in zip(*found, strict=True))
    return own, simulators, statistics.median(a / b for a, b in found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("environments", nargs="*", default=list(ENVIRONMENTS), metavar="ENV")
    parser.add_argument("--rounds", type=int, default=7, help="seeds of each part (default: 7)")
    options = parser.parse_args()
    register([*oodd_environments(), *oodd_anomalies()])
    print(f"{'environment':12} {'part':6} {'recorded/s':>11} {'stepped/s':>11} {'share':>6}")
    low = []
    for environment in options.environments:
        for part in ("train", "test"):
            own, simulators, share = shares(environment, part, options.rounds)
            row = f"{environment:12} {part:6} {own:11.0f} {simulators:11.0f} {share:6.0%}"
            print(row, flush=True)
            if info_of(environment).family == "bullet" and share < SHARE:
                low.append(f"{environment} {part}")
    if low:
        print(f"below {SHARE:.0%}: {', '.join(low)}")
    return int(bool(low))


if __name__ == "__main__":
    sys.exit(main())
