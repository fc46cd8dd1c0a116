"""Building a leaderboard: seconds for the committed entries, and for one of 60 primary rows.

The rows of the large board are those of the committed entries under other names, every value of
theirs shifted a little, so that no two are equal. Suites are left out.

Run it with ``python benchmarks/bench_board.py [--rows N]``, from the root of a checkout.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from pathlib import Path

from oodd_eval.leaderboard.build import build
from oodd_eval.leaderboard.entry import read_entries
from oodd_eval.results.tables.board import SEEDS

MOST = 10.0
"""Seconds of wall time in which the large board is to be built, on two idle cores."""


def enlarged(entries, rows):
    """Return entries with so many primary rows, each a detector of its own."""
    by_row = {}
    for entry in entries:
        for record in entry.records:
            by_row.setdefault((entry.meta.id, record.setting), []).append(record)
    able = [
        own
        for own in by_row.values()
        if len({r.seed for r in own}) >= SEEDS or all(r.deterministic for r in own)
    ]
    found = []
    for i in range(rows):
        for r in able[i % len(able)]:
            shift = 1e-3 * (1 + i // len(able))
            terms = {
                name: ([x * (1 - shift) for x in numerators], denominators)
                for name, (numerators, denominators) in r.per_trajectory.items()
            }
            found.append(
                dataclasses.replace(r, detector=f"row-{i}", overrides={}, per_trajectory=terms)
            )
    first = dataclasses.replace(entries[0], records=found, path=Path("large"))
    return [first]


def timed(entries):
    """Build once; return wall and CPU seconds, and wall seconds by part."""
    marks = []
    start, cpu = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as output:
        build(entries, Path(output), on_part=lambda name: marks.append((name, time.perf_counter())))
    end = time.perf_counter()
    stops = [at for _, at in marks[1:]] + [end]
    parts = {name: stop - at for (name, at), stop in zip(marks, stops, strict=True)}
    return end - start, time.process_time() - cpu, parts


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=60, help="primary rows (default: 60)")
    options = parser.parse_args()
    entries = read_entries("leaderboard/results")
    found = {}
    boards = {"committed": entries, "large": enlarged(entries, options.rows)}
    for name, board in boards.items():
        wall, cpu, parts = found[name] = timed(board)
        shown = ", ".join(f"{part} {seconds:.1f}" for part, seconds in parts.items())
        print(f"{name:10} {wall:6.1f} s wall {cpu:6.1f} s CPU: {shown}", flush=True)
    wall = found["large"][0]
    ratio = found["large"][1] / found["committed"][1]
    print(f"{options.rows} rows take {ratio:.1f} times the CPU time; limit {MOST:g} s wall")
    return int(wall > MOST)


if __name__ == "__main__":
    sys.exit(main())
