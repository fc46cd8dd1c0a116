"""Cost of scoring groups apart: a run as it is, beside one that scores everything together.

``python benchmarks/bench_isolation.py [DETECTOR ...]`` (default rf, npn and riqn): fits and scores
hopper of split mini, in turns, with all guards and without: one group, no prefixes scored again, no
actions withheld. The limit is the work of fitting and scoring itself; forks and smaller batches
come on top. Exit code 1 when the guards cost more than 10 % of all runs together.
"""

import sys
import time
from unittest.mock import patch

from oodd_eval import evaluate
from oodd_eval.scoring import unit

MOST = 1.10
ROUNDS = 2


def together(work):
    """Make a unit's work as it would be without any guard: one group of all, no prefixes."""
    everything = [probe for group in unit.groups(work._lengths) for probe in group]
    work._ordered = work._groups = [everything]
    work._probes, work._drawn = [], [0]
    work._visible = lambda trajectory: trajectory


def timed(detector, *, guarded):
    initial = unit.GroupedScoring.__init__

    def unguarded(work, *arguments):
        initial(work, *arguments)
        together(work)

    start = time.perf_counter()
    with patch.object(unit.GroupedScoring, "__init__", initial if guarded else unguarded):
        records = evaluate(detector, environments="hopper")
    assert all(r.ok for r in records), records[0].reason
    return time.perf_counter() - start


def main(detectors):
    total = {True: 0.0, False: 0.0}
    for detector in detectors:
        found = {True: [], False: []}
        for turn in range(ROUNDS):
            for guarded in (turn % 2 == 0, turn % 2 == 1):
                found[guarded].append(timed(detector, guarded=guarded))
        best = {guarded: min(seconds) for guarded, seconds in found.items()}
        total = {guarded: total[guarded] + best[guarded] for guarded in total}
        ratio = best[True] / best[False]
        print(f"{detector}: apart {best[True]:.1f} s, together {best[False]:.1f} s, {ratio:.3f}")
    ratio = total[True] / total[False]
    print(f"all: ratio {ratio:.3f}, at most {MOST}")
    return int(ratio > MOST)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or ["rf", "npn", "riqn"]))
