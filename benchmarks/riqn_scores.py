"""Why RIQN's score is not the best use of its samples: three scores of the same fits.

``python benchmarks/riqn_scores.py [--fits DIR] [--env NAMES]``, ten minutes on one core.

RIQN's score is the mean distance of what came to samples of the predicted distribution, E|o - X|.
That has two parts: how surprising o is, and how wide the distribution is, which an anomaly need not
change. Beside it stand

- CRPS, E|o - X| - E|X - X'| / 2: the width subtracted, the proper score of a distribution;
- median, |o - median(X)|: the distance to a point forecast from the same samples.

Matched AUC (%), mini split, horizon 1, detector seed 0, mean over the eight anomalies. Nothing here
enters a detector: choosing among them by these numbers would be tuning on test data.
"""

import argparse
import statistics
from pathlib import Path

import numpy as np
import torch
from oodd_riqn import riqn
from oodd_torch.forecast import Forecaster
from oodd_torch.training import arrange
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.benchmark import ANOMALIES, ENVIRONMENTS
from oodd_eval.metrics import auc_contributions
from oodd_eval.selection import select

SCORES = ("E|o - X|", "CRPS", "median")


def fitted(data, environment, fits):
    """Return a fit of riqn, loaded where there is one and kept where fits are."""
    detector = riqn(seed=0, horizon=1)
    place = fits / environment if fits else None
    if place and place.exists():
        detector.load(place)
        return detector
    detector.fit(list(data.train))
    if place:
        place.mkdir(parents=True)
        detector.save(place)
    return detector


@torch.no_grad()
def three_scores(detector, trajectory):
    """Return the scores of a trajectory, arrays of shape (T + 1,) in the order of `SCORES`."""
    network, scale = detector.network_, detector.scale_
    rows = scale(trajectory)
    forecaster = Forecaster.of(network, horizon=1, samples=8, mean_sampling=False, seed=0)
    x = arrange([[rows]], 1)[0].expand(network.members, -1, -1, -1)
    drawn, _ = forecaster.forecast(x, network.start(1), range(1, len(rows)))
    samples = np.sort(drawn[:, :, 0].permute(1, 3, 0, 2).flatten(2).numpy(), axis=2)  # (T, D, E M)
    truth = rows[1:, :, None]
    distance = np.abs(truth - samples).mean(2)
    n = samples.shape[2]
    # Of sorted values, the sum of all distances between pairs is a weighted sum.
    width = 2 * (samples * (2 * np.arange(n) - n + 1)).sum(2) / n**2
    median = np.abs(truth[..., 0] - np.median(samples, axis=2))
    found = (distance, distance - width / 2, median)
    return [np.concatenate([[np.nan], each.mean(1)]) for each in found]


def matched_auc(data, detector):
    """Return the mean over anomalies of the matched AUC, for every score."""
    cells = []
    twins = [three_scores(detector, twin) for twin in data.twins]
    for anomaly in ANOMALIES:
        group = data.anomalous(anomaly)
        scores = [three_scores(detector, trajectory) for trajectory in group]
        cells.append([
            auc_contributions(
                [s[i] for s in scores], [t[i] for t in twins], list(group.onsets)
            )["auc_matched"].value
            for i in range(len(SCORES))
        ])  # fmt: skip
    return np.mean(cells, axis=0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--fits", type=Path, metavar="DIR", help="load fits from here, or keep them"
    )
    parser.add_argument("--env", default="all", metavar="NAMES")
    options = parser.parse_args()
    torch.set_num_threads(1)
    split, table = load_split("mini"), []
    for environment in select("environment", options.env, ENVIRONMENTS):
        data = split.environment(environment)
        found = 100 * matched_auc(data, fitted(data, environment, options.fits))
        table.append([environment, *found])
        print(environment, *(f"{v:.1f}" for v in found), flush=True)
    table.append(
        ["mean", *(statistics.fmean(column) for column in list(zip(*table, strict=True))[1:])]
    )
    print(tabulate(table, ["", *SCORES], floatfmt=".1f"))


if __name__ == "__main__":
    main()
