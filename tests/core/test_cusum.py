"""Standardization and the CUSUM, each against a second formula."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.metrics.cusum import Standardization, cusum

NAN = math.nan


def test_standardization_pools_defined_scores_with_ddof_0():
    fitted = Standardization.fit([np.array([NAN, 1.0, 2.0]), np.array([NAN, 6.0])])
    assert fitted.mean == 3
    assert fitted.std == pytest.approx(math.sqrt((4 + 1 + 9) / 3))


def test_standardized_scores_are_in_hundredths_of_a_standard_deviation():
    x = Standardization(mean=10.0, std=2.0)(np.array([NAN, 10.0, 14.0, 6.0]))
    assert np.array_equal(x, [NAN, 0.0, 0.02, -0.02], equal_nan=True)


@pytest.mark.parametrize("constant", [0.0, 7.0, 0.1, -1 / 3])
def test_beside_constant_calibration_scores_any_higher_one_is_an_alarm_at_once(constant):
    fitted = Standardization.fit([np.full(7, constant)] * 3)
    assert (fitted.mean, fitted.std) == (constant, 0.0)
    above, below = np.nextafter(constant, np.inf), np.nextafter(constant, -np.inf)
    x = fitted(np.array([NAN, below, constant, above, constant]))
    assert np.array_equal(x, [NAN, 0.0, 0.0, np.inf, 0.0], equal_nan=True)
    assert cusum(x)[1].tolist() == [False, False, False, True, False]
    # Without a new start the sum stays infinite.
    assert cusum(x, threshold=np.inf)[0].tolist() == [0, 0, 0, np.inf, np.inf]


@pytest.mark.parametrize("factor", [1e-9, 3.7, 1e10, 1e150])
def test_a_large_unit_changes_no_bit_of_the_standard_deviation(factor):
    scores = factor * np.random.default_rng(1).normal(size=200)
    mean = math.fsum(scores) / 200
    expected = math.sqrt(math.fsum((scores - mean) ** 2) / 200)
    assert Standardization.fit([scores]) == Standardization(mean, expected)


def test_the_squares_of_large_and_small_scores_are_numbers():
    scores = np.random.default_rng(2).normal(size=50)
    for factor in (1e200, 1e-200):
        fitted = Standardization.fit([factor * scores])
        assert fitted.std / factor == pytest.approx(scores.std())
    # A sum that overflows, and a distance from the mean that does.
    for beyond in ([1.7e308, 1.7e308, 0.0], [-1.7e308, 1.7e308, 1.7e308]):
        with pytest.raises(OverflowError):
            Standardization.fit([np.array(beyond)])


def test_without_a_calibration_score_nothing_is_ever_alarming():
    nothing = Standardization.fit([np.array([NAN])])
    assert math.isnan(nothing.mean)
    assert not cusum(nothing(np.array([1e9, 2e9])))[1].any()


def test_cusum_by_hand():
    # S: 0, .75, .5, 1.75 (alarm), reset, .25, 0
    x = np.array([NAN, 1.0, 0.0, 1.5, 0.5, -1.0])
    statistic, alarms = cusum(x, drift=0.25, threshold=1.5)
    assert statistic.tolist() == [0, 0.75, 0.5, 1.75, 0.25, 0]
    assert alarms.tolist() == [False, False, False, True, False, False]
    # An alarm needs more than the threshold.
    assert not cusum(np.array([1.0]), drift=0.0, threshold=1.0)[1].any()


def test_the_papers_setting_raises_an_alarm_at_one_and_eighteen_hundredths_of_a_deviation():
    above, below = (Standardization(0.0, 1.0)(np.array([s])) for s in (1.19, 1.17))
    assert cusum(above)[1].all()
    assert not cusum(below)[1].any()


def test_before_the_first_alarm_the_sum_is_the_distance_from_its_running_minimum():
    rng = np.random.default_rng(0)
    x = rng.normal(size=500)
    path = np.concatenate([[0.0], np.cumsum(x - 0.3)])
    expected = (path - np.minimum.accumulate(path))[1:]
    assert np.allclose(cusum(x, drift=0.3, threshold=np.inf)[0], expected)


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=60), st.integers(1, 60))
def test_alarms_of_a_prefix_are_the_prefix_of_the_alarms(values, cut):
    x = np.array(values)
    whole, part = cusum(x, drift=0.1, threshold=1), cusum(x[:cut], drift=0.1, threshold=1)
    assert whole[0][:cut].tolist() == part[0].tolist()
    assert whole[1][:cut].tolist() == part[1].tolist()


# Average run lengths of the zero-start one-sided CUSUM on N(delta, 1) with k = 0.5, from the
# literature (Brook & Evans 1972 and later tables).
@pytest.mark.parametrize(
    ("height", "delta", "expected"),
    [(4, 0.0, 335.4), (4, 1.0, 8.38), (5, 0.0, 930.9), (5, 1.0, 10.38)],
)
def test_average_run_length_is_that_of_the_literature(height, delta, expected):
    rng = np.random.default_rng([height, int(delta)])
    # Alarms restart the sum at zero, so that the gaps between alarms are run lengths.
    gaps = []
    while len(gaps) < 1500:
        alarms = cusum(rng.normal(delta, 1, 60_000), drift=0.5, threshold=height)[1]
        gaps += np.diff(np.flatnonzero(alarms), prepend=-1).tolist()
    error = np.std(gaps) / math.sqrt(len(gaps))
    assert abs(np.mean(gaps) - expected) < 4 * error
