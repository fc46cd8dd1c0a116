"""The catalogue of metrics: complete, consistent, and the same in records and documents."""

import re
from pathlib import Path

import pytest

from oodd_eval.errors import UnknownNameError
from oodd_eval.metrics.catalogue import (
    CALIBRATED,
    METRICS,
    NAMES,
    POOLED,
    RATIOS,
    UNDEFINED,
    metric_info,
)


def test_every_name_has_facts_and_every_null_is_a_metric():
    assert len(set(NAMES)) == len(NAMES) == 25
    for name in NAMES:
        info = metric_info(name)
        assert info.name == name
        assert info.null in ("", *METRICS)
    assert (*RATIOS, *POOLED) == tuple(METRICS)
    assert set(CALIBRATED) < set(RATIOS)


def test_the_suffix_of_a_target_is_understood():
    info = metric_info("far_at_01pct")
    assert (info.title, info.unit, info.better) == ("FAR at 0.1 %", "rate", "lower")
    assert info.summary.endswith("calibrated to 0.1 %")
    assert metric_info("threshold_at_1pct").title == "Threshold at 1 %"


@pytest.mark.parametrize("name", ["auc_mached", "auc_at_1pct", "far_at_2pct", "threshold", ""])
def test_other_names_are_refused(name):
    with pytest.raises(UnknownNameError, match="unknown metric"):
        metric_info(name)


def test_better_sides():
    better = {side: {n for n in METRICS if METRICS[n].better == side} for side in ("higher", "")}
    assert better["higher"] == {"auc", "auc_matched", "auc_pooled", "average_precision"}
    assert better[""] == {"auc_null", "auc_placebo", "delay_null"}


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("auc", 0.98765, "98.8"),
        ("delay_at_1pct", 12.34, "12.3"),
        ("far", 0.01234, "0.012"),
        ("threshold_at_1pct", 0.19491, "0.195"),
        ("delay", float("nan"), UNDEFINED),
    ],
)
def test_numbers_are_printed_by_their_unit(name, value, text):
    assert metric_info(name).text(value) == text


def test_the_documented_metrics_are_those_of_the_catalogue():
    text = (Path(__file__).parents[1] / "docs/metrics.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == list(METRICS)
