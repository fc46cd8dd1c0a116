"""What a watchdog adds to a control loop at 50 Hz: milliseconds of `update`, and memory.

``python benchmarks/bench_live.py [--env hopper] [--detector panel,panel-linear,panel-a,pe,pe-a]
[--seconds 60] [--rate 50] [--busy N] [--kept DIR]``; ``panel-linear`` is ``panel`` with
``forecast=linear``. With ``--kept`` fitted watchdogs are saved there and taken from there.

A loop sleeps until the next row is due and hands it to the watchdog: twins of split mini, one after
the other, with a reset between them. Then 3000 rows come back to back: the limit that a processor
would set whose caches nobody else empties in the meantime. Both are measured as the machine is, and
again while N other processes multiply matrices, by default one a processor.

Machines differ, and so do their neighbours. So each row of the loop is followed, half an interval
later, by a hundred sums of ten numbers, and the table has medians and 99th percentiles in
milliseconds and in multiples of these.

Exit code 1 where no other process was started and more than one row of a hundred takes more than
1 ms at the rate, or where memory grows by more than 1 MB after the first quarter.
"""

import argparse
import contextlib
import itertools
import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import torch
from live_faults import watchdog_of
from tabulate import tabulate

from oodd_eval import load_split

ROWS = "panel,panel-linear,panel-a,pe,pe-a"
LIMIT = 1.0  # milliseconds, 99th percentile
BACK_TO_BACK = 3000  # rows
GROWTH = 1.0  # MB


def endless(episodes):
    """Yield whether an episode begins, and its next observation and action, over and over."""
    for x in itertools.cycle(episodes):
        actions = [None, *x.actions]
        for t, row in enumerate(zip(x.observations, actions, strict=True)):
            yield t == 0, row


def multiply():
    """Keep a processor and its caches busy."""
    a = np.random.default_rng(os.getpid()).normal(size=(512, 512))
    while True:
        a = np.tanh(a @ a)


@contextlib.contextmanager
def beside(processes):
    """Have other processes at work meanwhile."""
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=multiply, daemon=True) for _ in range(processes)]
    for other in others:
        other.start()
    time.sleep(3.0 * bool(others))  # until they have started
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.join()


def timed(call):
    """Return milliseconds of a call."""
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)


class Loop:
    """A watchdog in a loop over twins."""

    def __init__(self, watchdog, twins):
        self.watchdog, self.rows = watchdog, endless(twins)
        self.numbers = np.linspace(0.0, 1.0, 10)

    def update(self):
        """Return milliseconds of the next update."""
        first, row = next(self.rows)
        if first:
            self.watchdog.reset()
        return timed(lambda: self.watchdog.update(*row))

    def sums(self):
        """Add numbers, a hundred times."""
        for _ in range(100):
            np.add(self.numbers, self.numbers)

    def at(self, rate, seconds):
        """Return milliseconds of updates and of sums at a rate, and megabytes along the way."""
        updates, sums, memory, process = [], [], [], psutil.Process()
        due = time.perf_counter()
        for i in range(round(seconds * rate)):
            for waits, call in ((updates, self.update), (sums, lambda: timed(self.sums))):
                due += 0.5 / rate
                time.sleep(max(0.0, due - time.perf_counter()))
                waits.append(call())
            if i % max(1, round(seconds * rate / 4)) == 0:
                memory.append(process.memory_info().rss / 1e6)
        return updates, sums, memory[-1] - memory[min(1, len(memory) - 1)]

    def at_once(self):
        """Return milliseconds of updates and of sums that follow one another at once."""
        updates = [self.update() for _ in range(BACK_TO_BACK)]
        return updates, [timed(self.sums) for _ in range(BACK_TO_BACK)]


def cells(updates, sums):
    """Return median and 99th percentile, in milliseconds and in medians of the sums."""
    median, tail = np.quantile(updates, [0.5, 0.99])
    unit = np.median(sums)
    return [median, tail, median / unit, tail / unit]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="hopper")
    parser.add_argument("--detector", default=ROWS, help="names, separated by commas")
    parser.add_argument("--seconds", type=float, default=60.0, help="of a loop")
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--busy", type=int, default=os.cpu_count(), help="other processes; 0: none")
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    twins = list(load_split("mini").environment(options.env).twins)
    table, failed = [], False
    for name in options.detector.split(","):
        detector = name.removesuffix("-linear")
        linear = {"parameters": {"forecast": "linear"}} if name != detector else {}
        loop = Loop(watchdog_of(options.env, detector, options.kept, **linear), twins)
        for busy in sorted({0, options.busy}):
            with beside(busy):
                updates, sums, grown = loop.at(options.rate, options.seconds)
                hot = loop.at_once()
            table.append([name, busy, *cells(updates, sums), *cells(*hot), grown])
            failed |= not busy and (table[-1][3] > LIMIT or grown > GROWTH)
    times = ["median, ms", "99 %, ms", "median, x", "99 %, x"]
    at_once = ["at once: median, ms", *times[1:]]
    heads = [
        options.env,
        "busy",
        f"{options.rate:g} Hz: median, ms",
        *times[1:],
        *at_once,
        "MB more",
    ]
    print(tabulate(table, heads, floatfmt=("", "", *[".2f", ".2f", ".0f", ".0f"] * 2, "+.1f")))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
