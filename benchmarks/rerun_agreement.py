"""False refusals and power of the rule by which an entry has to agree with its re-run.

``python benchmarks/rerun_agreement.py [--splits 6] [--detectors NAMES] [--env NAMES] [--work DIR]``
records splits of mini's sizes, each from 128 bits of its own, and runs every detector on them; what
a work directory has of this is taken. Each row is then compared with itself on each other split, as
an entry is with its re-run. Honest pairs have the numbers as they are. In the others the entry says
of matched AUC, in one environment or in all, that every episode had so much more, at most 1. Lines
of single metrics say by which of them honest pairs are refused. Exit code 1 when more than one
honest pair in a hundred is refused, or a lie of .2 in all environments is granted. Row ``range`` is
printed and left out of the first: on some draws it has no finite threshold in CartPole and misses
everything, which no resample of calibration episodes shows.
"""

import argparse
import hashlib
import itertools
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from oodd_leaderboard.verify.rerun import COMPARED, differences
from oodd_recording.build import build_split, digest_of_bits

from oodd_eval.api import evaluate
from oodd_eval.data.facts import ENVIRONMENTS, SPLITS
from oodd_eval.metrics.catalogue import RANKING
from oodd_eval.names import select
from oodd_eval.results.board import grouped

LIES = (0.05, 0.1, 0.2, 0.417)


def recorded(number, work, environments):
    """Return the directory of a split whose 128 bits follow from a number."""
    bits = int.from_bytes(hashlib.sha256(f"agreement {number}".encode()).digest()[:16], "big")
    drawn = digest_of_bits(bits)
    definition = replace(SPLITS["mini"], name=f"drawn-{number}", seed_base=0, drawn=drawn)
    return build_split(definition, work / definition.name, environments=environments, bits=bits)


def rows_of(split, detectors, results, environments):
    """Return records by detector and environment."""
    records = grouped(
        evaluate(detectors, split, environments=environments, output=results), lambda r: r.detector
    )
    return {name: grouped(records[name], lambda r: r.environment) for name in detectors}


def raised(record, lie):
    """Return a record whose matched AUC is higher by a lie in every episode, and at most 1."""
    top, bottom = record.per_trajectory[RANKING]
    terms = np.array([np.minimum(top + lie * bottom, bottom), bottom])
    metric = replace(record.metrics[RANKING], value=float(terms[0].sum() / terms[1].sum()))
    return replace(
        record,
        per_trajectory={**record.per_trajectory, RANKING: terms},
        metrics={**record.metrics, RANKING: metric},
    )


def honest(pairs):
    """Print refusals of honest pairs of a detector; return their number."""
    compared = [differences({e: (ours[e], theirs[e]) for e in theirs}) for ours, theirs in pairs]
    for metric in COMPARED:
        zs = {
            where: [d.z for one in compared for d in one if (d.metric, not d.environment) == key]
            for where, key in {"in one": (metric, False), "on the mean": (metric, True)}.items()
        }
        if zs["in one"]:
            texts = (f"{w} z to {max(z):5.2f}, s.d. {np.std(z):4.2f}" for w, z in zs.items())
            print(f"    {metric:<26}{';  '.join(texts)}")
    return sum(any(d.refused for d in one) for one in compared)


def lies(pairs, lie, environments):
    """Return how many pairs with a lie in these environments are refused, and its mean size."""
    refused, sizes = 0, []
    for ours, theirs in pairs:
        lying = {e: [raised(r, lie if e in environments else 0.0) for r in ours[e]] for e in ours}
        compared = differences({e: (lying[e], theirs[e]) for e in theirs}, [RANKING])
        refused += any(d.refused for d in compared)
        sizes += [r.value(RANKING) for e in ours for r in lying[e]]
        sizes += [-r.value(RANKING) for e in ours for r in ours[e]]
    return refused, 2 * float(np.mean(sizes))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splits", type=int, default=6)
    parser.add_argument("--detectors", default="mewma,mahalanobis,range,persistence")
    parser.add_argument("--env", default="all")
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    environments = select("environment", options.env, ENVIRONMENTS)
    detectors = options.detectors.split(",")
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        runs = [
            rows_of(recorded(n, work, environments), detectors, work / f"results-{n}", environments)
            for n in range(options.splits)
        ]
        return judge(runs, detectors, environments)


def judge(runs, detectors, environments):
    """Print what is refused, by detector and in all."""
    total, refusals, granted = 0, 0, 0
    for detector in detectors:
        pairs = list(itertools.permutations([run[detector] for run in runs], 2))
        print(detector)
        count = honest(pairs)
        if detector != "range":
            total, refusals = total + len(pairs), refusals + count
        print(f"    honest: {count} of {len(pairs)} pairs refused")
        for lie in LIES:
            everywhere, size = lies(pairs, lie, environments)
            granted += (lie >= 0.2) * (len(pairs) - everywhere)
            alone = [lies(pairs, lie, [e])[0] for e in environments]
            share = sum(alone) / (len(pairs) * len(environments))
            print(
                f"    +{lie:g} in all environments (a mean of {size:.3f}): {everywhere} of "
                f"{len(pairs)} refused; in a single one: {share:.0%}"
            )
    print(f"honest pairs refused, without range: {refusals} of {total}")
    return int(refusals > total / 100 or granted > 0)


if __name__ == "__main__":
    sys.exit(main())
