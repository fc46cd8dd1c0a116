"""Paired differences: counted out by hand, Holm, errors under the null, one verdict."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import mean_of
from oodd_eval.metrics.ranking import ALPHA, differences, holm

CELLS = [("ant", "iid"), ("ant", "gravity"), ("hopper", "iid")]
NAN = math.nan


def row(values, cells=(("ant", "iid"),), seed=0):
    """A row with one detector seed and the same values in every cell."""
    return {seed: {cell: mean_of(values) for cell in cells}}


def drawn(rng, mean=0.6, n=30, cells=CELLS, spread=0.1):
    return {0: {cell: mean_of(rng.normal(mean, spread, size=n)) for cell in cells}}


def one(first, second, **options):
    """The test of two rows alone."""
    return differences({"a": first, "b": second}, [("a", "b")], **options)[0]


def test_holm_of_worked_numbers():
    # Sorted .005 .01 .03 .04 times 4 3 2 1: .02 .03 .06 .04, and .04 is raised to .06 before it.
    p = np.array([0.01, 0.04, 0.03, 0.005])
    assert holm(p) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.5, 0.9])) == pytest.approx([1.0, 1.0])
    assert holm(np.array([])).tolist() == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_rejects_what_stepping_down_rejects(values):
    rejected = set()
    for step, i in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        if values[i] * (len(values) - step) > ALPHA:
            break
        rejected.add(i)
    corrected = holm(np.array(values))
    assert {i for i, p in enumerate(corrected) if p <= ALPHA} == rejected


def studentized(sample, centre=0.0):
    """Mean of a sample from a centre, in standard errors."""
    n, shift = len(sample), sum(sample) / len(sample) - centre
    spread = sum((x - sum(sample) / n) ** 2 for x in sample) / (n - 1) / n
    if abs(shift) < 1e-12:
        return 0.0
    return shift / math.sqrt(spread) if spread > 1e-20 else math.copysign(math.inf, shift)


def test_p_value_and_interval_are_those_of_all_resamples_counted_out():
    shifts = np.array([0.3, 0.1, -0.1, 0.2, 0.25, 0.05, 0.12, -0.02])
    resamples = itertools.product(shifts[:6], repeat=6)
    counted = sorted(studentized(sample, shifts[:6].mean()) for sample in resamples)
    t = studentized(shifts[:6])
    expected = 2 * np.mean([value >= t - 1e-9 for value in counted])
    test = one(row(shifts[:6] + 0.5), row([0.5] * 6), resamples=40_000)
    assert 2.0**-5 < expected < 0.4
    assert test.p == pytest.approx(expected, abs=8 * math.sqrt(expected / 40_000))
    # The ends are d - t* s at the 2.5 % most extreme t* of either side.
    error = shifts[:6].std() / math.sqrt(5)
    at = math.ceil(0.025 * len(counted))
    ends = [shifts[:6].mean() - t_star * error for t_star in (counted[-at], counted[at - 1])]
    assert (test.low, test.high) == pytest.approx(ends, abs=0.03)
    # Seven test seeds that differ by the same might as well have the other sign: 2 / 2^7.
    same = one(row(shifts[:7] + 0.25), row(shifts[:7]), resamples=2000)
    assert (same.p, same.difference) == pytest.approx((2.0**-6, 0.25))
    assert (same.low, same.high) == pytest.approx((0.25, 0.25))
    assert same.told_apart


def test_holm_steps_decide_levels_of_intervals():
    rng = np.random.default_rng(3)
    base, noise = rng.uniform(size=40), rng.normal(size=(4, 40))
    noise = (noise - noise.mean(axis=1)[:, None]) / noise.std(axis=1)[:, None]
    errors = {"a": 0.0, "b": 20.0, "c": 2.1, "d": 2.09}  # differences in standard errors
    rows = {
        name: row(base - (t / math.sqrt(39) + sample) * (t > 0))
        for (name, t), sample in zip(errors.items(), noise, strict=True)
    }
    pairs = [("a", "b"), ("a", "c"), ("a", "d")]
    together = differences(rows, pairs, resamples=20_000)
    alone = [differences(rows, [pair], resamples=20_000)[0] for pair in pairs]
    order = sorted(range(3), key=lambda i: alone[i].p)
    running, failed = 0.0, None
    for step, i in enumerate(order):
        running = max(running, alone[i].p * (3 - step))
        assert together[i].p == pytest.approx(min(running, 1.0))
        # The level is 0.05 over the pairs that are left; after a failure that of the failure.
        level_of = failed or 3 - step
        failed = failed or (3 - step if running > ALPHA else None)
        wider = together[i].high - together[i].low >= alone[i].high - alone[i].low
        assert wider if level_of > 1 else together[i].high == alone[i].high
    assert [test.told_apart for test in together] == [test.p <= ALPHA for test in together]
    # Alone both are told apart; of three pairs neither is, since the second step asks for 0.025.
    assert [test.told_apart for test in alone] == [True, True, True]
    assert [test.told_apart for test in together] == [True, False, False]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.integers(2, 12), st.integers(2, 4), st.floats(0, 0.3))
def test_told_is_p_of_at_most_five_percent_for_any_order(seed, n, count, step):
    rng = np.random.default_rng(seed)
    cells = CELLS[: 1 + seed % 3]
    rows = {
        f"r{i}": {s: drawn(rng, step * (i // 2), n, cells)[0] for s in range(1 + seed % 2)}
        for i in range(count)
    }
    rows |= {"copy": rows["r0"], "constant": row([0.5] * n, cells)}
    pairs = [*itertools.pairwise(rows), ("copy", "r0")]
    tests = differences(rows, pairs, resamples=500)
    assert all(test.told_apart == (test.p <= ALPHA) for test in tests)
    assert not tests[-1].told_apart
    assert tests[-1].p == 1
    reordered = {
        name: {s: dict(reversed(c.items())) for s, c in reversed(r.items())}
        for name, r in reversed(rows.items())
    }
    again = differences(reordered, pairs[::-1], resamples=500)
    np.testing.assert_equal(again[::-1], tests)
    straight, turned = (
        differences(rows, [pair], resamples=500)[0] for pair in (pairs[0], pairs[0][::-1])
    )
    np.testing.assert_array_equal(
        [turned.difference, turned.low, turned.high, turned.p],
        [-straight.difference, -straight.high, -straight.low, straight.p],
    )


def test_too_few_test_seeds_for_any_verdict_give_no_interval():
    five = one(row([0.9, 0.91, 0.92, 0.9, 0.93]), row([0.1] * 5), resamples=2000)
    assert five.p == 2.0**-4
    assert not five.told_apart
    assert math.isnan(five.low)
    assert math.isnan(five.high)
    single = one(row([0.9]), row([0.1]))
    assert (single.p, single.told_apart) == (1.0, False)
    assert math.isnan(single.low)


def test_detector_seeds_are_fixed():
    rng = np.random.default_rng(6)
    cells = [drawn(rng, mean)[0] for mean in (0.5, 0.9)]
    rival = drawn(rng, 0.6)
    both = one({0: cells[0], 1: cells[1]}, rival)
    mean = {0: {c: mean_of((cells[0][c].numerator + cells[1][c].numerator) / 2) for c in CELLS}}
    expected = one(mean, rival)
    assert (both.difference, both.low, both.high, both.p) == pytest.approx(
        (expected.difference, expected.low, expected.high, expected.p)
    )
    assert both.told_apart


@pytest.mark.parametrize(("environments", "tables"), [(1, 200), (4, 100)])
def test_of_equal_rows_few_are_told_apart(environments, tables):
    """No row from the row above, nor a given one, which is as good as any, from the first."""
    rng, n, wrong = np.random.default_rng(5), 10, np.zeros(2)
    for _ in range(tables):
        episodes = {f"e{e}": rng.beta(4, 2, size=n) for e in range(environments)}
        rows = {
            f"d{d}": {0: {(e, "iid"): mean_of(0.6 * base + 0.4 * rng.beta(3, 1.5, size=n))
                          for e, base in episodes.items()}}
            for d in range(4)
        }  # fmt: skip
        means = {name: np.mean([c.value for c in r[0].values()]) for name, r in rows.items()}
        order = sorted(rows, key=lambda name: -means[name])
        families = [*itertools.pairwise(order)], [(order[0], name) for name in order[1:]]
        for i, pairs in enumerate(families):
            tests = differences(rows, pairs, resamples=1000)
            wrong[i] += any(t.told_apart for t in tests if i == 0 or t.second == "d0")
    # 5 % expected; three standard errors more would come by chance in a suite of a thousand.
    assert (wrong / tables <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / tables)).all(), wrong / tables


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([0.5, 0.6, 0.7], "b has 3 test trajectories in ant/iid, expected 2"),
        ([NAN, NAN], "b has no value in ant/iid"),
    ],
)
def test_rows_of_other_test_seeds_and_undefined_cells_are_refused(values, message):
    with pytest.raises(ResultsError, match=message):
        one(row([0.5, 0.6]), row(values))
    assert differences({}, []) == []
