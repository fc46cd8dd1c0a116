"""How often a scan calls an episode odd where none is, and which of the odd ones it finds.

``python benchmarks/scan_rates.py [--scans 200] [--fdr 0.1]`` draws largest statistics of n episodes
from known distributions. A fit knows their mean in the episodes that it is fitted on, and a
statistic is relative to that, in two passes of five fits as in a scan. First it prints the share of
scans with an odd episode among those that have none; then the multiple of the median of a further
episode that nine in ten scans call odd, where the others' are normal: 6 with a standard deviation
of 1.3.

``--data DIR [--recipe FILE] [--detector mahalanobis]`` draws from nominal episodes of logs; with
``--odd 0.33`` that share of each scan are anomalous ones. Each counts as a recording. Printed
are the share of scans with a call among those with nominal episodes alone and, of scans with odd
ones, the share of these among the k first of the ranking (k is their number), in its first fifth,
and surely odd, and the share of calls that are nominal. ``--robots`` does the same with three
synthetic robots, of whose odd episodes half miss a step and half have a shift.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from oodd_logs import scan_episodes
from oodd_logs.episodes import Episode
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.evidence import Peers, evidence_of
from oodd_logs.scanning.limits import FITS
from oodd_logs.scanning.logs import read_logs
from oodd_logs.scanning.outliers import ENOUGH, ODD_SHARE, q_values

FAMILIES = {
    "normal": lambda rng, n: np.abs(rng.normal(3, 1, n)),
    "Gumbel": lambda rng, n: 10 + rng.gumbel(size=n),
    "exponential": lambda rng, n: rng.exponential(size=n),
    "log-normal": lambda rng, n: rng.lognormal(sigma=1.0, size=n),
    "cube of exponential": lambda rng, n: rng.exponential(size=n) ** 3,
    "Pareto, exponent 3": lambda rng, n: 1 + rng.pareto(3, n),
    "Cauchy": lambda rng, n: np.abs(rng.standard_cauchy(n)),
}
SIZES = (8, 12, 20, 60, 200)


def relative(values, apart=()):
    """Return values over their mean in the episodes that their fit has seen."""
    kept = [i for i in range(len(values)) if i not in {*apart}]
    means = np.empty((FITS, len(values)))
    for k in range(FITS):
        fold = kept[k::FITS]
        means[k, :] = np.nan
        means[k, [*fold, *apart]] = values[[i for i in kept if i not in {*fold}]].mean()
    return np.nanmean(values / means, axis=0)


def odd(values, fdr):
    """Return whether each episode of a scan is surely odd."""
    n = len(values)
    peers = [Peers([j for j in range(n) if j != i], np.ones(n - 1)) for i in range(n)]
    nothing = np.zeros(n)
    statistics = relative(values)
    if n >= ENOUGH:
        _, excesses = evidence_of(statistics, nothing, nothing, peers)
        order = np.argsort(-excesses.max(axis=1), kind="stable")
        apart = order[: int(ODD_SHARE * n)].tolist()
        statistics = relative(values, apart)
    found, _ = evidence_of(statistics, nothing, nothing, peers)
    called = q_values(np.minimum(np.exp(-found.max(axis=1)), 1.0)) <= fdr
    return called & (called.mean() <= ODD_SHARE)


def false_share(draw, n, scans, fdr):
    """Return the share of scans without an odd episode in which one is called odd."""
    rngs = (np.random.default_rng([n, k]) for k in range(scans))
    return np.mean([odd(draw(rng, n), fdr).any() for rng in rngs])


def multiple(n, scans, fdr):
    """Return from which multiple of the median on nine in ten odd episodes are called odd."""
    for times in np.arange(1.5, 20, 0.5):
        called = 0
        for k in range(scans):
            nominal = np.random.default_rng([n, k]).normal(6, 1.3, n - 1)
            called += odd(np.append(nominal, times * np.median(nominal)), fdr)[-1]
        if called >= 0.9 * scans:
            return times
    return np.inf


def families(scans, fdr):
    """Print shares of false discoveries of known distributions."""
    print(f"share of scans with a false discovery, in %, of {scans} at {fdr}")
    print(f"{'':22}" + "".join(f"{n:>8}" for n in SIZES))
    for name, draw in FAMILIES.items():
        shares = [false_share(draw, n, scans, fdr) for n in SIZES]
        print(f"{name:22}" + "".join(f"{100 * share:8.1f}" for share in shares))
    times = [multiple(n, scans // 4, fdr) for n in SIZES[:-1]]
    print("multiple of the median" + "".join(f"{value:8.1f}" for value in times))


def bump(rows, at, width):
    """Return a smooth peak of height 1."""
    return np.exp(-(((np.arange(rows) - at) / width) ** 2))


def arm(rng, skips):
    """Return an arm that turns a screw: angle, speed and torque, whose peak a skip lacks."""
    rows, start = 200, rng.integers(60, 90)
    speed = bump(rows, start, 25) * rng.normal(1, 0.05)
    torque = 0.4 * speed + (not skips) * bump(rows, start + 50, 6) * rng.normal(1.5, 0.12)
    return np.column_stack([np.cumsum(speed) / 40, speed, torque])


def gripper(rng, skips):
    """Return a gripper that grasps and lifts: opening, force and height; a skip lifts nothing."""
    rows, at = 240, rng.integers(60, 100)
    closed = (not skips) * bump(rows, at + 40, 30) ** 0.5
    force = closed * rng.normal(2, 0.15)
    height = np.sin((np.arange(rows) - at) / 30)
    return np.column_stack([0.08 - 0.06 * closed, force, height])


def carrier(rng, skips):
    """Return a vehicle that charges at the end: speed, current and voltage; a skip does not."""
    rows, charge = 300, rng.integers(200, 230)
    speed = np.sin(np.arange(rows) / 20 + rng.normal(0, 0.3)) * (np.arange(rows) < charge)
    current = -np.abs(speed) + (not skips) * 1.2 * (np.arange(rows) > charge)
    return np.column_stack([speed, current, 24 + np.cumsum(current) / 200])


ROBOTS = {"arm": arm, "gripper": gripper, "carrier": carrier}


def robot(make, seed, count=200):
    """Return nominal and odd episodes of a robot; of the odd ones every other misses a step."""
    rng = np.random.default_rng(seed)
    parts = [], []
    for i in range(2 * count):
        is_odd = i >= count
        rows = make(rng, is_odd and i % 2 == 0)
        noise = rng.normal(size=rows.shape)
        for t in range(1, len(rows)):
            noise[t] += 0.7 * noise[t - 1]
        rows = rows + 0.02 * np.abs(rows).max(axis=0) * noise
        if is_odd and i % 2:
            sensor, start = rng.integers(rows.shape[1]), rng.integers(60, 140)
            rows[start:, sensor] += 0.35 * np.ptp(rows[:, sensor])
        name = f"{'skip' if is_odd and i % 2 == 0 else 'shift' if is_odd else 'nominal'}-{i}"
        nothing = np.empty((len(rows) - 1, 0))
        parts[is_odd].append(Episode(name, name, rows, nothing, None))
    return parts


def read(folder, recipe):
    """Return nominal and anomalous episodes of logs, sensors, and the number of baseline rows."""
    home = None if recipe is None else folder
    logs = read_logs(folder, None if recipe is None else Recipe.load(recipe), home=home)
    parts = [], []
    for episode in logs.episodes:
        is_odd = bool(episode.kind or episode.intervals or episode.outcome is False)
        parts[is_odd].append(replace(episode, recording=None))
    return *parts, logs.sensors, logs.baseline


def draws(nominal, anomalous, options, share, **arguments):
    """Print what scans of some of the episodes find."""
    called, found = [], []
    size = min(options.episodes, len(nominal))
    count = min(round(share * size), len(anomalous))
    for k in range(options.scans):
        rng = np.random.default_rng([k, count])
        some = [nominal[i] for i in rng.permutation(len(nominal))[: size - count]]
        others = [anomalous[i] for i in rng.permutation(len(anomalous))[:count]]
        scan = scan_episodes([*some, *others], detector=options.detector, fdr=options.fdr,
                             **arguments)  # fmt: skip
        called.append(bool(scan.odd))
        places = np.array([one.position for one in scan.episodes[len(some) :]])
        if count:
            sure = np.array([one.odd for one in scan.episodes])
            true = sure[len(some) :].sum()
            found.append(
                (
                    (places <= count).mean(),
                    (places <= np.ceil(size / 5)).mean(),
                    true / count,
                    1 - true / max(1, sure.sum()) if sure.any() else 0.0,
                )
            )
    line = f"{count:3} odd of {size}: scans with a call {100 * np.mean(called):5.1f} %"
    if found:
        first, fifth, sure, false = 100 * np.mean(found, axis=0)
        line += f", of the odd in the first k {first:.0f}, in the first fifth {fifth:.0f}, "
        line += f"surely {sure:.0f}; of the calls nominal {false:.0f} %"
    print(line, flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--fdr", type=float, default=0.1)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--recipe", type=Path)
    parser.add_argument("--match", default="", help="only episodes with this in their source")
    parser.add_argument("--robots", action="store_true")
    parser.add_argument("--detector", default="mahalanobis")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--odd", type=float, nargs="*", default=[0.0, 0.1, 0.2, 0.34])
    options = parser.parse_args()
    if not (options.data or options.robots):
        families(options.scans, options.fdr)
    for name, make in ROBOTS.items() if options.robots else ():
        print(name)
        parts = robot(make, 7)
        for share in options.odd:
            draws(*parts, options, share)
    if options.data:
        *parts, sensors, baseline = read(options.data, options.recipe)
        parts = [[e for e in part if options.match in e.source] for part in parts]
        for share in options.odd:
            draws(*parts, options, share, sensors=sensors, baseline=baseline)
    return 0


if __name__ == "__main__":
    sys.exit(main())
