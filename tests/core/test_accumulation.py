"""Statistics that guaranteed alarms may watch beside the CUSUM, against their definitions."""

import itertools
import math
from typing import get_args

import numpy as np
import pytest
from oodd_live import Watchdog

from oodd_eval import Trajectory
from oodd_eval.cli.main import main
from oodd_eval.errors import UsageError
from oodd_eval.metrics.accumulation import (
    BETS,
    SHIFT,
    STATISTICS,
    WEIGHT,
    AlarmKind,
    Ranks,
    accumulated,
)
from oodd_eval.metrics.alarms import Calibration, GuaranteedAlarm, Monitor, least_episodes
from oodd_eval.metrics.cusum import DRIFT, Standardization, cusum
from oodd_eval.metrics.promise import enough_episodes
from oodd_eval.plugins.contract import Alarm
from oodd_eval.results.directory import ResultsDirectory

SUMS = ["ewma", "shiryaev-roberts", "e-detector"]


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def test_the_contract_offers_the_statistics_that_there_are():
    assert get_args(Alarm) == get_args(AlarmKind) == STATISTICS


def test_a_moving_average_weighs_a_score_by_its_age():
    z = normal(1, 60)
    weights = WEIGHT * (1 - WEIGHT) ** np.arange(60)
    expected = [sum(weights[: t + 1] * z[t::-1]) for t in range(60)]
    np.testing.assert_allclose(accumulated("ewma", 0.01 * z), expected, rtol=1e-12, atol=1e-15)
    # Two thirds of the way up in 21 rows, and below a tenth of that 50 rows after the end.
    step = accumulated("ewma", 0.01 * np.repeat([3.0, 0.0], [21, 50]))
    assert step[20] > 1.9
    assert step[70] < 0.19


def test_a_shiryaev_roberts_sum_is_that_of_the_likelihood_ratios_of_all_beginnings():
    z = normal(2, 40)
    ratios = np.exp(-((z - SHIFT) ** 2) / 2) / np.exp(-(z**2) / 2)  # of two normal densities
    sums = [sum(math.prod(ratios[k : t + 1]) for k in range(t + 1)) for t in range(40)]
    np.testing.assert_allclose(
        np.expm1(accumulated("shiryaev-roberts", 0.01 * z)), sums, rtol=1e-10
    )


def test_a_shiryaev_roberts_sum_is_above_the_cusum_of_the_same_rise_by_little():
    z = normal(3, 300)
    soft = accumulated("shiryaev-roberts", 0.01 * z)
    # The harness's CUSUM adds 0.01 z - 0.0018: the logarithm of the same ratio by 100 SHIFT.
    hard = 100 * SHIFT * cusum(0.01 * z, threshold=math.inf)[0]
    assert pytest.approx(SHIFT / 2) == 100 * DRIFT
    assert (soft >= hard - 1e-9).all()
    assert (soft <= hard + np.log(np.arange(2, 302)) + 1e-9).all()


def test_an_e_detector_is_the_mean_of_sums_of_bets_on_ranks():
    u = np.random.default_rng(4).random(30)
    sums = [
        sum(
            math.prod(1 + b * (x - 0.5) for x in u[k : t + 1])
            for b in BETS
            for k in range(t + 1)
        ) / len(BETS)
        for t in range(30)
    ]  # fmt: skip
    np.testing.assert_allclose(np.expm1(accumulated("e-detector", u)), sums, rtol=1e-12)


def test_factors_of_nominal_scores_have_the_mean_that_bounds_on_run_lengths_take():
    # Then R_t - t is a martingale, whatever the number of rows: the mean of R_t is t.
    z, rng = normal(5, 4000, 20), np.random.default_rng(6)
    for kind, x in (("shiryaev-roberts", 0.01 * z), ("e-detector", rng.random((4000, 20)))):
        last = np.expm1([accumulated(kind, row)[-1] for row in x])
        assert last.mean() == pytest.approx(20, abs=4 * last.std() / math.sqrt(4000))


def test_ranks_are_shares_of_calibration_scores_and_of_equal_ones_half():
    ranks = Ranks.fit([np.array([np.nan, 3.0, 1.0]), np.array([3.0, 3.0, 8.0])])
    assert ranks(np.array([0.0, 1.0, 2.0, 3.0, 8.0, 9.0])).tolist() == [
        0.0, 0.1, 0.2, 0.5, 0.9, 1.0,
    ]  # fmt: skip
    assert np.isnan(ranks(np.array([np.nan]))).all()
    assert Ranks.fit([])(np.array([7.0])).tolist() == [0.5]


def test_ranks_among_many_scores_are_those_among_their_quantiles():
    scores = np.random.default_rng(7).permutation(100_000) * 1.0
    ranks = Ranks.fit(np.split(scores, 10))
    assert len(ranks.values) == 512
    x = np.linspace(-5, 100_005, 77)
    np.testing.assert_allclose(ranks(x), np.clip(x / 100_000, 0, 1), atol=1 / 512)
    assert np.mean(ranks(scores)) == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("kind", SUMS)
def test_a_monitor_gives_the_statistics_and_alarms_of_the_whole_episode_bit_for_bit(kind):
    calibration = [np.concatenate([[np.nan], row]) for row in normal(8, 19, 50)]
    rule = GuaranteedAlarm.fit(calibration, 0.10, kind)
    scores = np.concatenate([[np.nan], normal(9, 40), normal(10, 40) + 2])
    monitor = Monitor(rule)
    for _ in range(2):
        alarms, statistics = [], []
        for score in scores:
            alarms.append(monitor.update(score))
            statistics.append(monitor.statistic)
        assert statistics == rule.statistic(scores).tolist()
        assert alarms.index(True) == rule.first(scores) > 40
        monitor.reset()


@pytest.mark.parametrize("kind", SUMS)
def test_the_promise_holds_for_every_statistic(kind):
    # 39 episodes: 19 that rank or standardize (20 of even number) and 19 for the quantile.
    shares = []
    for seed in range(60):
        rows = np.cumsum(normal(seed, 69, 30), axis=1)  # as dependent as can be
        rule = GuaranteedAlarm.fit([*rows[:39]], 0.05, kind)
        shares += [rule.first(row) is not None for row in rows[39:]]
    # Exactly 1 in 20 where no two statistics are equal; 1 800 in 60 draws of a threshold.
    assert 0.02 < np.mean(shares) < 0.08
    assert least_episodes(0.05, kind) == 38
    with pytest.raises(UsageError, match=r"takes 38 calibration episodes, got 37: 38 for an? "):
        GuaranteedAlarm.fit([*normal(0, 37, 9)], 0.05, kind)


def test_the_threshold_is_from_the_odd_episodes_and_the_basis_from_the_even():
    episodes = [*normal(11, 40, 25)]
    for kind, basis in (("ewma", Standardization), ("e-detector", Ranks)):
        known = Calibration.fit(episodes, kind)
        assert known.standardization == basis.fit(episodes[0::2])
        largest = [accumulated(kind, known.standardization(s)).max() for s in episodes[1::2]]
        assert known.largest == tuple(largest)
        assert known.rule(0.05).threshold == sorted(largest)[19]


def test_a_moving_average_ends_its_alarm_when_the_fault_does_and_a_cusum_does_not():
    calibration = [*normal(12, 39, 200)]
    scores = normal(13, 300)
    scores[100:140] += 3
    above = {}
    for kind in ("ewma", "cusum"):
        rule = GuaranteedAlarm.fit(calibration, 0.05, kind)
        above[kind] = np.flatnonzero(rule.statistic(scores) > rule.threshold)
        assert 100 <= above[kind][0] < 120
    assert 140 <= above["ewma"][-1] < 200
    assert above["cusum"][-1] == 299


def test_sentences_on_episodes_name_the_statistic():
    text = str(enough_episodes(30, ["e-detector", "ewma"]))
    assert text.endswith("at 5 % 38 are needed for an e-detector of the scores, 38 for an EWMA of "
                         "the scores")  # fmt: skip


@pytest.mark.parametrize("kind", SUMS)
def test_a_watchdog_watches_the_statistic_and_keeps_it(tmp_path, kind):
    rng = np.random.default_rng(14)
    train, calibration = (
        [Trajectory(rng.normal(size=(80, 2)), np.zeros((79, 1))) for _ in range(n)]
        for n in (10, 20)
    )
    watchdog = Watchdog.fit("mahalanobis", train, calibration, alpha=0.10, statistic=kind)
    watchdog.save(tmp_path / "dog.npz")
    other = Watchdog.load(tmp_path / "dog.npz")
    x = rng.normal(size=(90, 2))
    x[40:] += 2.5
    readings = [[dog.update(row) for row in x] for dog in (watchdog, other)]
    values = [[(r.statistic, r.alarm) for r in each] for each in readings]
    assert values[0] == values[1]
    # The same by hand, from the scores of the detector alone.
    scores = [dog_scores(watchdog, t.observations) for t in calibration]
    rule = GuaranteedAlarm.fit(scores, 0.10, kind)
    expected = rule.statistic(dog_scores(watchdog, x))
    assert [s for s, _ in values[0]] == pytest.approx(expected.tolist())
    assert [a for _, a in values[0]].index(True) == rule.first(dog_scores(watchdog, x)) >= 40


def dog_scores(watchdog, rows):
    rows = np.asarray(rows, np.float32)
    return np.asarray(watchdog._handle.detector.score(Trajectory(rows)), np.float64)


def test_a_watchdog_refuses_a_statistic_that_there_is_not():
    train = [Trajectory(normal(i, 20, 2)) for i in range(9)]
    with pytest.raises(UsageError, match="statistic='max', expected one of 'cusum', 'score', 'ew"):
        Watchdog.fit("mahalanobis", train, train, alpha=0.5, statistic="max")


def test_show_computes_figures_with_another_statistic_and_stores_none(tmp_path, tiny_split, capsys):
    command = [
        "run", "--detector", "mahalanobis", "--env", "cartpole", "--anomaly", "iid", "-q",
        "--split", str(tiny_split), "--output", str(tmp_path), "--jobs", "1",
    ]  # fmt: skip
    assert main(command) == 0
    stored = (tmp_path / "records.jsonl").read_bytes()
    shown = {}
    for kind in (None, "cusum", "ewma"):
        capsys.readouterr()
        option = ["--alarm", kind] if kind else []
        assert main(["show", str(tmp_path), "--csv", "--split", str(tiny_split), *option]) == 0
        shown[kind] = capsys.readouterr().out
    assert shown[None] == shown["cusum"] != ""
    assert (tmp_path / "records.jsonl").read_bytes() == stored
    assert [r.alarm for r in ResultsDirectory(tmp_path).records()] == ["cusum"]
    assert main(["show", str(tmp_path), "--stored", "--alarm", "ewma"]) == 4
    assert "--alarm ewma computes figures that --stored would not" in capsys.readouterr().err


def test_statistics_need_no_more_than_the_rows_so_far():
    u = np.random.default_rng(15).random(50)
    for kind, t in itertools.product(SUMS, (1, 17, 49)):
        assert accumulated(kind, u)[:t].tolist() == accumulated(kind, u[:t]).tolist()
