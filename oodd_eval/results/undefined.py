"""Reasons for figures that records do not have, from what their metrics were computed of."""

import math

from oodd_eval.data.condition import NOMINAL
from oodd_eval.metrics.alarms import missing_level, offered_levels
from oodd_eval.metrics.catalogue import ATTRIBUTION, LEVELS, metric_info
from oodd_eval.results.record import Record


def why_undefined(record: Record, metric: str) -> str:
    """Return why a record has no value of a metric; empty where it has one, or no reason is known.

    Parameters
    ----------
    record
        Of a cell; one that failed has its own reason.
    metric
        See ``oodd-eval list metrics``.

    Returns
    -------
    str
        A phrase without a full stop.
    """
    if not record.ok or not math.isnan(record.value(metric)):
        return ""
    info = metric_info(metric)
    if metric in record.metrics:
        return info.undefined
    if info.cells == "paired" and not record.paired:
        return "the episodes have no nominal twins"
    if info.cells == "unpaired" and record.paired:
        return "it is for episodes without nominal twins"
    withheld, _, reason = record.note.partition(" are withheld: ")
    if metric in withheld.split(", "):
        return reason
    if info.level and (reason := _left_out(record, metric)):
        return reason
    if metric in ATTRIBUTION:
        return "the detector does not explain its scores"
    if record.condition == NOMINAL:
        return "there are no anomalous episodes"
    return "it is computed with --row-metrics alone" if info.request else ""


def _left_out(record: Record, metric: str) -> str:
    """Return how many calibration episodes a metric's level takes; empty if there are enough."""
    suffix = f"at_{metric.rpartition('_at_')[2]}"
    for note in record.note.split("; "):  # a rolling calibration takes more
        if note.startswith(f"guaranteed alarms at {metric_info(metric).level} are left out: "):
            return note.partition(": ")[2]
    episodes = record.counts.get("calibration")
    if episodes is None or suffix in offered_levels(episodes, record.alarm):
        return ""
    return missing_level(episodes, LEVELS[suffix], record.alarm)
