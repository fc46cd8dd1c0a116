"""Detection thresholds: worked by hand, against scikit-learn and a second way, and properties."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sklearn.isotonic import IsotonicRegression

from oodd_eval.metrics.bootstrap import shared_weights
from oodd_eval.metrics.threshold import DetectionThreshold, crossing, geometric_mean, isotonic

STRENGTHS = (1.0, 4.0, 16.0)


def threshold(*rungs, counted=None, strengths=STRENGTHS, environment="ant"):
    """Threshold of one detector seed, from a list of outcomes for each rung."""
    found = np.array([rungs], dtype=float)
    counts = np.ones_like(found) if counted is None else np.array([counted], dtype=float)
    return DetectionThreshold.of(environment, strengths, found, counts)


def drawn_at(rng, weakest_found, strengths, noise=0.3):
    """Whether each rung is above the strength that an episode takes, up to some noise."""
    logs = np.log(strengths)[:, None] + noise * rng.normal(
        size=(len(strengths), len(weakest_found))
    )
    return (logs > weakest_found)[None].astype(float)


def of(environment, strengths, found):
    return DetectionThreshold.of(environment, strengths, found, np.ones_like(found))


# By hand


def test_a_threshold_is_read_off_between_two_rungs_in_the_logarithm():
    # Shares 0, 1/4 and 3/4: half of the way from 4 to 16, in the logarithm, is 8.
    own = threshold([0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0])
    assert own.value == pytest.approx(8)
    assert own.interval[0] <= 8 <= own.interval[1]


def test_a_stronger_rung_that_is_found_less_often_is_pooled_with_the_weaker():
    # Shares 1/4, 3/4, 1/4 become 1/4, 1/2, 1/2.
    own = threshold([1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0])
    assert own.value == pytest.approx(4)


def test_episodes_with_an_early_alarm_count_nowhere():
    counted = [1, 1, 1, 1], [1, 1, 0, 0], [1, 1, 1, 1]
    own = threshold([0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 1], counted=counted)
    assert own.value == pytest.approx(4)  # one of two, not of four
    # A rung without an episode that counts has the share of the rung below it.
    counted = [1, 1, 1, 1], [0, 0, 0, 0], [1, 1, 1, 1]
    own = threshold([0, 0, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1], counted=counted)
    assert own.value == pytest.approx(8)
    assert math.isnan(threshold([0], [0], [0], counted=([0], [0], [0])).value)


@pytest.mark.parametrize(
    ("rungs", "value", "text"),
    [
        (([1, 1], [1, 1], [1, 1]), 0, "≤1"),
        (([1, 0], [1, 1], [1, 1]), 0, "≤1"),  # at most: it may be weaker than the weakest
        (([0, 0], [0, 0], [0, 0]), math.inf, ">16"),
        (([0, 0], [0, 0], [1, 0]), 16, "16"),
        (([0, 0], [1, 0], [1, 1]), 4, "4"),
    ],
)
def test_a_threshold_beyond_the_ladder_is_censored(rungs, value, text):
    own = threshold(*rungs)
    assert own.value == pytest.approx(value)
    assert own.text(own.value) == text
    assert np.isfinite(own.within).all()


@pytest.mark.parametrize("strengths", [(1, 4), (4, 1, 16), (0, 1, 4), (math.nan, 1, 4)])
def test_strengths_that_are_no_ladder_are_refused(strengths):
    with pytest.raises(ValueError, match="of 3 rungs: expected as many positive numbers"):
        threshold([0], [0], [1], strengths=strengths)


# Other ways to the same numbers


@pytest.mark.parametrize("seed", range(5))
def test_monotone_shares_are_those_of_scikit_learn(seed):
    rng = np.random.default_rng(seed)
    total = rng.integers(1, 20, size=(8, 30)).astype(float)
    found = rng.binomial(total.astype(int), 0.5).astype(float)
    own = isotonic(found, total)
    for i in range(30):
        fitted = IsotonicRegression().fit_transform(
            np.arange(8.0), found[:, i] / total[:, i], sample_weight=total[:, i]
        )
        np.testing.assert_allclose(own[:, i], fitted, atol=1e-12)


def plain_threshold(found, counted, strengths):
    """Logarithm of a threshold from counts by rung: blocks merged from the left, then a walk."""
    blocks = []
    for pair in zip(found, counted, strict=True):
        blocks.append([*pair, 1])
        while len(blocks) > 1 and blocks[-2][0] * blocks[-1][1] > blocks[-1][0] * blocks[-2][1]:
            f, n, k = blocks.pop()
            blocks[-1] = [blocks[-1][0] + f, blocks[-1][1] + n, blocks[-1][2] + k]
    shares = [f / n for f, n, k in blocks for _ in range(k)]
    if shares[0] >= 0.5:
        return -math.inf
    for k in range(1, len(shares)):
        if shares[k] >= 0.5:
            part = (0.5 - shares[k - 1]) / (shares[k] - shares[k - 1])
            one, two = math.log(strengths[k - 1]), math.log(strengths[k])
            return one + part * (two - one)
    return math.inf


def plain_draws(environment, found, counted, strengths):
    """Thresholds of all resamples, one after another, episode by episode."""
    seeds, rungs, n = found.shape
    weights = shared_weights(environment, n)
    logs = []
    for row in weights.astype(int).tolist():
        episodes = [i for i, times in enumerate(row) for _ in range(times)]
        picked = [(s, i) for s in range(seeds) for i in episodes]
        sums = [[sum(x[s, k, i] for s, i in picked) for k in range(rungs)]
                for x in (found, counted)]  # fmt: skip
        logs.append(plain_threshold(*sums, strengths))
    return logs


@pytest.fixture(scope="module")
def two_environments():
    """Outcomes of two detectors of two seeds, six episodes; an early alarm here and there."""
    rng = np.random.default_rng(4)
    strengths = {"ant": (0.5, 2.0, 3.0), "hopper": (10.0, 20.0, 80.0)}
    shares = {"own": (0.2, 0.5, 0.8), "other": (0.1, 0.3, 0.6)}
    drawn = {
        (who, e): np.array([rng.random((2, 6)) < p for p in shares[who]], float).swapaxes(0, 1)
        for who in shares for e in strengths
    }  # fmt: skip
    early = np.zeros((2, 3, 6))
    early[0, 1, 2] = early[1, 0, 0] = 1
    return strengths, {key: (found * (1 - early), 1 - early) for key, found in drawn.items()}


def test_the_ends_of_an_interval_are_those_of_a_plain_bootstrap(two_environments):
    strengths, outcomes = two_environments
    for (_, e), (found, counted) in outcomes.items():
        own = DetectionThreshold.of(e, strengths[e], found, counted)
        draws = sorted(plain_draws(e, found, counted, strengths[e]))
        np.testing.assert_allclose(np.sort(own.logs[1:]), draws, atol=1e-7)
        low, high = draws[49], draws[1950]  # of 2000, one twentieth outside
        assert own.interval == pytest.approx((math.exp(low), math.exp(high)))


def test_the_mean_ratio_has_the_interval_of_a_plain_joint_bootstrap(two_environments):
    strengths, outcomes = two_environments
    made = {(who, e): DetectionThreshold.of(e, strengths[e], *outcomes[who, e])
            for who, e in outcomes}  # fmt: skip
    own, other = ([made[who, e] for e in strengths] for who in ("own", "other"))
    mean = geometric_mean(own, other)
    logs = np.zeros(2000)
    for e, ends in strengths.items():
        least, most = math.log(ends[0]), math.log(ends[-1])
        for who, sign in (("own", 1), ("other", -1)):
            draws = plain_draws(e, *outcomes[who, e], ends)
            logs += [sign * min(max(x, least), most) / 2 for x in draws]
    logs = np.sort(logs)
    assert (mean.low, mean.high) == pytest.approx((math.exp(logs[49]), math.exp(logs[1950])))
    values = [t.within[0] for t in (*own, *other)]
    assert mean.value == pytest.approx(
        math.exp((values[0] + values[1] - values[2] - values[3]) / 2)
    )


def test_an_interval_ends_at_the_resamples_next_beyond_the_level():
    logs = np.linspace(-1, 1, 2000)
    drawn = np.random.default_rng(0).permutation(logs)
    own = DetectionThreshold(0.1, 9.0, np.append(0.0, drawn))
    assert own.interval == pytest.approx((math.exp(logs[49]), math.exp(logs[1950])))
    outside = DetectionThreshold(0.1, 9.0, np.append(2.0, drawn))
    assert outside.interval[1] == pytest.approx(math.exp(2.0))


# The mean over pairs


def test_a_censored_threshold_counts_as_the_end_of_its_ladder_and_is_counted():
    below, above, between = (
        threshold([1, 1], [1, 1], [1, 1]), threshold([0, 0], [0, 0], [0, 0]),
        threshold([0, 0], [1, 0], [1, 1]),
    )  # fmt: skip
    mean = geometric_mean([below, above, between, above], [1.0, 2.0, 4.0, 1.0])
    assert mean.value == pytest.approx((1 * 16 / 2 * 4 / 4 * 16) ** 0.25)
    assert mean[3:] == (4, 1, 2, "~")
    others = below, above, between, 1.0
    for own, sides in ((below, ["", "≤", "≤", "≤"]), (above, [">", "", ">", ">"]),
                       (between, [">", "≤", "", ""])):  # fmt: skip
        assert [geometric_mean([own], [other]).side for other in others] == sides
    # Both below: either may be the lower one.
    assert geometric_mean([below], [threshold([1, 1], [1, 1], [1, 1])]).side == "~"


def test_intervals_contain_the_true_threshold_in_most_samples():
    strengths = np.geomspace(0.05, 20, 8)
    hits = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        # As many episodes take a strength above 1 as below it, and noise changes nothing in that.
        low, high = of("ant", strengths, drawn_at(rng, rng.normal(size=20), strengths)).interval
        hits += low <= 1 <= high
    assert 88 <= hits <= 99


# Properties


outcomes = arrays.arrays(np.float64, (2, 4, 5), elements=st.sampled_from([0.0, 1.0]))
LADDER = (0.1, 0.3, 2.0, 5.0)


@given(outcomes, outcomes, outcomes)
def test_more_found_never_raises_a_threshold(found, more, counted):
    few, many = (
        DetectionThreshold.of("ant", LADDER, x * counted, counted)
        for x in (found, np.maximum(found, more))
    )
    if counted.any():
        assert (many.logs <= few.logs + 1e-6).all()
    else:
        assert math.isnan(few.value)


@given(arrays.arrays(np.float64, (4, 3), elements=st.floats(0, 1)))
def test_a_crossing_is_where_the_line_between_two_rungs_meets_one_half(shares):
    shares = np.sort(shares, axis=0)
    for column, log in zip(shares.T, crossing(shares, np.array(LADDER)), strict=True):
        if math.isinf(log):
            assert (column[0] >= 0.5 - 1e-8) if log < 0 else (column[-1] < 0.5)
        else:
            assert np.interp(log - 1e-9, np.log(LADDER), column) <= 0.5 + 1e-6
            assert np.interp(log + 1e-9, np.log(LADDER), column) >= 0.5 - 1e-6
