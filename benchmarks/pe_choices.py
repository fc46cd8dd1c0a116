"""Results of each choice of the ensemble's statistic: charts learnt anew on the same networks.

``python benchmarks/pe_choices.py SPLIT [--env NAMES] [--fits DIR]``, half an hour for the split of
120 training episodes that the choices were made on (see detectors/pe/README.md).

Every variant has the networks of `pe-a`, seed 0, and changes one thing after them. Printed are
matched AUC (%), and sensor and dynamics anomalies found within 20 rows and missed at 5 % of nominal
episodes with an alarm, mean over environments and for LunarLander alone.
"""

import argparse
import math
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from oodd_pe import density, make_pe, rare, statistic
from oodd_pe.statistic import deviance
from tabulate import tabulate

from oodd_eval import DetectorSpec, evaluate, load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.names import select
from oodd_eval.plugins.state import pack, read_state, write_state

METRICS = ("auc_matched", "found_within_20_at_5pct", "missed_at_5pct")
VARIANTS = {
    "as it is": {},
    "no memory": {"memories": []},
    "shortest and longest memory only": {"memories": [0.01]},
    "steps at rest count fully": {"MOVEMENT": 0.0},
    "one scale for all tails": {"BINS": 1},
    "no energy": {"ENERGY": 0.0},
    "no rare events": {"rare": []},
    "sums without limit": {"RETURN": 2000},
    "scales wider than in training": {"wide": True},
    "8 degrees of freedom everywhere": {"BINS": 1, "nu": 8.0},
}


def fitted(environment, split, fits):
    """Return `pe-a` fitted, restored where there is a fit and kept where fits are."""
    detector = make_pe("pe-a", seed=0, forecaster="ensemble")
    place = fits and fits / f"{environment}.npz"
    if place and place.exists():
        detector.restore(read_state(place).state())
        return detector
    detector.fit(list(load_split(split).environment(environment).train))
    if place:
        write_state(place, pack(detector.state()))
    return detector


def spec(detector, change):
    """Return the spec of the detector with its charts learnt anew under a change."""

    class Variant:
        def __init__(self, *, seed, horizon):
            pass

        def fit(self, nominal):
            memories = change.get("memories", [0.3, 0.1, 0.03, 0.01])
            detector.charts_ = statistic.Charts(memories)
            detector.events_ = rare.RareEvents(change.get("rare", memories))
            pieces, folds = detector.pieces(nominal)
            detector.chart(pieces, detector.forecaster.chosen.out_of_fold(pieces, folds))

        def score(self, trajectory):
            return detector.score(trajectory)

    return DetectorSpec(
        name="variant", factory=Variant, summary="", alarm="score", inputs="observations+actions"
    )


def measured(detector, change, split, environment):
    """Return the figures of one variant: for each metric sensor and dynamics anomalies."""
    with ExitStack() as stack:
        for name in change.keys() & vars(statistic).keys():
            stack.enter_context(patch.object(statistic, name, change[name]))
        if nu := change.get("nu"):
            stack.enter_context(
                patch.object(density, "deviance", lambda e, t: deviance(e, t * 0 + math.log(nu)))
            )
        if change.get("wide"):
            ensemble = detector.forecaster.chosen.ensemble_
            stack.enter_context(patch.object(ensemble, "_floor", -math.inf))
        records = evaluate(spec(detector, change), split, environments=environment)
    return [
        np.mean([r.metrics[m].value for r in records if r.group == group])
        for m in METRICS
        for group in ("sensor", "dynamics")
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("split")
    parser.add_argument("--env", default="all")
    parser.add_argument("--fits", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    table = {name: {} for name in VARIANTS}
    for environment in select("environment", options.env, ENVIRONMENTS):
        detector = fitted(environment, options.split, options.fits)
        for name, change in VARIANTS.items():
            table[name][environment] = measured(detector, change, options.split, environment)
            print(environment, name, np.round(table[name][environment], 3), flush=True)
    heads = [f"{m} {group}" for m in METRICS for group in ("sensor", "dynamics")]
    for title, keep in (("all", list(ENVIRONMENTS)), ("lunarlander", ["lunarlander"])):
        rows = [
            [name, *(100 * np.mean([v for e, v in of.items() if e in keep], axis=0))]
            for name, of in table.items()
            if of.keys() & set(keep)
        ]
        print(f"\n{title}\n" + tabulate(rows, ["", *heads], floatfmt=".1f", tablefmt="github"))


if __name__ == "__main__":
    main()
