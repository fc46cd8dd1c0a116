"""Tolerances: by how much a metric may change, and which way counts as worse.

Written as ``METRIC:[+-]NUMBER[%]``. The sign says which way is worse: ``auc:-0.01`` fails where the
AUC fell by more than 0.01, ``delay:+10%`` where the delay rose by more than 10 % of the reference.
Without a sign the metric's own worse side is meant; both sides for one that has none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.metrics.alarms import CALIBRATED, TARGETS
from oodd_eval.metrics.auc import HIGHER_IS_BETTER, METRICS, POOLED

Side = Literal["+", "-", "±"]

KNOWN: Final = (
    *METRICS,
    *POOLED,
    *(f"{name}_{suffix}" for suffix in TARGETS for name in (*CALIBRATED, "threshold")),
)
"""Every metric that a record can have."""

_NEITHER: Final = frozenset({"auc_null", "auc_placebo", "delay_null", "threshold"})

_GRAMMAR: Final = re.compile(r"([^:\s]+):([+-]?)(\d+(?:\.\d*)?|\.\d+)(%?)")


def worse_side(metric: str) -> Side:
    """Return the way in which a metric gets worse: ``"+"``, ``"-"``, or ``"±"`` for neither.

    Null values, the placebo and thresholds describe a benchmark or a setting, and a metric that
    this version does not know could mean anything: a change of those is neither good nor bad.
    """
    base = metric.partition("_at_")[0]
    if base in HIGHER_IS_BETTER:
        return "-"
    return "+" if metric in KNOWN and base not in _NEITHER else "±"


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far one metric may move to its worse side.

    Attributes
    ----------
    metric
        Name of the metric.
    worse
        ``"+"`` where a rise is worse, ``"-"`` where a fall is, ``"±"`` where either is.
    amount
        Not negative; in the metric's unit, or in percent of the reference's absolute value.
    percent
        Which of the two.
    """

    metric: str
    worse: Side
    amount: float
    percent: bool = False

    @property
    def text(self) -> str:
        """Sign and number, such as ``-0.01`` or ``+10%``."""
        return f"{self.worse}{self.amount:g}{'%' if self.percent else ''}"

    def allowed(self, reference: float) -> float:
        """Return the largest change that passes, in the metric's unit."""
        return self.amount / 100 * abs(reference) if self.percent else self.amount


def parse_tolerance(text: str, known: Iterable[str] = KNOWN) -> Tolerance:
    """Read a tolerance as it is written on the command line.

    Parameters
    ----------
    text
        Such as ``"auc:-0.01"``.
    known
        Metrics that may be named.

    Raises
    ------
    UnknownNameError
        When the metric does not exist.
    UsageError
        When the text has another form, or its sign is the metric's better side.

    Examples
    --------
    >>> parse_tolerance("delay:+10%")
    Tolerance(metric='delay', worse='+', amount=10.0, percent=True)
    """
    match = _GRAMMAR.fullmatch(text.strip())
    if not match:
        raise UsageError(
            f"tolerance {text!r}, expected METRIC:[+-]NUMBER[%] such as 'auc:-0.01' (fell by more "
            "than 0.01) or 'delay:+10%' (rose by more than 10 %)"
        )
    metric, sign, number, percent = match.groups()
    names = list(known)
    if metric not in names:
        raise UnknownNameError("metric", metric, names)
    worse = worse_side(metric)
    if sign and worse not in (sign, "±"):
        better = "higher" if worse == "-" else "lower"
        raise UsageError(
            f"tolerance {text!r}: of {metric}, {better} is better, so the sign that counts as "
            f"worse is {worse!r}: write '{metric}:{worse}{number}{percent}', and --two-sided to "
            "have improvements fail too"
        )
    side: Side = "+" if sign == "+" else "-" if sign == "-" else worse
    return Tolerance(metric, side, float(number), bool(percent))


def parse_tolerances(texts: Sequence[str], known: Iterable[str] = KNOWN) -> list[Tolerance]:
    """Read several tolerances, one for a metric.

    Raises
    ------
    UsageError
        As `parse_tolerance`, and when a metric is named twice.
    """
    names = list(known)
    found: dict[str, Tolerance] = {}
    for text in texts:
        tolerance = parse_tolerance(text, names)
        if tolerance.metric in found:
            raise UsageError(f"two tolerances for {tolerance.metric}, expected one")
        found[tolerance.metric] = tolerance
    return list(found.values())


def strict_tolerances(metrics: Iterable[str]) -> list[Tolerance]:
    """Return what holds where nothing was asked for: no metric with a worse side may move to it."""
    return [Tolerance(m, worse_side(m), 0.0) for m in metrics if worse_side(m) != "±"]
