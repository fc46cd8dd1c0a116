"""Exact intervals and quantiles, against SciPy and small sums."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import betainc

from oodd_eval.metrics.binomial import clopper_pearson, incomplete_beta, t_quantile


@given(st.floats(0.5, 2000), st.floats(0.5, 2000), st.floats(0, 1))
def test_the_incomplete_beta_function_is_scipys(a, b, x):
    assert incomplete_beta(a, b, x) == pytest.approx(betainc(a, b, x), rel=1e-9, abs=1e-12)


@given(st.integers(1, 400), st.data())
def test_the_interval_is_scipys(trials, data):
    successes = data.draw(st.integers(0, trials))
    exact = stats.binomtest(successes, trials).proportion_ci(0.95, method="exact")
    assert clopper_pearson(successes, trials) == pytest.approx((exact.low, exact.high), abs=1e-10)


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 20), (20, 20)])
def test_each_end_leaves_a_tail_of_two_and_a_half_percent(successes, trials):
    def tail(p, counts):
        return sum(math.comb(trials, k) * p**k * (1 - p) ** (trials - k) for k in counts)

    low, high = clopper_pearson(successes, trials)
    if successes:
        assert tail(low, range(successes, trials + 1)) == pytest.approx(0.025)
    if successes < trials:
        assert tail(high, range(successes + 1)) == pytest.approx(0.025)
    assert (low == 0, high == 1) == (successes == 0, successes == trials)


def test_counts_between_whole_ones_have_intervals_between():
    lows, highs = zip(*(clopper_pearson(k / 3, 20) for k in range(61)), strict=True)
    assert list(lows) == sorted(lows)
    assert list(highs) == sorted(highs)


@pytest.mark.parametrize("freedom", [1, 2, 9, 19, 133, 6993])
def test_the_t_quantile_is_scipys(freedom):
    assert t_quantile(0.975, freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-9)
