"""The catalogue of metrics: name, title, meaning, unit and better side of everything measured.

Alarm metrics are reported again at each calibrated false-alarm rate, under a name with a suffix:
``far_at_1pct`` is `far` with the threshold that keeps the calibration trajectories at 1 %.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

from oodd_eval.errors import UnknownNameError

Unit = Literal["percent", "steps", "rate"]
Better = Literal["higher", "lower", ""]

RANKING: Final = "auc_matched"
"""The metric that boards rank by."""

TARGETS: Final[Mapping[str, float]] = MappingProxyType({"at_1pct": 0.01, "at_01pct": 0.001})
"""Target false-alarm rates of calibrated thresholds, by the suffix of their metrics."""

CALIBRATED: Final = ("far", "far_twin", "delay", "delay_censored", "missed")
"""Metrics that are reported again at each target."""

UNDEFINED: Final = "\N{EN DASH}"
"""Printed for NaN."""


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """Facts about one metric.

    Attributes
    ----------
    unit
        ``"percent"``: a share that is printed in percent; ``"steps"``: observation rows;
        ``"rate"``: a plain number, such as alarms per step.
    better
        ``"higher"`` or ``"lower"``; empty where a metric describes a benchmark or a setting.
    null
        Metric that says what chance or false alarms alone give; possibly empty.
    pooled
        Whether it is one number of all steps of a cell, not a ratio of sums over trajectories.
    target
        False-alarm rate of its calibrated threshold, such as ``"1 %"``; otherwise empty.
    """

    name: str
    title: str
    summary: str
    unit: Unit
    better: Better = ""
    null: str = ""
    pooled: bool = False
    target: str = ""

    def text(self, value: float) -> str:
        """Return a value as printed: percent and steps with one decimal, rates with three."""
        if math.isnan(value):
            return UNDEFINED
        if self.unit == "percent":
            return f"{100 * value:.1f}"
        return f"{value:.1f}" if self.unit == "steps" else f"{value:.3f}"


# fmt: off
_METRICS: Final = (
    MetricInfo("auc", "AUC",
        "the paper's: scores from the onset on against scores before it, mean over trajectories",
        "percent", "higher", null="auc_null"),
    MetricInfo("auc_null", "AUC null",
        "the same on the nominal twin: what the phase of the episode alone gives", "percent"),
    MetricInfo("auc_matched", "matched AUC",
        "ranks: anomalous scores against the twin's at the same times",
        "percent", "higher", null="auc_placebo"),
    MetricInfo("auc_placebo", "placebo",
        "two nominal twins against each other at the same times: 0.5 within noise", "percent"),
    MetricInfo("delay", "Delay",
        "steps from the onset to the first alarm, over trajectories that have one",
        "steps", "lower", null="delay_null"),
    MetricInfo("delay_null", "Delay null",
        "the same on the nominal twin: what false alarms alone give", "steps"),
    MetricInfo("delay_censored", "Delay censored",
        "delay with a miss counted as the whole remainder of the episode", "steps", "lower"),
    MetricInfo("missed", "Missed",
        "share of trajectories without an alarm from the onset on", "rate", "lower"),
    MetricInfo("far", "FAR",
        "false-alarm rate: alarms before the onset over the steps before it", "rate", "lower"),
    MetricInfo("far_twin", "FAR twin",
        "false-alarm rate over whole nominal twins", "rate", "lower"),
    MetricInfo("auc_pooled", "pooled AUC",
        "AUC of all trajectories' scores in one pool, labelled by the onset",
        "percent", "higher", pooled=True),
    MetricInfo("average_precision", "AP",
        "area under the precision-recall curve of that pool", "percent", "higher", pooled=True),
    MetricInfo("fpr95", "FPR95",
        "false-positive rate of that pool where 95 % of its anomalous steps are found",
        "percent", "lower", pooled=True),
)

_THRESHOLD: Final = MetricInfo("threshold", "Threshold",
    "smallest threshold that meets the target on calibration data", "rate")
# fmt: on

METRICS: Final = MappingProxyType({info.name: info for info in _METRICS})
"""Metrics without a calibrated threshold, in the order of records; pooled ones last."""

RATIOS: Final = tuple(name for name, info in METRICS.items() if not info.pooled)
"""Metrics that are ratios of sums over test trajectories."""

POOLED: Final = tuple(name for name, info in METRICS.items() if info.pooled)
"""Single numbers of pooled steps, as the neighbouring field reports them."""

_SUFFIXED: Final = (f"{name}_{suffix}" for suffix in TARGETS for name in (*CALIBRATED, "threshold"))
NAMES: Final = (*METRICS, *_SUFFIXED)
"""Every metric that a record can have."""


@functools.cache
def metric_info(name: str) -> MetricInfo:
    """Return the facts about a metric that records can have, with or without a target's suffix.

    Examples
    --------
    >>> metric_info("far_at_1pct").title
    'FAR at 1 %'
    """
    if name not in NAMES:
        raise UnknownNameError("metric", name, NAMES)
    if name in METRICS:
        return METRICS[name]
    base, _, suffix = name.partition("_at_")
    target = f"{100 * TARGETS[f'at_{suffix}']:g} %"
    info = METRICS.get(base, _THRESHOLD)
    summary = info.summary
    if info is not _THRESHOLD:
        summary += f"; with a false-alarm rate calibrated to {target}"
    title = f"{info.title} at {target}"
    return replace(info, name=name, title=title, summary=summary, null="", target=target)
