"""How long nominal scores stay below the thresholds of bounds on run lengths, and of calibration.

``python benchmarks/run_lengths.py [--split NAME] [--detector NAMES] [--env NAMES]`` prints the
table of docs/run-length.md. A Shiryaev-Roberts sum or an e-detector that exceeds A takes
A rows on average or more, if the factors of nominal scores have expectation 1 given the scores
before. Streams of normal scores, independent or autoregressive, begin anew until the sum exceeds A,
and their mean number of rows is divided by A. Scores of detectors are those of nominal episodes
that the basis (mean and standard deviation, or ranks) is not from: their rows are divided by their
alarms, a sum begins anew with every episode and after every alarm, and ratios are those of all
environments together.

Beside them stands the calibrated threshold at 5 %, as the A that it amounts to, and the share of
further nominal episodes that alarm at it: of normal scores episodes of 300 rows, 39 to calibrate,
mean of 200 calibrations; of detectors the twins of the split.
"""

import argparse
import math
import sys
from itertools import islice
from statistics import NormalDist

import numpy as np

from oodd_eval import load_split
from oodd_eval.metrics.accumulation import BETS, SHIFT, accumulated, basis_of
from oodd_eval.metrics.alarms import Calibration
from oodd_eval.plugins.contract import make_detector, score_chunk
from oodd_eval.plugins.discovery import discover

KINDS = {"shiryaev-roberts": "Shiryaev-Roberts", "e-detector": "e-detector"}
BOUNDS = (100, 1000)
LEVEL = 0.05
ROWS = 300
CALIBRATIONS = 200
CAP = 20
"""Rows, in units of A, after which a stream ends: its run length is then at least that."""

HEADER = [
    "scores", "statistic", *(f"run length / {bound}" for bound in BOUNDS),
    f"A at {100 * LEVEL:g} %", "episodes with an alarm",
]  # fmt: skip


def autoregressive(rng, phi, streams, z=None):
    """Return the next standard normal score of each stream."""
    noise = rng.normal(size=streams)
    return noise if z is None else phi * z + math.sqrt(1 - phi**2) * noise


def ranks(z):
    """Return the ranks of standard normal scores among infinitely many."""
    return np.vectorize(NormalDist().cdf, otypes=[float])(z)


def next_sums(kind, sums, z):
    """Return the logarithms of 1 + R after the next score of each stream: (bets or 1, streams)."""
    if kind == "shiryaev-roberts":
        return np.logaddexp(0.0, sums + SHIFT * z - SHIFT**2 / 2)
    return np.logaddexp(0.0, sums + np.log1p(np.array(BETS)[:, None] * (ranks(z) - 0.5)))


def run_length_ratio(kind, phi, bound, streams, seed=0):
    """Return the mean run length over the bound, and the share of streams that never ended."""
    rng, z = np.random.default_rng([seed, bound]), None
    lengths = np.full(streams, float(CAP * bound))
    sums = np.zeros((len(BETS) if kind == "e-detector" else 1, streams))
    index = np.arange(streams)
    for t in range(1, CAP * bound + 1):
        z = autoregressive(rng, phi, len(index), z)
        sums = next_sums(kind, sums, z)
        ends = np.expm1(sums).mean(axis=0) > bound
        if ends.any():
            lengths[index[ends]] = t
            index, sums, z = index[~ends], sums[:, ~ends], z[~ends]
            if not len(index):
                break
    return lengths.mean() / bound, len(index) / streams


def normal_episodes(rng, phi, count):
    rows, z = [], None
    for _ in range(ROWS):
        z = autoregressive(rng, phi, count, z)
        rows.append(z)
    return list(np.array(rows).T)


def calibrated(kind, calibration, test):
    """Return the A of the threshold at the level, and how many of further episodes exceed it."""
    rule = Calibration.fit(calibration, kind).rule(LEVEL)
    return math.expm1(rule.threshold), sum(rule.first(scores) is not None for scores in test)


def of_normal(kind, phi, streams, calibrations):
    """Return the cells of a line on autoregressive scores."""
    ratios = []
    for bound in BOUNDS:
        ratio, unfinished = run_length_ratio(kind, phi, bound, streams)
        ratios.append(f"{'> ' if unfinished else ''}{ratio:.2f}")
    rng = np.random.default_rng(1)
    draws = [
        calibrated(kind, normal_episodes(rng, phi, 39), normal_episodes(rng, phi, 20))
        for _ in range(calibrations)
    ]
    heights, alarms = np.array(draws).T
    share = alarms.sum() / (20 * calibrations)
    return [*ratios, f"{np.median(heights):.3g}", f"{100 * share:.1f} %"]


def alarms_of(kind, episodes, basis, bound):
    """Return the number of alarms of episodes when a sum begins anew after each."""
    count, height = 0, math.log1p(bound)
    for scores in episodes:
        x = basis(scores)
        start = 0
        while start < len(x):
            above = accumulated(kind, x[start:]) > height
            if not above.any():
                break
            count += 1
            start += int(above.argmax()) + 1
    return count


def of_scores(kind, parts):
    """Return the cells of a line on scores of a detector: (calibration, twins) by environment."""
    ratios, rows = [], 0
    counts = dict.fromkeys(BOUNDS, 0)
    heights, alarms, judged = [], 0, 0
    for calibration, twins in parts:
        basis = basis_of(kind, calibration[0::2])
        held_out = [*calibration[1::2], *twins]
        rows += sum(np.count_nonzero(~np.isnan(scores)) for scores in held_out)
        for bound in BOUNDS:
            counts[bound] += alarms_of(kind, held_out, basis, bound)
        height, exceeding = calibrated(kind, calibration, twins)
        heights.append(height)
        alarms, judged = alarms + exceeding, judged + len(twins)
    for bound, count in counts.items():
        ratios.append(f"{rows / count / bound:.2f}" if count else f"> {rows / bound:.2f}")
    span = f"{min(heights):.2g} to {max(heights):.2g}"
    return [*ratios, span, f"{100 * alarms / judged:.1f} % ({alarms} of {judged})"]


def scored(spec, split, environments, limit):
    """Yield the scores of calibration episodes and twins of each environment."""
    with split.opened() as opened:
        for name in environments:
            data = opened(name)
            parts = (data.train, data.calibration, data.twins)
            train, *others = ([*islice(part, limit)] for part in parts)
            if spec.inputs == "observations":
                train, *others = ([x.without_actions() for x in part] for part in (train, *others))
            detector = make_detector(spec.factory, seed=0, horizon=1, parameters={})
            detector.fit(train)
            yield tuple(score_chunk(detector, part) for part in others)


def autocorrelation(parts):
    """Return the mean correlation of a score with the one before, within episodes."""
    values = []
    for calibration, _ in parts:
        for scores in calibration:
            z = scores[~np.isnan(scores)]
            if len(z) > 2 and z[:-1].std() > 0 and z[1:].std() > 0:
                values.append(np.corrcoef(z[:-1], z[1:])[0, 1])
    return float(np.mean(values))


def table(options):
    yield HEADER
    yield ["---"] * len(HEADER)
    for phi in (0.0, 0.5, 0.9):
        name = f"AR(1), φ = {phi:g}" if phi else "independent normal"
        for kind, title in KINDS.items():
            yield [name, title, *of_normal(kind, phi, options.streams, options.calibrations)]
    plugins, split = discover(), load_split(options.split)
    chosen = options.env.split(",") if options.env else [*split.environments]
    for name in filter(None, options.detector.split(",")):
        parts = [*scored(plugins.offer(name).spec, split, chosen, options.limit)]
        label = f"`{name}`, φ = {autocorrelation(parts):.2f}"
        for kind, title in KINDS.items():
            yield [label, title, *of_scores(kind, parts)]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--split", default="mini")
    parser.add_argument("--detector", default="persistence,mahalanobis,mewma,pe")
    parser.add_argument("--env", default="")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--streams", type=int, default=2000)
    parser.add_argument("--calibrations", type=int, default=CALIBRATIONS)
    for line in table(parser.parse_args()):
        print("| " + " | ".join(line) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
