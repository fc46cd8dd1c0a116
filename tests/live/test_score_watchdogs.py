"""Watchdogs of scores that a monitor computes, of recorded columns, and of supervised detectors."""

import functools
import json

import numpy as np
import pytest
from helpers_columns import Sizes, scored_parts, sensors_alone, write_columns_split
from helpers_live import walk
from helpers_plugins import install
from hypothesis import given, settings
from hypothesis import strategies as st
from oodd_live import TerminalMonitor, Watchdog
from oodd_live.reading import STALE
from oodd_monitors import calibrate
from rich.console import Console

from oodd_eval import Trajectory, load_split
from oodd_eval.errors import (
    FittedStateError,
    PromiseWarning,
    TrajectoryError,
    UnknownNameError,
    UsageError,
)
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.plugins.state import PackedState, read_state, write_state

ROWS = 40


def healthy(seed, *, gaps=0.0, rows=ROWS):
    """Correlated scores with heavy tails, some of them missing."""
    rng = np.random.default_rng([seed, 7])
    noise = rng.gamma(1.5, size=rows + 4)
    scores = np.convolve(noise, np.ones(5) / 5, "valid")
    scores[rng.random(rows) < gaps] = np.nan
    return scores


HEALTHY = [healthy(seed, gaps=0.1) for seed in range(60)]


def fed(watchdog, scores):
    watchdog.reset()
    return [watchdog.update(score) for score in scores]


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("alarm", ["threshold", "cusum", "ewma"])
def test_row_by_row_is_the_calibration_bit_for_bit(alarm, hold, tmp_path):
    calibration = calibrate(HEALTHY, 0.1, alarm=alarm, hold=hold)
    watchdog = Watchdog.of_scores(calibration)
    assert watchdog.rule == calibration.rule
    assert watchdog.settings.alpha == 0.1
    watchdog.save(tmp_path / "kept")
    loaded = Watchdog.load(tmp_path / "kept")
    assert loaded.promise == watchdog.promise
    assert loaded.settings == watchdog.settings
    alarms = set()
    for k in range(20):
        scores = healthy(1000 + k, gaps=0.1)
        scores[20:] += 0.1 * k
        readings = fed(watchdog, scores)
        assert fed(loaded, scores) == readings
        scored = ~np.isnan(scores)
        statistic = np.array([reading.statistic for reading in readings])
        np.testing.assert_array_equal(statistic[scored], calibration.statistic(scores)[scored])
        by_gap = [r.t for r in readings if r.alarm and r.faults]
        first = next((r.t for r in readings if r.alarm), None)
        if not by_gap:
            assert first == calibration.first(scores)
            alarms.add(first is None)
    assert alarms == {True, False}


@functools.cache
def watched(alarm, hold):
    calibration = calibrate(HEALTHY, 0.1, alarm=alarm, hold=hold)
    return calibration, Watchdog.of_scores(calibration)


GAPS = st.lists(st.floats(-3, 9, width=16) | st.just(np.nan), min_size=1, max_size=30)


@settings(max_examples=150)
@given(
    st.sampled_from(["threshold", "cusum", "ewma"]),
    st.integers(1, 4),
    GAPS,
    st.integers(0, 5),
    st.sampled_from([None, np.nan, np.ma.masked]),
)
def test_the_first_alarm_is_that_of_the_whole_episode_or_of_a_gap(alarm, hold, scores, n, nothing):
    calibration, watchdog = watched(alarm, hold)
    scores = np.array([*[np.nan] * n, *scores], np.float64)
    readings = fed(watchdog, [nothing if np.isnan(s) else s for s in scores])
    statistic = calibration.statistic(scores)
    scored = ~np.isnan(scores)
    assert [r.statistic for r, has in zip(readings, scored, strict=True) if has] == [
        *statistic[scored]
    ]
    gap, by_gap = 0, None
    for t, has in enumerate(scored):
        gap = 0 if has else gap + 1
        by_gap = t if by_gap is None and gap > calibration.longest_gap else by_gap
    rows = [t for t in (calibration.first(scores), by_gap) if t is not None]
    expected = min(rows, default=None)
    assert next((r.t for r in readings if r.alarm), None) == expected


def test_arrays_are_calibrated_as_calibrate_does_it():
    watchdog = Watchdog.of_scores(HEALTHY, 0.1)
    assert watchdog.rule == calibrate(HEALTHY, 0.1).rule
    assert Watchdog.of_scores(HEALTHY).rule == calibrate(HEALTHY).rule
    assert Watchdog.of_scores(calibrate(HEALTHY, 0.1), 0.05).rule == calibrate(HEALTHY, 0.05).rule
    sure = Watchdog.of_scores(HEALTHY, 0.1, confidence=0.9)
    assert sure.rule == GuaranteedAlarm.fit(HEALTHY, 0.1, "score", 0.9)
    assert "90 % confidence" in sure.promise
    assert repr(watchdog) == f"Watchdog(column:score, 1 sensor: {watchdog.promise})"


def test_scores_keep_all_their_digits():
    fine = [np.array([0.0, 1.0 + k * 1e-12]) for k in range(19)]
    watchdog = Watchdog.of_scores(fine)
    assert watchdog.rule.threshold == 1.0 + 18e-12
    assert [r.alarm for r in fed(watchdog, [1.0 + 18e-12, 1.0 + 19e-12])] == [False, True]
    assert fed(watchdog, [np.inf])[0].alarm


@pytest.mark.slow
@pytest.mark.parametrize(("alarm", "hold"), [("threshold", 1), ("cusum", 1), ("ewma", 3)])
def test_healthy_streams_alarm_as_seldom_as_promised(alarm, hold):
    # With 39 episodes the share is 5 % on average over calibrations: 2 of 40 ranks.
    scores, gaps = [], []
    for draw in range(80):
        seeds = np.arange(100 * draw, 100 * draw + 49)
        episodes = [healthy(seed, gaps=0.2) for seed in seeds]
        watchdog = Watchdog.of_scores(calibrate(episodes[:39], 0.05, alarm=alarm, hold=hold))
        for episode in episodes[39:]:
            readings = fed(watchdog, episode)
            scores.append(
                max(r.statistic for r in readings if not r.faults) > watchdog.rule.threshold
            )
            gaps.append(any(r.faults for r in readings))
    # The standard error is .009: ten episodes share a calibration.
    assert 0.03 < np.mean(scores) < 0.075
    # Equal gaps are no alarm, so that fewer than 1 in 40 is longer than all.
    assert 0 < np.mean(gaps) < 1 / 40 + 0.01


def test_a_gap_longer_than_any_of_the_calibration_alarms():
    episodes = [np.array([0.0, 1.0 + k, *[np.nan] * (k % 4), 0.0]) for k in range(19)]
    watchdog = Watchdog.of_scores(episodes)
    assert watchdog.promise == (
        "at most 5 % of nominal episodes raise an alarm by their scores, and at most 1 of 20 by a "
        "gap of more than 3 rows without one"
    )
    readings = fed(watchdog, [0.5, np.nan, None, np.ma.masked, [np.nan], 0.5])
    assert [r.alarm for r in readings] == [False] * 4 + [True] * 2
    gone = readings[4]
    assert gone.faults == {"observation": "missing"}
    assert str(gone) == "row 4: alarm, observation missing"
    assert gone.diagnostics()["status"][0]["level"] == STALE
    assert np.isnan(gone.score)
    assert watchdog.raised == gone
    # Scores that come and go are no gap.
    assert not any(r.alarm for r in fed(watchdog, [None, None, None, 0.5] * 20))
    assert fed(watchdog, [None] * 4)[-1].alarm


def test_a_confirmed_gap_is_usual_from_then_on(tmp_path):
    watchdog = Watchdog.of_scores([np.array([0.0, 1.0 + k]) for k in range(40)], 0.1)
    assert fed(watchdog, [0.5, None, None, 60.0])[1].alarm
    watchdog.confirm()
    assert watchdog.calibration.largest[-1] == 60.0
    assert watchdog.rule == watchdog.calibration.rule(0.1)
    assert "at most 1 of 42 by a gap of more than 2 rows" in watchdog.promise
    watchdog.save(tmp_path / "kept")
    for one in (watchdog, Watchdog.load(tmp_path / "kept")):
        # A confirmed episode without a gap takes none of it back.
        assert not any(r.alarm for r in fed(one, [0.5, 0.5]))
        one.confirm()
        assert [r.alarm for r in fed(one, [0.5, None, None, None])] == [False, False, False, True]
        assert one.calibration.largest[-2:] == (60.0, 0.5)


def test_after_an_acknowledged_alarm_a_sum_is_held_as_long_again():
    watchdog = Watchdog.of_scores(calibrate(HEALTHY, 0.1, alarm="cusum", hold=3))
    high = 1e3 * watchdog.rule.threshold * watchdog.rule.standardization.std / 0.01
    assert [watchdog.update(high).alarm for _ in range(3)] == [False, False, True]
    watchdog.acknowledge()
    assert [watchdog.update(high).alarm for _ in range(3)] == [False, False, True]


def test_alarms_latch_are_acknowledged_and_held_off():
    watchdog = Watchdog.of_scores([[0.0, 1.0 + k] for k in range(19)])
    alarms = [watchdog.update(s).alarm for s in (0.0, 50.0, 0.0)]
    assert alarms == [False, True, True]
    watchdog.acknowledge()
    assert [watchdog.update(s).alarm for s in (0.0, 50.0)] == [False, True]
    # A gap that was acknowledged raises none until it has ended, and a high score does.
    watchdog.acknowledge()
    watchdog.update(None)
    watchdog.acknowledge()
    assert [watchdog.update(s).alarm for s in (None, 50.0)] == [False, True]
    loose = Watchdog.of_scores([[0.0, 1.0 + k] for k in range(19)], latch=False, hold_off=2)
    alarms = [loose.update(s).alarm for s in (50.0, 0.0, 50.0, 50.0, 50.0)]
    assert alarms == [True, False, False, False, True]
    summed = Watchdog.of_scores(calibrate(HEALTHY, 0.1, alarm="cusum"))
    while not summed.update(3.0).alarm:
        pass
    summed.acknowledge()
    assert summed.update(0.0).statistic == 0.0
    assert not summed.copy().update(0.1).alarm


def test_what_is_no_score_is_an_error_and_names_are_taken():
    watchdog = Watchdog.of_scores(HEALTHY)
    assert watchdog.sensors == ["score"]
    assert watchdog.update({"score": 0.25}).score == watchdog.update([0.25]).score == 0.25
    assert np.isnan(watchdog.update({}).score)
    with pytest.raises(TrajectoryError, match="2 scores of a row, expected one"):
        watchdog.update([0.1, 0.2])
    with pytest.raises(TrajectoryError, match="real numbers"):
        watchdog.update("high")
    with pytest.raises(UnknownNameError, match="'mse'"):
        watchdog.update({"mse": 0.1})
    with pytest.raises(UsageError, match="time stamps need a watchdog"):
        watchdog.update(0.1, time=1.0)
    for few in ([], HEALTHY[:18]):
        with pytest.raises(UsageError, match=f"takes 19 calibration episodes, got {len(few)}"):
            Watchdog.of_scores(few)
    for wrong in (HEALTHY[0], [np.ones((9, 2))] * 40, [[np.nan] * 9] * 40):
        with pytest.raises(UsageError, match=r"episode 0 has scores of shape .* a number a row"):
            Watchdog.of_scores(wrong)
    for alpha in (0.0, 1.0):
        with pytest.raises(UsageError, match="expected shares between 0 and 1"):
            Watchdog.of_scores(HEALTHY, alpha)


def test_windows_of_few_recordings_promise_nothing():
    calibration = calibrate(HEALTHY, 0.1, recordings=[0] * 60)
    with pytest.warns(PromiseWarning, match="60 windows of 1 recording: no promise at 10 %"):
        watchdog = Watchdog.of_scores(calibration)
    assert watchdog.promise.startswith("60 windows of 1 recording: no promise")


def test_a_damaged_watchdog_of_scores_is_refused(tmp_path):
    Watchdog.of_scores(HEALTHY).save(tmp_path / "kept")
    state = read_state(tmp_path / "kept")
    for name, value in (("hold", "three"), ("longest_gap", "9"), ("smoothing", [1])):
        values = state.values()
        values["watchdog"]["settings"][name] = value
        write_state(tmp_path / "damaged", PackedState(state.arrays, json.dumps(values)))
        with pytest.raises(FittedStateError):
            Watchdog.load(tmp_path / "damaged")


def test_the_terminal_shows_scores_and_gaps():
    console = Console(width=100, record=True, force_terminal=False)
    monitor, watchdog = TerminalMonitor("residual", console), Watchdog.of_scores(HEALTHY)
    for score in (1.0, None, 99.0):
        monitor.update(watchdog.update(score))
    console.print(monitor.picture())
    text = console.export_text()
    assert "row 2: alarm" in text
    assert "statistic 99" in text
    assert "residual" in text


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """An environment with recorded scores, a flag and failures, and it without them."""
    home, parts = tmp_path_factory.mktemp("scored"), scored_parts(Sizes(calibration=40))
    plain = {
        part: episodes for part, episodes in sensors_alone(parts).items() if part != "failures"
    }
    with (
        load_split(write_columns_split(home / "a", parts)).opened() as one,
        load_split(write_columns_split(home / "b", plain)).opened() as other,
    ):
        yield one("arm"), other("arm")


@pytest.mark.parametrize("sign", ["", "-", "abs"])
def test_a_recorded_column_of_a_split_is_judged_as_it_is(scored, sign, tmp_path):
    data, _ = scored
    name = "column:abs(chunk_mse)" if sign == "abs" else f"column:{sign}chunk_mse"
    convert = {"": np.positive, "-": np.negative, "abs": np.abs}[sign]
    watchdog = Watchdog.fit(name, data, alpha=0.1)
    assert watchdog.sensors == ["chunk_mse"]
    shown = data.of_columns(["chunk_mse"])
    calibration = [convert(x.observations[:, 0].astype(float)) for x in shown.calibration]
    rule = GuaranteedAlarm.fit(calibration, 0.1, "column")
    assert watchdog.rule == rule
    watchdog.save(tmp_path / "kept")
    loaded = Watchdog.load(tmp_path / "kept")
    assert loaded.calibration == watchdog.calibration
    alarms = set()
    slips = [*shown.labelled("slip")]
    for x in [*slips, *shown.twins, *(Trajectory(-x.observations) for x in slips)]:
        readings = watchdog.replay(x)
        assert loaded.replay(x) == readings
        first = next((r.t for r in readings if r.alarm), None)
        assert first == rule.first(convert(x.observations[:, 0].astype(float)))
        assert not any(r.faults or r.sensors for r in readings)
        alarms.add(first is None)
    assert alarms == {True, False}
    # A number that stands still is what it says; one that no longer comes is a fault.
    watchdog.reset()
    assert not any(watchdog.update([0.0]).alarm for _ in range(300))
    assert any("chunk_mse" in watchdog.update(None).faults for _ in range(10))


def test_scores_reach_no_other_detector_and_no_fault_of_the_stream(scored):
    data, plain = scored
    watchdog, other = (Watchdog.fit("mahalanobis", one, alpha=0.1) for one in scored)
    assert watchdog.sensors == other.sensors == ["q0", "q1", "q2"]
    assert watchdog.calibration == other.calibration
    for x, y in zip(data.twins, plain.twins, strict=True):
        assert watchdog.replay(x) == other.replay(y)


def test_columns_of_arrays_are_found_by_the_names_of_sensors(scored):
    data, _ = scored
    every = data.of_columns([column.name for column in data.columns])
    names = [column.name for column in data.columns]
    train, calibration = (
        [x.observations for x in part] for part in (every.train, every.calibration)
    )
    large = [x + np.array([0, 0, 0, 0, 0, 0, 0, 1e7]) for x in calibration]
    watchdog = Watchdog.fit("column:chunk_mse", train, calibration, 0.1, sensors=names)
    assert watchdog.rule == Watchdog.fit("column:chunk_mse", data, alpha=0.1).rule
    assert watchdog.update({"chunk_mse": 0.5}).score == 0.5
    with pytest.raises(UnknownNameError, match="column of the episodes 'chunk_ms'"):
        Watchdog.fit("column:chunk_ms", train, calibration, 0.1, sensors=names)
    with pytest.raises(UnknownNameError, match="sensor 0"):
        Watchdog.fit("column:chunk_mse", train, calibration, 0.1)
    # It is not shifted as readings are that float32 cannot tell.
    shifted = Watchdog.fit("column:chunk_mse", large, large, 0.1, sensors=names)
    assert shifted.rule.threshold > 1e7 - 100


def test_a_flag_is_its_own_alarm_and_promises_nothing(scored):
    data, _ = scored
    with pytest.warns(PromiseWarning, match="flag is an alarm already"):
        watchdog = Watchdog.fit("flag:alarm", data)
    assert watchdog.rule.threshold == 0.5
    assert "own operating point" in watchdog.promise
    assert [watchdog.update([v]).alarm for v in (0, 0, 1)] == [False, False, True]
    watchdog.reset()
    alarms = [watchdog.update([v]).alarm for v in (0, *[None] * 6)]
    assert alarms[:2] == [False, False]
    assert alarms[-1]
    with pytest.raises(UsageError, match="hours=1: a flag is an alarm already"):
        Watchdog.fit("flag:alarm", data, hours=1, rate=50)


SUPERVISED = """
class Margin(Good):
    def fit(self, nominal, failures=None):
        self.counts = np.array([len(nominal), len(failures)])
        self.far = np.float64(np.mean([np.abs(x.observations).mean() for x in failures]))
    def score(self, x):
        return np.abs(x.observations).mean(axis=1) / self.far
    def reset(self): ...
    def update(self, observation, action=None):
        return float(np.abs(observation).mean() / self.far)

@hookimpl
def oodd_detectors():
    return [DetectorSpec("margin", Margin, "a test's", alarm="score", training="failures")]
"""


def test_failed_episodes_reach_the_detectors_that_learn_from_them(scored, monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "margins", SUPERVISED)
    data, plain = scored
    watchdog = Watchdog.fit("margin", data, alpha=0.1)
    assert watchdog._handle.detector.counts.tolist() == [6, 3]
    nominal, calibration = [*data.train], [*data.calibration]
    twice = Watchdog.fit("margin", nominal, calibration, 0.1, failures=[*data.failures] * 2)
    assert twice._handle.detector.counts.tolist() == [6, 6]
    assert twice._handle.detector.far == watchdog._handle.detector.far
    for lacking in ((plain,), (nominal, calibration)):
        with pytest.raises(UsageError, match="margin learns from failed episodes, too"):
            Watchdog.fit("margin", *lacking, alpha=0.1)
    with pytest.raises(UsageError, match="mahalanobis learns from nominal episodes alone"):
        Watchdog.fit("mahalanobis", nominal, calibration, 0.1, failures=[*data.failures])


@pytest.mark.parametrize("name", ["logistic", "tdqc"])
def test_a_probability_of_failure_is_that_of_the_row_and_is_kept_in_a_file(scored, name, tmp_path):
    data, _ = scored
    watchdog = Watchdog.fit(name, data, alpha=0.1)
    watchdog.save(tmp_path / "kept")
    loaded = Watchdog.load(tmp_path / "kept")
    slip = data.labelled("slip")[0]
    readings = watchdog.replay(slip)
    assert loaded.replay(slip) == readings
    scores = [reading.score for reading in readings]
    np.testing.assert_allclose(scores, watchdog._handle.detector.score(slip), atol=1e-6)
    assert all(0 <= score <= 1 for score in scores if not np.isnan(score))


class Unnamed:
    """Learns from failures; without a name."""

    def fit(self, nominal, failures=None):
        self.count = None if failures is None else len(failures)

    def score(self, x):
        return np.abs(x.observations).sum(axis=1).astype(float)


@pytest.mark.filterwarnings("ignore:Unnamed has no update")
def test_a_class_is_handed_failures_where_they_are_passed():
    train, calibration = ([walk(s) for s in part] for part in (range(5), range(50, 90)))
    failures = [Trajectory(walk(9).observations * 3)] * 4
    watchdog = Watchdog.fit(Unnamed, train, calibration, statistic="score", failures=failures)
    assert watchdog._handle.detector.count == 4
    watchdog = Watchdog.fit(Unnamed, train, calibration, statistic="score")
    assert watchdog._handle.detector.count is None
