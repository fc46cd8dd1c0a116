"""Measure how far the limit is in the worlds: oracles without and with an episode's parameters.

    python benchmarks/worlds_oracles.py --env tank --anomaly leak,level-drift

prints, per world and rung of its ladder, matched AUC and share of episodes found within 100 rows
where at most 5 % of nominal episodes have an alarm (%), both for the detector `oracle` and for the
same filter with the parameters that the episode's reset has drawn, which no detector can know: the
ceiling. Both by the harness's own metrics, on seeds of this script's own. The sizes below take
about two minutes a world.
"""

import argparse
from collections import defaultdict

import numpy as np
from oodd_recording.closed_loop import Setup, record_anomalous
from oodd_recording.environments import make
from oodd_recording.policies import load_policy
from oodd_worlds import oodd_anomalies, oodd_environments
from oodd_worlds.oracles import MODELS, charts_of, judged, standards_of
from tabulate import tabulate

from oodd_eval.data.condition import ladder_of, rungs_of
from oodd_eval.data.registry import register
from oodd_eval.metrics.alarms import guaranteed_contributions, least_episodes
from oodd_eval.metrics.auc import cell_contributions
from oodd_eval.metrics.catalogue import HEADLINE, LEVELS
from oodd_eval.names import select
from oodd_eval.results.evaluate import Rules

FIRST_SEED = 973_000_000  # apart from the ladder's calibration, its check and all splits
METRICS = ("auc_matched", f"found_within_100_{HEADLINE}")


class Oracle:
    """Scores of the filter, with the parameters of each episode or without."""

    def __init__(self, world, *, informed):
        self.world, self.informed = world, informed
        self.simulator, self.model = make(world), MODELS[world]()

    def fit(self, episodes):
        self.standards = standards_of([self.charts(episode) for episode in episodes])

    def charts(self, episode):
        drawn = None
        if self.informed:
            self.simulator.reset(episode.seed)
            drawn = self.model.drawn(self.simulator.env)
        return charts_of(self.world, episode.trajectory, drawn)

    def scores(self, episodes):
        charts = (self.charts(episode) for episode in episodes)
        return [np.concatenate([[np.nan], judged(c, self.standards)]) for c in charts]


def cells(world, kinds, options):
    """Yield rung and metrics of each kind: two numbers for either oracle, (2, 2)."""
    setup, count = Setup(world, load_policy(world)), [options.train, options.calibration]
    seeds = FIRST_SEED + np.arange(sum(count) + options.test)
    nominal = [setup.record(int(seed)) for seed in seeds]
    train, calibration, twins = np.split(np.array(nominal, object), np.cumsum(count))
    oracles = [Oracle(world, informed=informed) for informed in (False, True)]
    rules, references = [], []
    for oracle in oracles:
        oracle.fit(train)
        rules.append(Rules.fit(oracle.scores(calibration), "score"))
        references.append(oracle.scores(twins))
    for kind in kinds:
        for rung, entry in rungs_of(world, kind).items():
            episodes = [record_anomalous(setup, kind, entry.strength, twin) for twin in twins]
            onsets, effects = ([getattr(e, name) for e in episodes] for name in ("onset", "effect"))
            values = []
            for oracle, rule, reference in zip(oracles, rules, references, strict=True):
                scores, alarm = oracle.scores(episodes), rule.guaranteed[HEADLINE]
                terms = cell_contributions(scores, reference, onsets, effects, rule.paper)
                alarms = guaranteed_contributions(scores, reference, effects, alarm)
                alarms = {f"{name}_{HEADLINE}": term for name, term in alarms.items()}
                values.append([(terms | alarms)[metric].value for metric in METRICS])
            yield rung, kind, values


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="all")
    parser.add_argument("--anomaly", default="all")
    parser.add_argument("--train", type=int, default=20)
    parser.add_argument("--calibration", type=int, default=20)
    parser.add_argument("--test", type=int, default=6)
    parser.add_argument("--cells", action="store_true", help="a line per kind, too")
    options = parser.parse_args(arguments)
    least = least_episodes(LEVELS[HEADLINE], "score")
    if options.calibration < least:
        parser.error(f"--calibration is {options.calibration}, expected at least {least}")
    register([*oodd_environments(), *oodd_anomalies()])
    known = sorted({kind for world in MODELS for kind in ladder_of(world)})
    table = []
    for world in select("environment", options.env, MODELS):
        kinds = [*ladder_of(world)]
        chosen = select("anomaly", options.anomaly, known)
        by_rung = defaultdict(list)
        for rung, kind, values in cells(world, [k for k in kinds if k in chosen], options):
            by_rung[rung].append(values)
            by_rung["all"].append(values)
            if options.cells:
                table.append([world, f"{kind}@{rung}", *(100 * np.ravel(values))])
        rungs = [*(name for name in by_rung if name != "all"), *(["all"] if by_rung else [])]
        for name in rungs:
            means = np.nanmean(by_rung[name], axis=0)
            table.append([world, name, *(100 * np.ravel(means))])
    names = ("oracle: AUC", "found", "with the parameters: AUC", "found")
    print(tabulate(table, ["world", "rung", *names], floatfmt=".1f", tablefmt="github"))


if __name__ == "__main__":
    main()
