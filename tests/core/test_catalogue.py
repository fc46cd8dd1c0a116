"""The catalogue of metrics: complete, consistent, and the same in records and documents."""

import re
from pathlib import Path

import pytest

from oodd_eval.errors import UnknownNameError
from oodd_eval.metrics.catalogue import (
    ALARM_RANKING,
    ATTRIBUTION,
    GUARANTEED,
    HEADLINE,
    INTERVENTIONS,
    LEVELS,
    NAMES,
    RANKING,
    UNDEFINED,
    metric_info,
)


def test_every_name_has_facts_and_every_null_is_a_metric():
    assert len(set(NAMES)) == len(NAMES)
    for name in NAMES:
        info = metric_info(name)
        assert info.name == name
        assert info.null in ("", *NAMES)
    for name in (RANKING, ALARM_RANKING):
        assert name in NAMES
    assert HEADLINE in LEVELS


def test_the_names_of_a_level_are_those_of_its_metrics_their_nulls_and_the_threshold():
    own = ["early", "delay", "missed", "delay_censored", "found_within_20", "found_within_100"]
    expected = ["false_episodes", *(n for name in own for n in (name, f"{name}_null"))]
    expected += ["events_found", "false_alarms_per_hour", "found_outcome", "found_outcome_null"]
    expected += ["balanced_outcome", "outcome_time"]
    assert list(GUARANTEED) == expected
    sets = [f"named_{of}{after}" for after in ("", "_20") for of in ("precision", "recall")]
    named = ["sensor_named", "onset_error", *sets, "named_chance", "named_largest", "kind_named"]
    assert {n for n in NAMES if n.endswith("_at_5pct")} == {
        f"{name}_at_5pct" for name in [*expected, "threshold", *named]
    }
    assert list(ATTRIBUTION) == [f"{name}_at_5pct" for name in named]
    assert metric_info("named_precision_at_5pct").null == "named_chance_at_5pct"
    assert metric_info("named_recall_at_5pct").null == "named_largest_at_5pct"
    assert [n for n in NAMES if metric_info(n).median] == ["onset_error_at_5pct"]


def test_the_suffix_of_a_level_is_understood():
    info = metric_info("missed_at_10pct")
    assert (info.title, info.unit, info.better) == ("Missed at 10 %", "percent", "lower")
    assert (info.null, info.level) == ("missed_null_at_10pct", "10 %")
    assert info.summary.endswith("in at most 10 % of nominal episodes")
    assert metric_info("threshold_at_1pct").title == "Threshold at 1 %"
    for name in NAMES:
        assert bool(metric_info(name).level) == ("_at_" in name)


@pytest.mark.parametrize(
    "name", ["auc_mached", "auc_at_1pct", "missed_at_2pct", "threshold", "", "sensor_named_at_1pct"]
)
def test_other_names_are_refused(name):
    with pytest.raises(UnknownNameError, match="unknown metric"):
        metric_info(name)


_BESIDE = ("null", "placebo", "threshold", "before", "chance", "largest")


def test_better_sides():
    """Nulls and their like describe a benchmark or a setting; the others rank rows."""
    for name in NAMES:
        beside = any(word in name for word in _BESIDE)
        assert bool(metric_info(name).better) != beside, name
    found = [n for n in NAMES if n.startswith("found") and "null" not in n]
    for name in ("auc", RANKING, "sensor_named_at_5pct", "named_recall_20_at_5pct", *found):
        assert metric_info(name).better == "higher"
    for name in (ALARM_RANKING, "far", "missed", "onset_error_at_5pct", "brier_outcome"):
        assert metric_info(name).better == "lower"


def test_metrics_without_twins_and_those_on_request():
    facts = {name: metric_info(name) for name in NAMES}
    assert {n for n in facts if facts[n].request} == {"f1_rows", "far_rows", "mar_rows", "vus_pr"}
    assert {n.partition("_at_")[0] for n in facts if facts[n].cells == "unpaired"} == {
        "auc_pool", "auc_pool_null", "auc_rows", "auc_outcome", "auc_outcome_half",
        "auc_outcome_whole", "brier_outcome", "f1_rows", "far_rows", "mar_rows", "vus_pr",
        "events_found", "false_alarms_per_hour", "found_outcome", "found_outcome_null",
        "balanced_outcome", "outcome_time",
    }  # fmt: skip
    for name, info in facts.items():
        assert not info.null or facts[info.null].cells in (info.cells, "")
        assert "_null" not in name or f"{name.replace('_null', '')}" in facts


def test_kinds_of_intervals():
    kinds = {name: metric_info(name).interval for name in NAMES}
    assert {n for n in NAMES if kinds[n] == "exact"} == {f"false_episodes_{s}" for s in LEVELS}
    rates = {f"false_alarms_per_hour_{s}" for s in LEVELS}
    assert {n for n in NAMES if kinds[n] == "count"} == rates
    assert {n for n in NAMES if not kinds[n]} == {f"threshold_{s}" for s in LEVELS}
    assert {n.partition("_at_")[0] for n in NAMES if kinds[n] == "mean"} == {
        "delay", "delay_null", "delay_censored", "delay_censored_null", "onset_error",
        "outcome_time", "brier_outcome",
    }  # fmt: skip


def test_numbers_are_printed_by_their_unit():
    texts = {
        ("auc", 0.98765): "98.8", ("delay_at_1pct", 12.34): "12.3", ("far", 0.01234): "0.012",
        ("missed_at_5pct", 0.25): "25.0", ("threshold_at_1pct", 0.19491): "0.195",
        ("delay", float("nan")): UNDEFINED, ("far", -1e-9): "0.000", ("auc", -1e-9): "0.0",
    }  # fmt: skip
    assert {key: metric_info(key[0]).text(key[1]) for key in texts} == texts


def test_the_documented_metrics_are_those_of_the_catalogue():
    text = (Path(__file__).parents[2] / "docs/metrics.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    names = {name.partition("_at_")[0] for name in NAMES}
    assert {*documented} <= names
    # Of the nulls of alarms one sentence speaks.
    assert {name for name in names - {*documented} if not name.endswith("_null")} == set()


def test_columns_of_interventions_are_no_metrics_of_records():
    """They have the same facts, and stand in records of their own."""
    assert not {*INTERVENTIONS} & {*NAMES}
    for name, info in INTERVENTIONS.items():
        assert info.name == name
        assert info.null in ("", *INTERVENTIONS)
    better = {name: info.better for name, info in INTERVENTIONS.items()}
    assert [n for n, side in better.items() if side == "higher"] == ["return_saved", "safety_gain"]
    assert [n for n, side in better.items() if not side] == [
        "placebo_saved",
        "forced_harm",
        "acted",
    ]
