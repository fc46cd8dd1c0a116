"""False alarms of a watchdog on fresh nominal episodes: by episode, and in operation without end.

``python benchmarks/live_alarms.py [--env NAMES] [--detector pe-a] [--split mini] [--confidence P]
[--episodes 200] [--seed-base 41] [--kept DIR]``, about three minutes an environment; with
``--kept`` fitted watchdogs are saved there and taken from there.

Both watchdogs are fitted to the split. One promises an alarm in at most 5 % of the episodes, on
average over calibrations or with a confidence; printed is the share that has one, with the largest
that the promise allows for one calibration (97.5 % quantile of the beta-binomial distribution; with
a confidence 5 %). The other promises a mean time of three minutes
at 50 Hz between false alarms: the episodes are handed over one after the other, each after a reset,
as those that it was calibrated on; alarms less than two seconds apart are one. Printed is the mean
time with its 95 % interval (of a Poisson process) beside that of the promise. Exit code 1 where an
environment has more alarms than allowed, or where the two intervals are apart.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from false_alarms import fresh_episodes
from live_faults import RATE, first_alarm, rows_of, watchdog_of
from scipy.stats import betabinom, chi2
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.metrics.alarms import quantile_rank
from oodd_eval.names import select

MINUTES = 3.0
ONE = 100  # rows in which alarms are one


def without_end(watchdog, episodes):
    """Return the hours of all episodes and the number of alarms."""
    alarms = rows = 0
    for x in episodes:
        watchdog.reset()
        last = -ONE
        for t, row in enumerate(rows_of(x)):
            if watchdog.update(*row).alarm:
                alarms += t - last >= ONE
                last = t
                watchdog.acknowledge()
        rows += len(x)
    return rows / RATE / 3600, alarms


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="all")
    parser.add_argument("--detector", default="pe-a")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--split", default="mini")
    parser.add_argument("--confidence", type=float)
    parser.add_argument("--seed-base", type=int, default=41, help="of the fresh episodes")
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    split, table, wrong = load_split(options.split), [], False
    cap, n = split.manifest["definition"]["episode_cap"], options.episodes
    for environment in select("environment", options.env, ENVIRONMENTS):
        fresh = fresh_episodes(environment, n, options.seed_base, cap)
        given = environment, options.detector, options.kept, options.split
        sure = {"confidence": options.confidence} if options.confidence else {}
        watchdog = watchdog_of(*given, **sure)
        alarms = sum(first_alarm(watchdog, rows_of(x)) is not None for x in fresh)
        halves = watchdog.rule.standardization is not None
        episodes = len(split.environment(environment).calibration) // (2 if halves else 1)
        alpha = watchdog.settings.alpha
        rank = quantile_rank(episodes, alpha)
        chance = betabinom.ppf(0.975, n, episodes + 1 - rank, rank)
        most = n * alpha if sure else chance
        endless = watchdog_of(*given, hours=MINUTES / 60)
        hours, count = without_end(endless, fresh)
        promised = endless.run_length
        most_often = 2 * hours / chi2.ppf(0.975, 2 * count + 2)
        least_often = 2 * hours / chi2.ppf(0.025, 2 * count) if count else np.inf
        inside = most_often <= promised.high and least_often >= promised.low
        wrong |= alarms > most or not inside
        mean = f"{60 * hours / count:.1f}" if count else f"above {60 * hours:.0f}"
        table.append(
            [
                environment,
                f"{100 * alarms / n:.1f}",
                f"{100 * most / n:.1f}",
                count,
                mean,
                f"{60 * most_often:.1f} to {60 * least_often:.1f}",
                f"{60 * promised.low:.1f} to {60 * promised.high:.1f}",
            ]
        )
        print(table[-1], flush=True)
    heads = [
        "",
        "episodes with an alarm (%)",
        "at most",
        "alarms without end",
        "minutes between them",
        "their interval",
        "promised: 3, within",
    ]
    print(tabulate(table, heads, tablefmt="github"))
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
