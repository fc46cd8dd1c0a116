"""Ranks: Holm, tie groups, studentized paired bootstrap, win rates."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.errors import ResultsError
from oodd_eval.metrics import ranking as ranking_module
from oodd_eval.metrics.auc import mean_of
from oodd_eval.metrics.bootstrap import bounds, drawn_cell, sample_cells
from oodd_eval.metrics.ranking import ALPHA, Ranking, holm, rank, tie_groups, win_rates

CELLS = [("ant", "iid"), ("ant", "gravity"), ("hopper", "iid")]
NAN = math.nan


def row(values, cells=(("ant", "iid"),), seed=0):
    """A row with one detector seed and the same values in every cell."""
    return {seed: {cell: mean_of(values) for cell in cells}}


def drawn(rng, mean=0.6, n=30, cells=CELLS):
    return {0: {cell: mean_of(rng.normal(mean, 0.1, size=n)) for cell in cells}}


def p_of(ranking, first, second):
    return next(c for c in ranking.comparisons if (c.first, c.second) == (first, second))


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


def test_identical_detectors_share_the_first_rank():
    values = np.random.default_rng(0).uniform(size=30)
    ranking = rank({name: row(values, CELLS) for name in "abc"})
    assert ranking.ranks == {"a": 1, "b": 1, "c": 1}
    assert ranking.groups == [("a", "b", "c")]
    assert {c.p for c in ranking.comparisons} == {1.0}


def test_a_clearly_better_one_ranks_alone():
    rng = np.random.default_rng(1)
    ranking = rank({"a": drawn(rng), "best": drawn(rng, 0.8), "b": drawn(rng)})
    assert ranking.ranks == {"best": 1, "a": 2, "b": 2}
    assert p_of(ranking, "best", "a").p == 1 / 10_001  # none of 10 000 resamples
    assert [set(group) for group in ranking.groups] == [{"best"}, {"a", "b"}]
    assert [ranking.letters(name) for name in ("best", "a", "b")] == ["", "a", "a"]


def test_ranks_do_not_depend_on_any_order():
    rng = np.random.default_rng(2)
    rows = {
        name: {seed: drawn(rng, mean)[0] for seed in (0, 1, 2)}
        for name, mean in (("a", 0.6), ("b", 0.62), ("c", 0.7))
    }
    turned = {
        name: {seed: dict(reversed(cells.items())) for seed, cells in reversed(one.items())}
        for name, one in reversed(rows.items())
    }
    assert rank(turned) == rank(rows)
    assert list(rank(turned).ranks) == list(rank(rows).ranks)


def studentized(sample, centre=0.0):
    """Mean of a sample from a centre, in standard errors."""
    n, shift = len(sample), sum(sample) / len(sample) - centre
    spread = sum((x - sum(sample) / n) ** 2 for x in sample) / (n - 1) / n
    if abs(shift) < 1e-12:
        return 0.0
    return shift / math.sqrt(spread) if spread > 1e-20 else math.copysign(math.inf, shift)


def counted_out(differences):
    """Share of all resamples that are as far from the mean as it is from 0."""
    resamples = itertools.product(differences, repeat=len(differences))
    reached = [studentized(s, differences.mean()) >= studentized(differences) for s in resamples]
    return sum(reached) / len(reached)


def test_p_value_is_that_of_all_resamples_counted_out():
    differences = np.array([0.3, 0.1, -0.1, 0.2, 0.25, 0.05])
    expected, n = counted_out(differences), len(differences)
    ranking = rank({"a": row(differences + 0.5), "b": row([0.5] * n)}, resamples=20_000)
    assert 2.0**-n < expected < 0.2
    error = 4 * math.sqrt(expected / 20_000)
    assert p_of(ranking, "a", "b").p == pytest.approx(expected, abs=error)
    # Of detector seeds alone, where all test seeds agree.
    values, shifts = np.linspace(0, 1, 30), np.array([0.1, 0.2, 0.6, 0.15])
    seeds = {k: row(values + shift)[0] for k, shift in enumerate(shifts)}
    found = p_of(rank({"a": seeds, "b": row(values)}, resamples=20_000), "a", "b").p
    assert found == pytest.approx(counted_out(shifts), abs=error)
    # Where four test seeds differ by the same, each might as well have the other sign.
    four = rank({"a": row(values[:4] + 0.2), "b": row(values[:4])}, resamples=2000)
    assert p_of(four, "a", "b").p == 2.0**-4


def test_interval_of_a_difference_is_the_paired_one():
    rng = np.random.default_rng(4)
    a, b = drawn(rng, n=12), drawn(rng, n=12)
    ranking = rank({"a": a, "b": b}, resamples=2000)
    first, second = (sample_cells([drawn_cell(c[0], 0, x[0][c]) for c in CELLS]) for x in (a, b))
    value = np.mean([a[0][c].value - b[0][c].value for c in CELLS])
    expected = bounds(first - second, value, [12, 12])
    one, other = p_of(ranking, "a", "b"), p_of(ranking, "b", "a")
    assert (one.low, one.high) == pytest.approx(expected)
    assert (other.difference, other.low, other.high) == (-one.difference, -one.high, -one.low)


@pytest.mark.parametrize(("environments", "tables"), [(1, 200), (4, 60)])
def test_equal_detectors_are_called_different_in_one_table_of_twenty(environments, tables):
    rng, n, wrong = np.random.default_rng(5), 10, 0
    for _ in range(tables):
        episodes = {f"e{e}": rng.beta(4, 2, size=n) for e in range(environments)}
        rows = {
            f"d{d}": {0: {(e, "iid"): mean_of(0.6 * base + 0.4 * rng.beta(3, 1.5, size=n))
                          for e, base in episodes.items()}}
            for d in range(4)
        }  # fmt: skip
        wrong += any(c.better for c in rank(rows, resamples=1000).comparisons)
    # 5 % expected; three standard errors more would come by chance in a suite of a thousand.
    assert wrong / tables <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / tables)


def test_detector_seeds_that_disagree_widen_a_comparison():
    rng = np.random.default_rng(6)
    cells = [drawn(rng, mean, cells=CELLS)[0] for mean in (0.5, 0.9)]
    rival = drawn(rng, 0.6)
    assert rank({"a": {1: cells[1]}, "rival": rival}).ranks == {"a": 1, "rival": 2}
    both = rank({"a": {0: cells[0], 1: cells[1]}, "rival": rival})
    assert both.ranks == {"a": 1, "rival": 1}
    assert p_of(both, "a", "rival").difference == pytest.approx(0.1, abs=0.03)


def test_rank_counts_better_rows_and_ties_need_not_be_transitive():
    assert tie_groups(["a", "b", "c"], [("a", "c")]) == [("a", "b"), ("b", "c")]
    ranking = Ranking({"a": 1, "b": 1, "c": 2}, [("a", "b"), ("b", "c")], [], 0)
    assert [ranking.letters(name) for name in "abc"] == ["a", "ab", "b"]


@given(st.integers(0, 6), st.sets(st.tuples(st.integers(0, 5), st.integers(0, 5))))
def test_tie_groups_are_the_largest_sets_without_a_significant_pair(size, pairs):
    names = [str(i) for i in range(size)]
    apart = {(str(a), str(b)) for a, b in pairs if a < b < size}
    subsets = [
        set(s)
        for k in range(1, size + 1)
        for s in itertools.combinations(names, k)
        if not any((a, b) in apart for a, b in itertools.combinations(s, 2))
    ]
    largest = {tuple(sorted(s)) for s in subsets if not any(s < other for other in subsets)}
    assert set(tie_groups(names, apart)) == largest


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([0.5, 0.6, 0.7], "b has 3 test trajectories in ant/iid, expected 2"),
        ([NAN, NAN], "b has no value in ant/iid"),
    ],
)
def test_rows_of_other_test_seeds_and_undefined_cells_are_refused(values, message):
    with pytest.raises(ResultsError, match=message):
        rank({"a": row([0.5, 0.6]), "b": row(values)})
    assert rank({"a": row([0.5, 0.6])}).ranks == {"a": 1}
    assert rank({}).ranks == {}


def test_win_rates_count_equal_values_one_half():
    values = {
        "a": dict(zip(CELLS, [0.9, 0.5, 0.4], strict=True)),
        "b": dict(zip(CELLS, [0.8, 0.5, 0.6], strict=True)),
    }
    assert win_rates(values) == {("a", "b"): 0.5, ("b", "a"): 0.5}
    values["a"][CELLS[2]] = 0.7
    assert win_rates(values)["a", "b"] == pytest.approx(2.5 / 3)


# -- primary rows and variants --------------------------------------------------------------------


def ladder(levels, n=30):
    """Rows that differ by far more than noise, best first."""
    rng = np.random.default_rng(7)
    return {name: drawn(rng, 0.9 - 0.1 * i, n) for i, name in enumerate(levels)}


def test_variants_push_nobody_down_and_have_the_rank_that_they_would_have():
    rows = ladder(["a-tuned", "a", "b-tuned", "b", "c"])
    ranking = rank(rows, primary={"a", "b", "c"})
    assert ranking.ranks == {"a-tuned": 1, "a": 1, "b-tuned": 2, "b": 2, "c": 3}
    assert list(rank(rows).ranks.values()) == [1, 2, 3, 4, 5]
    assert ranking.groups == [("a",), ("b",), ("c",)]
    assert not any(c.first in ("a-tuned", "b-tuned") and c.second in ("a-tuned", "b-tuned")
                   for c in ranking.comparisons)  # fmt: skip


def test_primary_rows_are_told_apart_as_if_there_were_no_variants():
    rng = np.random.default_rng(8)
    rows = {name: drawn(rng, mean) for name, mean in (("a", 0.66), ("b", 0.62), ("c", 0.6))}
    alone = rank(rows, resamples=4000)
    variants = {f"v{i}": drawn(rng, 0.6) for i in range(20)}
    beside = rank(rows | variants, primary=rows, resamples=4000)
    among = [c for c in beside.comparisons if {c.first, c.second} <= rows.keys()]
    assert among == alone.comparisons
    assert beside.groups == alone.groups
    assert {name: beside.ranks[name] for name in rows} == alone.ranks


def test_a_variants_tests_are_corrected_as_those_of_one_more_primary_row():
    rng = np.random.default_rng(9)
    rows = {name: drawn(rng, mean) for name, mean in (("a", 0.65), ("b", 0.6), ("v", 0.62))}
    beside = rank(rows, primary={"a", "b"}, resamples=4000)
    whole = rank(rows, resamples=4000)
    for c in beside.comparisons:
        if "v" in (c.first, c.second):
            assert c.p_holm == p_of(whole, c.first, c.second).p_holm


def noisy(count, step, seed, environments=4):
    """Rows whose means rise by a step each, of one to three detector seeds."""
    rng = np.random.default_rng(seed)
    cells = [(f"e{i}", "iid") for i in range(environments)]
    return {
        f"r{i}": {
            seed: {c: mean_of(step * i + 0.02 * rng.normal(size=10)) for c in cells}
            for seed in range(1 + i % 3)
        }
        for i in range(count)
    }


def test_p_values_too_small_to_be_counted_are_nearly_those_of_more_resamples(monkeypatch):
    rows = noisy(9, 0.004, seed=5)
    counted = rank(rows, resamples=400_000).comparisons
    monkeypatch.setattr(ranking_module, "RESAMPLES_PER_PAIR", 5_000)
    few = rank(rows).comparisons
    small = [(one.p, other.p) for one, other in zip(few, counted, strict=True)
             if 1e-4 < other.p < ranking_module.ENOUGH / 30_000]  # fmt: skip
    assert len(small) > 3
    for p, expected in small:
        assert 1 / 3 < p / expected < 3
    # Further away they go on falling, where counting ends at 1 / (R + 1).
    assert min(c.p for c in few) < 1e-5


def test_blocks_of_resamples_do_not_change_what_is_beyond(monkeypatch):
    rows = noisy(7, 0.003, seed=9)
    constant = {0: {cell: mean_of([0.5] * 10) for cell in rows["r0"][0]}}
    rows |= {"r0-again": rows["r0"], "constant": constant}
    comparisons = rank(rows, resamples=3_000).comparisons
    for block in (3_000, 700):
        monkeypatch.setattr(ranking_module, "_BLOCK", block)
        assert rank(rows, resamples=3_000).comparisons == comparisons
