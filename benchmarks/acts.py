"""What each act costs where nothing is wrong, and what it saves if it acts at a fault's effect.

    python benchmarks/acts.py --seeds 12 cartpole lunarlander

Mean returns, and in brackets how many episodes failed. *nominal* acts from row 50 on without any
fault. The faults are Table 1's, in the worlds those of the rung loss25.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import oodd_worlds
from oodd_common.naming import ReadingModel
from oodd_interventions.acts import ACTS
from oodd_interventions.loop import Loop, LoopPair, NamedParts
from oodd_recording.closed_loop import Setup, measure, record_anomalous, return_of
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of

from oodd_eval import Naming
from oodd_eval.data.facts import TABLE1
from oodd_eval.data.registry import anomaly_spec, register

BASE = 773_000_000
ROW = 50
WORLDS = json.loads((Path(oodd_worlds.__file__).parent / "ladder.json").read_text())
RUNG = "loss25"


def kinds_of(environment):
    """Return the strengths of an environment's faults of the dynamics by kind."""
    rungs = WORLDS.get(environment)
    kinds = dict.fromkeys(TABLE1) if rungs is None else rungs
    return {
        kind: rungs and rungs[kind]["rungs"][RUNG]["strength"]
        for kind in kinds
        if anomaly_spec(kind).group == "dynamics"
    }


def text_of(loop, episodes):
    """Return the mean return of episodes, and how many failed."""
    failures = sum(map(loop.failed, episodes))
    return f"{np.mean([*map(return_of, episodes)]):.1f} ({failures})"


def study(environment, seeds, base, names):
    """Print the lines of an environment."""
    policy, info = load_policy(environment), info_of(environment)
    if environment in WORLDS:
        measure(environment, policy)
    setup, twins, seed = Setup(environment, policy), [], base
    while len(twins) < seeds:
        twin = setup.record(seed)
        seed += 1
        if twin.trajectory.transitions > ROW:
            twins.append(twin)
    train = [setup.record(base - 1 - i).trajectory for i in range(20)]
    loop = Loop(setup, ReadingModel.fit(train))
    nobody = np.zeros(info.observation_dim)
    nothing = Naming(nobody, np.zeros(info.action_dim), np.full_like(nobody, np.nan))
    specs = [
        spec
        for spec in (*ACTS, *oodd_worlds.oodd_acts())
        if environment in spec.environments and spec.name in names
    ]
    cells = {
        kind: [
            LoopPair(
                kind, strength, "dynamics", twin, record_anomalous(setup, kind, strength, twin)
            )
            for twin in twins
        ]
        for kind, strength in kinds_of(environment).items()
    }
    columns = [text_of(loop, [pair.never for pair in pairs]) for pairs in cells.values()]
    print(f"| {environment} | act | nominal | {' | '.join(cells)} |")
    print(f"| {environment} | never | {text_of(loop, twins)} | {' | '.join(columns)} |")
    for spec in specs:
        named = {0: NamedParts(nothing, ROW)}
        forced = [
            loop.arm(
                LoopPair("", None, "dynamics", twin, twin),
                spec,
                ROW,
                lambda _, since, named=named: named.get(since),
                nominal=True,
            ).episode
            for twin in twins
        ]
        columns = [
            text_of(loop, [loop.oracle(pair, spec).episode for pair in pairs])
            for pairs in cells.values()
        ]
        line = f"{text_of(loop, forced)} | {' | '.join(columns)}"
        print(f"| {environment} | {spec.name} | {line} |", flush=True)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environments", nargs="+")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--base", type=int, default=BASE)
    parser.add_argument("--acts", nargs="+", default=["stop", "switch"])
    options = parser.parse_args()
    register([*oodd_worlds.oodd_environments(), *oodd_worlds.oodd_anomalies()])
    for environment in options.environments:
        study(environment, options.seeds, options.base, options.acts)


if __name__ == "__main__":
    main()
