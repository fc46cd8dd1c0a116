"""The catalogue of metrics: name, title, meaning, unit and better side of everything measured.

The metrics of guaranteed alarms have a name for each level, with a suffix: ``delay_at_5pct`` is the
delay where at most 5 % of nominal episodes raise an alarm. ``catalogue.toml`` has them all.
"""

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

from oodd_eval.names import check_known

Unit = Literal["percent", "steps", "rate"]
Better = Literal["higher", "lower", ""]
IntervalKind = Literal["mean", "share", "exact", "count", ""]
Cells = Literal["paired", "unpaired", ""]

RANKING: Final = "auc_matched"
"""The metric that boards rank by."""

ALARM_RANKING: Final = "delay_censored_at_5pct"
"""The metric of alarms that rows are compared by."""

LEVELS: Final[Mapping[str, float]] = MappingProxyType(
    {"at_10pct": 0.10, "at_5pct": 0.05, "at_1pct": 0.01}
)
"""Largest share of nominal episodes with an alarm, by the suffix of the metrics at this level."""

HEADLINE: Final = "at_5pct"  # suffix of the level that tables show
PAPER: Final = "The paper's alarm: meant to be false in about one row in ten"
"""Heading of all figures of alarms at the paper's threshold."""

NAMED_AFTER: Final = (0, 20)  # rows from the alarm on at which parts are named
FOUND_WITHIN: Final = (20, 100)  # rows from the effect on within which an episode counts as found
UNDEFINED: Final = "\N{EN DASH}"  # printed for NaN


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """Facts about one metric, as ``catalogue.toml`` has them.

    Attributes
    ----------
    name, title, summary
        Name in records, heading of a column, and meaning in one line.
    short
        The title without the alarm or the level that it is of, for tables whose heading names it.
    undefined
        Of a cell without a value, what all its episodes have in common; empty where there is none.
    paper
        Whether it is of the paper's alarm, which about one in ten nominal rows raises.
    unit
        ``"percent"`` for a share that is printed in percent, ``"steps"`` for observation rows,
        ``"rate"`` for a plain number, such as alarms per step.
    range
        Least and largest value of a trajectory, in the unit of records: shares are within [0, 1].
    interval
        Kind of the interval, see `oodd_eval.metrics.bootstrap.mean_interval`; empty for a metric
        that is no ratio of sums over trajectories.
    better
        The better side; empty where a metric describes a benchmark or a setting.
    null
        The metric that says what chance or false alarms alone give.
    level
        The level of guaranteed alarms, such as ``"5 %"``.
    median
        Whether a cell's value is the median over trajectories and not their mean.
    cells
        The cells that have the metric: those with twins (``"paired"``), those without, or both.
    request
        Whether it is computed only when asked for. Such a metric never ranks.
    """

    name: str
    title: str
    summary: str
    unit: Unit
    range: tuple[float, float]
    interval: IntervalKind
    better: Better = ""
    null: str = ""
    level: str = ""
    median: bool = False
    cells: Cells = ""
    request: bool = False
    short: str = ""
    undefined: str = ""
    paper: bool = False

    @property
    def noun(self) -> str:
        """The short title as it stands inside a sentence: abbreviations keep their letters."""
        return self.short if self.short[:2].isupper() else self.short[0].lower() + self.short[1:]

    @property
    def phrase(self) -> str:
        """The title as it stands inside a sentence."""
        return self.noun + self.title.removeprefix(self.short)

    @property
    def in_paper(self) -> str:
        """The title on pages of the paper: an alarm without a level is the paper's there."""
        return self.short if self.paper else self.title

    def text(self, value: float) -> str:
        """Return a value as printed: rates below 10 with three decimals, all else with one."""
        if math.isnan(value):
            return UNDEFINED
        if self.unit == "percent":
            return f"{100 * value:z.1f}"
        if self.unit == "steps" or value >= 10:
            return f"{value:z.1f}"
        return f"{value:z.3f}"

    @property
    def meaning(self) -> str:
        """The summary without the alarm that it is of, for tables whose heading names it."""
        return self.summary.partition(f"; {_PROMISE}")[0].removesuffix(f" ({_PAPERS})")


_PAPERS: Final = "the paper's alarm"
_PROMISE: Final = "at a threshold that promises"

_TABLES: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _facts(table: str) -> dict[str, MetricInfo]:
    """Return the metrics of a table of the catalogue by name, in its order."""
    rows = (
        row
        | {"range": tuple(row["range"]), "short": row["title"]}
        | {
            "title": row["title"] + ", paper's alarm" * row.get("paper", False),
            "summary": row["summary"] + f" ({_PAPERS})" * row.get("paper", False),
        }
        for row in _TABLES[table]
    )
    return {row["name"]: MetricInfo(**row) for row in rows}


METRICS: Final = MappingProxyType(_facts("metric"))
"""Metrics without a level, in the order of records."""

_BY_LEVEL: Final = _facts("alarm")

GUARANTEED: Final = tuple(name for name, info in _BY_LEVEL.items() if info.interval)
"""Metrics of guaranteed alarms over trajectories, which have a suffix for each level."""

_EXPLAINED: Final = _facts("attribution")

ATTRIBUTION: Final = tuple(f"{name}_{HEADLINE}" for name in _EXPLAINED)
"""Metrics of detectors that explain, at the headline level alone."""

INTERVENTIONS: Final = MappingProxyType(_facts("intervention"))
"""Columns of studies of interventions: no record of a cell that is scored has them."""

NAMES: Final = (
    *METRICS,
    *(f"{name}_{suffix}" for suffix in LEVELS for name in _BY_LEVEL),
    *ATTRIBUTION,
)
"""Every metric that a record can have. A record may lack any, as one of an earlier version does."""


@functools.cache
def metric_info(name: str) -> MetricInfo:
    """Return the facts about a metric that records can have, with or without a level's suffix.

    Parameters
    ----------
    name
        See ``oodd-eval list metrics``.

    Returns
    -------
    MetricInfo

    Raises
    ------
    UnknownNameError
        When the catalogue has no such metric.

    Examples
    --------
    >>> metric_info("missed_at_5pct").title
    'Missed at 5 %'
    """
    check_known("metric", NAMES, name)
    if name in METRICS:
        return METRICS[name]
    base, _, level = name.rpartition("_at_")
    suffix = f"at_{level}"
    info = _BY_LEVEL.get(base) or _EXPLAINED[base]
    percent = f"{100 * LEVELS[suffix]:g} %"
    return replace(
        info,
        name=name,
        title=f"{info.title} at {percent}",
        summary=f"{info.summary}; {_PROMISE} an alarm in at most {percent} of nominal episodes",
        null=f"{info.null}_{suffix}" if info.null else "",
        level=percent,
    )
