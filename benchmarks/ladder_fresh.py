"""Measure what the policy keeps at each rung of the ladder on fresh seeds.

    python benchmarks/ladder_fresh.py --env cartpole,acrobot --episodes 200

prints, per environment, how many rungs keep a share inside their 95 % interval, and the rungs that
do not. Each interval is widened by 1.96 standard errors of the fresh mean, so that fewer than one
in twenty are outside by chance. Rungs of a kind share their seeds: those outside come in groups.
The exit code is 1 where fewer than nine in ten are inside. `--rung paper-whole` measures that rung.
"""

import argparse
import functools
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from oodd_recording.calibrate import kept_shares, measure, twins_of
from oodd_recording.closed_loop import return_of

from oodd_eval.data.condition import RUNGS, WHOLE, all_rungs_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.names import select

FIRST_SEED = 970_000_000  # the calibration's begin at 950 000 000


@functools.cache
def nominal_of(environment, count, *, whole):
    return twins_of(environment, FIRST_SEED, count, whole=whole)


def fresh(task):
    environment, kind, name, strength, count = task
    whole = name == WHOLE
    twins = nominal_of(environment, count, whole=whole)
    nominal = np.array([return_of(twin) for twin in twins])
    returns = np.array(measure(environment, kind, strength, twins, whole=whole))
    # The standard error of a fresh mean: the noise of the check itself is not the ladder's.
    error = (returns - nominal).std(ddof=1) / np.sqrt(count) / abs(nominal.mean())
    return environment, kind, name, float(kept_shares(returns, nominal)), float(error)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="all")
    parser.add_argument("--anomaly", default="all")
    parser.add_argument("--rung", default="kept*")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    inside, outside = {}, []
    names = select("rung", options.rung, [*RUNGS, WHOLE])
    tasks = [
        (e, kind, name, rung.strength, options.episodes)
        for e in select("environment", options.env, ENVIRONMENTS)
        for kind in select("anomaly", options.anomaly, ANOMALIES)
        for name, rung in all_rungs_of(e, kind).items()
        if name in names
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        for environment, kind, name, kept, error in pool.map(fresh, tasks):
            rung = all_rungs_of(environment, kind)[name]
            low, high = rung.kept_low - 1.96 * error, rung.kept_high + 1.96 * error
            inside.setdefault(environment, []).append(low <= kept <= high)
            if not low <= kept <= high:
                shown = f"{kept:.3f} not in {rung.kept_low:.3f} .. {rung.kept_high:.3f}"
                outside.append(f"{environment} {kind}@{name}: {shown}")
    for environment, found in inside.items():
        print(f"{environment}: {sum(found)} of {len(found)} rungs inside their interval")
    print("\n".join(outside))
    every = [one for found in inside.values() for one in found]
    return int(np.mean(every) < 0.9)


if __name__ == "__main__":
    sys.exit(main())
