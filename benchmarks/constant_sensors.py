"""Thresholds at 5 % where sensors that never varied in training vary in calibration.

``python benchmarks/constant_sensors.py SPLIT [--env halfcheetah] [--draws 10] [--episodes 40]``,
about a minute a draw. The split has more nominal episodes than a draw takes, such as

    oodd-eval data build pool --train 160 --calibration 80 --test 10 --cap 300 --seed-base 811 \\
        --env halfcheetah

Each draw takes so many episodes for training, and as many for calibration, out of both parts.
Printed are the sensors that are constant in training, those of them that change in calibration, in
how many episodes, and the threshold of `pe-a`. Exit code 1 where one is 6 or more.
"""

import argparse
import sys

import numpy as np
import torch
from oodd_pe import PeParameters, make_pe
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.plugins.forecasting import CONSTANT

LARGEST = 6.0


def draw(pool, number, episodes, updates):
    """Return the row of one draw."""
    order = np.random.default_rng([911, number]).permutation(len(pool))
    training, calibration = (
        [pool[i] for i in part] for part in np.split(order[: 2 * episodes], [episodes])
    )
    rows = np.concatenate([x.observations for x in training]).astype(np.float64)
    constant = rows.std(axis=0) < CONSTANT
    changes = [
        np.abs(x.observations[:, constant] - rows.mean(axis=0)[constant]) > CONSTANT
        for x in calibration
    ]
    sensors = np.any([c.any(axis=0) for c in changes], axis=0).sum()
    detector = make_pe("pe-a", seed=0, updates=updates).fit(training)
    largest = sorted(np.nanmax(detector.score(x)) for x in calibration)
    threshold = largest[int(np.ceil((episodes + 1) * 0.95)) - 1]
    return [number, constant.sum(), sensors, sum(c.any() for c in changes), threshold]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("split")
    parser.add_argument("--env", default="halfcheetah")
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--updates", type=int, default=PeParameters().updates)
    options = parser.parse_args()
    torch.set_num_threads(1)
    data = load_split(options.split).environment(options.env)
    pool = [*data.train, *data.calibration]
    table = [draw(pool, n, options.episodes, options.updates) for n in range(options.draws)]
    heads = ["draw", "constant sensors", "changing", "episodes with a change", "threshold at 5 %"]
    print(tabulate(table, heads, floatfmt=".2f", tablefmt="github"))
    return int(max(row[-1] for row in table) >= LARGEST)


if __name__ == "__main__":
    sys.exit(main())
