"""Metrics against hand-worked numbers, scikit-learn, and what must hold for any detector."""

import math

import numpy as np
import pytest
from helpers_records import PAIRED
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

from oodd_eval.metrics.auc import AlarmRule, alarm_contributions, auc, cell_contributions, smoothed
from oodd_eval.metrics.auc import auc_contributions as every_auc
from oodd_eval.metrics.catalogue import ATTRIBUTION, GUARANTEED, NAMES, metric_info
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.recalibration import PairedScores
from oodd_eval.results.evaluate import Rules, cell_metrics

NAN = math.nan
# Alarm exactly where the score is above 1.
RULE = AlarmRule(Standardization(mean=0.0, std=0.01), drift=0.0, threshold=1.0)


def arrays(*sequences):
    return [np.array(s, dtype=float) for s in sequences]


def auc_contributions(anomalous, twins, onsets, effects=None, standardization=None):
    """The AUCs where every anomaly has its effect at once."""
    own = standardization or Standardization(0.0, 1.0)
    return every_auc(anomalous, twins, onsets, effects or onsets, own)


@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=30),
    st.lists(st.integers(0, 5), min_size=1, max_size=30),
)
def test_auc_is_scikit_learns(positives, negatives):
    labels = [1] * len(positives) + [0] * len(negatives)
    expected = roc_auc_score(labels, positives + negatives)
    assert auc(np.array(positives, float), np.array(negatives, float)) == pytest.approx(expected)


def test_auc_counts_ties_half_leaves_undefined_scores_out_and_needs_both_classes():
    assert auc(np.array([2.0, 3.0]), np.array([1.0, 2.0])) == 3.5 / 4
    assert auc(np.array([NAN, 2.0]), np.array([NAN, 1.0])) == 1
    assert math.isnan(auc(np.array([NAN]), np.array([1.0])))


@pytest.mark.parametrize(
    ("scores", "onset", "expected"),
    [
        # 2, 3, 5 after 1, 4: wins of 1, 1 and 2 pairs.
        ([1, 4, 2, 3, 5], 2, 4 / 6),
        # 4, 2, 3, 5 after 1 alone; a row of the onset left out would change nothing here.
        ([1, 4, 2, 3, 5], 1, 1),
        # 3 ties with 3: the row of the onset itself counts.
        ([3, 1, 2, 3, 0, 2], 3, (2.5 + 0 + 1.5) / 9),
        ([NAN, 1, 4, NAN, 2, 5], 3, 3 / 4),
        ([1, 2], 0, NAN),
        ([1, 2], 2, NAN),
    ],
)
def test_paper_auc_in_worked_numbers(scores, onset, expected):
    flat = np.zeros(len(scores))
    found = auc_contributions([np.array(scores, float), flat], [flat] * 2, [onset, 1])
    assert found["auc"].numerator[0] == pytest.approx(np.nan_to_num(expected), abs=1e-15)
    assert found["auc"].denominator[0] == (not math.isnan(expected))
    twin = auc_contributions([flat], arrays(scores), [onset])
    assert twin["auc_null"].value == pytest.approx(expected, abs=1e-15, nan_ok=True)


def test_matched_auc_compares_the_same_times_of_anomalous_and_twin():
    # Times 1 and 2: the twin ends there.
    found = auc_contributions(arrays([9, 1, 2, 50]), arrays([9, 1, 1]), [1])
    assert found["auc_matched"].value == (0.5 + 0.5 + 1 + 1) / 4


def test_matched_comparisons_begin_at_the_effect_and_the_papers_at_the_onset():
    # Between onset 1 and effect 3 both are the same.
    anomalous, twins = arrays([0, 5, 5, 9, 9]), arrays([0, 5, 5, 1, 1])
    found = auc_contributions(anomalous, twins, [1], [3])
    assert found["auc_matched"].value == 1
    assert found["auc"].value == found["auc_null"].value == 1
    assert auc_contributions(anomalous, twins, [1])["auc_matched"].value == 14 / 16


def test_unpaired_compares_with_the_next_twin_where_both_are():
    anomalous = arrays([0, 2, 2, 2], [0, 1, 1, 1], [0, 0, 0, 9])
    twins = arrays([0, 0, 0, 0], [0, 1, 3, 0], [0, 0])
    found = auc_contributions(anomalous, twins, [1, 1, 1])
    # 2, 2, 2 against 1, 3, 0; 1 against 0; and 0 (the own twin ends there) against 0.
    assert found["auc_unpaired"].numerator.tolist() == [2 / 3, 1, 0.5]


def test_an_anomalous_episode_that_ends_first_ends_the_comparison_of_its_twins():
    twins = arrays([0, 1, 1, 5], [0, 0, 2, 9])
    found = auc_contributions(arrays([0, 2, 2], [0, 1, 1, 1]), twins, [1, 1])
    # Rows 1 and 2: 2, 2 against 0, 2; and 1, 1 against 0, 2. Row 3 would make both lower.
    assert found["auc_unpaired"].numerator[0] == 3 / 4
    assert found["auc_placebo"].numerator[0] == 2 / 4


def test_unpaired_loses_what_accumulated_noise_of_the_twin_gives_away():
    """A random walk shared until the effect: a small step is seen beside the own twin only."""
    rng = np.random.default_rng(8)
    steps = rng.normal(size=(40, 300))
    twins = [np.cumsum(s) for s in steps]
    anomalous = [t + 0.5 * (np.arange(300) >= 150) for t in twins]
    found = auc_contributions(anomalous, twins, [150] * 40)
    assert found["auc_matched"].value > 0.505
    assert abs(found["auc_unpaired"].value - 0.5) < 3 * 0.5 / math.sqrt(40)


def test_smoothing_is_a_moving_average_from_the_mean_on():
    expected, level = [], 0.0
    for x in (1.0, -2.0, 0.5):
        level = 0.97 * level + 0.03 * x
        expected.append(level)
    assert smoothed(np.array([NAN, NAN, 1.0, -2.0, 0.5]))[2:] == pytest.approx(expected)
    assert np.isnan(smoothed(np.array([NAN, NAN, 1.0]))).tolist() == [True, True, False]
    assert smoothed(np.array([0.0, np.inf, 0.0])).tolist() == [0, np.inf, np.inf]


@given(st.integers(0, 9))
def test_smoothed_auc_is_the_matched_auc_of_the_smoothed_scores(seed):
    rng = np.random.default_rng(seed)
    a, b = [list(rng.normal(size=(2, 30))) for _ in range(2)]
    own = Standardization(0.3, 2.0)
    found = auc_contributions(a, b, [10, 20], [12, 20], own)["auc_smoothed"]
    means = [[smoothed((s - 0.3) / 2) for s in part] for part in (a, b)]
    expected = auc_contributions(*means, [10, 20], [12, 20])["auc_matched"]
    assert found.numerator.tolist() == expected.numerator.tolist()


def test_placebo_compares_each_twin_with_the_next():
    twins = arrays([0, 1, 1], [0, 2, 0], [0, 0, 0])
    found = auc_contributions(arrays(*[[0, 0, 0]] * 3), twins, [1, 1, 1])
    # 1, 1 against 2, 0; 2, 0 against 0, 0; 0, 0 against 1, 1
    assert found["auc_placebo"].numerator.tolist() == [0.5, 0.75, 0.0]


def test_placebo_of_a_clock_is_one_half_although_twins_differ_in_length():
    clock = [np.arange(n, dtype=float) for n in (60, 90, 75)]
    assert auc_contributions(clock, clock, [30, 40, 50])["auc_placebo"].value == 0.5


def test_clock_has_paper_auc_one_and_matched_auc_one_half():
    clock = [np.arange(n, dtype=float) for n in (80, 120, 95)]
    twins = [np.arange(100, dtype=float)] * 3
    found = auc_contributions(clock, twins, [30, 40, 50])
    assert found["auc"].value == 1
    equal = auc_contributions(twins, twins, [30, 40, 50])
    assert equal["auc_matched"].value == equal["auc_placebo"].value == 0.5


def test_delay_counts_from_the_onset_and_may_be_zero():
    loud, quiet = [[0, 0, 2, 0], [0, 0, 0, 2], [2, 0, 0, 0]], [[0] * 4, [0, 0, 0, 2], [0] * 4]
    found = alarm_contributions(arrays(*loud), arrays(*quiet), [2, 2, 1], RULE)
    # An alarm before the onset is not a detection; a null is the twin's at its partner's onset.
    for name, expected in {"delay": [0, 1, None], "missed": [0, 0, 1],
                           "delay_null": [None, 1, None]}.items():  # fmt: skip
        terms = zip(found[name].numerator, found[name].denominator, strict=True)
        assert [top if bottom else None for top, bottom in terms] == expected


def test_a_miss_has_no_delay_and_the_whole_remainder_as_censored_delay():
    found = alarm_contributions(
        arrays([0, 0, 2, 0], [0, 0, 0, 0]), arrays([0] * 4, [0] * 4), [1, 1], RULE
    )
    assert (found["delay"].value, found["delay"].n) == (1, 1)
    assert found["missed"].value == 0.5
    # T = 3, onset 1: T - onset + 1 = 3
    assert found["delay_censored"].numerator.tolist() == [1, 3]


def test_false_alarms_are_pooled_over_defined_steps_from_row_20_to_the_onset():
    start = [2.0] * 20
    anomalous = arrays([*start, NAN, 2, 0, 9], [*start, NAN, 0, 0, 9], [*start, 9])
    twins = arrays([0] * 4, [0, 2, 2, 0], [0])
    found = alarm_contributions(anomalous, twins, [23, 23, 20], RULE)
    assert found["far"].denominator.tolist() == [2, 2, 0]
    assert found["far"].value == 1 / 4
    assert found["far_twin"].value == 2 / 9


@given(st.permutations(range(4)))
def test_values_do_not_depend_on_the_order_of_trajectories(order):
    rng = np.random.default_rng(0)
    scores, twins = list(rng.normal(size=(4, 40))), list(rng.normal(size=(4, 40)))
    onsets = [5, 10, 15, 20]

    def pick(values):
        return [values[i] for i in order]

    effects = [6, 10, 18, 25]
    first = cell_contributions(scores, twins, onsets, effects, RULE)
    second = cell_contributions(pick(scores), pick(twins), pick(onsets), pick(effects), RULE)
    for name in set(PAIRED) - {"auc_placebo", "auc_unpaired"}:  # these pair neighbours
        assert first[name].value == pytest.approx(second[name].value, nan_ok=True)


def test_cell_has_every_metric_in_order():
    flat = [np.zeros(50)] * 2
    assert list(cell_contributions(flat, flat, [10, 20], [10, 20], RULE)) == PAIRED
    cell = PairedScores(flat, flat, [10, 20], [10, 20])
    metrics, found = cell_metrics(cell, Rules.fit([np.zeros(50)] * 198), environment="ant")
    paired = {name for name in NAMES if metric_info(name).cells != "unpaired"}
    assert set(metrics) == paired - {*ATTRIBUTION, "auc_before"}
    assert [n for n in found if n.endswith("_at_5pct")] == [
        f"{n}_at_5pct" for n in GUARANTEED if f"{n}_at_5pct" in paired
    ]


def test_a_threshold_without_end_is_undefined_and_alarms_nowhere():
    # An odd episode rises above the constant that the even ones have: no threshold is above that.
    calibration = [np.full(30, float(i % 2 and t > 30)) for i in range(40) for t in [i]]
    rules = Rules.fit(calibration)
    loud = [np.full(50, 9.0)] * 2
    cell = PairedScores(loud, loud, [10, 20], [10, 20])
    metrics, _ = cell_metrics(cell, rules, environment="ant")
    assert math.isnan(metrics["threshold_at_5pct"].value)
    assert metrics["missed_at_5pct"].value == 1
