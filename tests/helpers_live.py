"""Streams of rows as a robot's loop sees them, and faults in them."""

import numpy as np

from oodd_eval import Trajectory

SENSOR_FAULTS = ("nan", "infinite", "frozen", "swapped")
FAULTS = (*SENSOR_FAULTS, "silent", "lost", "dropped", "doubled", "late")


def rows_of(x, rate=None):
    """Arguments of `Watchdog.update` for each row, with time stamps where there is a rate."""
    rows = zip(x.observations, [None, *x.actions], strict=True)
    stamps = [(t / rate, (t - 1) / rate) if rate else (None, None) for t in range(len(x))]
    return [(o.copy(), a, *stamps[t]) for t, (o, a) in enumerate(rows)]


def with_fault(kind, x, at, sensors, rng, rate=None):
    """Rows of an episode with a fault from a row on, and the sensors whose fault it is."""
    rows, (d, e) = rows_of(x, rate), rng.choice(sensors, 2, replace=False)
    before, after = rows[:at], rows[at:]
    stuck = rows[at - 1][0][d]
    if kind in {"silent", "lost"}:
        gone = [kind == "silent" or i % 3 == 0 for i in range(len(after))]
        return before + [
            (None if g else o, *rest) for g, (o, *rest) in zip(gone, after, strict=True)
        ], set()
    if kind == "dropped":
        return before + [row for i, row in enumerate(after) if i % 3], set()
    if kind == "doubled":
        return before + [row for i, row in enumerate(after) for _ in range(1 + (i % 3 == 0))], set()
    if kind == "late":
        older = [rows[max(at + i - 3, 1)] for i in range(len(after))]
        return before + [
            (o, a, time, acted)
            for (o, _, time, _), (_, a, _, acted) in zip(after, older, strict=True)
        ], set()
    for o, *_ in after:
        if kind == "swapped":
            o[[d, e]] = o[[e, d]]
        else:
            o[d] = {"nan": np.nan, "infinite": -np.inf, "frozen": stuck}[kind]
    return rows, {d, e} if kind == "swapped" else {d}


def first_alarm(watchdog, rows):
    """The reading of the first alarm, or None."""
    watchdog.reset()
    readings = (watchdog.update(*row) for row in rows)
    return next((reading for reading in readings if reading.alarm), None)


def walk(seed, rows=120, sensors=3, *, push=0.0, contact=False):
    """A stable nominal system that is pushed by its actions; with a contact that rarely changes."""
    rng = np.random.default_rng(seed)
    o, a = np.zeros((rows, sensors)), rng.normal(size=(rows - 1, 1))
    for t in range(1, rows):
        noise = 0.3 * rng.normal(size=sensors)
        o[t] = 0.9 * o[t - 1] + 0.5 * a[t - 1] + noise + push
    if contact:
        o[:, -1] = o[:, 0] > 0
        o[: rows // 2, -1] = 0.0
    return Trajectory(o, a)
