"""Speed and memory of the probabilistic ensemble on one core, beside the processor's peak.

``python benchmarks/bench_pe.py [--split mini] [--env NAMES] [--updates N]``, about a minute an
environment.

Fits `pe-a` to the split's training part, by as many updates as asked for, and scores its twins: in
batch, and streamed one observation at a time. The processor's peak is that of large matrix products
in the same minute, in single precision for the fit and in double for the scores, so that a busy
machine slows both alike: read the ratios.

What bounds the speed: in the fit, products of 3 x 256 rows with matrices of 128 x 128 and, where
there are many sensors, with the output layer, whose width grows with their square; as many
operations again make the momentum of the hidden layers orthogonal. In streaming, the calls.

Exit code 1 above 60 s of fit (for the default number of updates), 40 us a row in batch, 500 us a
streamed update, or 1 GB of memory.
"""

import argparse
import resource
import sys
import time

import numpy as np
import torch
from oodd_pe import PeParameters, make_pe
from oodd_pe.network import LAYERS
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.names import select

LIMITS = {"fit": 60.0, "batch": 40.0, "stream": 500.0, "memory": 1000.0}
NEWTON_SCHULZ = 5 * 3
"""Matrix products by which one momentum is made orthogonal."""


def peak(dtype):
    """Return floating-point operations per second of large matrix products."""
    a = torch.randn(768, 768, dtype=dtype)
    start = time.perf_counter()
    for _ in range(10):
        a @ a
    return 10 * 2 * 768**3 / (time.perf_counter() - start)


def flops(arrays, batch):
    """Return operations of judging a row, and of an update of all members."""
    hidden = [arrays[f"weights.{n}"].shape for n in range(LAYERS)]
    row = sum(2 * m * i * o for m, i, o in (*hidden, arrays["out"].shape))
    orthogonal = sum(2 * m * min(s) ** 2 * max(s) for m, *s in hidden) * NEWTON_SCHULZ
    return row, 3 * row * batch + orthogonal


def measured(split, environment, updates):
    """Return the row of one environment."""
    data = load_split(split).environment(environment)
    train, twins = list(data.train), list(data.twins)
    whole = PeParameters().updates
    start, rates = time.perf_counter(), [peak(torch.float32)]
    detector = make_pe("pe-a", seed=0, updates=updates, forecaster="ensemble").fit(train)
    fit = (time.perf_counter() - start) * whole / updates
    rates.append(peak(torch.float32))
    start = time.perf_counter()
    for x in twins:
        detector.score(x)
    rows = sum(map(len, twins))
    batch = (time.perf_counter() - start) / rows * 1e6
    double = peak(torch.float64)
    waits = []
    for x in twins[:3]:
        detector.reset()
        actions = [None, *x.actions]
        for observation, action in zip(x.observations, actions, strict=True):
            start = time.perf_counter()
            detector.update(observation, action)
            waits.append(time.perf_counter() - start)
    stream = 1e6 * float(np.median(waits))
    of_row, of_update = flops(detector.forecaster.chosen.ensemble_.arrays, PeParameters().batch)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    at_fit = of_update * whole / fit / np.mean(rates)
    at_batch = of_row / (batch * 1e-6) / double
    return [
        environment,
        fit,
        of_update / 1e9,
        at_fit,
        batch,
        of_row / 1e6,
        at_batch,
        stream,
        1e6 * float(np.quantile(waits, 0.99)),
        memory,
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="mini", help="name or path")
    parser.add_argument("--env", default="all", help="names or globs of environments")
    parser.add_argument("--updates", type=int, default=600, help="updates that are timed")
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = select("environment", args.env, ENVIRONMENTS)
    rows = [measured(args.split, e, args.updates) for e in chosen]
    heads = [
        "",
        "fit, s",
        "GFLOP an update",
        "of peak",
        "batch, us a row",
        "MFLOP a row",
        "of peak",
        "streamed, us",
        "99 %, us",
        "memory, MB",
    ]
    print(
        tabulate(
            rows,
            heads,
            floatfmt=("", ".0f", ".2f", ".2f", ".0f", ".2f", ".2f", ".0f", ".0f", ".0f"),
        )
    )
    worst = {"fit": 1, "batch": 4, "stream": 7, "memory": 9}
    above = [n for n, column in worst.items() if max(r[column] for r in rows) > LIMITS[n]]
    print("above the limit:", ", ".join(f"{n} ({LIMITS[n]:g})" for n in above) or "nothing")
    return bool(above)


if __name__ == "__main__":
    sys.exit(main())
