"""Splits of logs with recorded scores, a flag and failed episodes, as an import writes them."""

from dataclasses import dataclass, replace

import numpy as np
from helpers_logs import UNPAIRED, LogEpisode, log_arrays, log_episode, write_log_manifest

from oodd_eval.data.facts import Quantity
from oodd_eval.data.layout import own_facts, write_environment

SENSORS = [Quantity(f"q{i}", "rad") for i in range(3)]
SCORES = [
    Quantity(name, "1", "score")
    for name in ("pos_innov[0]", "pos_innov[1]", "vel_innov", "alarm", "chunk_mse")
]
PARTS = ("train", "failures", "calibration", "test/nominal", "test/slip")


@dataclass(frozen=True)
class Sizes:
    """Episodes by part."""

    train: int = 6
    failures: int = 3
    calibration: int = 40
    nominal: int = 8
    slip: int = 5


def scored_parts(sizes=Sizes(), *, rows=60):
    """Episodes with five scores behind the sensors, by part; scores are higher where they slip."""
    counts = dict(zip(PARTS, vars(sizes).values(), strict=True))
    parts = {}
    for k, (part, n) in enumerate(counts.items()):
        slips = part in ("failures", "test/slip")
        intervals = ((30, 45),) if slips else ()
        parts[part] = [
            with_scores(log_episode(1000 * k + i, rows + i % 3, intervals), 1000 * k + i)
            for i in range(n)
        ]
    return parts


def with_scores(episode, seed):
    """The episode with the columns of `SCORES`; its flag rings in one of five nominal episodes."""
    rng = np.random.default_rng([seed, 99])
    noise = rng.normal(size=(len(episode.observations), len(SCORES)))
    for start, stop in episode.intervals:
        noise[start + 2 : stop] += 4.0
    noise[:, 3] = 0.0
    if seed % 5 == 0 or episode.intervals:
        noise[33:40, 3] = 1.0
    return replace(episode, observations=np.hstack([episode.observations, noise]))


def sensors_alone(parts):
    """The same episodes without their scores."""
    return {
        part: [
            LogEpisode(e.observations[:, : len(SENSORS)], e.intervals, e.task, e.name)
            for e in episodes
        ]
        for part, episodes in parts.items()
    }


def write_columns(directory, parts, facts=UNPAIRED, *, environment="arm", columns=None):
    """Write an environment of parts whose last columns are scores; return its manifest entry."""
    directory.mkdir(parents=True, exist_ok=True)
    width = parts["train"][0].observations.shape[1]
    columns = columns or [*SENSORS, *SCORES][:width]
    groups = [
        (part, log_arrays(episodes, labelled=part == "test/slip", sensors=width))
        for part, episodes in parts.items()
        if episodes
    ]
    return write_environment(
        directory / f"{environment}.h5", groups, "0" * 64,
        sensors=columns, actions=[Quantity("cmd", "V")],
        custom=own_facts(
            environment, discrete=False, groups={"slip": "dynamics"}, sensors=columns
        ),
        logs=facts,
    )  # fmt: skip


def write_columns_split(directory, parts, facts=UNPAIRED, **more):
    """Write a split of one environment, see `write_columns`; return the directory."""
    entry = write_columns(directory, parts, facts, **more)
    return write_log_manifest(directory, {more.get("environment", "arm"): entry}, name="scored")
