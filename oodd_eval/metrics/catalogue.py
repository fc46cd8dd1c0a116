"""The catalogue of metrics: name, title, meaning, unit and better side of everything measured.

The metrics of guaranteed alarms have a name for each level, with a suffix: ``delay_at_5pct`` is the
delay where at most 5 % of nominal episodes raise an alarm.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

from oodd_eval.names import check_known

Unit = Literal["percent", "steps", "rate"]
Better = Literal["higher", "lower", ""]
IntervalKind = Literal["mean", "share", "exact", ""]

RANKING: Final = "auc_matched"
"""The metric that boards rank by."""

ALARM_RANKING: Final = "delay_censored_at_5pct"
"""The metric of the second ranking, by alarms."""

LEVELS: Final[Mapping[str, float]] = MappingProxyType(
    {"at_10pct": 0.10, "at_5pct": 0.05, "at_1pct": 0.01}
)
"""Largest share of nominal episodes with an alarm, by the suffix of the metrics at this level."""

HEADLINE: Final = "at_5pct"  # suffix of the level that tables show
FOUND_WITHIN: Final = (20, 100)  # rows from the effect on within which an episode counts as found
UNDEFINED: Final = "\N{EN DASH}"  # printed for NaN


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """Facts about one metric.

    Its unit is ``"percent"`` for a share that is printed in percent, ``"steps"`` for observation
    rows, ``"rate"`` for a plain number, such as alarms per step. `better` is empty where a metric
    describes a benchmark or a setting, `null` is the metric that says what chance or false alarms
    alone give, and `level` is the level of guaranteed alarms, such as ``"5 %"``.
    """

    name: str
    title: str
    summary: str
    unit: Unit
    better: Better = ""
    null: str = ""
    level: str = ""

    @property
    def interval(self) -> IntervalKind:
        """Kind of its interval, see `oodd_eval.metrics.bootstrap`; empty for a threshold."""
        if self.name.startswith("threshold"):
            return ""
        if self.name.startswith("false_episodes"):
            return "exact"
        return "mean" if self.unit == "steps" else "share"

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
        "what the rank goes by: anomalous scores from the effect on against the twin's at the same "
        "times",
        "percent", "higher", null="auc_placebo"),
    MetricInfo("auc_placebo", "placebo",
        "two nominal twins against each other at the same times: 0.5 within noise", "percent"),
    MetricInfo("auc_unpaired", "unpaired AUC",
        "matched AUC against the next seed's twin: without the noise that the own twin shares",
        "percent", "higher", null="auc_placebo"),
    MetricInfo("auc_smoothed", "smoothed AUC",
        "matched AUC after the same moving average for every detector: what accumulation adds",
        "percent", "higher"),
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
        "false-alarm rate: alarms before the onset over the steps before it, from row 20 on",
        "rate", "lower"),
    MetricInfo("far_twin", "FAR twin",
        "false-alarm rate over whole nominal twins", "rate", "lower"),
)

_ALARMS: Final = (
    MetricInfo("early", "Early",
        "share of anomalous episodes whose first alarm comes before the effect; they count in no "
        "other figure", "percent", "lower"),
    MetricInfo("delay", "Delay",
        "steps from the effect to the first alarm, over episodes that have one", "steps", "lower"),
    MetricInfo("missed", "Missed", "share of episodes without an alarm", "percent", "lower"),
    MetricInfo("delay_censored", "Delay censored",
        "delay with a miss counted as the whole remainder of the episode", "steps", "lower"),
    *(MetricInfo(f"found_within_{k}", f"Found within {k}",
        f"share of episodes with the first alarm in the {k} rows from the effect on, counting rows "
        "that the twin has, too",
        "percent", "higher") for k in FOUND_WITHIN),
)
# fmt: on

METRICS: Final = MappingProxyType({info.name: info for info in _METRICS})
"""Metrics without a level, in the order of records."""


def _with_nulls(infos: tuple[MetricInfo, ...]) -> list[MetricInfo]:
    found = []
    for info in infos:
        null = f"{info.name}_null"
        summary = f"{info.name} of the nominal twin: what false alarms alone give"
        found += [replace(info, null=null),
                  MetricInfo(null, f"{info.title} null", summary, info.unit)]  # fmt: skip
    return found


_BY_LEVEL: Final = {
    info.name: info
    for info in (
        MetricInfo(
            "false_episodes", "False episodes", "share of nominal twins with an alarm", "percent",
            "lower",
        ),
        *_with_nulls(_ALARMS),
        MetricInfo("threshold", "Threshold", "threshold of the statistic", "rate"),
    )
}  # fmt: skip

GUARANTEED: Final = tuple(name for name in _BY_LEVEL if name != "threshold")
"""Metrics of guaranteed alarms, which have a suffix for each level."""

NAMES: Final = (*METRICS, *(f"{name}_{suffix}" for suffix in LEVELS for name in _BY_LEVEL))
"""Every metric that a record can have."""


@functools.cache
def metric_info(name: str) -> MetricInfo:
    """Return the facts about a metric that records can have, with or without a level's suffix.

    >>> metric_info("missed_at_5pct").title
    'Missed at 5 %'
    """
    check_known("metric", NAMES, name)
    if name in METRICS:
        return METRICS[name]
    base, suffix = split_name(name)
    info = _BY_LEVEL[base]
    level = f"{100 * LEVELS[suffix]:g} %"
    return replace(
        info,
        name=name,
        title=f"{info.title} at {level}",
        summary=f"{info.summary}; at a threshold that promises an alarm in at most {level} of "
        "nominal episodes",
        null=f"{info.null}_{suffix}" if info.null else "",
        level=level,
    )


def split_name(name: str) -> tuple[str, str]:
    """Return a metric's name without the suffix of its level, and that suffix or nothing.

    >>> split_name("delay_null_at_5pct"), split_name("delay_null")
    (('delay_null', 'at_5pct'), ('delay_null', ''))
    """
    base, separator, level = name.rpartition("_at_")
    return (base, f"at_{level}") if separator else (name, "")
