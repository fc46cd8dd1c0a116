"""Achieved share of false episodes of every shipped row, on fresh nominal episodes.

``python benchmarks/false_alarms.py [--episodes 200] [--seed-base 41] [--env NAMES] [--fits RESULTS]
[DETECTOR ...]`` fits each detector on split mini, or takes the fit that a results directory has,
takes its thresholds from mini's calibration part, and scores fresh nominal episodes of the same
policies, simulators and episode cap. The promise holds on average over calibrations: given one, the
number of alarms among m episodes has a beta-binomial distribution with parameters n + 1 - k and k.
Printed is its 97.5 % quantile; that of the mean over environments is higher, so that all rows
together have a chance of 2.5 % that any is above its own. Exit code 1 when a row is above in more
environments than chance allows, or on average over them.
"""

import argparse
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
from oodd_recording.closed_loop import record_nominal
from oodd_recording.policies import load_policy
from scipy.stats import betabinom, binom

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.metrics.alarms import GuaranteedAlarm, offered_levels, quantile_rank
from oodd_eval.names import select
from oodd_eval.plugins.contract import make_detector, score_chunk
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import FitStore
from oodd_eval.scoring.plan import make_unit

ROWS = (
    "random,clock,comb,persistence,range,mahalanobis,mewma,mewma-a,rf,rf-ewma,"
    "npn,n-riqn,riqn,riqn-r,pe,pe-a,pe-step,pe-step-a"
)


def fresh_episodes(environment, n, base, cap):
    policy, first = load_policy(environment), base * 10**6
    return [
        record_nominal(environment, first + i, policy=policy, episode_cap=cap).trajectory
        for i in range(n)
    ]


def shown(spec, trajectories):
    withheld = spec.inputs == "observations"
    return [x.without_actions() if withheld else x for x in trajectories]


def fitted(offer, split, data, stores):
    """Return a detector with seed 0 at horizon 1, fitted now or by an earlier run."""
    detector = make_detector(offer.spec.factory, seed=0, horizon=1, parameters={})
    unit = make_unit(offer, {}, data.id, (), 1, 0, split.digest, None)
    kept = next(filter(None, (store.find(unit.fit_key) for store in stores)), None)
    if kept:
        detector.restore(kept.packed.state())
        return detector
    detector.fit(shown(offer.spec, data.train))
    return detector


def counts(detector, spec, data, fresh):
    """Return by level: alarms among the fresh episodes, and rank and number of calibration ones."""
    scores = score_chunk(detector, shown(spec, data.calibration))
    again = score_chunk(detector, shown(spec, fresh))
    n = len(scores) // 2 if spec.alarm == "cusum" else len(scores)
    found = {}
    for suffix, level in offered_levels(len(scores), spec.alarm).items():
        rule = GuaranteedAlarm.fit(scores, level, spec.alarm)
        alarms = sum(rule.first(one) is not None for one in again)
        found[suffix] = alarms, quantile_rank(n, level), n, level
    return found


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("detectors", nargs="*")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed-base", type=int, default=41)
    parser.add_argument("--env", default="all")
    parser.add_argument("--fits", type=Path, action="append", default=[], metavar="RESULTS")
    options = parser.parse_args()
    stores = [FitStore(results / "fitted") for results in options.fits]
    split, plugins = load_split("mini"), discover()
    names = plugins.select(",".join(options.detectors) or ROWS)
    cap = split.manifest["definition"]["episode_cap"]
    table = {}
    for environment in select("environment", options.env, ENVIRONMENTS):
        fresh = fresh_episodes(environment, options.episodes, options.seed_base, cap)
        with closing(split.environment(environment)) as data:
            for name in names:
                offer = plugins.offer(name)
                detector = fitted(offer, split, data, stores)
                for suffix, found in counts(detector, offer.spec, data, fresh).items():
                    table.setdefault((name, suffix), {})[environment] = found
                    alarms, rank, n, _ = found
                    most = betabinom.ppf(0.975, options.episodes, n + 1 - rank, rank)
                    share = alarms / options.episodes
                    print(
                        f"{environment:12} {name:12} {suffix:9} {share:.3f} "
                        f"(at most {most / options.episodes:.3f})",
                        flush=True,
                    )
    wrong = []
    rng = np.random.default_rng(0)
    print("\nmean over environments")
    for (name, suffix), cells in table.items():
        m = options.episodes
        drawn = sum(
            betabinom.rvs(m, n + 1 - k, k, size=200_000, random_state=rng)
            for _, k, n, _ in cells.values()
        ) / (m * len(cells))
        most = float(np.quantile(drawn, 1 - 0.025 / len(table)))
        mean = float(np.mean([found[0] for found in cells.values()])) / m
        above = sum(
            found[0] > betabinom.ppf(0.975, m, found[2] + 1 - found[1], found[1])
            for found in cells.values()
        )
        many = above > binom.ppf(1 - 0.025 / len(table), len(cells), 0.025)
        wrong += [(name, suffix)] if mean > most or many else []
        print(
            f"{name:12} {suffix:9} {mean:.3f} (at most {most:.3f}); above in {above} of "
            f"{len(cells)} environments"
            + ("  <-- more than promised" if wrong[-1:] == [(name, suffix)] else "")
        )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
