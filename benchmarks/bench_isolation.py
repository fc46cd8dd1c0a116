"""Cost of groups apart: a plain run beside one with larger groups, and a sandboxed one by rows.

``python benchmarks/bench_isolation.py [--rows] [DETECTOR ...]`` (default rf, npn and riqn, by rows
mewma, pe, panel, rf and riqn) first fits and scores hopper of split mini, in turns, as a run does
and with each part as one group: more forks and smaller batches come on top of the work itself. Then
it streams 16 episodes into fresh sandboxes, one after the other and in lockstep.
Exit code 1 when the plain runs cost more than 10 % of all together, or lockstep costs more than
one after the other.
"""

import argparse
import sys
import time
from contextlib import suppress
from unittest.mock import patch

import psutil
from oodd_leaderboard.sandbox.launcher import Sandbox

from oodd_eval import evaluate, load_split
from oodd_eval.plugins.contract import make_detector
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation import supervisor
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.state import pack
from oodd_eval.scoring import unit

MOST = 1.10
MOST_ROWS = 1.05
ROUNDS = 3
PLAIN = ("rf", "npn", "riqn")
STREAMED = ("mewma", "pe", "panel", "rf", "riqn")
EPISODES, ROWS = 16, 101


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


def state_of(name, episodes):
    """Return the request of a detector with a quick fit, and the state of that."""
    offer = discover().offer(name)
    known = getattr(offer.spec.parameters, "__dataclass_fields__", {})
    parameters = {"updates": 5} if "updates" in known else {}
    common = {"seed": 0, "horizon": 1, "parameters": parameters}
    detector = make_detector(offer.spec.factory, **common)
    detector.fit(episodes)
    return {"plugin": offer.plugin, "detector": name, **common}, pack(detector.state())


def processor():
    """Return processor seconds of this process and of those that it has started and that run."""
    spent = time.process_time()
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            spent += sum(child.cpu_times()[:2])
    return spent


def streamed(request, state, group, streams):
    """Return microseconds a row in a sandbox with so many streams, its seconds before, scores."""
    spent, stream = [], supervisor._UnitRun._stream

    def timed_stream(unit, *arguments):
        unit.streams = streams
        spent.append(processor())
        stream(unit, *arguments)
        spent.append(processor())

    start = processor()
    with patch.object(supervisor._UnitRun, "_stream", timed_stream):
        out = supervisor.run_isolated(
            request, [], [group], limits=Limits(3600), stop=lambda: False, launcher=Sandbox(()),
            state=state, streamed=True,
        )  # fmt: skip
    assert out.status == "ok", out.reason
    begun, ended = spent
    rows = sum(map(len, group))
    return 1e6 * (ended - begun) / rows, begun - start, [x.tobytes() for x in out.scores]


def streamed_rows(detectors):
    """Stream rows of one episode at a time and of all in lockstep; return the largest ratio."""
    data, ratios = load_split("mini").environment("hopper"), []
    nominal = [x.without_actions() for x in data.train]
    group = [x.without_actions()[:ROWS] for x in data.calibration][:EPISODES]
    for detector in detectors:
        request, state = state_of(detector, nominal)
        turns = [[streamed(request, state, group, n) for n in (1, EPISODES)] for _ in range(ROUNDS)]
        assert all(a[2] == b[2] for a, b in turns), f"{detector}: other scores in lockstep"
        one, all_ = (min(turn[i][0] for turn in turns) for i in (0, 1))
        fresh = min(run[1] for turn in turns for run in turn)
        ratios.append(all_ / one)
        print(f"{detector}: {one:.0f} us a row by itself, {all_:.0f} us in lockstep, "
              f"{ratios[-1]:.2f}; {fresh:.2f} s for a fresh sandbox")  # fmt: skip
    return max(ratios)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", action="store_true", help="only the streamed rows")
    parser.add_argument("detector", nargs="*")
    arguments = parser.parse_args()
    ratio = 0.0 if arguments.rows else plain_runs(arguments.detector or PLAIN)
    print(f"all: ratio {ratio:.3f}, at most {MOST}")
    return int(streamed_rows(arguments.detector or STREAMED) > MOST_ROWS or ratio > MOST)


if __name__ == "__main__":
    sys.exit(main())
