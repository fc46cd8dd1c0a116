"""Progress of training: matched AUC and held-out loss against the number of updates.

``python benchmarks/riqn_updates.py [--split mini] [--env all] [--updates 250,800,2500]
[--members 5] [--seed 0]``, one core. One fit per environment, number of networks and number of
updates, Δ = 1. The loss is that on the nominal trajectories that training does not see, as a
multiple of the loss of the last row: 1.02 is two per cent above it. Matched AUC (%) is the mean
over the eight anomalies, for the paper's score (riqn) and for the median forecast in nominal
distances (riqn-r) of the same fit.
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


def measured(data, **parameters):
    """Return held-out loss, matched AUC of both scores, and CPU seconds of a fit."""
    start = time.process_time()
    detector = riqn(horizon=1, **parameters).fit(list(data.train))
    seconds = time.process_time() - start
    other = riqn_r(horizon=1, **parameters)
    other.restore(detector.state())
    loss = np.mean(detector.history_[-1])
    return loss, auc_of(detector, data), auc_of(other, data), seconds


def show(title, fits, figures):
    """Print a row of figures for each fit."""
    rows = [[f["members"], f["updates"], *row] for f, row in zip(fits, figures, strict=True)]
    header = [f"{title}: members", "updates", "loss", "riqn", "riqn-r", "fit (s)"]
    print(tabulate(rows, header, floatfmt=("", "", ".3f", ".1f", ".1f", ".0f")), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="mini", metavar="NAME")
    parser.add_argument("--env", default="all", metavar="NAMES")
    parser.add_argument("--updates", default="250,800,2500", metavar="NUMBERS")
    parser.add_argument("--members", default="5", metavar="NUMBERS")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    split = load_split(options.split)
    fits = [
        {"seed": options.seed, "members": members, "updates": updates}
        for members in sorted(int(n) for n in options.members.split(","))
        for updates in sorted(int(n) for n in options.updates.split(","))
    ]
    figures = []
    for environment in select("environment", options.env, ENVIRONMENTS):
        data = split.environment(environment)
        figures.append(np.array([measured(data, **parameters) for parameters in fits]))
        figures[-1][:, 0] /= figures[-1][-1, 0]
        show(environment, fits, figures[-1])
    mean = np.mean(figures, axis=0)
    mean[:, 0] = np.exp(np.mean(np.log([f[:, 0] for f in figures]), axis=0))
    show("mean", fits, mean)


if __name__ == "__main__":
    main()
