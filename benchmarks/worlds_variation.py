"""Measure what nominal variation and noise do to detectors in the worlds, by leaving them out.

    python benchmarks/worlds_variation.py --env tank --detector mahalanobis,mewma-a --work DIR

records each world in four variants, with sizes and seeds of the split `worlds` and at strengths of
its ladder: as it is, which gives the numbers of that split; without what differs from episode to
episode but the task; without the noise of sensors and the disturbances within an episode; and
without both. Detectors are fitted and evaluated on each anew. Printed are matched AUC / share of
episodes found within 100 rows where at most 5 % of nominal episodes have an alarm / that share of
their twins (%), means over the cells of a world and of all. Start states, ways and set points stay
as the seed has drawn them, and so does where and when a fault begins. What a work directory has of
this is taken. All rows below take about 25 minutes on an idle core.
"""

import argparse
import functools
import tempfile
from collections import defaultdict
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import oodd_worlds
from oodd_recording.build import build_split
from oodd_worlds.facts import read_world
from tabulate import tabulate

from oodd_eval.api import evaluate
from oodd_eval.data.condition import GROWTH, conditions_of
from oodd_eval.data.facts import SPLITS, SplitDefinition
from oodd_eval.data.registry import register
from oodd_eval.metrics.alarms import least_episodes
from oodd_eval.metrics.catalogue import HEADLINE, LEVELS
from oodd_eval.names import select

SPLIT = SPLITS["worlds"]
METRICS = ("auc_matched", f"found_within_100_{HEADLINE}", f"found_within_100_null_{HEADLINE}")
VARIANTS = {
    "as they are": (True, True),
    "no variation": (False, True),
    "no noise": (True, False),
    "neither": (False, False),
}
"""Whether episodes differ in their parameters, and whether rows are noisy."""

DISTURBANCES = ("ripple", "gust")  # facts: what is drawn within an episode


def changed(world, *, variation, noise):
    """Return the facts of a world without variation between episodes, without noise, or both."""
    facts = dict(world.facts)
    for name, fact in facts.items():
        if not variation and isinstance(fact.spread, list):
            # The direction of the wind is drawn as well: still air is in the middle.
            middle = 0.0 if name == "wind" else sum(fact.spread) / 2
            facts[name] = replace(fact, spread=[middle, middle])
        elif not variation:
            facts[name] = replace(fact, spread=0.0)
        if not noise and name in DISTURBANCES:
            facts[name] = replace(fact, value=(0.0 * np.array(fact.value)).tolist())
    quiet = tuple(replace(sensor, noise=0.0) for sensor in world.sensors)
    return replace(world, facts=facts, sensors=world.sensors if noise else quiet)


def make_changed(name, variation, noise):
    """Return a fresh simulator, and let the world's module have the changed facts from now on.

    Its environments read them while they run: a process has one variant at a time.
    """
    module = import_module(f"oodd_worlds.{name}")
    module.WORLD = changed(read_world(name), variation=variation, noise=noise)
    return getattr(oodd_worlds, f"make_{name}")()


def spec_of(name, variation, noise):
    """Return the spec of a world's variant, which has the world's name: that decides draws."""
    (spec,) = (spec for spec in oodd_worlds.oodd_environments() if spec.name == name)
    sensors = changed(read_world(name), variation=variation, noise=noise).sensors
    make = functools.partial(make_changed, name, variation, noise)
    return replace(spec, make=make, sensors=sensors)


def metrics_of(name, variant, strengths, options, work):
    """Return the metrics of each cell by detector, (cells, 3): record a split and evaluate."""
    register([spec_of(name, *VARIANTS[variant])])
    where = work / f"{name} {variant}".replace(" ", "-")
    sizes = (options.train, options.calibration, options.test)
    definition = SplitDefinition(
        where.name, *sizes, None, options.seed_base, strengths=strengths, environments=(name,)
    )
    split = build_split(definition, where / "split", environments=[name], jobs=1)
    rows = options.detector.split(",")
    values = defaultdict(list)
    for record in evaluate(rows, split, output=where / "results", seed=options.seed, jobs=1):
        values[record.detector].append([record.value(metric) for metric in METRICS])
    return values


def table_of(means):
    """Return a table of means by variant and detector: AUC / found / in twins."""
    rows = dict.fromkeys(row for by_row in means.values() for row in by_row)
    lines = [
        [row, *(" / ".join(f"{100 * x:.1f}" for x in means[variant][row]) for variant in means)]
        for row in rows
    ]
    return tabulate(lines, ["", *means], tablefmt="github", disable_numparse=True)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="all")
    parser.add_argument("--detector", default="random,mahalanobis,mewma-a,rf,riqn,pe-a")
    parser.add_argument("--rung", default="loss5,loss25", help="of the ladder, a comma list")
    parser.add_argument("--train", type=int, default=SPLIT.train)
    parser.add_argument("--calibration", type=int, default=SPLIT.calibration)
    parser.add_argument("--test", type=int, default=SPLIT.test)
    parser.add_argument("--seed-base", type=int, default=SPLIT.seed_base)
    parser.add_argument("--seed", type=int, default=0, help="of the detectors")
    parser.add_argument("--work", type=Path, help="keep and take splits and results here")
    options = parser.parse_args(arguments)
    least = least_episodes(LEVELS[HEADLINE], "cusum")
    if options.calibration < least:
        parser.error(f"--calibration is {options.calibration}, expected at least {least}")
    register([*oodd_worlds.oodd_environments(), *oodd_worlds.oodd_anomalies()])
    every = {variant: defaultdict(list) for variant in VARIANTS}
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        rungs = select("rung", options.rung, GROWTH)
        worlds = select("environment", options.env, oodd_worlds.TITLES)
        for name in worlds:
            ladder = conditions_of("ladder", name)
            strengths = {str(c): ladder[c] for c in ladder if c.strength in rungs}
            means = {}
            for variant in VARIANTS:
                values = metrics_of(name, variant, strengths, options, work)
                for row, cells in values.items():
                    every[variant][row] += cells
                means[variant] = {row: np.nanmean(cells, axis=0) for row, cells in values.items()}
            print(f"{name}, {len(strengths)} cells\n\n{table_of(means)}\n", flush=True)
    if len(worlds) > 1:
        means = {
            variant: {row: np.nanmean(cells, axis=0) for row, cells in by_row.items()}
            for variant, by_row in every.items()
        }
        print(f"all\n\n{table_of(means)}")


if __name__ == "__main__":
    main()
