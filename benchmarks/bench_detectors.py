"""Speed and memory of detectors on one core, beside the processor's peak, and with large data.

``python benchmarks/bench_detectors.py [--split mini] [--env hopper] [--detector NAMES]
[--wide NAMES] [--shape NAMES] [--param K=V]``, some seconds a row on an idle core, a minute with
networks.

Each row has a process of its own, so that its memory is its own, too. Times are of the processor,
which other work on the machine slows less than the clock's. Operations are those of the products
with the matrices that a fit keeps; the peak is that of large products in double precision in the
same minute. A detector streams a row as a block of several, which is what makes its bits those of
the batch.

The second table has episodes of other shapes: by default 20 of 200 rows and 1 000 sensors;
``--shape all --wide panel`` also has 20 of 500 rows and 52 sensors, and 10^6 rows of 8 sensors.
Exit code 1 when a fit takes longer, or the process has more memory, than `SHAPES` allows.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import time

import numpy as np
from tabulate import tabulate

from oodd_eval import Trajectory, load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.names import select
from oodd_eval.plugins.contract import make_detector
from oodd_eval.plugins.discovery import discover

ROWS = "panel,mewma,pe,pca,knn,deedee,rnd,paano"
MANY = "panel,mewma,pca,knn,deedee,rnd,paano"
USES = {"loadings": 2, "components": 2}
"""How often a row is multiplied by an array of a state, where that is not once."""
UNUSED = ("prior", "tails")
"""Parts of names of arrays that no row is multiplied by."""
SHAPES = {
    "52-sensors": (52, 20, 500, 30.0, 1000.0),
    "1000-sensors": (1000, 20, 200, 120.0, 2000.0),
    "million-rows": (8, 1000, 1000, 300.0, 1500.0),
}
"""Sensors, episodes, rows of each, and most seconds of a fit and megabytes of its process."""


def peak():
    """Return operations per second of large matrix products in double precision."""
    a = np.random.default_rng(0).normal(size=(768, 768))
    start = time.process_time()
    for _ in range(5):
        a @ a
    return 5 * 2 * 768**3 / (time.process_time() - start)


def arrays(state, prefix=""):
    """Yield the arrays of a state with their names, nested ones too."""
    for name, value in state.items():
        if isinstance(value, dict):
            yield from arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray):
            yield prefix + name, value


def operations(detector):
    """Return operations of the matrix products that judge a row."""
    total = 0
    for name, array in arrays(detector.state()):
        if array.ndim < 2 or array.dtype.kind != "f" or any(part in name for part in UNUSED):
            continue
        uses = USES.get(name.rpartition(".")[2], 1)
        total += 2 * (detector.window if name.startswith("filters.") else uses) * array.size
    return total


def timed(detector, nominal, twins):
    """Return seconds of a fit, microseconds of a row in batch, and of streamed ones."""
    start = time.process_time()
    detector.fit(nominal)
    fit = time.process_time() - start
    start = time.process_time()
    for x in twins:
        detector.score(x)
    batch = (time.process_time() - start) / sum(map(len, twins)) * 1e6
    waits = []
    for x in twins[:2]:
        detector.reset()
        for observation, action in zip(x.observations, [None, *x.actions], strict=True):
            start = time.process_time()
            detector.update(observation, action)
            waits.append(1e6 * (time.process_time() - start))
    return fit, batch, float(np.median(waits)), float(np.quantile(waits, 0.99))


def unfitted(name, parameters):
    """Return an unfitted detector, and whether it sees actions."""
    spec = discover().offer(name).spec
    fields = getattr(spec.parameters, "__dataclass_fields__", {})
    known = {key: value for key, value in parameters.items() if key in fields}
    detector = make_detector(spec.factory, seed=0, horizon=1, parameters=known)
    return detector, spec.inputs != "observations"


def measured(split, environment, name, parameters):
    """Return the row of one detector in one environment."""
    data = load_split(split).environment(environment)
    detector, actions = unfitted(name, parameters)
    nominal, twins = (
        [x if actions else x.without_actions() for x in part] for part in (data.train, data.twins)
    )
    rate = peak()
    fit, batch, median, slow = timed(detector, nominal, twins)
    count = operations(detector)
    share = count / (batch * 1e-6) / (0.5 * (rate + peak()))
    held = sum(a.nbytes for _, a in arrays(detector.state())) / 1e6
    return [environment, name, fit, batch, count / 1e6, share, median, slow, held, megabytes()]


def large(shape, name, parameters):
    """Return the row of one detector with a shape: slow walks of a few causes, and noise."""
    rng = np.random.default_rng(0)
    d, count, n, *_ = SHAPES[shape]
    mixing = rng.normal(size=(20, d)) / 10
    rows = (
        np.cumsum(rng.normal(size=(n, 20)), axis=0) @ mixing + rng.normal(size=(n, d))
        for _ in range(count)
    )
    episodes = [Trajectory(x.astype(np.float32), np.zeros((n - 1, 0), np.float32)) for x in rows]
    detector, _ = unfitted(name, parameters)
    return [shape, name, *timed(detector, episodes, episodes[:2]), megabytes()]


def megabytes():
    """Return the largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def pair(text):
    """Return the name and the value of a parameter."""
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="mini", help="name or path")
    parser.add_argument("--env", default="hopper", help="names or globs of environments, or none")
    parser.add_argument("--detector", default=ROWS, help="names or globs of detectors")
    parser.add_argument("--wide", default=MANY, help="those with other shapes, or none")
    parser.add_argument("--shape", default="1000-sensors", help="names of shapes, or all")
    parser.add_argument("--param", type=pair, action="append", default=[], metavar="K=V")
    args = parser.parse_args()
    names, many = (
        [] if chosen == "none" else discover().select(chosen)
        for chosen in (args.detector, args.wide)
    )
    chosen = [] if args.env == "none" else select("environment", args.env, ENVIRONMENTS)
    times = ["fit, s", "batch, us a row"]
    streamed = ["streamed, us", "99 %, us"]
    heads = ["", "", *times, "MFLOP a row", "of peak", *streamed, "state, MB", "process, MB"]
    parameters = dict(args.param)
    shapes = select("shape", args.shape, SHAPES) if many else []
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        rows = [
            pool.apply(measured, (args.split, e, name, parameters))
            for e in chosen
            for name in names
        ]
        form = ("", "", ".2f", ".0f", ".2f", ".2f", ".0f", ".0f", ".2f", ".0f")
        print(tabulate(rows, heads, floatfmt=form), flush=True)
        lots = [pool.apply(large, (s, name, parameters)) for s in shapes for name in many]
    form = ("", "", ".1f", ".0f", ".0f", ".0f", ".0f")
    print("\n" + tabulate(lots, ["", "", *times, *streamed, "process, MB"], floatfmt=form))
    return any(row[2] > SHAPES[row[0]][-2] or row[-1] > SHAPES[row[0]][-1] for row in lots)


if __name__ == "__main__":
    sys.exit(main())
