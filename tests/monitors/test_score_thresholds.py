"""The promise on machines that differ, in a small version of benchmarks/score_thresholds.py.

What is expected is counted here: how often a further log is among the largest of n + 1, and by
simulated ranks how far the share over some draws may be from that.
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).parents[2] / "benchmarks" / "score_thresholds.py"
SPEC = importlib.util.spec_from_file_location("score_thresholds", PATH)
BENCHMARK = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(BENCHMARK)

DRAWS, LOGS, FURTHER = 30, 19, 40
CELLS = [(machine, score) for machine in BENCHMARK.MACHINES for score in BENCHMARK.SCORES]


def ranked_shares(allowed, experiments=4000):
    """Mean shares of numbers of any law above the (allowed + 1)-th largest of LOGS others."""
    rng = np.random.default_rng(0)
    means = np.zeros(experiments)
    for i in range(experiments):
        ranks = rng.random((DRAWS, LOGS + FURTHER))
        thresholds = np.sort(ranks[:, :LOGS], axis=1)[:, LOGS - allowed - 1]
        means[i] = (ranks[:, LOGS:] > thresholds[:, None]).mean()
    return means


def test_there_are_seven_machines_with_three_scores_each():
    assert len(BENCHMARK.MACHINES) == 7
    assert len(BENCHMARK.SCORES) == 3


@pytest.mark.parametrize(("machine", "score"), CELLS, ids="-".join)
def test_healthy_logs_alarm_as_often_as_ranks_say(machine, score):
    """5 %: above all of 19; 10 %: 19 + 1 logs times .1 are 2, so above all but one of them."""
    at_5, at_10, swept = BENCHMARK.shares(
        machine, score, draws=DRAWS, logs=LOGS, further=FURTHER
    ).mean(axis=0)
    for share, allowed in ((at_5, 0), (swept, 0), (at_10, 1)):
        low, high = EXPECTED[allowed]
        # Counts are often equal, and then fewer alarm.
        assert (0 if machine == "pump" else low) <= share <= high


# Of 63 shares none is to be outside by chance alone.
EXPECTED = [np.quantile(ranked_shares(allowed), [0.0005, 0.9995]) for allowed in (0, 1)]


def test_those_intervals_are_about_what_is_promised():
    for allowed, (low, high) in enumerate(EXPECTED):
        assert low < (allowed + 1) / 20 < high
        assert ranked_shares(allowed).mean() == pytest.approx((allowed + 1) / 20, abs=0.0008)
