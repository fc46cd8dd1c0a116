"""Speed and memory of the rivals on one core, beside the processor's peak, and with 1 000 sensors.

``python benchmarks/bench_rivals.py [--split mini] [--env NAMES] [--detector NAMES]``, about two
minutes an environment on an idle core, most of it for the two that train networks.

Fits every rival to the split's training part and scores its twins: in batch, and streamed one
observation at a time. Operations are those of matrix products that judge a row; the peak is that
of large products in double precision in the same minute, so that a busy machine slows both alike.
Streamed, a row is multiplied as a block of eight, which is what makes its bits those of the batch.

The second table has 20 episodes of 200 rows and 1 000 sensors. Exit code 1 when a fit of it takes
more than two minutes or the process more than 2 GB.
"""

import argparse
import resource
import sys
import time

import numpy as np
import torch
from oodd_rivals import oodd_detectors
from tabulate import tabulate

from oodd_eval import Trajectory, load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.names import select

SPECS = {spec.name: spec for spec in oodd_detectors() if spec.inputs == "observations"}
USES = {"loadings": 2}
"""How often a row is multiplied by an array of a state, where that is not once."""
WIDE = {"sensors": 1000, "episodes": 20, "rows": 200}
MOST_SECONDS, MOST_MEGABYTES = 120.0, 2000.0


def peak():
    """Return operations per second of large matrix products in double precision."""
    a = np.random.default_rng(0).normal(size=(768, 768))
    start = time.perf_counter()
    for _ in range(5):
        a @ a
    return 5 * 2 * 768**3 / (time.perf_counter() - start)


def operations(detector):
    """Return operations of the matrix products that judge a row."""
    total = 0
    for name, array in detector.state().items():
        if isinstance(array, np.ndarray) and array.ndim == 2:
            uses = detector.window if name.startswith("filters.") else USES.get(name, 1)
            total += 2 * uses * array.size
    return total


def timed(detector, nominal, twins):
    """Return seconds of a fit, microseconds of a row in batch, and of streamed ones."""
    start = time.perf_counter()
    detector.fit(nominal)
    fit = time.perf_counter() - start
    start = time.perf_counter()
    for x in twins:
        detector.score(x)
    batch = (time.perf_counter() - start) / sum(map(len, twins)) * 1e6
    waits = []
    for x in twins[:2]:
        detector.reset()
        for observation in x.observations:
            start = time.perf_counter()
            detector.update(observation)
            waits.append(1e6 * (time.perf_counter() - start))
    return fit, batch, float(np.median(waits)), float(np.quantile(waits, 0.99))


def measured(split, environment, name):
    """Return the row of one detector in one environment."""
    data = load_split(split).environment(environment)
    nominal, twins = ([x.without_actions() for x in part] for part in (data.train, data.twins))
    detector = SPECS[name].factory(seed=0, horizon=1)
    rate = peak()
    fit, batch, median, slow = timed(detector, nominal, twins)
    count = operations(detector)
    held = sum(a.nbytes for a in detector.state().values() if isinstance(a, np.ndarray))
    share = count / (batch * 1e-6) / (0.5 * (rate + peak()))
    return [environment, name, fit, batch, count / 1e6, share, median, slow, held / 1e6]


def wide(name):
    """Return the row of one detector with many sensors: slow walks of a few causes, and noise."""
    rng = np.random.default_rng(0)
    d, n = WIDE["sensors"], WIDE["rows"]
    mixing = rng.normal(size=(20, d)) / 10
    rows = (
        np.cumsum(rng.normal(size=(n, 20)), axis=0) @ mixing + rng.normal(size=(n, d))
        for _ in range(WIDE["episodes"])
    )
    episodes = [Trajectory(x.astype(np.float32), np.zeros((n - 1, 0), np.float32)) for x in rows]
    detector = SPECS[name].factory(seed=0, horizon=1)
    figures = timed(detector, episodes, episodes[:2])
    return [name, *figures, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="mini", help="name or path")
    parser.add_argument("--env", default="all", help="names or globs of environments")
    parser.add_argument("--detector", default="all", help="names or globs of rivals")
    args = parser.parse_args()
    torch.set_num_threads(1)
    names = select("detector", args.detector, SPECS)
    times = ["fit, s", "batch, us a row"]
    streamed = ["streamed, us", "99 %, us"]
    heads = ["", "", *times, "MFLOP a row", "of peak", *streamed, "state, MB"]
    chosen = select("environment", args.env, ENVIRONMENTS)
    rows = [measured(args.split, e, name) for e in chosen for name in names]
    form = ("", "", ".2f", ".0f", ".2f", ".2f", ".0f", ".0f", ".2f")
    print(tabulate(rows, heads, floatfmt=form))
    many = [wide(name) for name in names]
    print("\n" + tabulate(many, ["", *times, *streamed, "process, MB"], floatfmt=".0f"))
    return any(row[1] > MOST_SECONDS or row[-1] > MOST_MEGABYTES for row in many)


if __name__ == "__main__":
    sys.exit(main())
