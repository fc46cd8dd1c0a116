"""Rollouts of a policy by task, and figures of their outcomes from the files alone.

Nothing here is from the package: parts, thresholds and metrics are computed by their definitions,
in loops, so that records can be compared with them. Rollouts have the shape of pi0's on LIBERO.
"""

import gzip
import json
import math
from dataclasses import dataclass, field

import numpy as np

COLUMNS = (
    "action_norm", "chunk_mse", "action_jerk", "gripper_oscillation", "denoising_curvature",
    "eef_z", "eef_z_vel", "eef_speed_3d", "gripper_qpos_mean", "gripper_qpos_vel", "chunk_mse_mmd",
)  # fmt: skip
LIMIT = 40
SHORTEST = {"0": 24, "1": 17, "3": 30}  # rows of the shortest success, by task
FAILS = {"0": 0.15, "1": 0.3, "3": 0.4}  # share of failures, by task
LEVELS = {"at_10pct": 0.10, "at_5pct": 0.05}


def simulate(folder, episodes=54, seed=0):
    """Write a file a task: failures run into the limit, and their chunk error rises before."""
    rng = np.random.default_rng(seed)
    for number, (task, least) in enumerate(SHORTEST.items()):
        lines = []
        for i in sorted(range(episodes), key=str):
            failed = bool(rng.random() < FAILS[task])
            length = LIMIT if failed else int(least + rng.integers(LIMIT - least))
            rows = np.abs(rng.normal(1 + number, 0.3, size=(length, len(COLUMNS))))
            rows[:, 1] = rng.gamma(2, 0.02 * (1 + number), size=length)
            if failed:
                rows[:, 1] *= 1 + rng.uniform(0, 3) * np.linspace(0, 1, length)
                rows[:, 2] += 0.2
            rows[0, [1, 6, 7, 9, 10]] = 0.0
            steps = [{"t": t, **dict(zip(COLUMNS, row, strict=True))}
                     for t, row in enumerate(rows.tolist())]  # fmt: skip
            facts = {"episode_id": i, "task_id": int(task), "success": not failed}
            lines.append(json.dumps({**facts, "length": length, "steps": steps}))
        (folder / f"task_{task}.jsonl").write_text("\n".join(lines) + "\n")


@dataclass(frozen=True)
class Rollout:
    """An episode as it was recorded."""

    task: str
    number: int
    success: bool
    rows: int
    chunk_error: list = field(repr=False)


def read(folder):
    """Return all rollouts in recorded order: files by name, episodes as they stand there."""
    rollouts = []
    for path in sorted(folder.glob("task_*.jsonl*")):
        opened = gzip.open if path.suffix == ".gz" else open
        with opened(path, "rt") as file:
            for line in file:
                episode = json.loads(line)
                # Splits have float32.
                errors = [float(np.float32(step["chunk_mse"])) for step in episode["steps"]]
                facts = str(episode["task_id"]), episode["episode_id"], episode["success"]
                rollouts.append(Rollout(*facts, len(errors), errors))
    return rollouts


def shared_out(rollouts, shares, failures, unseen=()):
    """Return the parts: of each task the first successes to train, then to calibrate, then test."""
    parts = {name: [] for name in ("train", "calibration", "nominal", "failure", "failures")}
    # What no training has seen is the first of the test.
    parts["nominal"] = [r for r in rollouts if r.success and r.task in unseen]
    for task in dict.fromkeys(r.task for r in rollouts):
        if task not in unseen:
            good = [r for r in rollouts if r.task == task and r.success]
            first, second = round(shares[0] * len(good)), round(sum(shares[:2]) * len(good))
            parts["train"] += good[:first]
            parts["calibration"] += good[first:second]
            parts["nominal"] += good[second:]
        bad = [r for r in rollouts if r.task == task and not r.success]
        taken = 0 if task in unseen else round(failures * len(bad))
        parts["failures"] += bad[:taken]
        parts["failure"] += bad[taken:]
    return parts


def column(rollout):
    return rollout.chunk_error


def running_mean(rollout):
    total, means = 0.0, []
    for t, error in enumerate(rollout.chunk_error, 1):
        total += error
        means.append(total / t)
    return means


def clock(rollout):
    return [float(t) for t in range(rollout.rows)]


FROM_FILES = {"column:chunk_mse": column, "mean:chunk_mse": running_mean, "clock": clock}
"""Scores that the files tell."""


class Alarms:
    """Thresholds of calibration scores, and what exceeds them.

    `stream` says by part how unusual the stream is in each row; it is left out for a column.
    """

    def __init__(self, kind, calibration, stream=None):
        self.scale = None
        if kind == "cusum":
            pooled = [s for scores in calibration[::2] for s in scores if not math.isnan(s)]
            mean = math.fsum(pooled) / len(pooled)
            spread = math.sqrt(math.fsum((s - mean) ** 2 for s in pooled) / len(pooled))
            self.scale = mean, spread
            calibration, stream = calibration[1::2], stream and stream[1::2]
        largest = [max(self.statistic(scores)) for scores in calibration]
        self.tail = _tail(largest) if stream else None
        if stream:
            largest = [
                max(top, self._as_rare(max(rows)))
                for top, rows in zip(largest, stream, strict=True)
            ]
        self.thresholds, n = {}, len(largest)
        for suffix, level in LEVELS.items():
            above = math.floor((n + 1) * level + 1e-9)  # so many of n + 1 may alarm
            if above:
                self.thresholds[suffix] = sorted(largest)[n - above]

    def statistic(self, scores):
        """What a detector's own alarms are of."""
        if self.scale is None:
            return [-math.inf if math.isnan(s) else s for s in scores]
        (mean, spread), total, sums = self.scale, 0.0, []
        for s in scores:
            if not math.isnan(s):
                total = max(0.0, total + (0.01 * ((s - mean) / spread) - 0.0018))
            sums.append(0.0 if math.isnan(s) else total)
        return sums

    def joint(self, scores, stream):
        """The same, or the statistic that is as rare as what the stream does."""
        if stream is None:
            return self.statistic(scores)
        pairs = zip(self.statistic(scores), stream, strict=True)
        return [max(own, self._as_rare(row)) for own, row in pairs]

    def _as_rare(self, surprise):
        start, scale, shape, share = self.tail
        beyond = surprise + math.log(share)
        if beyond <= 0:
            return -math.inf
        return start + scale * (math.expm1(shape * beyond) / shape if shape else beyond)


def _tail(largest):
    """A generalized Pareto tail of the upper 30 %, by probability-weighted moments."""
    values = sorted(v for v in largest if math.isfinite(v))
    n = len(values)
    m = min(max(1, math.floor(0.3 * n)), n - 1)
    start = values[n - m - 1]
    above = [v - start for v in values[n - m :]]
    mean, shape = sum(above) / m, 0.0
    if n >= 20 and mean > 0:
        weighted = sum(a * (1 - (i - 0.35) / m) for i, a in enumerate(above, 1)) / m
        if mean > 2 * weighted:
            shape = min(max(2 - mean / (mean - 2 * weighted), 0.0), 0.5)
    scale = max(mean * (1 - shape), 1e-9 * max(1.0, abs(start)))
    return start, scale, shape, (m + 1) / (n + 1)


@dataclass(frozen=True)
class Scored:
    """A test episode with its scores, and how unusual its stream is."""

    task: str
    scores: list
    stream: list | None = None


def mean(values):
    values = list(values)
    return sum(values) / len(values) if values else math.nan


def better(bad, good):
    """Share of pairs in which the first is larger, half of those that tie."""
    return mean((b > g) + 0.5 * (b == g) for b in bad for g in good)


def figures(alarms, nominal, failed, *, probabilities=False):
    """Return all figures of outcomes by name; tasks without episodes of both kinds are left out."""
    tasks = {}
    for task in dict.fromkeys(r.task for r in failed):
        good, bad = ([r for r in part if r.task == task] for part in (nominal, failed))
        if good:
            tasks[task] = good, bad, min(len(r.scores) for r in [*good, *bad])
    count = sum(len(bad) for _, bad, _ in tasks.values())
    result = {}
    for name, stop in (
        ("auc_outcome", lambda n: n), ("auc_outcome_half", lambda n: math.ceil(n / 2)),
        ("auc_outcome_whole", lambda n: None),
    ):  # fmt: skip
        result[name] = 0.0
        for good, bad, rows in tasks.values():
            tops = [[max(alarms.statistic(r.scores)[: stop(rows)]) for r in p] for p in (bad, good)]
            result[name] += len(bad) * better(*tops) / count
    result["auc_pool"] = mean(
        share for good, bad, _ in tasks.values() for r in bad
        if not math.isnan(share := at_the_same_rows(r, good))
    )  # fmt: skip
    result["auc_pool_null"] = mean(
        share for good, bad, _ in tasks.values() for r in good
        if not math.isnan(share := at_the_same_rows(r, [o for o in good if o is not r]))
    )  # fmt: skip
    if probabilities:
        result["brier_outcome"] = mean(
            mean((p - y) ** 2 for p in r.scores[:rows])
            for *parts, rows in tasks.values() for y, part in enumerate(parts) for r in part
        )  # fmt: skip
    for suffix, threshold in alarms.thresholds.items():

        def first(r, rows=None, threshold=threshold):
            above = enumerate(alarms.joint(r.scores, r.stream)[:rows])
            return next((t for t, s in above if s > threshold), None)

        found, times, null = [], [], 0.0
        for good, bad, rows in tasks.values():
            firsts = [first(r, rows) for r in bad]
            found += [t is not None for t in firsts]
            times += [rows if t is None else t for t in firsts]
            null += len(bad) * mean(first(r, rows) is not None for r in good) / count
        result[f"threshold_{suffix}"] = threshold
        result[f"false_episodes_{suffix}"] = mean(first(r) is not None for r in nominal)
        result[f"found_outcome_{suffix}"] = mean(found)
        result[f"found_outcome_null_{suffix}"] = null
        result[f"balanced_outcome_{suffix}"] = (mean(found) + 1 - null) / 2
        result[f"outcome_time_{suffix}"] = mean(times)
    return result


def at_the_same_rows(rollout, others):
    """Mean over rows of the share of others below it in that row, where at least five have one."""
    shares = []
    for t, score in enumerate(rollout.scores):
        rivals = [o.scores[t] for o in others if t < len(o.scores) and not math.isnan(o.scores[t])]
        if len(rivals) >= 5 and not math.isnan(score):
            shares.append(better([score], rivals))
    return mean(shares)
