"""Progress of training: matched AUC and held-out loss against the number of updates.

``python benchmarks/riqn_updates.py [--split mini] [--env all] [--updates 250,800,2500]``, one
core. One fit per environment and number of updates, detector seed 0, Δ = 1. The loss is that on the
nominal trajectories that training does not see, as a multiple of the loss after the most updates:
1.02 is two per cent above it. Matched AUC (%) is the mean over the eight anomalies, for the paper's
score (riqn) and for the median forecast in nominal distances (riqn-r) of the same fit.
"""

import argparse
import time

import numpy as np
import torch
from oodd_riqn import riqn, riqn_r
from riqn_scores import matched_auc
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.names import select


def auc_of(detector, data):
    """Return the mean over anomalies of matched AUC (%)."""
    twins = detector.score_many(list(data.twins))
    cells = []
    for anomaly in TABLE1:
        group = data.anomalous(anomaly)
        effects = [max(e, 1) for e in group.effects]
        cells.append(matched_auc(detector.score_many(list(group)), twins, effects))
    return 100 * np.mean(cells)


def measured(data, updates):
    """Return held-out loss, matched AUC of both scores, and CPU seconds of a fit."""
    start = time.process_time()
    detector = riqn(seed=0, horizon=1, updates=updates).fit(list(data.train))
    seconds = time.process_time() - start
    other = riqn_r(seed=0, horizon=1, updates=updates)
    other.restore(detector.state())
    loss = np.mean(detector.history_[-1])
    return loss, auc_of(detector, data), auc_of(other, data), seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="mini", metavar="NAME")
    parser.add_argument("--env", default="all", metavar="NAMES")
    parser.add_argument("--updates", default="250,800,2500", metavar="NUMBERS")
    options = parser.parse_args()
    torch.set_num_threads(1)
    split = load_split(options.split)
    steps = sorted(int(n) for n in options.updates.split(","))
    found = []
    for environment in select("environment", options.env, ENVIRONMENTS):
        data = split.environment(environment)
        found.append(np.array([measured(data, n) for n in steps]))
        found[-1][:, 0] /= found[-1][-1, 0]
        rows = [[n, *row] for n, row in zip(steps, found[-1], strict=True)]
        header = [environment, "loss", "riqn", "riqn-r", "fit (s)"]
        print(tabulate(rows, header, floatfmt=("", ".3f", ".1f", ".1f", ".0f")), flush=True)
    mean = np.mean(found, axis=0)
    mean[:, 0] = np.exp(np.mean(np.log([f[:, 0] for f in found]), axis=0))
    rows = [[n, *row] for n, row in zip(steps, mean, strict=True)]
    header = ["mean", "loss", "riqn", "riqn-r", "fit (s)"]
    print(tabulate(rows, header, floatfmt=("", ".3f", ".1f", ".1f", ".0f")))


if __name__ == "__main__":
    main()
