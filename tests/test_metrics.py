"""Metrics against hand-worked numbers, scikit-learn, and what must hold for any detector."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score, roc_auc_score, roc_curve

from oodd_eval.metrics.auc import (
    AlarmRule,
    Contribution,
    alarm_contributions,
    auc,
    auc_contributions,
    cell_contributions,
    pooled_metrics,
)
from oodd_eval.metrics.catalogue import POOLED, RATIOS
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.results.evaluate import Rules, cell_metrics

NAN = math.nan
# Alarm exactly where the score is above 1.
RULE = AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.0, threshold=1.0)


def arrays(*sequences):
    return [np.array(s, dtype=float) for s in sequences]


def test_auc_counts_ties_half():
    assert auc(np.array([2.0, 3.0]), np.array([1.0, 2.0])) == 3.5 / 4


@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=30),
    st.lists(st.integers(0, 5), min_size=1, max_size=30),
)
def test_auc_is_scikit_learns(positives, negatives):
    labels = [1] * len(positives) + [0] * len(negatives)
    expected = roc_auc_score(labels, positives + negatives)
    assert auc(np.array(positives, float), np.array(negatives, float)) == pytest.approx(expected)


def test_auc_leaves_undefined_scores_out_and_needs_both_classes():
    assert auc(np.array([NAN, 2.0]), np.array([NAN, 1.0])) == 1
    assert math.isnan(auc(np.array([NAN]), np.array([1.0])))


@given(st.lists(st.integers(-9, 9).map(float), min_size=4, max_size=20))
def test_auc_does_not_change_under_a_monotone_transform(values):
    a, b = np.array(values[::2]), np.array(values[1::2])
    assert auc(a, b) == auc(2 * a + 1, 2 * b + 1)


def test_paper_auc_compares_scores_from_the_onset_on_with_those_before():
    found = auc_contributions(arrays([0, 1, 5, 6]), arrays([3, 2, 1, 0]), [2])
    assert found["auc"].value == 1
    assert found["auc_null"].value == 0


def test_matched_auc_compares_the_same_times_of_anomalous_and_twin():
    # Times 1 and 2: the twin ends there.
    found = auc_contributions(arrays([9, 1, 2, 50]), arrays([9, 1, 1]), [1])
    assert found["auc_matched"].value == (0.5 + 0.5 + 1 + 1) / 4


def test_placebo_compares_each_twin_with_the_next():
    twins = arrays([0, 1, 1], [0, 2, 0], [0, 0, 0])
    found = auc_contributions(arrays(*[[0, 0, 0]] * 3), twins, [1, 1, 1])
    # 1, 1 against 2, 0; 2, 0 against 0, 0; 0, 0 against 1, 1
    assert found["auc_placebo"].numerator.tolist() == [0.5, 0.75, 0.0]


def test_placebo_of_a_clock_is_one_half_although_twins_differ_in_length():
    clock = [np.arange(n, dtype=float) for n in (60, 90, 75)]
    assert auc_contributions(clock, clock, [30, 40, 50])["auc_placebo"].value == 0.5


def test_placebo_of_a_single_twin_is_undefined():
    assert math.isnan(auc_contributions(arrays([0, 1]), arrays([0, 1]), [1])["auc_placebo"].value)


def test_clock_has_paper_auc_one_and_matched_auc_one_half():
    clock = [np.arange(n, dtype=float) for n in (80, 120, 95)]
    twins = [np.arange(100, dtype=float)] * 3
    found = auc_contributions(clock, twins, [30, 40, 50])
    assert found["auc"].value == 1
    equal = auc_contributions(twins, twins, [30, 40, 50])
    assert equal["auc_matched"].value == equal["auc_placebo"].value == 0.5


def test_a_constant_detector_has_every_auc_one_half():
    flat = [np.zeros(50)] * 3
    found = auc_contributions(flat, flat, [10, 20, 30])
    assert {c.value for c in found.values()} == {0.5}


def test_delay_counts_from_the_onset_and_may_be_zero():
    found = alarm_contributions(
        arrays([0, 0, 2, 0], [0, 0, 0, 2]), arrays([0] * 4, [0] * 4), [2, 2], RULE
    )
    assert found["delay"].numerator.tolist() == [0, 1]
    assert found["missed"].value == 0


def test_a_miss_has_no_delay_and_the_whole_remainder_as_censored_delay():
    found = alarm_contributions(
        arrays([0, 0, 2, 0], [0, 0, 0, 0]), arrays([0] * 4, [0] * 4), [1, 1], RULE
    )
    assert (found["delay"].value, found["delay"].n) == (1, 1)
    assert found["missed"].value == 0.5
    # T = 3, onset 1: T - onset + 1 = 3
    assert found["delay_censored"].numerator.tolist() == [1, 3]


def test_false_alarms_are_pooled_over_defined_steps_before_the_onset():
    anomalous = arrays([NAN, 2, 0, 9], [NAN, 0, 0, 9])
    found = alarm_contributions(anomalous, arrays([0] * 4, [0, 2, 2, 0]), [3, 3], RULE)
    assert (found["far"].numerator.sum(), found["far"].denominator.sum()) == (1, 4)
    assert found["far_twin"].value == 2 / 8


def test_an_alarm_before_the_onset_is_not_a_detection():
    found = alarm_contributions(arrays([2, 0, 0]), arrays([0, 0, 0]), [1], RULE)
    assert found["missed"].value == 1
    assert math.isnan(found["delay"].value)


def test_the_sum_is_not_reset_at_the_onset():
    rule = AlarmRule(Standardization(0.0, 0.01), drift=0.0, threshold=1.0)
    assert alarm_contributions(arrays([0.6, 0.6]), arrays([0, 0]), [1], rule)["delay"].value == 0


def test_delay_null_is_the_twins_delay_at_its_partners_onset():
    found = alarm_contributions(arrays([0, 0, 0]), arrays([0, 0, 2]), [1], RULE)
    assert found["delay_null"].value == 1


@given(st.permutations(range(4)))
def test_values_do_not_depend_on_the_order_of_trajectories(order):
    rng = np.random.default_rng(0)
    scores, twins = list(rng.normal(size=(4, 40))), list(rng.normal(size=(4, 40)))
    onsets = [5, 10, 15, 20]

    def pick(values):
        return [values[i] for i in order]

    first = cell_contributions(scores, twins, onsets, RULE)
    second = cell_contributions(pick(scores), pick(twins), pick(onsets), RULE)
    for name in set(RATIOS) - {"auc_placebo"}:  # the placebo pairs neighbours
        assert first[name].value == pytest.approx(second[name].value, nan_ok=True)


def test_cell_has_every_metric_in_order():
    flat = [np.zeros(50)] * 2
    assert list(cell_contributions(flat, flat, [10, 20], RULE)) == list(RATIOS)


def test_a_ratio_without_denominator_is_undefined():
    empty = Contribution(np.zeros(2), np.zeros(2))
    assert math.isnan(empty.value)
    assert empty.n == 0


POOLS = st.lists(
    st.tuples(st.lists(st.integers(0, 6), min_size=2, max_size=30), st.integers(0, 30)),
    min_size=1,
    max_size=5,
)


@given(POOLS)
def test_pooled_metrics_are_scikit_learns(trajectories):
    scores = [np.array(values, float) for values, _ in trajectories]
    onsets = [min(onset, len(values)) for values, onset in trajectories]
    pool = np.concatenate(scores)
    labels = np.concatenate([np.arange(len(s)) >= t for s, t in zip(scores, onsets, strict=True)])
    found = pooled_metrics(scores, onsets)
    assert list(found) == list(POOLED)
    if labels.all() or not labels.any():
        assert all(map(math.isnan, found.values()))
        return
    fpr, tpr, _ = roc_curve(labels, pool, drop_intermediate=False)
    assert found["auc_pooled"] == pytest.approx(roc_auc_score(labels, pool))
    assert found["average_precision"] == pytest.approx(average_precision_score(labels, pool))
    assert found["fpr95"] == pytest.approx(fpr[np.argmax(tpr >= 0.95)])


def test_pooled_metrics_by_hand():
    # Positives 3, 1 | 2; negatives 2 | 0: at or above 3, 2, 1 there are 1, 2, 3 positives and
    # 0, 1, 1 negatives.
    found = pooled_metrics(arrays([NAN, 2, 3, 1], [0, 2]), [2, 1])
    assert found["auc_pooled"] == (2 + 1 + 1.5) / 6
    assert found["average_precision"] == pytest.approx((1 + 2 / 3 + 3 / 4) / 3)
    assert found["fpr95"] == 1 / 2


def test_95_percent_of_the_positives_are_enough_and_fewer_are_not():
    # Twenty positives, the lowest below all negatives: nineteen are 95 %, eighteen are not.
    negatives = [5.0, 4.0]
    assert pooled_metrics(arrays([*negatives, *[9.0] * 19, 1.0]), [2])["fpr95"] == 0
    assert pooled_metrics(arrays([*negatives, *[9.0] * 18, 4.5, 1.0]), [2])["fpr95"] == 1 / 2


def test_pooled_metrics_without_a_class_are_undefined():
    assert all(map(math.isnan, pooled_metrics(arrays([NAN, 1, 2]), [1]).values()))
    assert all(map(math.isnan, pooled_metrics(arrays([1, 2, NAN]), [2]).values()))
    assert all(map(math.isnan, pooled_metrics(arrays([NAN, NAN]), [1]).values()))


def test_a_cell_has_the_pooled_metrics_last_without_interval_or_contribution():
    rng = np.random.default_rng(3)
    calibration = list(rng.normal(size=(4, 300)))
    scores, twins = list(rng.normal(size=(3, 80))), list(rng.normal(size=(3, 80)))
    scores[2][:] = NAN
    metrics, contributions = cell_metrics(
        scores, twins, [10, 20, 30], Rules.fit(calibration), environment="hopper"
    )
    assert list(metrics)[-3:] == list(POOLED)
    expected = pooled_metrics(scores, [10, 20, 30])
    for name in POOLED:
        assert (metrics[name].value, metrics[name].n) == (expected[name], 2)
        assert math.isnan(metrics[name].low)
        assert name not in contributions
