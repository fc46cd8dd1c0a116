"""Cells of studies of interventions, made by hand."""

import json

ARMS = ("twin", "never", "watchdog", "oracle", "placebo", "false", "forced")


def episode(seed, returns, *, effect=40, alarm=45, acted="alarm", failed=(), named=None, **more):
    """An episode with the returns of the arms in their order, or of all that differ from never."""
    values = dict(zip(ARMS, returns, strict=True))
    act = alarm if acted == "alarm" else acted
    acts = dict.fromkeys(ARMS) | {"watchdog": act, "oracle": effect}
    return {
        "seed": seed, "onset": effect, "effect": effect, "alarm": alarm, "false_alarm": None,
        "parts": {"sensors": [0, 2], "actuators": [], "kind": "sensor"},
        "named": named or {}, "largest": {"0": [2, 1, 0], "20": [0, 2, 1]},
        "returns": values, "rows": dict.fromkeys(ARMS, 100),
        "failed": {arm: arm in failed for arm in ARMS}, "acted": acts,
    } | more  # fmt: skip


def naming(*named, sensors=3, actuators=1, kind="sensor", onset=42):
    """A naming of some sensors, and of actuators as negative numbers from -1 on."""
    return {
        "sensors": [0.9 if i in named else 0.1 for i in range(sensors)],
        "actuators": [0.5 if -1 - i in named else 0.0 for i in range(actuators)],
        "kind": kind, "onset": onset,
    }  # fmt: skip


def study_cell(episodes, detector="panel", environment="hopper", anomaly="iid", act="mask", **more):
    """A cell of a study with some episodes."""
    arms = {arm: [1.0] * 80 for arm in ARMS}
    return {
        "schema": "oodd-eval/intervention/1", "detector": detector, "detector_version": "1",
        "plugin": "oodd_panel", "parameters": {}, "overrides": {}, "seed": 0, "horizon": 1,
        "environment": environment, "anomaly": anomaly, "group": "sensor", "split": "mini",
        "split_digest": "0a1b", "act": act, "level": 0.05, "base": 950, "cap": 300,
        "provenance": {}, "seconds": 2.0, "episodes": episodes,
        "curves": {"first": -20, "arms": arms},
    } | more  # fmt: skip


def write_cells(directory, cells):
    """Write cells as a study does."""
    for cell in cells:
        path = directory / "cells" / cell["environment"] / cell["detector"]
        path.mkdir(parents=True, exist_ok=True)
        text = json.dumps(cell)
        (path / f"{cell['anomaly']}--{cell['act']}.json").write_text(text, encoding="utf-8")
