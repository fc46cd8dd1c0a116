"""Faults in the stream of a watchdog's sensors: found within 20 rows, the right sensor first.

``python benchmarks/live_faults.py [--env NAMES] [--detector pe-a] [--kept DIR]``, about a minute an
environment; with ``--kept`` the fitted watchdogs are saved there and taken from there.

A watchdog for one nominal episode in twenty is fitted to split mini. Each of the ten twins then
gets each fault at three times (never in its last 25 rows), in sensors drawn anew that vary in
training. Printed are the shares that raise an alarm within 20 rows, of those the shares in which a
faulty sensor is named first (where the fault is of sensors), and the share of twins without a fault
that raise one. Exit code 1 below 90 %, or above the alarms that one in twenty allows.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.live import Watchdog
from oodd_eval.names import select

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers_live import FAULTS, SENSOR_FAULTS, first_alarm, rows_of, with_fault

TIMES = 3
LEAST = 0.9


def watchdog_of(environment, detector, kept, **promise):
    """Return a fitted watchdog, kept or new."""
    place = kept and kept / "-".join([detector, environment, *map(str, promise.values())])
    if place and place.exists():
        return Watchdog.load(place)
    data = load_split("mini").environment(environment)
    made = Watchdog.fit(detector, data.train, data.calibration, sensors=data.sensors, **promise)
    if place:
        made.save(place)
    return made


def measured(environment, detector, kept):
    """Return, by fault, the shares of alarms and of right names; and the false alarms."""
    watchdog, twins = (
        watchdog_of(environment, detector, kept),
        list(load_split("mini").environment(environment).twins),
    )
    rows = np.concatenate([x.observations for x in twins])
    moving = [d for d in range(rows.shape[1]) if len(np.unique(rows[:, d])) > 8]
    false = np.mean([first_alarm(watchdog, rows_of(x)) is not None for x in twins])
    shares = {}
    for kind in FAULTS:
        rng, found, named = np.random.default_rng(7), [], []
        for x in twins:
            for _ in range(TIMES if len(x) > 60 else 1):
                at = int(rng.integers(min(30, len(x) // 3), max(31, len(x) - 25)))
                stream, sensors = with_fault(kind, x, at, moving, rng)
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
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    table, worst = [], 1.0
    for environment in select("environment", options.env, ENVIRONMENTS):
        shares, false = measured(environment, options.detector, options.kept)
        cells = [f"{100 * f:.0f}" + ("" if np.isnan(n) else f" / {100 * n:.0f}")
                 for f, n in shares.values()]  # fmt: skip
        table.append([environment, *cells, f"{100 * false:.0f}"])
        worst = min(worst, *(v for pair in shares.values() for v in pair if not np.isnan(v)))
        print(table[-1], flush=True)
    print(tabulate(table, ["", *FAULTS, "false"], tablefmt="github"))
    return int(worst < LEAST)


if __name__ == "__main__":
    sys.exit(main())
