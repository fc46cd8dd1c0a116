"""Curves: hand-worked points, areas and rates against the metrics, a strict reader."""

import copy
import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oodd_leaderboard.curve_file import check_curves, make_curves, read_curves, write_curves
from oodd_leaderboard.curves import (
    FPR,
    Sweep,
    delay_far,
    example,
    mean_matched_roc,
    roc,
    rounded,
    thresholds,
)

from oodd_eval import evaluate
from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import AlarmRule, alarm_contributions, auc_contributions
from oodd_eval.metrics.cusum import THRESHOLD, UNIT, Standardization, cusum
from oodd_eval.results.directory import ResultsDirectory

RULE = AlarmRule(Standardization(mean=0.0, std=1.0))
FINE = np.linspace(0, 1, 20_001)
NAN = math.nan


def cell(rng, n=4, shift=1.0):
    """Scores of n anomalous trajectories with twins, of different lengths, and onsets."""
    lengths = rng.integers(90, 160, size=(n, 2))
    twins = [rng.normal(size=length) for _, length in lengths]
    anomalous = [rng.normal(size=length) for length, _ in lengths]
    onsets = [int(rng.integers(30, 60)) for _ in range(n)]
    for scores, onset in zip(anomalous, onsets, strict=True):
        scores[onset:] += shift
        scores[:2] = NAN
    return anomalous, twins, onsets


# -- ROC ------------------------------------------------------------------------------------------


@given(
    arrays(np.float64, st.integers(1, 8), elements=st.integers(-3, 3)),
    arrays(np.float64, st.integers(1, 8), elements=st.integers(-3, 3)),
)
def test_roc_is_the_polygon_of_counted_rates(positives, negatives):
    # The slow way: rates at every threshold, one after the other.
    scores = sorted({*positives.tolist(), *negatives.tolist()}, reverse=True)
    x = [0.0] + [float(np.mean(negatives >= s)) for s in scores]
    y = [0.0] + [float(np.mean(positives >= s)) for s in scores]
    expected = []
    for f in FPR:
        value = 0.0
        for i in range(len(scores)):
            if x[i] <= f <= x[i + 1]:
                width = x[i + 1] - x[i]
                share = (f - x[i]) / width if width else 1.0
                value = max(value, y[i] + share * (y[i + 1] - y[i]))
        expected.append(value)
    np.testing.assert_allclose(roc(positives, negatives, np.array(FPR)), expected, atol=1e-12)


def test_area_under_the_averaged_curve_is_the_matched_auc():
    anomalous, twins, onsets = cell(np.random.default_rng(0))
    area = np.trapezoid(mean_matched_roc(anomalous, twins, onsets, FINE), FINE)
    matched = auc_contributions(anomalous, twins, onsets, onsets, RULE.standardization)[
        "auc_matched"
    ].value
    assert area == pytest.approx(matched, abs=2e-4)
    assert 0.6 < matched < 0.9


# -- delay and false-alarm rate -------------------------------------------------------------------


def test_thresholds_reach_from_every_alarm_to_none():
    twins = cell(np.random.default_rng(2))[1]
    at = thresholds(twins, RULE)
    assert at[0] == 0.0
    assert THRESHOLD in at
    assert (np.diff(at) > 0).all()
    found = delay_far(Sweep.over(twins, RULE, at), twins, [30] * len(twins))
    assert found["far"][-1] == 0.0
    assert found["far"][0] > 0.2
    assert found["far"] == sorted(found["far"], reverse=True)


def test_each_point_is_the_metrics_under_that_threshold():
    anomalous, twins, onsets = cell(np.random.default_rng(3))
    sweep = Sweep.over(twins, RULE, np.array([0.0, THRESHOLD, 0.5, 50.0]))
    found = delay_far(sweep, anomalous, onsets)
    assert found["threshold"] == [0.0, THRESHOLD, 0.5, 50.0]
    for i, threshold in enumerate(found["threshold"]):
        rule = dataclasses.replace(RULE, threshold=threshold)
        cell_metrics = alarm_contributions(anomalous, twins, onsets, rule)
        null = alarm_contributions(twins, twins, onsets, rule)
        assert found["far"][i] == cell_metrics["far_twin"].value
        assert found["delay_censored"][i] == cell_metrics["delay_censored"].value
        assert found["missed"][i] == cell_metrics["missed"].value
        assert found["null_censored"][i] == null["delay_censored"].value
    # At the last threshold nothing alarms: everything is missed, at the full remainder.
    remainders = [len(a) - t for a, t in zip(anomalous, onsets, strict=True)]
    assert (found["missed"][3], found["delay_censored"][3]) == (1.0, np.mean(remainders))


def test_without_a_defined_score_there_is_no_curve():
    nothing = [np.full(80, NAN)]
    assert delay_far(Sweep.over(nothing, RULE, np.ones(1)), nothing, [30])["far"] == []
    assert np.isnan(mean_matched_roc(nothing, nothing, [30])).all()


# -- example --------------------------------------------------------------------------------------


def test_example_is_the_trajectory_with_the_median_matched_auc():
    twins = [np.zeros(60)] * 4
    anomalous = [np.full(60, value) for value in (1.0, -1.0, 0.0, 1.0)]
    # Matched AUCs 1, 0, 1/2, 1: the lower median is 1/2.
    found = example(anomalous, twins, [30] * 4, [30] * 4, RULE)
    assert (found["index"], found["auc_matched"]) == (2, 0.5)
    found = example(anomalous[:2] + anomalous[3:], twins[:3], [30] * 3, [30] * 3, RULE)
    assert (found["index"], found["auc_matched"]) == (0, 1.0)


def test_example_shows_rows_around_the_onset_in_standard_deviations():
    scores = np.arange(200.0)
    rule = AlarmRule(Standardization(mean=100.0, std=50.0))
    found = example([scores], [scores[:120]], [100], [100], rule)
    assert (found["start"], found["onset"], found["length"]) == (60, 100, 200)
    assert found["scores"] == pytest.approx([(t - 100) / 50 for t in range(60, 160)])
    assert len(found["twin"]) == 60
    statistic, alarms = cusum(UNIT * (scores - 100) / 50)
    assert found["cusum"] == pytest.approx(statistic[60:160])
    assert found["alarms"] == [int(t) for t in np.flatnonzero(alarms) if 60 <= t < 160]
    assert found["twin_alarms"] == [t for t in found["alarms"] if t < 120]
    scores = np.concatenate([[NAN, NAN], np.ones(60)])
    found = example([scores], [scores], [30], [30], RULE)
    assert (found["scores"][:3], found["cusum"][:2]) == ([None, None, 1.0], [0.0, 0.0])


# -- from stored scores ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stored(tiny_split, tmp_path_factory):
    """Records of a run, the directory with its scores, and the curves made of them."""
    output = tmp_path_factory.mktemp("results")
    cells = {"environments": "cartpole", "anomalies": "iid,gravity"}
    records = evaluate("persistence", tiny_split, output=output, **cells)
    results = ResultsDirectory(output)
    return records, results, make_curves(records, results, load_split(tiny_split))


def test_curves_of_a_run_agree_with_its_records(stored):
    records, _, curves = stored
    assert [u["cell"] for u in curves["units"]] == [str(r.cell) for r in records]
    for record, unit in zip(records, curves["units"], strict=True):
        assert (unit["environment"], unit["anomaly"]) == ("cartpole", record.anomaly)
        points = unit["delay_far"]
        at = points["threshold"].index(THRESHOLD)
        assert points["far"][at] == pytest.approx(record.value("far_twin"), rel=1e-2)
        for name in ("delay_censored", "missed"):
            assert points[name][at] == pytest.approx(record.value(name), rel=1e-2)
        # 25 points, so coarser than the metric.
        area = np.trapezoid(unit["roc"]["tpr"], unit["roc"]["fpr"])
        assert area == pytest.approx(record.value("auc_matched"), abs=0.03)
        areas = record.per_trajectory["auc_matched"][0]
        assert unit["example"]["auc_matched"] == pytest.approx(np.median(areas), rel=1e-2)


def test_written_curves_are_read_back(stored, tmp_path):
    write_curves(stored[2], tmp_path / "curves.json")
    assert read_curves(tmp_path / "curves.json") == stored[2]
    assert rounded({"a": [1 / 3, 2.0, 123456.0, 1e-9], "b": None, "c": math.inf}) == {
        "a": [0.333, 2, 123000, 0], "b": None, "c": 10**12,
    }  # fmt: skip
    # 56 cells have to stay below 250 kB.
    assert (tmp_path / "curves.json").stat().st_size / 2 < 250_000 / 56


@pytest.mark.parametrize("text", [None, "{", "[" * 100_000, "\xff"])
def test_files_that_are_no_json_are_refused(tmp_path, text):
    file = tmp_path / "curves.json"
    if text is not None:
        file.write_text(text, encoding="latin-1")
    with pytest.raises(ResultsError, match="cannot be read"):
        read_curves(file)


DAMAGE = [
    ("schema", 2),
    ("schema", True),
    ("units", {}),
    ("more", 1),
    ("units.0", []),
    ("units.0.cell", 7),
    ("units.0.environment", "moon"),
    ("units.0.anomaly", "x"),
    ("units.0.horizon", "1"),
    ("units.0.seed", False),
    ("units.0.roc.tpr", [0.5]),
    ("units.0.roc.tpr", [0.5] * 2000),
    ("units.0.roc.tpr.3", 1.1),
    ("units.0.roc.fpr.2", 0.0),  # they rise
    ("units.0.roc.fpr.2", math.nan),
    ("units.0.delay_far.far.0", -0.1),
    ("units.0.delay_far.delay_censored.0", math.inf),
    ("units.0.delay_far.delay_censored.0", 10**400),
    ("units.0.example.index", 1.0),
    ("units.0.example.auc_matched", 2),
    ("units.0.example.onset", 999),
    ("units.0.example.start", 60),
    ("units.0.example.scores", []),
    ("units.0.example.scores", [0] * 500),
    ("units.0.example.scores.1", 1e16),
    ("units.0.example.cusum.1", None),
    ("units.0.example.alarms.0", 500),
    ("units.1.cell", "the first one's"),
]


@pytest.mark.parametrize(("path", "value"), DAMAGE, ids=lambda x: str(x)[:40])
def test_every_damaged_field_is_named(stored, path, value):
    plain = copy.deepcopy(stored[2])
    place = {"": plain}
    *way, last = (int(step) if step.isdigit() else step for step in ["", *path.split(".")])
    for step in way:
        place = place[step]
    place[last] = plain["units"][0]["cell"] if path == "units.1.cell" else value
    if path.endswith("alarms.0"):
        plain["units"][0]["example"]["alarms"] = [value]
    with pytest.raises(ResultsError) as caught:
        check_curves(plain, "curves.json")
    name = re.sub(r"\.(\d+)", r"[\1]", path)
    assert str(caught.value).startswith(f"curves.json: {name}")
