"""Cost of groups apart: a plain run beside one with larger groups, and a sandboxed one by rows.

``python benchmarks/bench_isolation.py [--jobs N] [DETECTOR ...]`` (default rf, npn and riqn) first
fits and scores hopper of split mini, in turns, as a run does and with each part as one group: more
forks and smaller batches come on top of the work itself. Then it scores all of mini row by
row with a quick ``pe-a``, each group in a fresh sandbox; the fits are excluded. Exit code 1 when
the plain runs cost more than 10 % of all together, or the sandboxed one takes more than five
minutes on as many cores.
"""

import argparse
import sys
import tempfile
import time
from unittest.mock import patch

from oodd_leaderboard.sandbox.launcher import Sandbox

from oodd_eval import evaluate, load_split
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring import unit
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

MOST = 1.10
MOST_SECONDS = 300.0
ROUNDS = 2
ROWS = {"detector": "pe-a", "parameters": {"updates": 50}}


def whole(sizes):
    """Return groups as if there was no reason for any: each part is one."""
    return [[unit.Member(part, i) for i in range(n)] for part, n in sizes.items() if n]


def timed(detector, *, apart):
    start = time.perf_counter()
    with patch.object(unit, "groups", unit.groups if apart else whole):
        records = evaluate(detector, environments="hopper")
    assert all(r.ok for r in records), records[0].reason
    return time.perf_counter() - start


def plain_runs(detectors):
    """Compare a run with the work itself, and return the ratio."""
    total = {True: 0.0, False: 0.0}
    for detector in detectors:
        seconds = {True: [], False: []}
        for turn in range(ROUNDS):
            for apart in (turn % 2 == 0, turn % 2 == 1):
                seconds[apart].append(timed(detector, apart=apart))
        best = {apart: min(times) for apart, times in seconds.items()}
        total = {apart: total[apart] + best[apart] for apart in total}
        ratio = best[True] / best[False]
        print(f"{detector}: apart {best[True]:.1f} s, together {best[False]:.1f} s, {ratio:.3f}")
    return total[True] / total[False]


def rows_in_sandboxes(jobs):
    """Score all of mini row by row in sandboxes, with fits of a run before; return the seconds."""
    split, plugins = load_split("mini"), discover()
    plan = make_plan(
        plugins, split=split, detectors=[ROWS["detector"]], environments=[*split.environments],
        parameters=ROWS["parameters"],
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as path:
        results = ResultsDirectory(path)
        for settings in (
            RunSettings(jobs=jobs),
            RunSettings(jobs=jobs, streamed=True, limits=Limits(3600), launcher=Sandbox(())),
        ):
            start = time.perf_counter()
            records = run(plan, split, plugins, settings, results).records
            seconds = time.perf_counter() - start
            assert all(r.ok for r in records), records[0].reason
    steps = sum({r.environment: r.steps_scored for r in records}.values())
    spent = sum({r.environment: r.seconds_score for r in records}.values())
    print(f"rows of mini in sandboxes: {seconds:.0f} s with {jobs} jobs, {steps} rows, "
          f"{1e6 * spent / steps:.0f} us of the detector's a row")  # fmt: skip
    return seconds


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("detector", nargs="*", default=["rf", "npn", "riqn"])
    arguments = parser.parse_args()
    ratio = plain_runs(arguments.detector)
    print(f"all: ratio {ratio:.3f}, at most {MOST}")
    seconds = rows_in_sandboxes(arguments.jobs)
    return int(ratio > MOST or seconds > MOST_SECONDS)


if __name__ == "__main__":
    sys.exit(main())
