"""Records made by hand, with values that can be worked out beside the test."""

import numpy as np

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.metrics.catalogue import METRICS
from oodd_eval.results.record import Metric, Record

PAIRED = [n for n, info in METRICS.items() if info.cells == "paired" and n != "auc_before"]
"""Metrics without a level of recorded cells with twins."""


def make_record(
    detector="riqn", environment="hopper", anomaly="iid", *, values=None, status="ok", reason="",
    seed=0, horizon=1, plugin=None, overrides=None, digest="ab" * 32, limit=None, **fields,
):  # fmt: skip
    """One record; `values` gives numerators per metric over two trajectories (default 0.5).

    Its detector is deterministic, so that one seed is enough for a rank.
    """
    plugin = plugin or ("trivial" if detector in ("clock", "persistence", "random") else detector)
    given = values or {}
    numbers = {
        name: list(given.get(name, [0.5, 0.5])) for name in {**dict.fromkeys(PAIRED), **given}
    }
    per_trajectory = {
        name: np.array([[v or 0.0 for v in column], [v is not None for v in column]], dtype=float)
        for name, column in numbers.items()
    }
    metrics = {}
    for name, column in numbers.items():
        defined = [v for v in column if v is not None]
        metrics[name] = Metric(
            float(np.mean(defined)) if defined else float("nan"), n=len(defined)
        )  # fmt: skip
    ok = status == "ok"
    return Record(
        detector=detector, detector_version="1.0", plugin=f"oodd-eval:{plugin}",
        parameters=overrides or {}, environment=environment, anomaly=anomaly,
        group=ANOMALIES[anomaly].group, horizon=horizon, seed=seed, split="mini",
        split_digest=digest, status=status, protocol=1, reason=reason,
        metrics=metrics if ok else {}, counts={"test": 2},
        per_trajectory=per_trajectory if ok else {},
        limit=limit, overrides=overrides or {}, **{"deterministic": True, **fields},
    )  # fmt: skip


def example():
    """Two environments, one anomaly of each group, four detectors, one of which fails on ant."""
    records = []
    for detector, auc, matched in (
        ("riqn", 0.9, 0.7), ("rf", 0.8, 0.75), ("persistence", 0.6, 0.55), ("clock", 1.0, 0.5),
    ):  # fmt: skip
        for environment in ("ant", "hopper"):
            for anomaly in ("iid", "gravity"):
                shift = 0.1 if anomaly == "gravity" else 0.0
                values = {
                    "auc": [auc - shift, auc - shift],
                    "auc_matched": [matched - shift, matched],
                    "auc_placebo": [0.5, 0.52],
                    "delay": [4.0, None] if anomaly == "gravity" else [2.0, 3.0],
                    "missed": [0.0, 1.0] if anomaly == "gravity" else [0.0, 0.0],
                    "far": [0.1, 0.05],
                    "false_episodes_at_5pct": [0.0, 1.0],
                    "early_at_5pct": [0.0, 0.0],
                    "delay_at_5pct": [8.0, None],
                    "missed_at_5pct": [0.0, 1.0],
                    "found_within_20_at_5pct": [1.0, 0.0],
                    "found_within_20_null_at_5pct": [0.0, 1.0],
                }
                failed = detector == "rf" and environment == "ant"
                records.append(
                    make_record(
                        detector, environment, anomaly, values=values,
                        status="timeout" if failed else "ok",
                        reason="not done after 5 s (--timeout)" if failed else "",
                    )
                )  # fmt: skip
    return records
