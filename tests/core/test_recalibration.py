"""What the calibration episodes do to figures of alarms, against loops over the definition."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers_records import make_record

from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.alarms import (
    STATISTICS,
    GuaranteedAlarm,
    guaranteed_contributions,
    offered_levels,
    quantile_rank,
)
from oodd_eval.metrics.auc import AlarmRule, Contribution, alarm_contributions, mean_of
from oodd_eval.metrics.bootstrap import calibration_draws, drawn_cell, mean_interval
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.ranking import differences
from oodd_eval.metrics.recalibration import DRAWS, PairedScores, Recalibration, drawn, thresholds
from oodd_eval.metrics.unpaired import UnpairedScores, unpaired_alarms
from oodd_eval.results.board import Board
from oodd_eval.results.record import STEPS, CodedDraws, Record


def record(**changes):
    return replace(make_record(environment="ant"), **changes)


def episodes(seed, n, shift=0.0, rows=80):
    """Scores with a level of their own and a spike here and there, undefined at the start."""
    rng = np.random.default_rng(seed)
    made = []
    for length in rng.integers(rows // 2, rows, size=n):
        scores = rng.normal(rng.normal(0, 0.3), 1, size=length) + rng.exponential(0.3, size=length)
        scores[length // 2 :] += shift
        scores[: rng.integers(1, 3)] = np.nan
        made.append(scores)
    return made


CALIBRATION, TWINS = episodes(1, 41), episodes(2, 6)
ANOMALOUS = [
    np.concatenate([t[:20], s[20:]]) for t, s in zip(TWINS, episodes(3, 6, 2), strict=True)
]
ONSETS = np.array([20, 22, 25, 20, 30, 21])
EFFECTS = ONSETS + np.array([0, 1, 0, 2, 0, 0])


def naive_rules(draw, kind):
    """Return the rules of one draw: the paper's, and guaranteed ones by suffix."""
    chosen, spread = (x[draw] for x in drawn("arm", len(CALIBRATION)))
    again = [CALIBRATION[i] for i in chosen]
    paper = AlarmRule(Standardization.fit(again))
    standardization, judged, chosen_judged = None, CALIBRATION, chosen
    if kind != "score":
        standardization = Standardization.fit(again[0::2])
        judged, chosen_judged, spread = CALIBRATION[1::2], chosen[1::2] // 2, spread[1::2]
    statistic = GuaranteedAlarm(standardization, math.inf)
    largest = [statistic.largest(scores) for scores in judged]
    m, ordered = len(judged), sorted(largest)
    levels = [
        (ordered.index(largest[j]) + v) / m for j, v in zip(chosen_judged, spread, strict=True)
    ]
    rules = {}
    for suffix, level in offered_levels(len(CALIBRATION), kind).items():
        height = -math.log(1 - sorted(levels)[quantile_rank(m, level) - 1])
        known = [sum(1 / (m - j) for j in range(i + 1)) for i in range(m)]
        k = math.isqrt(m)
        excess = sum(x - ordered[m - 1 - k] for x in ordered[m - k :]) / k
        if height > known[-1]:
            threshold = ordered[-1] + (height - known[-1]) * excess
        else:
            threshold = float(np.interp(height, known, ordered))
        rules[suffix] = GuaranteedAlarm(standardization, threshold)
    return paper, rules


@pytest.mark.parametrize("kind", STATISTICS)
def test_draws_and_intervals_are_those_of_the_definition(kind):
    expected = {}
    for draw in range(DRAWS):
        paper, rules = naive_rules(draw, kind)
        terms = alarm_contributions(ANOMALOUS, TWINS, ONSETS, paper)
        for suffix, rule in rules.items():
            of_level = guaranteed_contributions(ANOMALOUS, TWINS, EFFECTS, rule)
            terms |= {f"{name}_{suffix}": c for name, c in of_level.items()}
        for name, contribution in terms.items():
            expected.setdefault(name, []).append(contribution.value)
    again = Recalibration.fit(CALIBRATION, kind, "arm")
    # Two cells, so that a cell is more than the first of its block.
    cells = [PairedScores(part, TWINS, ONSETS, EFFECTS) for part in (TWINS, ANOMALOUS)]
    values = again.of_cells(cells)[1]
    assert values.keys() == expected.keys()
    assert {"far", "delay_null", "found_within_20_null_at_5pct"} <= values.keys()
    varying = 0
    for name, draws in values.items():
        np.testing.assert_allclose(draws, expected[name], rtol=1e-9, err_msg=name)
        varying += len(set(expected[name])) > 1
    assert varying > 10
    # The interval of one of them, from what a record keeps.
    name = "delay_censored_at_5pct"
    mean = sum(expected[name]) / DRAWS
    step = float(f"{np.std(expected[name]) / STEPS:.3g}")
    changes = sorted(step * round((value - mean) / step) for value in expected[name])
    below, above = (np.percentile(changes, q) for q in (2.5, 97.5))
    rule = GuaranteedAlarm.fit(CALIBRATION, 0.05, kind)
    plain = guaranteed_contributions(ANOMALOUS, TWINS, EFFECTS, rule)["delay_censored"]
    low, high = mean_interval([drawn_cell("arm", 0, plain)], kind="mean")
    ends = plain.value - math.hypot(plain.value - low, below)
    ends = max(ends, 0.0), plain.value + math.hypot(high - plain.value, above)
    noisy = replace(plain, deviations=CodedDraws.of(values)[name])
    found = mean_interval([drawn_cell("arm", 0, noisy)], kind="mean")
    assert found == pytest.approx(ends, rel=1e-3)
    assert found[1] - found[0] > high - low


@pytest.mark.parametrize("kind", ["score", "cusum"])
def test_without_twins_the_draws_are_those_of_the_definition(kind):
    intervals = [((int(start), len(s)),) for start, s in zip(ONSETS, ANOMALOUS, strict=True)]
    cell = UnpairedScores(TWINS, ANOMALOUS, intervals, [""] * 6, [""] * 6)
    values = Recalibration.fit(CALIBRATION, kind, "arm").of_cells([cell], 10.0)[0]
    for draw in (0, 7, DRAWS - 1):
        for suffix, rule in naive_rules(draw, kind)[1].items():
            for name, terms in unpaired_alarms(cell, rule, 10.0).items():
                found = values[f"{name}_{suffix}"][draw]
                assert found == pytest.approx(terms.value, nan_ok=True), name


def test_drawn_thresholds_spread_as_fresh_ones_do():
    # The largest of 20 exponential values: its standard deviation is 1.26.
    rng = np.random.default_rng(0)
    spreads, plain = [], []
    for k in range(300):
        largest = np.tile(rng.exponential(size=20), (DRAWS, 1))
        draws = drawn(f"e{k}", 20)
        spreads.append(thresholds(largest, draws, 1 / 21).std())
        plain.append(np.take_along_axis(largest, draws.episodes, axis=1).max(axis=1).std())
    truth = math.sqrt(sum(1 / k**2 for k in range(1, 21)))
    assert np.mean(spreads) == pytest.approx(truth, rel=0.1)
    assert np.mean(plain) < 0.85 * truth


def test_scores_that_do_not_vary_have_no_noise_and_no_alarm():
    still = [np.zeros(9)] * 40
    again = Recalibration.fit(still, "cusum", "arm")
    values = again.of_cells([PairedScores(still[:2], still[:2], [3, 3], [3, 3])])
    assert {name: set(v) for name, v in values[0].items()}["missed_at_5pct"] == {1.0}
    assert not any(map(len, CodedDraws.of(values[0]).values()))
    loud = [np.append(np.zeros(8), 1.0)] * 2
    cells = [PairedScores(loud, still[:2], [3, 3], [3, 3])]
    assert set(again.of_cells(cells)[0]["delay_at_5pct"]) == {5.0}


def test_a_record_keeps_draws_in_few_characters():
    values = {"far": np.linspace(0, 1, DRAWS), "missed": np.ones(DRAWS)}
    values["delay"] = np.append(np.full(DRAWS - 1, np.nan), 3.0)
    values["delay_null"] = np.append(np.full(DRAWS - 2, 7.0), [np.nan, 9.0])
    one = record(calibration_draws=CodedDraws.of(values))
    read = Record.from_json(one.to_json())
    assert read == one
    kept = read.calibration_draws
    assert kept["far"] == pytest.approx(
        values["far"] - 0.5, abs=np.std(values["far"]) / STEPS / 2 + 1e-3
    )
    assert len(kept["missed"]) == len(kept["delay"]) == 0
    assert kept["delay_null"][-2] == 0 < kept["delay_null"][-1]
    assert "calibration_draws" not in record().to_json()


@pytest.mark.parametrize("coded", [[-0.1, "UV"], [0.1, "U!"], [0.1, "U"], ["0.1", "UV"], [0.1]])
def test_other_draws_are_refused(coded):
    one = record(calibration_draws=CodedDraws({"far": (0.5, "VTU")}))
    line = one.to_json().replace(
        '"far": [0.5, "VTU"]', f'"far": [0.5, "VTUU"], "missed": {coded}'.replace("'", '"')
    )
    with pytest.raises(ResultsError, match="calibration_draws"):
        Record.from_json(line)


def contributions(values, deviations):
    return {0: {("arm", "slip"): replace(mean_of(values), deviations=np.asarray(deviations))}}


def test_calibration_noise_of_both_rows_decides_a_verdict_and_common_noise_does_not():
    rng = np.random.default_rng(0)
    values, noise = rng.normal(size=30), rng.normal(size=DRAWS)
    first, second = values + rng.normal(0.5, 0.3, size=30), values
    names = {}
    for kind, both in {"none": (0, 0), "common": (1, 1), "apart": (1, -1)}.items():
        rows = {
            "a": contributions(first, both[0] * noise), "b": contributions(second, both[1] * noise)
        }  # fmt: skip
        (names[kind],) = differences(rows, [("a", "b")])
    assert names["none"].told_apart
    assert names["common"] == names["none"]
    assert not names["apart"].told_apart
    assert names["apart"].low < 0 < names["none"].low


def test_environments_are_drawn_apart_and_cells_of_one_together():
    noise = np.random.default_rng(0).normal(size=DRAWS)

    def width(*environments):
        terms = Contribution(np.full(4, 9.0), np.ones(4), deviations=noise)
        cells = [drawn_cell(e, 0, terms) for e in environments]
        low, high = mean_interval(cells, kind="mean")
        return high - low

    one = width("ant")
    assert width("ant", "ant", "ant") == pytest.approx(one, rel=1e-3)
    assert width("ant", "hopper", "walker2d") == pytest.approx(one / math.sqrt(3), rel=0.25)
    order = calibration_draws("ant", DRAWS, 2000)
    assert np.ptp(np.bincount(order)) <= 1


def width(one, metric):
    """Width of the interval of a record's mean, in standard errors."""
    board = Board([one])
    mean = board.mean(one.setting, [one.environment], [one.anomaly], metric, intervals=True)
    return (mean.high - mean.low) / (2 * 1.96)


def test_an_interval_has_both_sources_of_noise():
    terms = np.array([[0.2, 0.4, 0.6, 0.8], np.ones(4)])
    plain = record(per_trajectory={"missed": terms})
    noise = np.random.default_rng(0).normal(0, 0.2, size=DRAWS)
    noisy = replace(plain, calibration_draws=CodedDraws.of({"missed": noise}))
    alone, both = (width(r, "missed") for r in (plain, noisy))
    assert 0.1 < alone < 0.2
    assert both == pytest.approx(math.hypot(alone, 0.2), rel=0.15)
    # A share of 1 everywhere is not exact.
    certain = record(per_trajectory={"missed": np.ones((2, 10))})
    assert width(certain, "missed") > 0.05
    assert math.isnan(width(certain, "far"))


@pytest.mark.slow
def test_a_run_of_mini_keeps_draws_and_leaves_aucs_as_they_are(tmp_path):
    from oodd_eval import evaluate

    records = evaluate("mahalanobis", load_split("mini"), environments="cartpole").records
    for one in records:
        plain = replace(one, calibration_draws=CodedDraws())
        assert len(one.calibration_draws) > 30
        widths = [width(r, "delay_censored_at_5pct") for r in (plain, one)]
        assert widths[0] < widths[1]
