"""Small splits of logs without twins, written as an import of logs writes them.

Nominal sensors follow ``o_t = 0.9 o_{t-1} + 0.1 e_t``; in anomalous rows the last one has 3 more.
"""

import csv
import tomllib
from dataclasses import dataclass

import numpy as np
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import inspect_logs
from oodd_logs.recipe import Recipe

from oodd_eval import Trajectory
from oodd_eval.data.facts import LogFacts, Quantity
from oodd_eval.data.layout import own_facts, write_environment, write_manifest

UNPAIRED = LogFacts(paired=False)


def draft_recipe(path):
    """Return the recipe that `data inspect` writes of logs, read."""
    return Recipe.parse(tomllib.loads(draft(inspect_logs(path))), "the draft")


@dataclass(frozen=True)
class LogEpisode:
    """Observations (R, D), the intervals [start, stop) that are anomalous, task and name."""

    observations: np.ndarray
    intervals: tuple = ()
    task: str = ""
    name: str = ""


def log_episode(seed, rows=60, intervals=(), task="", *, sensors=3, shift=3.0):
    """Run the process; a start of -1 is anomalous from the first row on."""
    noise = np.random.default_rng([seed, sensors]).normal(size=(rows, sensors))
    states = np.zeros_like(noise)
    states[0] = noise[0]
    for t in range(1, rows):
        states[t] = 0.9 * states[t - 1] + 0.1 * noise[t]
    for start, stop in intervals:
        states[max(start, 0) : stop, -1] += shift
    return LogEpisode(states, tuple(intervals), task, f"log{seed}")


def nominal_episodes(seeds, *, drift=0.0, rows=60):
    """Nominal episodes whose second sensor rises from each to the next."""
    return [
        Trajectory(log_episode(seed, rows).observations + np.array([0, drift * k, 0]))
        for k, seed in enumerate(seeds)
    ]


def log_arrays(episodes, *, labelled, sensors=3, actions=1):
    """Datasets of one part; actions and rewards are zero."""
    lengths = [len(e.observations) - 1 for e in episodes]
    total, counts = sum(lengths), [len(e.intervals) for e in episodes]
    arrays = {
        "observations": np.concatenate(
            [np.zeros((0, sensors)), *(e.observations for e in episodes)]
        ),
        "actions": np.zeros((total, actions)),
        "rewards": np.zeros(total),
        "offsets": np.cumsum([0, *lengths]),
        "seeds": np.arange(len(episodes)),
        "terminated": np.zeros(len(episodes), np.uint8),
        "names": np.array([e.name.encode() for e in episodes], "S16"),
        "tasks": np.array([e.task.encode() for e in episodes], "S16"),
    }
    if labelled:
        intervals = [interval for e in episodes for interval in e.intervals]
        arrays["interval_offsets"] = np.cumsum([0, *counts])
        arrays["intervals"] = np.array(intervals, np.int64).reshape(-1, 2)
    return arrays


def write_log_environment(directory, parts, facts=UNPAIRED, *, environment="arm", recordings=None):
    """Write an environment's episodes by part (``"train"``, ``"test/slip"``); return its entry.

    A part that is not named is empty; `facts` must not say that episodes are paired.
    """
    directory.mkdir(parents=True, exist_ok=True)
    nominal = ("train", "calibration", "test/nominal")
    kinds = [part.removeprefix("test/") for part in parts if part not in nominal]
    sensors = parts["train"][0].observations.shape[1]
    groups = [
        (part, log_arrays(parts.get(part, []), labelled=part not in nominal, sensors=sensors))
        for part in (*nominal, *(f"test/{kind}" for kind in kinds))
    ]
    return write_environment(
        directory / f"{environment}.h5", groups, "0" * 64,
        sensors=[Quantity(f"q{i}", "rad") for i in range(sensors)],
        actions=[Quantity("cmd", "V")],
        custom=own_facts(environment, discrete=False, groups=dict.fromkeys(kinds, "dynamics")),
        logs=facts,
        recordings=recordings,
    )  # fmt: skip


def write_log_split(directory, parts, facts=UNPAIRED, *, name="arm", environment="arm", **more):
    """Write a split of one environment, see `write_log_environment`; return the directory."""
    entry = write_log_environment(directory, parts, facts, environment=environment, **more)
    return write_log_manifest(directory, {environment: entry}, name=name)


def write_log_manifest(directory, environments, *, name):
    """Write the manifest of a split of logs; return the directory."""
    recipe = {"name": name, "source": "imported"}
    write_manifest(directory, recipe, environments, generator=0, versions={})
    return directory


def log_parts(*, train=6, calibration=40, nominal=8, anomalies=None, rows=60):
    """Episodes by part, for `write_log_split`; `anomalies` are lists of intervals by kind."""
    kinds = {"slip": [((30, 45),)] * 5} if anomalies is None else anomalies
    sizes = {"train": train, "calibration": calibration, "test/nominal": nominal}
    parts = {
        part: [log_episode(1000 * k + i, rows + i % 3) for i in range(n)]
        for k, (part, n) in enumerate(sizes.items())
    }
    for k, (kind, intervals) in enumerate(kinds.items(), 4):
        parts[f"test/{kind}"] = [
            log_episode(1000 * k + i, rows + i % 3, labels) for i, labels in enumerate(intervals)
        ]
    return parts


def make_log_split(directory, facts=UNPAIRED, *, name="arm", environment="arm", **sizes):
    """Write a small split of logs, sized as `log_parts` takes it; return the directory."""
    return write_log_split(directory, log_parts(**sizes), facts, name=name, environment=environment)


def write_table(path, columns, separator=","):
    """Write columns by name as a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        rows = csv.writer(file, delimiter=separator)
        rows.writerow(columns)
        rows.writerows(zip(*columns.values(), strict=True))
