"""Guaranteed alarms: thresholds, what counts as found, and the promise itself, by simulation."""

import math
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from helpers_records import make_record
from scipy.stats import binom

from oodd_eval.cli.main import main
from oodd_eval.data.parts import CALIBRATION
from oodd_eval.metrics.alarms import (
    RECORDED,
    STATISTICS,
    AlarmKind,
    Calibration,
    GuaranteedAlarm,
    Monitor,
    guaranteed_contributions,
    least_episodes,
    offered_levels,
    quantile_rank,
)
from oodd_eval.metrics.auc import AlarmRule
from oodd_eval.metrics.catalogue import FOUND_WITHIN, GUARANTEED, LEVELS, metric_info
from oodd_eval.metrics.cusum import Standardization, cusum
from oodd_eval.metrics.recalibration import PairedScores
from oodd_eval.plugins.contract import Alarm
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.evaluate import Rules, cell_metrics, evaluated

NAN = math.nan
# The score itself is the statistic: an alarm exactly where it is above 1.
ABOVE_ONE = GuaranteedAlarm(None, 1.0)


def arrays(*sequences):
    return [np.array(s, dtype=float) for s in sequences]


def terms(found, name):
    return list(zip(found[name].numerator.tolist(), found[name].denominator.tolist(), strict=True))


# -- thresholds -----------------------------------------------------------------------------------


def test_the_rank_is_the_smallest_that_keeps_the_level():
    for level in LEVELS.values():
        percent = round(100 * level)
        for n in range(1, 300):
            promising = [k for k in range(1, n + 2) if 100 * (n + 1 - k) <= percent * (n + 1)]
            assert quantile_rank(n, level) == promising[0]


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.99])
def test_the_rank_with_a_confidence_is_the_smallest_that_so_many_calibrations_keep(confidence):
    for level in (0.01, 0.05, 0.2):
        for n in range(1, 120):
            chances = binom.sf(np.arange(n), n, 1 - level)  # of at least k quiet episodes
            enough = [k for k, p in enumerate(chances, 1) if p <= 1 - confidence]
            assert quantile_rank(n, level, confidence) == (enough or [n + 1])[0]
            for kind, episodes in (("score", n), ("cusum", 2 * n)):
                assert bool(enough) == (least_episodes(level, kind, confidence) <= episodes)


@pytest.mark.parametrize(
    ("episodes", "kind", "levels"),
    [
        (17, "cusum", []),
        (18, "cusum", ["at_10pct"]),
        (37, "cusum", ["at_10pct"]),
        (38, "cusum", ["at_10pct", "at_5pct"]),
        (198, "cusum", ["at_10pct", "at_5pct", "at_1pct"]),
        (8, "score", []),
        (19, "score", ["at_10pct", "at_5pct"]),
        (99, "score", ["at_10pct", "at_5pct", "at_1pct"]),
    ],
)
def test_levels_that_the_calibration_episodes_are_too_few_for_are_not_offered(
    episodes, kind, levels
):
    assert list(offered_levels(episodes, kind)) == levels
    scores = list(np.random.default_rng(0).normal(size=(episodes, 5)))
    assert list(Rules.fit(scores, kind).guaranteed) == levels


def test_even_episodes_standardize_and_odd_ones_give_the_threshold():
    rng = np.random.default_rng(1)
    scores = list(rng.normal(3, 2, size=(20, 30)))
    rule = GuaranteedAlarm.fit(scores, 0.10)
    even = np.concatenate(scores[0::2])
    largest = []
    for s in scores[1::2]:
        total, most = 0.0, 0.0
        for x in 0.01 * (s - even.mean()) / even.std():
            total = max(0.0, total + x - 0.0018)
            most = max(most, total)
        largest.append(most)
    # n = 10: rank ceil(11 x 0.9) = 10, the largest.
    assert rule.threshold == pytest.approx(max(largest))
    assert quantile_rank(10, 0.10) == 10


def test_a_score_of_its_own_is_its_statistic_and_all_episodes_count():
    peaks = [5.0, 1.0, 4.0, 2.0, 3.0, 9.0, 8.0, 7.0, 6.0]
    calibration = arrays(*[[NAN, 0, p, 0] for p in peaks])
    rule = GuaranteedAlarm.fit(calibration, 0.10, "score")
    assert (rule.standardization, rule.threshold) == (None, 9.0)
    assert rule.first(np.array([NAN, 9.0, 9.5, 10.0])) == 2
    assert rule.first(np.array([NAN, 9.0])) is None
    # Two of ten: the eighth.
    assert GuaranteedAlarm.fit(calibration, 0.20, "score").threshold == 8.0


# -- what is counted ------------------------------------------------------------------------------


def test_only_the_first_alarm_counts_and_an_early_one_leaves_the_episode_out():
    anomalous = arrays([0, 0, 0, 2, 2], [0, 2, 0, 2, 2], [0, 0, 0, 0, 0])
    found = guaranteed_contributions(anomalous, arrays(*[[0] * 5] * 3), [2, 2, 3], ABOVE_ONE)
    shared = [n for n in GUARANTEED if not metric_info(f"{n}_at_5pct").cells]
    assert list(found) == shared
    assert terms(found, "early") == [(0, 1), (1, 1), (0, 1)]
    assert terms(found, "delay") == [(1, 1), (0, 0), (0, 0)]
    assert terms(found, "missed") == [(0, 1), (0, 0), (1, 1)]
    # T = 4: a miss from row 3 on counts 4 - 3 + 1.
    assert terms(found, "delay_censored") == [(1, 1), (0, 0), (2, 1)]
    assert terms(found, "found_within_20") == [(1, 1), (0, 0), (0, 1)]


@pytest.mark.parametrize("k", [20, 100])
def test_found_within_k_counts_the_rows_from_the_effect_on(k):
    effect = 7
    rows = np.zeros((2, effect + k + 5))
    rows[0, effect + k - 1] = rows[1, effect + k] = 2
    found = guaranteed_contributions(list(rows), list(0 * rows), [effect] * 2, ABOVE_ONE)
    assert terms(found, f"found_within_{k}") == [(1, 1), (0, 1)]


@pytest.mark.parametrize("k", [20, 100])
def test_found_within_k_counts_rows_that_both_episodes_have(k):
    effect = 3
    rows = np.zeros((2, 9))
    rows[:, 6] = 2
    for ends in ([7, 6], [6, 7]):
        quiet = [np.zeros(n) for n in ends]
        own, null = f"found_within_{k}", f"found_within_{k}_null"
        found = guaranteed_contributions(list(rows), quiet, [effect] * 2, ABOVE_ONE)
        assert terms(found, own) == [(float(n == 7), 1) for n in ends]
        found = guaranteed_contributions(quiet, list(rows), [effect] * 2, ABOVE_ONE)
        assert terms(found, null) == [(float(n == 7), 1) for n in ends]
        # Delays and misses count all rows that an episode has.
        assert terms(found, "delay_null") == [(3, 1)] * 2
    # No row is shared from the effect on.
    found = guaranteed_contributions(list(rows), [np.zeros(effect)] * 2, [effect] * 2, ABOVE_ONE)
    assert terms(found, own) == terms(found, null) == [(0, 0)] * 2
    # A twin that ended there has missed nothing.
    assert terms(found, "missed_null") == terms(found, "delay_censored_null") == [(0, 0)] * 2
    assert terms(found, "delay_censored") == [(3, 1)] * 2


def test_nulls_are_the_same_figures_of_the_twins_at_their_partners_effects():
    rng = np.random.default_rng(2)
    anomalous, twins = ([rng.normal(0, 0.6, size=n) for n in sizes]
                        for sizes in ((60, 35, 50, 20), (30, 40, 50, 60)))  # fmt: skip
    effects = [5, 10, 15, 20]
    found = guaranteed_contributions(anomalous, twins, effects, ABOVE_ONE)
    turned = guaranteed_contributions(twins, anomalous, effects, ABOVE_ONE)
    for name in (n for n in GUARANTEED if f"{n}_null" in found):
        assert terms(found, f"{name}_null") == terms(turned, name)
        assert terms(found, f"{name}_null") != terms(found, name)
    alarmed = [bool((t > 1).any()) for t in twins]
    assert terms(found, "false_episodes") == [(float(a), 1) for a in alarmed]


@pytest.mark.parametrize(
    ("scores", "alarm", "reason"),
    [
        (NAN, "score", "no score of the calibration trajectories is defined"),
        (1.7e308, "cusum", "too large"),
        (1.7e308, "score", "too large"),
    ],
)
def test_a_cell_without_a_threshold_is_invalid(scores, alarm, reason):
    calibration = [np.full(9, scores) for _ in range(40)]
    record = make_record(alarm=alarm)
    data = SimpleNamespace(recordings=lambda _part: None)
    (found,) = evaluated([record], ScoreFile({CALIBRATION: calibration}, {}), data)
    assert found.status == "invalid"
    assert reason in found.reason


@pytest.mark.parametrize("kind", ["cusum", "score"])
@pytest.mark.parametrize("unit", [1.0, 1e200])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_an_ideal_detector_is_perfect(kind, noise, unit):
    """0 on nominal rows and 1 from the effect on, also where the calibration has no spread."""
    rng = np.random.default_rng(3)
    lengths, effects = [60, 80, 100], [30, 41, 52]
    nominal = [noise * rng.uniform(-1, 1, size=n) for n in [*[70] * 40, *lengths]]
    calibration, twins = nominal[:40], nominal[40:]
    anomalous = [
        np.where(np.arange(n) < e, b, 1.0) for n, e, b in zip(lengths, effects, twins, strict=True)
    ]
    calibration, twins, anomalous = ([unit * s for s in part]
                                     for part in (calibration, twins, anomalous))  # fmt: skip
    # Every nominal score is at most its noise, every anomalous one is 1.
    cell = PairedScores(anomalous, twins, [30, 40, 50], effects)
    found, _ = cell_metrics(cell, Rules.fit(calibration, kind), environment="ant")
    assert found["auc_matched"].value == found["auc_smoothed"].value == 1
    assert found["missed"].value == 0
    if noise and kind == "cusum":
        assert found["missed_at_5pct"].value == 0
        assert found["delay_at_5pct"].value < 60
        return
    perfect = {"false_episodes": 0, "early": 0, "delay": 0, "missed": 0, "delay_censored": 0,
               "found_within_20": 1, "found_within_100": 1}  # fmt: skip
    assert {name: found[f"{name}_at_5pct"].value for name in perfect} == perfect


BLIND = {
    "comb": lambda n: np.arange(n) % 100 == 99,
    "timer": lambda n: np.arange(n) >= 60,
    "clock": np.arange,
}
"""Scores that know nothing but the time."""


@pytest.mark.parametrize("kind", ["cusum", "score"])
@pytest.mark.parametrize("blind", BLIND.values(), ids=BLIND)
def test_blind_alarms_find_no_more_than_their_null(blind, kind):
    """Also where an anomaly prolongs the episodes."""
    rng = np.random.default_rng(4)
    calibration, twins = rng.integers(60, 120, 40), rng.integers(60, 120, 60)
    effects, longer = rng.integers(10, 70, 60), twins + rng.integers(0, 200, 60)
    parts = [[blind(n).astype(float) for n in part] for part in (calibration, longer, twins)]
    found = guaranteed_contributions(*parts[1:], effects, GuaranteedAlarm.fit(parts[0], 0.05, kind))
    for k in FOUND_WITHIN:
        assert terms(found, f"found_within_{k}") == terms(found, f"found_within_{k}_null")
    assert 0 < found["found_within_20"].n < 60


# -- the promise ----------------------------------------------------------------------------------


def nominal_scores(rng, episodes, rows=20):
    """Student's t with 1.5 degrees of freedom, autocorrelated, each episode at its own level."""
    noise = rng.standard_t(1.5, size=(episodes, rows))
    scores = np.empty_like(noise)
    level = noise[:, 0]
    for t in range(rows):
        level = 0.9 * level + noise[:, t]
        scores[:, t] = level
    return scores + 5 * rng.standard_t(3, size=(episodes, 1))


@pytest.mark.parametrize("kind", ["cusum", "score"])
@pytest.mark.parametrize("n", [20, 40, 100])
def test_a_nominal_episode_alarms_with_at_most_the_promised_probability(n, kind):
    problems = 2000
    rng = np.random.default_rng([n, kind == "score"])
    episodes = nominal_scores(rng, problems * (n + 1)).reshape(problems, n + 1, -1)
    levels = offered_levels(n, kind)
    assert levels
    false = dict.fromkeys(levels, 0)
    for problem in episodes:
        calibration = Calibration.fit(list(problem[:n]), kind)
        for suffix, level in levels.items():
            false[suffix] += calibration.rule(level).first(problem[n]) is not None
    for suffix, level in levels.items():
        # Three standard errors: 6 wrong failures in 10 000 runs of one test.
        error = 3 * math.sqrt(level * (1 - level) / problems)
        assert false[suffix] / problems <= level + error
        # Nor is the promise kept by silence.
        quantile = n // 2 if kind == "cusum" else n
        exact = 1 - quantile_rank(quantile, level) / (quantile + 1)
        assert false[suffix] / problems >= exact - 3 * math.sqrt(level / problems)


# -- beside a robot -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_monitor_raises_the_alarms_of_the_whole_episode(seed):
    rng = np.random.default_rng(seed)
    scores = rng.normal(1, 2, 200)
    scores[[0, 1, 2, 60]] = np.nan
    rule_ = AlarmRule(Standardization(1.0, 2.0))
    statistic, expected = cusum(rule_.standardization(scores))
    monitor = Monitor(rule_)
    for _ in range(2):  # it begins anew with each episode
        assert monitor.statistic == 0
        found = [(monitor.update(s), monitor.statistic) for s in scores]
        assert [alarm for alarm, _ in found] == expected.tolist()
        assert [s for _, s in found] == statistic.tolist()
        monitor.reset()
    assert expected.any()


@pytest.mark.parametrize("kind", STATISTICS)
def test_a_monitor_gives_the_statistics_and_alarms_of_a_guaranteed_alarm_bit_for_bit(kind):
    rng = np.random.default_rng(8)
    calibration = [np.concatenate([[NAN], row]) for row in rng.normal(size=(19, 50))]
    rule = GuaranteedAlarm.fit(calibration, 0.10, kind)
    scores = np.concatenate([[NAN], rng.normal(size=40), rng.normal(size=40) + 3])
    monitor = Monitor(rule)
    for _ in range(2):
        seen = [(monitor.update(score), monitor.statistic) for score in scores]
        alarms, statistics = zip(*seen, strict=True)
        assert statistics == tuple(rule.statistic(scores).tolist())
        assert alarms.index(True) == rule.first(scores) > 40
        monitor.reset()


def test_the_contract_offers_the_statistics_that_there_are():
    assert get_args(Alarm) == get_args(AlarmKind) == (*STATISTICS, *RECORDED)


def test_show_computes_figures_with_another_statistic_and_stores_none(tmp_path, tiny_split, capsys):
    command = [
        "run", "--detector", "mahalanobis", "--env", "cartpole", "--anomaly", "iid", "-q",
        "--split", str(tiny_split), "--output", str(tmp_path), "--jobs", "1",
    ]  # fmt: skip
    assert main(command) == 0
    stored = (tmp_path / "records.jsonl").read_bytes()
    shown = {}
    for kind in (None, "cusum", "score"):
        capsys.readouterr()
        option = ["--alarm", kind] if kind else []
        assert main(["show", str(tmp_path), "--csv", "--split", str(tiny_split), *option]) == 0
        shown[kind] = capsys.readouterr().out
    assert shown[None] == shown["cusum"] != ""
    assert (tmp_path / "records.jsonl").read_bytes() == stored
    assert [r.alarm for r in ResultsDirectory(tmp_path).records()] == ["cusum"]
    assert main(["show", str(tmp_path), "--stored", "--alarm", "score"]) == 4
    assert "--alarm score computes figures that --stored would not" in capsys.readouterr().err
