"""Measured run lengths: the script behind docs/run-length.md, small, and the page's table."""

import importlib.util
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from oodd_eval.metrics.accumulation import accumulated

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("run_lengths", ROOT / "benchmarks/run_lengths.py")
run_lengths = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(run_lengths)


@pytest.mark.parametrize("kind", run_lengths.KINDS)
def test_the_fast_sums_are_the_harnesss_own(kind):
    z = np.random.default_rng(1).normal(size=50)
    x = z / 100 if kind == "shiryaev-roberts" else run_lengths.ranks(z)
    sums = np.zeros((5 if kind == "e-detector" else 1, 1))
    fast = []
    for value in z:
        sums = run_lengths.next_sums(kind, sums, np.array([value]))
        fast.append(np.log1p(np.expm1(sums).mean()))
    np.testing.assert_allclose(accumulated(kind, x), fast, rtol=1e-9)


def test_alarms_begin_anew_after_each_one():
    # Ranks of 1: R = 1.5, 3.75, 7.125 for a stake of 1, and less for the others.
    class Top:
        def __call__(self, scores):
            return np.ones(len(scores))

    statistic = np.expm1(accumulated("e-detector", np.ones(7)))
    assert statistic[1] < 3 < statistic[2]
    assert run_lengths.alarms_of("e-detector", [np.zeros(7), np.zeros(2)], Top(), 3) == 2


def test_run_lengths_keep_the_bound_on_independent_scores_and_break_it_on_dependent_ones():
    for kind in run_lengths.KINDS:
        independent, dependent = (
            run_lengths.run_length_ratio(kind, phi, 100, 300)[0] for phi in (0.0, 0.9)
        )
        assert 0.95 < independent < 1.6
        assert dependent < 0.8


@pytest.fixture(scope="module")
def small():
    options = SimpleNamespace(
        split="mini", detector="mewma", env="cartpole", limit=None, streams=60, calibrations=3
    )
    return list(run_lengths.table(options))


def test_the_pages_table_is_one_of_the_script(small):
    page = (ROOT / "docs" / "run-length.md").read_text()
    lines = re.findall(r"^\| (.*) \|$", page, re.MULTILINE)
    rows = [line.split(" | ") for line in lines]
    assert rows[:2] == small[:2]
    assert [row[:2] for row in rows[2:8]] == [row[:2] for row in small[2:8]]
    # Each detector has a line per statistic, with ratios, a range of A and counts.
    assert len(rows) >= 14
    numbers = [r"(> )?\d+\.\d\d"] * 2
    for row in (*rows[8:], *small[8:]):
        assert re.fullmatch(r"`[\w-]+`, φ = -?0\.\d\d", row[0])
        assert row[1] in run_lengths.KINDS.values()
        assert all(map(re.fullmatch, [*numbers, r"\S+ to \S+", r".* % \(\d+ of \d+\)"], row[2:]))
    # What the page says of it.
    ratios = {(row[0], row[1]): [float(x) for x in row[2:4]] for row in rows[2:]}
    for (label, _), values in ratios.items():
        if label == "independent normal":
            assert min(values) >= 1
        else:
            assert max(values) < 1
