"""Calibrated thresholds: exact, and the smallest that meet the target."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.metrics.alarms import Monitor, calibrate, false_alarm_rate
from oodd_eval.metrics.auc import AlarmRule
from oodd_eval.metrics.cusum import Standardization, cusum


def rule(threshold=0.0, drift=0.0018):
    return AlarmRule(Standardization(mean=0.0, std=1.0), drift=drift, threshold=threshold)


def rate(scores, threshold, drift=0.0018):
    return false_alarm_rate(scores, rule(threshold, drift))


@pytest.mark.parametrize("target", [0.01, 0.1])
def test_the_rate_at_the_threshold_meets_the_target_and_just_below_does_not(target):
    scores = list(np.random.default_rng(0).normal(size=(5, 400)))
    found = calibrate(scores, rule(), target)
    assert rate(scores, found) <= target
    assert rate(scores, np.nextafter(found, 0)) > target


@given(st.lists(st.lists(st.integers(-3, 3), min_size=1, max_size=12), min_size=1, max_size=3))
def test_alarms_never_grow_with_the_threshold(values):
    runs = [np.array(v, float) for v in values]
    counts = [
        sum(int(cusum(x, drift=0.5, threshold=h)[1].sum()) for x in runs)
        for h in np.arange(0, 12, 0.25)
    ]
    assert counts == sorted(counts, reverse=True)


def test_quiet_scores_need_no_threshold():
    assert calibrate([np.array([-1.0, -2.0])], rule(), 0.01) == 0


def test_without_defined_scores_there_is_no_threshold():
    assert math.isnan(calibrate([np.array([math.nan])], rule(), 0.01))


@pytest.mark.parametrize("seed", range(5))
def test_a_monitor_raises_the_alarms_of_the_whole_episode(seed):
    rng = np.random.default_rng(seed)
    scores = rng.normal(1, 2, 200)
    scores[[0, 1, 2, 60]] = np.nan
    rule_ = AlarmRule(Standardization(1.0, 2.0))
    statistic, expected = cusum(rule_.standardization(scores))
    monitor = Monitor(rule_)
    found = [(monitor.update(s), monitor.statistic) for s in scores]
    assert [alarm for alarm, _ in found] == expected.tolist()
    assert [s for _, s in found] == statistic.tolist()
    assert expected.any()


def test_a_monitor_begins_anew_with_each_episode():
    monitor = Monitor(AlarmRule(Standardization(0.0, 0.01), drift=0.0, threshold=3.0))
    assert [monitor.update(2.0), monitor.update(2.0)] == [False, True]
    assert not monitor.update(2.0)
    monitor.reset()
    assert monitor.statistic == 0
    assert not monitor.update(2.0)
