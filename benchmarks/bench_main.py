"""The README's main command of two checkouts, in turns: seconds of processors and of the clock.

``python benchmarks/bench_main.py OLD NEW [--rounds 1] [--command "run --detector ..."]``, where OLD
and NEW are two programs ``oodd-eval``, each of an environment of its own. Each run has a results
directory that is new and goes afterwards. A machine is quick at one time and slow at another, so
read the ratios: of a round, the new program's seconds over the old one's. Exit code 1 where a run
fails.
"""

import argparse
import os
import resource
import shlex
import statistics
import subprocess
import sys
import tempfile
import time

from tabulate import tabulate

COMMAND = "run --detector panel,riqn,mewma --env all"


def measured(program, command):
    """Return seconds of all its processes and of the clock, most megabytes of one, exit code."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as output:
        words = [program, *shlex.split(command), "--output", output, "-q"]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, wall, used.ru_maxrss / 1024, code


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("programs", nargs=2, metavar="PROGRAM")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--command", default=COMMAND)
    options = parser.parse_args()
    rounds, table, failed = [], [], False
    for number in range(options.rounds):
        pair = [measured(program, options.command) for program in options.programs]
        rounds.append([new / old for old, new in zip(*(run[:2] for run in pair), strict=True)])
        for program, run in zip(options.programs, pair, strict=True):
            table.append([number + 1, program, *run])
            failed |= run[-1] != 0
    heads = ["round", "program", "processors, s", "clock, s", "largest process, MB", "exit code"]
    print(tabulate(table, heads, floatfmt=".1f"))
    cpu, wall = (statistics.median(ratios) for ratios in zip(*rounds, strict=True))
    print(f"new over old, median of rounds: processors {cpu:.2f}, clock {wall:.2f}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
