"""What speaks for and against a promise on false alarms, and thresholds that are refused."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from helpers_logs import (
    UNPAIRED,
    log_episode,
    log_parts,
    make_log_split,
    nominal_episodes,
    write_log_split,
)
from scipy.stats import binom, spearmanr

from oodd_eval import Trajectory, evaluate, load_results, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.baseline import Baseline, episode_means
from oodd_eval.data.offsets import fit_offsets
from oodd_eval.data.parts import lengths_of, parts_of
from oodd_eval.errors import PromiseWarning, UsageError
from oodd_eval.metrics import promise
from oodd_eval.metrics.alarms import (
    Calibration,
    GuaranteedAlarm,
    least_rolling,
    quantile_rank,
    rolling_rules,
)
from oodd_eval.metrics.promise import (
    EpisodeMeans,
    achieved_share,
    drift_test,
    enough_episodes,
    permutation_test,
    two_sample_test,
)
from oodd_eval.plugins.contract import make_detector
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.scoring.promises import promises_of

# -- thresholds -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("episodes", "level", "kind", "needed"),
    [(8, 0.10, "score", (18, 9)), (30, 0.05, "cusum", (38, 19)), (98, 0.01, "score", (198, 99))],
)
def test_too_few_episodes_are_an_error_that_counts_them_for_both_statistics(
    episodes, level, kind, needed
):
    scores = list(np.random.default_rng(0).normal(size=(episodes, 9)))
    with pytest.raises(UsageError) as caught:
        GuaranteedAlarm.fit(scores, level, kind)
    message = str(caught.value)
    assert f"got {episodes}" in message
    assert f"{needed[0]} for a CUSUM" in message
    assert f"{needed[1]} for the detector's own score" in message
    enough = list(np.random.default_rng(0).normal(size=(needed[kind == "score"], 9)))
    assert math.isfinite(GuaranteedAlarm.fit(enough, level, kind).threshold)


def test_a_statistic_without_end_is_no_threshold():
    # Scores that are all equal have no spread: any higher one is infinitely far.
    scores = [np.full(5, k % 2, float) for k in range(40)]
    with pytest.raises(UsageError, match=r"20 of the 20 calibration episodes .* infinite"):
        GuaranteedAlarm.fit(scores, 0.05)


def test_a_rolling_threshold_is_a_weighted_quantile():
    known = Calibration.fit([np.array([peak]) for peak in range(20)], "score")
    rolling = known.joined(3.5)
    weights = 0.95 ** np.arange(20, -1, -1)
    values = np.array([*range(20), 3.5])
    share = {v: weights[values <= v].sum() / (weights.sum() + 1) for v in values}
    assert rolling.threshold(0.10) == min(v for v, s in share.items() if s >= 0.90)
    assert math.isinf(rolling.threshold(0.05))


def test_equal_weights_give_the_rank_of_the_guarantee(monkeypatch):
    monkeypatch.setattr("oodd_eval.metrics.alarms.FADING", 1.0)
    rng = np.random.default_rng(0)
    for n, level in itertools.product(range(9, 60), (0.01, 0.05, 0.10, 0.2)):
        largest = tuple(rng.normal(size=n))
        known = Calibration("score", None, largest, n, tuple(range(n)), n, rolling=True)
        rank = quantile_rank(n, level)
        expected = sorted(largest)[rank - 1] if rank <= n else math.inf
        assert known.threshold(level) == expected


def rolling_calibration(n):
    numbers = tuple(range(n))
    return Calibration("score", None, numbers, n, numbers, n, rolling=True)


def test_so_many_episodes_and_no_fewer_allow_a_rolling_threshold():
    for level in (0.2, 0.1, 0.06, 0.05):
        n = least_rolling(level)
        for size in (n - 1, n):
            known = Calibration(
                "score", None, (*range(size),), size, (*range(size),), size, rolling=True
            )
            assert math.isfinite(known.threshold(level)) == (size == n)
    known = rolling_calibration(5000)
    with pytest.raises(UsageError, match="more than any number can promise"):
        known.rule(0.01)


def test_rolling_rules_know_the_episodes_before_alone():
    calibration = Calibration.fit(list(np.random.default_rng(0).normal(size=(30, 5))), "score")
    nominal = list(np.random.default_rng(1).normal(2, 1, size=(12, 5)))
    rules = rolling_rules(calibration, nominal, 0.10)
    assert len(rules) == 13
    assert rules[0] == calibration.rule(0.10)
    changed = [*nominal[:6], *(x + 100 for x in nominal[6:])]
    again = rolling_rules(calibration, changed, 0.10)
    assert again[:7] == rules[:7]
    assert again[-1].threshold > rules[-1].threshold


# -- permutation tests ----------------------------------------------------------------------------


def test_the_statistic_is_spearmans_with_ties():
    rng = np.random.default_rng(0)
    values = np.column_stack([rng.integers(0, 4, 40), rng.normal(size=40)]).astype(float)
    expected = [abs(spearmanr(column, np.arange(40)).statistic) for column in values.T]
    test = drift_test(values)
    assert test.statistic == pytest.approx(max(expected))
    assert test.column == int(np.argmax(expected))


def test_p_values_of_exchangeable_episodes_are_uniform():
    rng = np.random.default_rng(0)
    ps = np.array([drift_test(rng.normal(size=(20, 5))).p for _ in range(300)])
    for level in (0.05, 0.2, 0.5):
        low, high = binom.ppf([0.001, 0.999], 300, level)
        assert low <= (ps <= level).sum() <= high


def test_all_orders_of_a_few_episodes_agree_with_the_drawn_ones():
    values = np.array([[1.0], [2.0], [3.0], [5.0], [4.0], [6.0], [7.0]])
    orders = np.array([*itertools.permutations(range(7))]) - 3
    # Ranks without ties: their variance is 4.
    correlations = np.abs(orders @ (np.argsort(values[:, 0]) - 3)) / (7 * 4)
    test = drift_test(values)
    exact = np.mean(correlations >= test.statistic - 1e-12)
    assert test.p == pytest.approx(exact, abs=0.004)


@pytest.mark.parametrize(
    "values", [np.ones((30, 3)), np.empty((0, 2)), np.empty((8, 0)), np.ones((1, 1))]
)
def test_what_does_not_vary_does_not_drift(values):
    assert drift_test(values) == permutation_test(values, np.arange(len(values), dtype=float))
    assert (drift_test(values).p, drift_test(values).column) == (1.0, -1)
    # Nor are five episodes remarkable in any order.
    assert drift_test(np.arange(5.0)[:, None]).p == 1.0
    assert drift_test(np.arange(9.0)[:, None]).p == 0.001


def test_two_sets_differ_where_one_is_shifted():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(30, 3)), rng.normal(size=(20, 3))
    assert two_sample_test(first, second).p > 0.05
    second[:, 2] += 2
    assert (two_sample_test(first, second).p, two_sample_test(first, second).column) == (0.001, 2)


def test_orders_that_tie_with_the_recorded_one_count():
    first, second = np.arange(3.0)[:, None], np.arange(3.0, 6.0)[:, None]
    # Of 20 ways to choose three of six, two set them apart.
    assert two_sample_test(first, second).p == pytest.approx(0.1, abs=0.03)


# -- findings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "doubt", "parts"),
    [
        (8, True, ["10 %", "18 are needed for a CUSUM", "9 for a detector's own score"]),
        (30, True, ["at 5 %", "38 are needed for a CUSUM", "19 for a detector's own score"]),
        (40, False, ["at 1 %", "198 are needed", "99 for"]),
        (400, False, ["enough for all levels"]),
    ],
)
def test_how_many_episodes_which_level_needs(n, doubt, parts):
    finding = enough_episodes(n)
    assert finding.doubt == doubt
    assert all(part in finding.text for part in [f"{n} calibration episodes", *parts])
    assert not enough_episodes(30, ["score"]).doubt


def promises(train, calibration, nominal=(), *, baseline=0, **facts):
    base = Baseline.fit(train, baseline) if baseline else None
    parts = (EpisodeMeans(*episode_means(part, base)) for part in (train, calibration, nominal))
    return promise.promises(*parts, **facts)


def subjects(findings):
    return {finding.subject: finding for finding in findings}


def test_a_drift_is_named_with_its_sensor():
    train, calibration = nominal_episodes(range(20), drift=0.1), nominal_episodes(range(100, 140))
    calibration = [Trajectory(x.observations + np.float32([0, 2, 0])) for x in calibration]
    found = subjects(promises(train, calibration, sensors=["a", "b", "c"]))
    assert found["drift"].doubt
    assert found["drift"].sensor == "b"
    assert "the mean of b follows the order of all 60" in found["drift"].text
    assert found["drift"].p == 0.001
    quiet = subjects(promises(nominal_episodes(range(20)), nominal_episodes(range(100, 140))))
    assert not quiet["drift"].doubt
    assert "drift" not in subjects(promises(train, calibration, recorded=False))


def test_with_baseline_rows_only_what_is_left_of_a_drift_counts():
    drifting = nominal_episodes(range(60), drift=0.1)
    assert subjects(promises(drifting[:20], drifting[20:]))["drift"].doubt
    assert not subjects(promises(drifting[:20], drifting[20:], baseline=20))["drift"].doubt


def test_calibration_that_is_unlike_or_shorter_is_said():
    train, calibration = nominal_episodes(range(20)), nominal_episodes(range(100, 140))
    alike = subjects(promises(train, calibration, nominal_episodes(range(200, 220))))
    assert not alike["difference"].doubt
    assert not alike["length"].doubt
    assert "no drift seen in 80 nominal episodes" in alike["drift"].text
    moved = [
        Trajectory(x.observations + np.float32([0, 0, 2]))
        for x in nominal_episodes(range(200, 220))
    ]
    other = subjects(promises(train, calibration, moved))
    assert other["difference"].doubt
    assert other["difference"].sensor == "sensor 2"
    longer = subjects(promises(train, calibration, nominal_episodes(range(200, 220), rows=90)))
    assert longer["length"].doubt
    assert "60 rows in the median, nominal test episodes 90" in longer["length"].text
    shorter = subjects(promises(train, calibration, nominal_episodes(range(200, 220), rows=30)))
    assert not shorter["length"].doubt


def test_a_split_is_asked_what_it_knows(tmp_path):
    split = load_split(make_log_split(tmp_path / "arm", UNPAIRED))
    shuffled = dataclasses.replace(UNPAIRED, order="shuffled")
    other = load_split(make_log_split(tmp_path / "shuffled", shuffled))
    with split.opened() as opened, other.opened() as further:
        found = subjects(promises_of(opened("arm")))
        assert [*found] == ["episodes", "drift", "difference", "length"]
        assert "drift" not in subjects(promises_of(further("arm")))
    with load_split("mini").opened() as opened:
        assert [*subjects(promises_of(opened("cartpole")))] == ["episodes"]


def test_the_share_of_later_calibration_episodes_is_set_beside_the_promise():
    rng = np.random.default_rng(0)
    steady = list(rng.normal(size=(40, 20)))
    quiet = achieved_share(steady, "score", "mine")
    assert not quiet.doubt
    assert quiet.text.startswith("mine: ")
    rising = [x + 0.1 * k for k, x in enumerate(steady)]
    loud = achieved_share(rising, "score")
    assert loud.doubt
    assert "of the 20 later calibration episodes alarm" in loud.text
    assert achieved_share(steady[:17], "score") is None
    # The 19th of 20 earlier ones is the threshold of 10 %: what reaches it does not alarm.
    equal = achieved_share([np.array([float(k)]) for k in [*range(1, 21), *[19] * 20]], "score")
    assert equal.text.startswith("0 of the 20 later")


def test_the_chance_of_so_many_later_alarms_is_that_of_random_orders():
    rng = np.random.default_rng(0)
    values = rng.normal(size=40)
    finding = achieved_share([np.array([v]) for v in values], "score")
    alarms = int(finding.text.split(" of the ")[0].split()[-1])
    orders = rng.permuted(np.tile(values, (20_000, 1)), axis=1)
    thresholds = np.sort(orders[:, :20], axis=1)[:, quantile_rank(20, 0.10) - 1]
    share = ((orders[:, 20:] > thresholds[:, None]).sum(axis=1) >= alarms).mean()
    assert finding.p == pytest.approx(share, abs=0.02)


def test_offsets_are_of_what_float32_cannot_tell_and_of_nothing_else():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(50, 4)) * [0.2, 100.0, 1e-3, 0.0] + [5.4e6, 1013.0, 1.0, 7e6]
    offsets = fit_offsets([rows[:20], rows[20:]])
    assert offsets == (pytest.approx(rows[:, 0].mean()), 0.0, pytest.approx(1.0, abs=1e-2), 0.0)
    assert fit_offsets([rows[:, 1:2]]) == ()


# -- machines that differ from episode to episode ------------------------------------------------


def alarm_share(name, parts, *, baseline=0, rolling=False, seed=0):
    """Share of nominal test episodes with an alarm at a promised 10 %."""
    if baseline:
        base = Baseline.fit(parts[0], baseline)
        parts = [[base.judged(x) for x in part] for part in parts]
    spec = discover().offer(name).spec
    if spec.inputs == "observations":
        parts = [[x.without_actions() for x in part] for part in parts]
    detector = make_detector(spec.factory, seed=seed, horizon=1, parameters={})
    detector.fit(parts[0])
    calibration, test = ([detector.score(x) for x in part] for part in parts[1:])
    known = Calibration.fit(calibration, spec.alarm)
    rules = rolling_rules(known, test, 0.10) if rolling else [known.rule(0.10)] * len(test)
    return np.mean([r.first(scores) is not None for r, scores in zip(rules, test, strict=False)])


@pytest.mark.parametrize("name", ["mewma", "mahalanobis", "persistence", "comb"])
@pytest.mark.parametrize("baseline", [0, 15])
def test_shuffled_episodes_keep_the_promise(name, baseline):
    """In random order the mean share is at most the level, whatever the episodes are."""
    rng = np.random.default_rng(1)
    pool = [Trajectory(log_episode(k, 45).observations + rng.normal(size=3)) for k in range(90)]
    shares = []
    for draw in range(12):
        order = np.random.default_rng(draw).permutation(len(pool))
        parts = [[pool[k] for k in part] for part in np.split(order, [20, 60])]
        shares.append(alarm_share(name, parts, baseline=baseline, seed=draw))
    error = np.std(shares, ddof=1) / math.sqrt(len(shares))
    assert np.mean(shares) <= 0.10 + 3 * error


def test_a_machine_that_drifts_breaks_the_promise_and_is_helped():
    """As recorded, most nominal episodes alarm; the test of drift has said so before."""
    rng = np.random.default_rng(2)
    level = np.cumsum(rng.normal(0.08, 0.1, size=(120, 3)), axis=0)
    recorded = [Trajectory(log_episode(k, 60).observations + level[k]) for k in range(120)]
    parts = recorded[:40], recorded[40:80], recorded[80:]
    assert subjects(promises(parts[0], parts[1]))["drift"].p == 0.001
    shares = {
        (rows, rolling): alarm_share("mewma", parts, baseline=rows, rolling=rolling)
        for rows in (0, 20)
        for rolling in (False, True)
    }
    assert shares[0, False] >= 0.5
    assert shares[20, True] <= 0.20
    assert shares[20, True] <= shares[20, False] < shares[0, False]


# -- rolling calibration in runs ------------------------------------------------------------------


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A split whose episodes rise in the order in which they were recorded."""
    parts = log_parts(train=12, calibration=40, nominal=30, anomalies={"slip": [((30, 45),)] * 6})
    nominal = [part for part in parts if part != "test/slip"]
    k = 0
    for part in nominal:
        for i, episode in enumerate(parts[part]):
            rows = episode.observations + np.array([0.0, 0.04 * k, 0.0])
            parts[part][i] = dataclasses.replace(episode, observations=rows)
            k += 1
    return load_split(write_log_split(tmp_path_factory.mktemp("rising") / "arm", parts))


@pytest.mark.filterwarnings("ignore::oodd_eval.errors.PromiseWarning")
def test_a_rolling_run_judges_episodes_with_the_calibration_so_far(drifting, tmp_path):
    fixed, rolling = (
        evaluate("mahalanobis", drifting, output=tmp_path, rolling=flag) for flag in (False, True)
    )
    assert [str(r.setting) for r in (*fixed.records, *rolling.records)] == [
        "mahalanobis", "mahalanobis[rolling=true]"
    ]  # fmt: skip
    plain, record = fixed.records[0], rolling.records[0]
    name = "false_episodes_at_10pct"
    assert plain.value(name) > 0.5 > record.value(name)
    file = rolling._directory.scores(record.scores, stored_lengths(drifting))
    known = Calibration.fit(file.parts["calibration"], record.alarm)
    rules = rolling_rules(known, file.parts["test/nominal"], 0.10)
    alarms = [
        r.first(s) is not None for r, s in zip(rules, file.parts["test/nominal"], strict=False)
    ]
    assert record.value(name) == pytest.approx(np.mean(alarms))
    assert record.metrics["threshold_at_10pct"].value == rules[-1].threshold
    missed = np.mean([rules[-1].first(s) is None for s in file.parts["test/slip"]])
    assert record.value("missed_at_10pct") == pytest.approx(missed)
    # 20 of 40 set a CUSUM's threshold, and 5 % takes 59.
    assert "threshold_at_5pct" in plain.metrics
    assert "threshold_at_5pct" not in record.metrics
    assert "takes 59 episodes" in record.note
    # Same scores, no second fit, two records, and both can be recomputed.
    assert plain.scores == record.scores
    kept = load_results(tmp_path, drifting)
    assert len(kept.records) == 2
    again = rescore(kept.records, kept._directory, drifting)
    assert [r.to_json() for r in again] == [r.to_json() for r in kept.records]


def stored_lengths(split):
    with split.opened() as opened:
        return lengths_of(parts_of(opened("arm"), ["slip"]), None)


def test_a_record_says_whether_its_calibration_rolls(drifting, tmp_path):
    with pytest.warns(PromiseWarning):
        record = evaluate("clock", drifting, rolling=True).records[0]
    assert '"rolling": true' in record.to_json()
    assert Record.from_json(record.to_json()).to_json() == record.to_json()
    plain = dataclasses.replace(record, rolling=False)
    assert '"rolling":' not in plain.to_json()
    assert plain.identity != record.identity
    assert Setting.parse(str(record.setting)) == record.setting
    assert Setting.parse("rf[h=2,rolling=true]") == Setting("rf", 2, rolling=True)


def test_a_rolling_run_needs_an_order_without_twins(tmp_path):
    with pytest.raises(UsageError, match="no nominal test episodes in recorded order"):
        evaluate("clock", "mini", environments="cartpole", rolling=True)
    shuffled = dataclasses.replace(UNPAIRED, order="shuffled")
    split = load_split(make_log_split(tmp_path / "shuffled", shuffled))
    with pytest.raises(UsageError, match="no nominal test episodes in recorded order"):
        evaluate("clock", split, rolling=True)


def test_a_run_warns_of_drift_before_it_and_of_the_share_reached_after_it(drifting):
    with pytest.warns(PromiseWarning) as caught:
        evaluate("mahalanobis", drifting)
    texts = [str(one.message) for one in caught]
    assert "arm: nominal episodes drift: the mean of q1" in texts[0]
    assert "mahalanobis[h=1,seed=0]: " in texts[-1]
    assert "later calibration episodes alarm" in texts[-1]


def test_the_command_prints_doubts_before_the_tables(drifting, tmp_path, capsys):
    arguments = ["run", "--detector", "clock", "--env", "all", "--split", str(drifting.path)]
    assert main([*arguments, "--rolling", "--output", str(tmp_path / "out")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert out.index("arm: nominal episodes drift") < out.index("ok arm/clock")
    assert main(["data", "info", str(drifting.path)]) == 0
    assert "nominal episodes drift: the mean of q1" in " ".join(capsys.readouterr().out.split())
