"""Building a leaderboard: seconds for the committed one, and for a large one with peak memory.

The rows of the large board are those of the committed entries on one split under other names,
every value of theirs shifted a little, so that no two are equal, and with three detector seeds
where seeds matter. They lie in entries of 32 rows, without suites. Times are of all that
``leaderboard build`` does: entries are read from disk.

Run it with ``python benchmarks/bench_board.py [--rows N] [--split NAME]``, from the root of a
checkout. ``--rows 300`` takes minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from pathlib import Path

from oodd_leaderboard.pages import build
from oodd_leaderboard.reported import ENTRY, read_entries, suite_sections

from oodd_eval.results.directory import RECORDS

SEEDS = 3  # detector seeds of a row

COMMITTED = Path("leaderboard")
ROWS = 32  # of an entry

LIMITS = {60: 30.0}
"""Seconds in which a large board of so many rows is to be built, on two idle cores."""

MEMORY = 2000.0
"""Megabytes that a board of 300 rows may take at most."""


def enlarged(rows, split, results):
    """Write entries with so many primary rows, each a detector of its own."""
    entries = [e for e in read_entries(COMMITTED / "results") if e.meta.split == split]
    by_row = {}
    for entry in entries:
        for record in entry.records:
            by_row.setdefault((entry.meta.id, record.setting), []).append(record)
    able = [
        records
        for records in by_row.values()
        if len({r.seed for r in records}) >= SEEDS or all(r.deterministic for r in records)
    ]
    for start in range(0, rows, ROWS):
        directory = results / f"large-{start}"
        directory.mkdir(parents=True)
        about = json.loads((entries[0].path / ENTRY).read_text())
        (directory / ENTRY).write_text(json.dumps(about | {"id": directory.name, "primary": []}))
        with (directory / RECORDS).open("w") as file:
            for i in range(start, min(start + ROWS, rows)):
                for r in able[i % len(able)]:
                    for seed in range(SEEDS) if r.deterministic else (r.seed,):
                        file.write(_shifted(r, i, seed, 1 + i // len(able)).to_json() + "\n")


def _shifted(record, i, seed, turn):
    scale = [[1 - 1e-3 * turn - 1e-4 * seed], [1.0]]
    terms = {name: pair * scale for name, pair in record.per_trajectory.items()}
    changes = {"detector": f"row-{i}", "overrides": {}, "seed": seed, "deterministic": False}
    return dataclasses.replace(record, per_trajectory=terms, **changes)


def timed(leaderboard, queue):
    """Build a directory's board once: wall and CPU seconds, megabytes, and seconds by part."""
    marks = [("reading", time.perf_counter())]
    with tempfile.TemporaryDirectory() as output:
        build(
            read_entries(leaderboard / "results"),
            Path(output),
            suite_sections(leaderboard),
            on_part=lambda name: marks.append((name, time.perf_counter())),
        )
    marks.append(("", time.perf_counter()))
    parts = {name: marks[i + 1][1] - at for i, (name, at) in enumerate(marks[:-1])}
    usage = resource.getrusage(resource.RUSAGE_SELF)
    seconds = marks[-1][1] - marks[0][1], usage.ru_utime + usage.ru_stime
    queue.put((*seconds, usage.ru_maxrss / 1000, parts))


def apart(function, *arguments):
    """Run a function in a process of its own, whose memory is counted from the start."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=function, args=(*arguments, queue))
    process.start()
    result = queue.get()
    process.join()
    return result


def write(rows, split, results, queue):
    """Write the entries of the large board."""
    queue.put(enlarged(rows, split, results))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=60, help="primary rows (default: 60)")
    parser.add_argument("--split", default="mini", help="split of the rows (default: mini)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as large:
        apart(write, options.rows, options.split, Path(large) / "results")
        for name, leaderboard in {"committed": COMMITTED, "large": Path(large)}.items():
            wall, cpu, memory, parts = apart(timed, leaderboard)
            text = ", ".join(f"{part} {seconds:.1f}" for part, seconds in parts.items())
            sizes = f"{wall:6.1f} s wall {cpu:6.1f} s CPU {memory:6.0f} MB"
            print(f"{name:10} {sizes}: {text}", flush=True)
    limit = LIMITS.get(options.rows)
    print(f"limits: {f'{limit:g} s wall' if limit else 'no time'}, {MEMORY:g} MB")
    return int(memory > MEMORY or (limit is not None and wall > limit))


if __name__ == "__main__":
    sys.exit(main())
