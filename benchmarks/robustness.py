"""Hostile plug-ins, malformed inputs, kills, full disks and pipes, played and counted.

Every case is a command in a process of its own. It breaks something when it prints a traceback,
does not end, ends by a signal or an internal error, takes gigabytes, loses a result of another
detector, sends control characters to a terminal, or leaves a process, a file or a directory behind.
The generators are those of ``tests/helpers_robustness.py``, of which ``pytest -m attacks`` plays a
sample.

Run it with ``python benchmarks/robustness.py [--jobs 2] [--seed 1] [--only FAMILY,...]``; all take
about ten minutes on two cores. It prints what broke, and a line a family, and exits with 1 where
anything did.
"""

import argparse
import itertools
import shutil
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import helpers_robustness as robustness

FILES, KILLS = 110, 40


def families(seed):
    """Return the cases of each family, by name."""
    named = {
        "hostile plug-ins": robustness.hostile_runs(seed),
        "files": robustness.damaged_files(FILES, seed),
        "logs": robustness.IMPORTS,
        "pipes": robustness.pipes(),
        "configurations": robustness.CONFIGURATIONS,
        "metadata": robustness.DISTRIBUTIONS[seed % 4 :: 4],
        "terminal": robustness.TERMINAL,
        "kills": robustness.kills(KILLS, seed),
        "full disks": robustness.FULL,
    }
    if not robustness.can_mount():
        print("full disks: left out, as this user may not mount any")
        del named["full disks"]
    if not shutil.which("bwrap"):
        boxed = {"run --sandbox", "rerun"}
        for family in named.keys() & {"kills", "full disks"}:
            named[family] = [case for case in named[family] if case.command not in boxed]
    return named


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time (default: 2)")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (default: 1)")
    parser.add_argument("--only", default="", help="families, separated by commas")
    options = parser.parse_args()
    numbers, broken = itertools.count(), 0
    with tempfile.TemporaryDirectory() as directory:
        home = Path(directory)
        (home / "ground").mkdir()
        ground = robustness.Ground(home / "ground")

        def played(case):
            try:
                return case, case.play(ground, home / f"case-{next(numbers)}")
            except Exception:  # noqa: BLE001  a case that cannot be played holds nothing
                return case, [traceback.format_exc()]

        lines = []
        for family, cases in families(options.seed).items():
            if options.only and family not in options.only.split(","):
                continue
            begun, wrong, count = time.monotonic(), 0, 0
            with ThreadPoolExecutor(options.jobs) as pool:
                for case, problems in pool.map(played, cases):
                    count += len(getattr(case, "names", [case]))
                    wrong += bool(problems)
                    for problem in problems:
                        print(f"{case.name}\n  {problem}", flush=True)
            seconds = time.monotonic() - begun
            lines.append(f"{family:18} {count:4} cases, {wrong:3} broken, {seconds:5.0f} s")
            print(lines[-1], flush=True)
            broken += wrong
    print("\n" + "\n".join(lines))
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
