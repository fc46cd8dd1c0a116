"""What a watchdog adds to a control loop at 50 Hz: milliseconds of `update`, and memory.

``python benchmarks/bench_live.py [--env hopper] [--detector pe-a] [--minutes 10] [--rate 50]
[--kept DIR]``; with ``--kept`` the fitted watchdog is saved there and taken from there.

A loop sleeps until the next row is due and hands it to the watchdog: twins of split mini, one after
the other, with a reset between them. Then 3000 rows come back to back: the limit that a processor
would set whose caches nobody else empties in the meantime. Exit code 1 above 1 ms in more than one
row of a hundred at the rate, or where memory grows by more than 1 MB after the first minute.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import torch
from live_faults import watchdog_of

from oodd_eval import load_split

LIMIT = 1.0  # milliseconds, 99th percentile
BACK_TO_BACK = 3000  # rows
GROWTH = 1.0  # MB


def endless(episodes):
    """Yield whether an episode begins, and its next observation and action, over and over."""
    for x in itertools.cycle(episodes):
        actions = [None, *x.actions]
        for t, row in enumerate(zip(x.observations, actions, strict=True)):
            yield t == 0, row


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="hopper")
    parser.add_argument("--detector", default="pe-a")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    watchdog = watchdog_of(options.env, options.detector, options.kept)
    twins = list(load_split("mini").environment(options.env).twins)
    stream = endless(twins)
    process, memory, waits = psutil.Process(), [], []

    def updated():
        first, row = next(stream)
        if first:
            watchdog.reset()
        start = time.perf_counter()
        watchdog.update(*row)
        return 1e3 * (time.perf_counter() - start)

    due = time.perf_counter()
    for i in range(round(options.minutes * 60 * options.rate)):
        due += 1 / options.rate
        time.sleep(max(0.0, due - time.perf_counter()))
        waits.append(updated())
        if i % round(60 * options.rate) == 0:
            memory.append(process.memory_info().rss / 1e6)
    median, tail, worst = np.quantile(waits, [0.5, 0.99, 1.0])
    hot = np.quantile([updated() for _ in range(BACK_TO_BACK)], [0.5, 0.99])
    grown = memory[-1] - memory[min(1, len(memory) - 1)]
    print(f"{options.detector} on {options.env}, {len(waits)} updates at {options.rate:g} Hz:")
    print(f"  median {median:.2f} ms, 99 % {tail:.2f} ms, longest {worst:.2f} ms")
    print(f"  back to back: median {hot[0]:.2f} ms, 99 % {hot[1]:.2f} ms")
    print(f"  memory {memory[-1]:.0f} MB, {grown:+.1f} MB since the first minute")
    return int(tail > LIMIT or grown > GROWTH)


if __name__ == "__main__":
    sys.exit(main())
