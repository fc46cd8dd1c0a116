"""Thresholds of scores: ranks counted by hand, statistics by their definitions, what is refused."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from oodd_monitors import Detections, LabelledScores, calibrate
from oodd_monitors.describing import sentences

from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError

LOGS = [[0.0, peak, 1.0] for peak in range(1, 41)]


def logs_of(peaks):
    return [[0.0, peak, 0.5] for peak in peaks]


RANKS = [(19, 0.05, 19), (20, 0.05, 20), (39, 0.05, 38), (40, 0.10, 37), (9, 0.10, 9), (3, 0.25, 3)]


@pytest.mark.parametrize(("n", "level", "rank"), RANKS)
def test_the_threshold_is_the_rank_that_further_logs_exceed_as_often_as_is_promised(n, level, rank):
    calibration = calibrate(logs_of(range(1, n + 1)), level)
    assert calibration.threshold == rank
    # A further log is equally likely to have any of the n + 1 ranks.
    above = [place for place in range(1, n + 2) if place > rank]
    assert Fraction(len(above), n + 1) <= Fraction(str(level))
    assert Fraction(len(above) + 1, n + 1) > Fraction(str(level))
    assert calibration.needed == 0


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_hand_sweep_lets_one_in_n_plus_1_by_in_all_orders_of_distinct_values(n):
    trips = 0
    for order in itertools.permutations(range(n + 1)):
        *logs, further = order
        spread = 0 if n > 1 else 1  # a single log of equal rows is no score
        values = [[value, value - 0.5, value - 0.25 * spread] for value in logs]
        calibration = calibrate(values, 0.5)
        largest, share = calibration.sweep
        trips += further > largest
        assert share == 1 / (n + 1)
    assert Fraction(trips, math.factorial(n + 1)) == Fraction(1, n + 1)


def test_a_hand_sweep_of_equal_values_lets_at_most_that_share_by():
    """Of 0, 1 and 1 in any order the last is never above both others, not in one of three."""
    assert not any(last > max(logs) for *logs, last in itertools.permutations([0, 1, 1]))
    for peaks, said in (([*range(1, 20)], "lets 5 %"), ([*range(1, 19), 18], "lets at most 5 %")):
        (text,) = (t for t in sentences(calibrate(logs_of(peaks)), "residual") if "sweep" in t)
        assert f"and {said} (1/20) of further healthy logs trip on average" in text


def test_the_interval_is_that_of_the_share_above_an_order_statistic():
    """Uniform values: the share above the k-th smallest is one less that value."""
    n, rank = 40, 39
    draws = np.sort(np.random.default_rng(0).random((40_000, n)), axis=1)
    low, high = np.quantile(1 - draws[:, rank - 1], [0.025, 0.975])
    calibration = calibrate(LOGS, 0.05)
    assert calibration.threshold == rank
    assert calibration.share_interval == pytest.approx((low, high), abs=0.004)


def test_of_equal_values_only_the_upper_end_is_known():
    calibration = calibrate(logs_of([1] * 10 + [2] * 30), 0.05)
    assert calibration.threshold == 2
    assert calibration.share_interval[0] == 0
    assert calibration.share_interval[1] == calibrate(LOGS, 0.05).share_interval[1]


def test_hold_asks_for_rows_in_a_row_and_passes_over_rows_without_a_score():
    rng = np.random.default_rng(1)
    logs = rng.normal(size=(20, 30))
    logs[:, ::7] = np.nan
    calibration = calibrate(logs, 0.05, hold=3)

    def largest(scores):
        scores = [s for s in scores if s == s]  # noqa: PLR0124  NaN
        return max(min(triple) for triple in zip(scores, scores[1:], scores[2:], strict=False))

    assert calibration.threshold == max(map(largest, logs))
    high = calibration.threshold + 1
    assert calibration.first([high, high, -9, high, np.nan, high, high, 0]) == 6
    assert calibration.first([high, high]) is None


def test_a_weighted_mean_begins_with_the_first_score():
    logs = np.random.default_rng(2).normal(size=(20, 30))
    logs[:, 4] = np.nan
    calibration = calibrate(logs, 0.05, alarm="ewma")

    def means(scores):
        mean = scores[0]
        for score in scores:
            mean = mean if math.isnan(score) else 0.8 * mean + 0.2 * score
            yield mean

    assert calibration.smoothing == 0.2
    assert calibration.threshold == pytest.approx(max(max(means(scores)) for scores in logs))
    expected = [*means(logs[0])]
    expected[4] = -math.inf
    assert calibration.statistic(logs[0]) == pytest.approx(expected)


def test_a_cusum_is_scaled_by_every_second_log():
    logs = np.random.default_rng(3).normal(5, 2, size=(38, 25))
    calibration = calibrate(logs, 0.05, alarm="cusum")
    mean, std = logs[::2].mean(), logs[::2].std()

    def sums(scores):
        total = 0.0
        for score in scores:
            total = max(0.0, total + 0.01 * (score - mean) / std - 0.0018)
            yield total

    assert calibration.units == 19
    assert calibration.threshold == pytest.approx(max(max(sums(s)) for s in logs[1::2]))
    assert calibration.statistic(logs[7]) == pytest.approx([*sums(logs[7])])
    message = (
        r"37 healthy logs, too few for 5 %: the alarm cusum needs 38, 1 more; threshold and ewma "
        r"do not; these allow 5\.3 % \(--level 5\.3\)"
    )
    with pytest.raises(UsageError, match=message):
        calibrate(logs[:37], 0.05, alarm="cusum")


def test_windows_of_one_recording_count_once():
    windows = logs_of(range(1, 41))
    calibration = calibrate(windows, 0.10, recordings=["a"] * 20 + ["b"] * 20)
    assert (
        calibration.promise == "40 windows of 2 recordings: no promise at 10 %; 9 recordings would"
    )
    assert (calibration.needed, calibration.units) == (7, 2)
    assert calibration.sweep == (40, 1 / 3)
    assert calibration.share_interval is None
    ten = calibrate(windows, 0.10, recordings=[i // 4 for i in range(40)])
    assert (ten.needed, ten.promise) == (0, "at most 10 % of windows of further healthy logs alarm")


def test_too_few_logs_are_told_how_many_more_and_what_they_allow():
    few = (
        r"3 healthy logs, too few for 5 %: the alarm threshold needs 19, 16 more; these allow 25 %"
    )
    with pytest.raises(UsageError, match=few + r" \(--level 25\)"):
        calibrate(logs_of([1, 2, 3]))
    assert calibrate(logs_of([1, 2, 3]), 0.25).threshold == 3
    # What a message allows is allowed.
    for n in range(1, 19):
        with pytest.raises(UsageError, match="too few") as refused:
            calibrate(logs_of(range(1, n + 1)))
        level = float(str(refused.value).rpartition("--level ")[2].rstrip(")")) / 100
        assert calibrate(logs_of(range(1, n + 1)), level).threshold == n


def test_drift_of_the_largest_values_is_said():
    rng = np.random.default_rng(4)
    steady = rng.normal(size=(40, 20))
    assert calibrate(steady).notes == ()
    (note,) = calibrate(steady + 0.1 * np.arange(40)[:, None]).notes
    assert "follow the order of the logs" in note


def test_labelled_logs_tell_what_a_threshold_detects():
    calibration = calibrate(
        LOGS,
        0.05,
        labelled=[
            LabelledScores([0, 0, 50, 0], [(1, 4)], "slip"),
            LabelledScores([0, 0, 0, 0, 50], [(1, 4)], "slip"),
            LabelledScores([50, 0, 0], [(1, 3)], "slip"),
            LabelledScores([0, 0, 0], [(1, 3)], "slip"),
            LabelledScores([0, 50], [(-1, 2)], "jam"),
            LabelledScores([0, 0, 0, 50]),
        ],
        healthy=[[0, 1], [0, 50], [3, 4]],
    )
    slip, jam, plain = calibration.detections
    assert slip == Detections("slip", 4, early=1, detected=2, missed=1, delay=2.0, in_time=1)
    assert (jam.kind, jam.episodes, jam.early, jam.detected, jam.missed) == ("jam", 1, 0, 1, 0)
    assert math.isnan(jam.delay)
    assert (plain.kind, plain.detected, plain.in_time) == ("anomalous", 1, 0)
    assert (calibration.false_alarms, calibration.healthy) == (1, 3)


def test_groups_have_thresholds_of_their_own_and_pooling_is_judged():
    peaks = [*range(1, 11), *range(101, 111), 200, 201]
    groups = ["small"] * 10 + ["large"] * 10 + ["new"] * 2
    calibration = calibrate(logs_of(peaks), 0.10, groups=groups)
    small, large, new = calibration.groups.values()
    assert calibration.threshold == 200
    assert (small.calibration.threshold, small.above) == (10, 0)
    assert (large.calibration.threshold, large.above) == (110, 0)
    assert (new.calibration, new.above, new.episodes) == (None, 1, 2)
    assert new.problem.startswith(
        "2 healthy logs, too few for 10 %: the alarm threshold needs 9, 7 more"
    )
    with pytest.raises(UsageError, match="1 groups of 22 episodes"):
        calibrate(logs_of(peaks), 0.10, groups=["small"])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"scores": [[0.0, 1.0]] * 20}, UsageError, "0 or 1 in all rows .*flag:NAME"),
        ({"scores": [[3.0, 3.0]] * 20}, UsageError, "is 3 in all rows of 20 healthy logs"),
        (
            {"scores": [[1.0, 2.0, 3.0], [math.nan] * 2]},
            UsageError,
            r"episode 1 .*\(2,\), expected a number a row, in 1 rows",
        ),
        ({"scores": [[1.0, 2.0], [[3.0]]]}, UsageError, r"episode 1 has scores of shape \(1, 1\)"),
        ({"scores": [["on", "off"]]}, TrajectoryError, "episode 0 of the scores: .*no real number"),
        ({"scores": LOGS, "level": 5}, UsageError, "level=5, expected a share"),
        ({"scores": LOGS, "alarm": "cosum"}, UnknownNameError, "did you mean 'cusum'"),
        ({"scores": LOGS, "hold": 0}, UsageError, "whole number of at least 1"),
        (
            {"scores": LOGS, "hold": 4},
            UsageError,
            r"episode 0 .*\(3,\), expected .* in 4 rows at least",
        ),
        (
            {"scores": [[1, math.inf]] * 20 + LOGS},
            UsageError,
            "20 of the 60 calibration episodes .* infinite",
        ),
        ({"scores": []}, UsageError, "0 healthy logs, too few for 5 %"),
    ],
)
def test_what_is_no_score_is_refused_with_what_to_do(arguments, error, message):
    with pytest.raises(error, match=message):
        calibrate(**arguments)


def test_the_harness_has_the_same_threshold():
    """``score`` is its word, and an alarm there is one here."""
    from oodd_eval.metrics.alarms import GuaranteedAlarm

    logs = np.random.default_rng(5).normal(size=(30, 12))
    for alarm, kind in (("score", "score"), ("cusum", "cusum")):
        level = 0.05 if alarm == "score" else 0.10
        rule = GuaranteedAlarm.fit([*logs], level, kind)
        calibration = calibrate(logs, level, alarm=alarm)
        assert calibration.rule == rule
        assert calibration.first(logs[3] + 9) == rule.first(logs[3] + 9)
