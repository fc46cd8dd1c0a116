"""Building a leaderboard: seconds for the committed one, and for one of 60 primary rows.

The rows of the large board are those of the committed entries under other names, every value of
theirs shifted a little, so that no two are equal, on the splits of these. It is one entry, without
suites. Times are of all that ``leaderboard build`` does: entries are read from disk.

Run it with ``python benchmarks/bench_board.py [--rows N]``, from the root of a checkout.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

from oodd_eval.leaderboard.build import build, started, suite_parts
from oodd_eval.leaderboard.entry import ENTRY, read_entries
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.standings import SEEDS

COMMITTED = Path("leaderboard")

MOST = 10.0
"""Seconds of wall time in which the large board is to be built, on two idle cores."""


def enlarged(rows, target):
    """Write an entry with so many primary rows, each a detector of its own."""
    entries = read_entries(COMMITTED / "results")
    by_row = {}
    for entry in entries:
        for record in entry.records:
            by_row.setdefault((entry.meta.id, record.setting), []).append(record)
    able = [
        own
        for own in by_row.values()
        if len({r.seed for r in own}) >= SEEDS or all(r.deterministic for r in own)
    ]
    target.mkdir(parents=True)
    shutil.copy(entries[0].path / ENTRY, target)
    with (target / RECORDS).open("w") as file:
        for i in range(rows):
            for r in able[i % len(able)]:
                shift = 1e-3 * (1 + i // len(able))
                terms = {name: own * [[1 - shift], [1.0]] for name, own in r.per_trajectory.items()}
                own = {"detector": f"row-{i}", "overrides": {}, "per_trajectory": terms}
                file.write(dataclasses.replace(r, **own).to_json() + "\n")


def timed(place):
    """Build a directory's board once; return wall and CPU seconds, and wall seconds by part."""
    marks = [("reading", time.perf_counter())]
    cpu = _cpu()
    with tempfile.TemporaryDirectory() as output:
        suites = started(lambda: suite_parts(place))
        entries = read_entries(place / "results")
        build(
            entries,
            Path(output),
            suites,
            on_part=lambda name: marks.append((name, time.perf_counter())),
        )
    marks.append(("", time.perf_counter()))
    parts = {name: marks[i + 1][1] - at for i, (name, at) in enumerate(marks[:-1])}
    return marks[-1][1] - marks[0][1], _cpu() - cpu, parts


def _cpu():
    """Return CPU seconds of this process and of those that it has waited for."""
    spent = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(r.ru_utime + r.ru_stime for r in spent)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=60, help="primary rows (default: 60)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as large:
        # In a process of its own, whose records are gone before anything is timed.
        if (writer := os.fork()) == 0:
            enlarged(options.rows, Path(large) / "results" / "large")
            os._exit(0)
        if os.waitpid(writer, 0)[1]:
            return 1
        found = {}
        for name, place in {"committed": COMMITTED, "large": Path(large)}.items():
            wall, cpu, parts = found[name] = timed(place)
            shown = ", ".join(f"{part} {seconds:.1f}" for part, seconds in parts.items())
            print(f"{name:10} {wall:6.1f} s wall {cpu:6.1f} s CPU: {shown}", flush=True)
    wall = found["large"][0]
    ratio = found["large"][1] / found["committed"][1]
    print(f"{options.rows} rows take {ratio:.1f} times the CPU time; limit {MOST:g} s wall")
    return int(wall > MOST)


if __name__ == "__main__":
    sys.exit(main())
