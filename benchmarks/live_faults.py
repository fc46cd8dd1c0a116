"""Faults in the stream of a watchdog's sensors: found within 20 rows, the right sensor first.

``python benchmarks/live_faults.py [--env NAMES] [--detector pe-a] [--split mini] [--stamps]
[--kept DIR]``, about a minute an environment; with ``--kept`` the fitted watchdogs are saved there
and taken from there.

A watchdog for one nominal episode in twenty is fitted to the split. Each of its first ten twins
then gets each fault at three times (never in its last 25 rows), in sensors drawn anew that vary in
training. Printed are the shares that raise an alarm within 20 rows, of those the shares in which a
faulty sensor is named first (where the fault is of sensors), and the share of twins without a fault
that raise one. With ``--stamps`` the watchdog is told time stamps, too. Exit code 1 below 90 %
(sensors that are swapped need not be named: neither is broken).
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from oodd_live import Watchdog
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.names import select

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers_live import FAULTS, SENSOR_FAULTS, first_alarm, rows_of, with_fault

TIMES = 3
LEAST = 0.9


RATE = 50.0  # observations a second


def watchdog_of(environment, detector, kept, split="mini", **promise):
    """Return a fitted watchdog, kept or new."""
    other = [Path(split).name] if split != "mini" else []
    name = "-".join([*other, detector, environment, *map(str, promise.values())])
    place = kept and kept / name
    if place and place.exists():
        return Watchdog.load(place)
    data = load_split(split).environment(environment)
    made = Watchdog.fit(
        detector, data.train, data.calibration, rate=RATE, sensors=data.sensors, **promise
    )
    if place:
        made.save(place)
    return made


def measured(environment, detector, kept, split, stamps):
    """Return, by fault, the shares of alarms and of right names; and the false alarms."""
    watchdog = watchdog_of(environment, detector, kept, split)
    twins = list(load_split(split).environment(environment).twins)[:10]
    rate = RATE if stamps else None
    rows = np.concatenate([x.observations for x in twins])
    moving = [d for d in range(rows.shape[1]) if len(np.unique(rows[:, d])) > 8]
    false = np.mean([first_alarm(watchdog, rows_of(x, rate)) is not None for x in twins])
    shares = {}
    for kind in FAULTS:
        rng, found, named = np.random.default_rng(7), [], []
        for x in twins:
            for _ in range(TIMES if len(x) > 60 else 1):
                at = int(rng.integers(min(30, len(x) // 3), max(31, len(x) - 25)))
                stream, sensors = with_fault(kind, x, at, moving, rng, rate)
                reading = first_alarm(watchdog, stream[: at + 20])
                if reading is not None and reading.t < at:
                    continue  # a false alarm, which is counted above
                found.append(reading is not None)
                if reading and kind in SENSOR_FAULTS:
                    named.append(reading.sensor in {watchdog.sensors[d] for d in sensors})
        shares[kind] = np.mean(found), np.mean(named) if named else np.nan
    return shares, false


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="all")
    parser.add_argument("--detector", default="pe-a")
    parser.add_argument("--split", default="mini")
    parser.add_argument("--stamps", action="store_true")
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    table, worst = [], 1.0
    for environment in select("environment", options.env, ENVIRONMENTS):
        shares, false = measured(
            environment, options.detector, options.kept, options.split, options.stamps
        )
        cells = [
            f"{100 * f:.0f}" + ("" if np.isnan(n) else f" / {100 * n:.0f}")
            for f, n in shares.values()
        ]
        table.append([environment, *cells, f"{100 * false:.0f}"])
        named = [n for kind, (_, n) in shares.items() if kind != "swapped" and not np.isnan(n)]
        worst = min(worst, *(f for f, _ in shares.values()), *named)
        print(table[-1], flush=True)
    print(tabulate(table, ["", *FAULTS, "false"], tablefmt="github"))
    return int(worst < LEAST)


if __name__ == "__main__":
    sys.exit(main())
