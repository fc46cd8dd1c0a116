"""Why RIQN stays behind its own network without quantiles: scores that can be made of one fit.

``python benchmarks/riqn_scores.py [--fits DIR] [--env NAMES]``, fifteen minutes on one core.

RIQN's score is the mean distance of what came to samples of the predicted distribution, E|o - X|.
That has two parts: how surprising o is, and how wide the distribution is, which an anomaly need not
change. Beside it stand

- CRPS, E|o - X| - E|X - X'| / 2: the width subtracted, the proper score of a distribution;
- median, |o - median(X)|: the distance to a point forecast from the same samples.

The same for NPN, whose X are the five members' forecasts. Matched AUC (%), mean over the eight
anomalies, and the mean of a score on nominal calibration trajectories, in standard deviations of a
sensor: how good the forecast is. Mini split, horizon 1, detector seed 0. Nothing here enters a
detector: to choose by these numbers would be tuning on test data.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from oodd_npn import npn
from oodd_riqn import riqn
from oodd_torch.forecast import Forecaster, arrange
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.metrics.auc import auc_same_times
from oodd_eval.names import select
from oodd_eval.plugins.state import pack, read_state, write_state

SCORES = ("E|o - X|", "CRPS", "median")
DETECTORS = {"riqn": (riqn, 8), "npn": (npn, 1)}
"""Factory, and samples of each member."""


def fitted(name, data, environment, fits):
    """Return a fitted detector, restored where there is a fit and kept where fits are."""
    detector = DETECTORS[name][0](seed=0, horizon=1)
    place = fits / name / f"{environment}.npz" if fits else None
    if place and place.exists():
        detector.restore(read_state(place).state())
        return detector
    detector.fit(list(data.train))
    if place:
        write_state(place, pack(detector.state()))
    return detector


@torch.no_grad()
def three_scores(detector, samples, trajectory):
    """Return the scores of a trajectory, arrays of shape (T + 1,) in the order of `SCORES`."""
    network, scale = detector.network_, detector.scale_
    rows = scale(trajectory)
    forecaster = Forecaster(network, horizon=1, samples=samples, mean_sampling=False, seed=0)
    x = arrange([rows[:-1]], 1).expand(network.members, -1, -1, -1)
    drawn, _ = forecaster.forecast(x, network.start(1), range(1, len(rows)))
    drawn = np.sort(drawn[:, :, 0].permute(1, 3, 0, 2).flatten(2).numpy(), axis=2)  # (T, D, E M)
    truth = rows[1:, :, None]
    distance = np.abs(truth - drawn).mean(2)
    n = drawn.shape[2]
    # Of sorted values, the sum of all distances between pairs is a weighted sum.
    width = 2 * (drawn * (2 * np.arange(n) - n + 1)).sum(2) / n**2
    median = np.abs(truth[..., 0] - np.median(drawn, axis=2))
    found = (distance, distance - width / 2, median)
    return [np.concatenate([[np.nan], each.mean(1)]) for each in found]


def matched_auc(scores, twins, effects):
    """Return the mean over trajectories of the AUC from the effect on."""
    both = zip(scores, twins, effects, strict=True)
    return np.mean([auc_same_times(s, t, e, min(len(s), len(t))) for s, t, e in both])


def evaluated(data, detector, samples):
    """Return matched AUCs (%) and nominal means of every score."""

    def scored(trajectories):
        return list(zip(*(three_scores(detector, samples, t) for t in trajectories), strict=True))

    twins = scored(data.twins)
    cells = []
    for anomaly in TABLE1:
        group = data.anomalous(anomaly)
        pairs = zip(scored(group), twins, strict=True)
        effects = list(group.effects)
        cells.append([matched_auc(s, t, effects) for s, t in pairs])
    nominal = [np.nanmean(np.concatenate(scores)) for scores in scored(data.calibration)]
    return [*(100 * np.mean(cells, axis=0)), *nominal]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fits", type=Path, metavar="DIR", help="keep the fits here")
    parser.add_argument("--env", default="all", metavar="NAMES")
    options = parser.parse_args()
    torch.set_num_threads(1)
    split = load_split("mini")
    header = ["", *(f"AUC {s}" for s in SCORES), *(f"nominal {s}" for s in SCORES)]
    for name, (_, samples) in DETECTORS.items():
        table = []
        for environment in select("environment", options.env, ENVIRONMENTS):
            data = split.environment(environment)
            detector = fitted(name, data, environment, options.fits)
            table.append([environment, *evaluated(data, detector, samples)])
        table.append(["mean", *np.mean([row[1:] for row in table], axis=0)])
        print(name)
        print(tabulate(table, header, floatfmt=("", *[".1f"] * 3, *[".3f"] * 3)), flush=True)


if __name__ == "__main__":
    main()
