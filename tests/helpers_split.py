"""A small synthetic split: autoregressive noise whose anomalies are plain to see.

Nominal sensors follow ``o_t = 0.9 o_{t-1} + 0.1 e_t`` (with a push of the action in sensor 0);
sensor anomalies add an offset to one sensor, dynamics anomalies make the noise five times as large.
Nothing is simulated, so a split takes milliseconds.
"""

import json

import numpy as np

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1, SplitDefinition
from oodd_eval.data.layout import pack_parameters, split_digest, write_environment, write_manifest
from oodd_eval.data.parts import TWINS


def sensors(noise, actions, onset=None, anomaly=None):
    """Run the process over given noise (T + 1, D) and actions (T, A)."""
    rows = np.zeros_like(noise)
    rows[0] = noise[0]
    for t in range(1, len(rows)):
        now = onset is not None and t >= onset
        scale = 0.5 if now and ANOMALIES[anomaly].group == "dynamics" else 0.1
        rows[t] = 0.9 * rows[t - 1] + scale * noise[t]
        rows[t, 0] += 0.05 * actions[t - 1, 0]
    if onset is not None and ANOMALIES[anomaly].group == "sensor":
        rows[onset:, -1] += 3.0
    return rows


def make_group(environment, seeds, length, anomaly=None):
    """Arrays of one group; trajectory i has ``length + i % 3`` transitions."""
    info = ENVIRONMENTS[environment]
    found = {name: [] for name in ("observations", "actions", "rewards", "onsets")}
    lengths = [length + i % 3 for i in range(len(seeds))]
    for seed, n in zip(seeds, lengths, strict=True):
        rng = np.random.default_rng([seed, info.observation_dim])
        noise = rng.normal(size=(n + 1, info.observation_dim))
        actions = rng.uniform(-1, 1, size=(n, info.action_dim))
        if info.discrete:
            actions = np.eye(info.action_dim)[actions.argmax(axis=1)]
        onset = int(rng.integers(30, int(0.6 * n) + 1)) if anomaly else None
        found["observations"].append(sensors(noise, actions, onset, anomaly))
        found["actions"].append(actions)
        found["rewards"].append(np.full(n, 0.5 if anomaly else 1.0))
        found["onsets"].append(onset)
    arrays = {k: np.concatenate(found[k]) for k in ("observations", "actions", "rewards")}
    arrays["offsets"] = np.concatenate([[0], np.cumsum(lengths)])
    arrays["seeds"] = np.array(seeds)
    arrays["terminated"] = np.zeros(len(seeds), np.uint8)
    if anomaly:
        # A sensor gets 3 more from the onset on, noise another scale: the first row differs.
        arrays["onsets"] = arrays["effects"] = np.array(found["onsets"])
        arrays["redraws"] = np.zeros(len(seeds), np.int64)
        arrays["parameters"] = pack_parameters(
            [{"anomaly": anomaly, "unit": "µ", "seed": int(s)} for s in seeds]
        )
    return arrays


def make_split(
    directory,
    environments=("cartpole", "hopper"),
    *,
    train=6,
    calibration=4,
    test=3,
    length=60,
    name="tiny",
    seed_base=9,
):
    """Write a synthetic split into a directory and return the directory."""
    definition = SplitDefinition(name, train, calibration, test, length + 2, seed_base)
    first = seed_base * 10**6
    directory.mkdir(parents=True, exist_ok=True)
    entries = {}
    for environment in environments:
        seeds = {
            "train": range(first, first + train),
            "calibration": range(first + 300_000, first + 300_000 + calibration),
            "test": range(first + 600_000, first + 600_000 + test),
        }
        groups = {p: make_group(environment, seeds[p], length) for p in ("train", "calibration")}
        groups[TWINS] = make_group(environment, seeds["test"], length)
        for anomaly in TABLE1:
            groups[f"test/{anomaly}"] = make_group(environment, seeds["test"], length, anomaly)
        info = ENVIRONMENTS[environment]
        entries[environment] = write_environment(
            directory / f"{environment}.h5", groups.items(), "0" * 64,
            sensors=info.sensors, actions=info.actions,
        )  # fmt: skip
    write_manifest(directory, definition, entries, generator=1, versions={})
    return directory


def edit_manifest(directory, change):
    """Change a manifest and make its digests fit, as somebody would who wants to deceive."""
    file = directory / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    manifest["digest"] = split_digest(manifest["environments"], manifest["definition"])
    file.write_text(json.dumps(manifest))
