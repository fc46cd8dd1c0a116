"""A watchdog's calibration: its statistic, baseline rows, offsets, and episodes that join it."""

import dataclasses
import math
import warnings

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
from oodd_live import Watchdog

from oodd_eval import Trajectory, load_split
from oodd_eval.data.baseline import Baseline
from oodd_eval.errors import PromiseWarning, UsageError
from oodd_eval.metrics.alarms import STATISTICS, Calibration, GuaranteedAlarm, joined
from oodd_eval.metrics.auc import auc
from oodd_eval.metrics.faults import StreamScale
from oodd_eval.plugins.discovery import discover

B = 20
FACTS = dataclasses.replace(UNPAIRED, baseline=B)


def test_a_watchdog_warns_of_drift_and_keeps_the_note():
    drifting = nominal_episodes(range(78), drift=0.02)
    with pytest.warns(PromiseWarning, match="the mean of sensor 1 follows the order"):
        watchdog = Watchdog.fit("mahalanobis", drifting[:40], drifting[40:], 0.10)
    assert any("drift" in note for note in watchdog.notes)


def test_confirmed_episodes_join_the_calibration(tmp_path):
    train, calibration = nominal_episodes(range(40)), nominal_episodes(range(100, 140))
    watchdog = Watchdog.fit("mahalanobis", train, calibration, 0.10)
    first = watchdog.calibration
    for k, x in enumerate(nominal_episodes(range(300, 306))):
        for row in x.observations:
            watchdog.update(row)
        largest = first.unbounded.largest(watchdog._handle.detector.score(x))
        watchdog.confirm()
        assert watchdog.calibration.largest[-1] == pytest.approx(largest)
        assert len(watchdog.calibration.largest) == len(first.largest) + k + 1
        assert watchdog.calibration.standardization == first.standardization
        assert watchdog.rule == watchdog.calibration.rule(0.10)
        assert watchdog.raised is None
    watchdog.save(tmp_path / "kept")
    other = Watchdog.load(tmp_path / "kept")
    assert other.calibration == watchdog.calibration
    for one in (watchdog, other):
        for row in log_episode(7).observations:
            reading = one.update(row)
        one.confirm()
        assert reading.threshold != one.rule.threshold or one.rule == watchdog.rule
    assert other.calibration == watchdog.calibration


def test_windows_of_one_recording_promise_nothing_and_those_of_many_their_share(tmp_path):
    train, calibration = nominal_episodes(range(40)), nominal_episodes(range(100, 140))
    plain = Watchdog.fit("mahalanobis", train, calibration, 0.10)
    words = "40 windows of 1 recording: no promise at 10 %; 18 recordings would"
    with pytest.warns(PromiseWarning, match=words):
        watchdog = Watchdog.fit("mahalanobis", train, calibration, 0.10, recordings=["a"] * 40)
    assert watchdog.rule == plain.rule
    assert (watchdog.promise, watchdog.notes[0]) == (words, words)
    watchdog.save(tmp_path / "kept")
    other = Watchdog.load(tmp_path / "kept")
    assert (other.promise, other.calibration) == (words, watchdog.calibration)
    several = [i // 2 for i in range(40)]
    with warnings.catch_warnings():
        warnings.simplefilter("error", PromiseWarning)
        of_files = Watchdog.fit("mahalanobis", train, calibration, 0.10, recordings=several)
    scores = [of_files._handle.detector.score(x) for x in calibration]
    expected = GuaranteedAlarm.fit(scores, 0.10, "cusum", None, several)
    assert of_files.rule.threshold == pytest.approx(expected.threshold)
    assert of_files.promise.startswith("at most 10 %")
    with pytest.raises(UsageError, match="3 recordings of 40 episodes"):
        Watchdog.fit("mahalanobis", train, calibration, 0.10, recordings=["a", "b", "c"])


def test_an_environment_knows_the_recordings_of_its_windows(tmp_path):
    numbers = {"train": range(40), "calibration": [40] * 40, "test/nominal": range(41, 49)}
    parts = log_parts(train=40, anomalies={})
    split = load_split(write_log_split(tmp_path, parts, recordings=numbers))
    with split.opened() as opened, pytest.warns(PromiseWarning, match="of 1 recording"):
        watchdog = Watchdog.fit("mahalanobis", opened("arm"), alpha=0.10)
    assert watchdog.calibration.recording_count == 1


def test_an_acknowledged_alarm_and_a_fault_count_when_an_episode_is_confirmed():
    train, calibration = nominal_episodes(range(40)), nominal_episodes(range(100, 140))
    watchdog = Watchdog.fit("mahalanobis", train, calibration, 0.20)
    x = Trajectory(log_episode(7, intervals=[(30, 50)], shift=0.7).observations)
    for row in x.observations:
        if watchdog.update(row).alarm:
            watchdog.acknowledge()
    whole = watchdog.calibration.unbounded.largest(watchdog._handle.detector.score(x))
    watchdog.confirm()
    assert watchdog.calibration.largest[-1] == pytest.approx(whole)
    for _ in range(10):
        watchdog.update(None)
    watchdog.confirm()
    assert watchdog.calibration.tail.start < watchdog.calibration.largest[-1] < math.inf


def test_what_cannot_join_is_refused_and_changes_nothing():
    train, calibration = nominal_episodes(range(40)), nominal_episodes(range(100, 140))
    watchdog = Watchdog.fit("mahalanobis", train, calibration, 0.05)
    with pytest.raises(UsageError, match="0 rows since the last reset"):
        watchdog.confirm()
    before = watchdog.calibration, watchdog.rule
    watchdog.update(np.zeros(3))
    with pytest.raises(UsageError, match=r"59 .*got 21"):
        watchdog.confirm()
    assert (watchdog.calibration, watchdog.rule) == before
    for arguments in ({"confidence": 0.5, "alpha": 0.1}, {"hours": 1, "rate": 50}):
        other = Watchdog.fit("mahalanobis", train, calibration, **arguments)
        other.update(np.zeros(3))
        with pytest.raises(UsageError, match="fit it with alpha alone"):
            other.confirm()


NORTHING = np.array([5.4e6, 0.0, 0.0])


def positions(seed, *, far, slip=()):
    """A vehicle near its mark; the slip is a fifth of a metre in the northing."""
    rows = log_episode(seed, 60).observations
    for start, stop in slip:
        rows[start:stop, 0] += 0.5 * np.arange(stop - start)
    return rows + (NORTHING if far else 0.0)


def test_a_watchdog_of_float64_rows_is_as_without_the_offset():
    found, areas = {}, {}
    for far in (False, True):
        train, calibration = (
            [positions(k, far=far) for k in part] for part in (range(40), range(100, 138))
        )
        watchdog = Watchdog.fit("mahalanobis", train, calibration, 0.10)
        assert bool(watchdog._nominal.offsets[0]) == far
        assert not watchdog._nominal.offsets[1:].any()
        found[far], areas[far] = [], []
        for k in range(20):
            watchdog.reset()
            rows = positions(500 + k, far=far, slip=[(30, 50)])
            readings = [watchdog.update(row) for row in rows]
            found[far].append(next((r.t for r in readings if r.alarm and r.t >= 30), None))
            scores = np.array([reading.score for reading in readings])
            areas[far].append(auc(scores[30:50], scores[:30]))
    assert found[True] == found[False]
    assert sum(t is not None for t in found[True]) == 20
    assert np.mean(areas[True]) == pytest.approx(np.mean(areas[False]), abs=0.002)
    assert np.mean(areas[True]) > 0.8


def test_a_split_gives_its_offsets_to_the_watchdog(tmp_path):
    facts = dataclasses.replace(UNPAIRED, offsets=(5.4e6, 0.0, 0.0), rate=10.0)
    split = load_split(make_log_split(tmp_path / "arm", facts, train=40, calibration=38))
    with split.opened() as opened:
        data = opened("arm")
        watchdog = Watchdog.fit("mahalanobis", data, alpha=0.10)
        plain = Watchdog.fit("mahalanobis", data.train, data.calibration, 0.10)
        assert watchdog.rule == plain.rule
        assert watchdog.sensors == [quantity.name for quantity in data.sensors]
        assert watchdog.settings.rate == 10.0
        watchdog.save(tmp_path / "kept")
        other = Watchdog.load(tmp_path / "kept")
        for row in data.twins[0].observations:
            near = plain.update(row).score
            raw = row.astype(np.float64) + NORTHING
            far = watchdog.update(raw).score
            assert far == pytest.approx(near, rel=1e-6)
            assert other.update(dict(zip(watchdog.sensors, raw, strict=True))).score == far
        # Of what a split has, the offsets are subtracted already.
        watchdog.acknowledge()
        replayed = [reading.score for reading in watchdog.replay(data.twins[0])]
        scored = plain.replay(data.twins[0])
        np.testing.assert_array_equal(replayed, [reading.score for reading in scored])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"offsets": [1.0]}, "expected 3 numbers"),
        ({"offsets": [1.0, math.nan, 0.0]}, "expected 3 numbers"),
        ({"baseline": -1}, "baseline is -1, expected a whole number of at least 0"),
        ({"baseline": 2.5}, "baseline is 2.5, expected a whole number"),
        ({"calibration": None}, "no calibration episodes"),
    ],
)
def test_wrong_arguments_of_a_watchdog_are_told(arguments, message):
    calibration = arguments.pop("calibration", nominal_episodes(range(100, 138)))
    with pytest.raises(UsageError, match=message):
        Watchdog.fit("mahalanobis", nominal_episodes(range(12)), calibration, **arguments)


@pytest.mark.parametrize("kind", STATISTICS)
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
    scale = StreamScale.of_episodes(train, calibration)
    largest = [scale.without(i).surprise(t.observations).max() for i, t in enumerate(calibration)]
    fitted = Calibration.fit(scores, kind, stream=largest)
    rule, tail = fitted.rule(0.10), fitted.tail
    faults = scale.surprise(np.asarray(x, np.float32))
    assert faults.any()
    expected = joined(rule.statistic(dog_scores(watchdog, x)), tail.value(faults))
    assert [s for s, _ in values[0]] == pytest.approx(expected.tolist())
    assert [a for _, a in values[0]].index(True) == np.argmax(expected > rule.threshold) >= 40


def dog_scores(watchdog, rows):
    rows = np.asarray(rows, np.float32)
    return np.asarray(watchdog._handle.detector.score(Trajectory(rows)), np.float64)


def test_a_watchdog_refuses_a_statistic_that_there_is_not():
    train = [Trajectory(np.random.default_rng(i).normal(size=(20, 2))) for i in range(9)]
    with pytest.raises(UsageError, match="statistic='max', expected one of 'cusum', 'score'"):
        Watchdog.fit("mahalanobis", train, train, alpha=0.5, statistic="max")


@pytest.mark.parametrize("name", ["mewma", "mahalanobis", "persistence"])
def test_a_watchdog_streams_what_a_run_scores_bit_for_bit(tmp_path, name):
    split = load_split(make_log_split(tmp_path / "arm", FACTS, calibration=38, train=12))
    with split.opened() as opened:
        data = opened("arm")
        watchdog = Watchdog.fit(name, data)
        base = Baseline.fit(data.train, B)
        detector = discover().offer(name).spec.factory(seed=0, horizon=1)
        detector.fit([base.judged(x).without_actions() for x in data.train])
        for x in (data.twins[0], data.labelled("slip")[0]):
            batch = detector.score(base.judged(x).without_actions())
            watchdog.reset()
            actions = [None, *x.actions]
            readings = [watchdog.update(o, a) for o, a in zip(x.observations, actions, strict=True)]
            scores = np.array([reading.score for reading in readings])
            assert np.isnan(scores[:B]).all()
            assert not any(reading.alarm for reading in readings[:B])
            np.testing.assert_array_equal(scores[B:], batch)


def test_a_saved_watchdog_keeps_its_baseline(tmp_path):
    train, calibration = (nominal_episodes(range(40)), nominal_episodes(range(100, 138)))
    watchdog = Watchdog.fit("mewma", train, calibration, baseline=B)
    watchdog.save(tmp_path / "kept")
    other = Watchdog.load(tmp_path / "kept")
    for row in log_episode(7, intervals=[(30, 50)]).observations:
        assert watchdog.update(row) == other.update(row)


def test_a_watchdog_learns_the_machine_it_is_beside():
    """A shift of the whole episode is no alarm with baseline rows, and one without."""
    train, calibration = (nominal_episodes(range(40)), nominal_episodes(range(100, 138)))
    alarms = {}
    for rows in (0, B):
        watchdog = Watchdog.fit("mahalanobis", train, calibration, baseline=rows)
        shifted = log_episode(300).observations + 5.0
        alarms[rows] = [watchdog.update(row).alarm for row in shifted]
    assert any(alarms[0])
    assert not any(alarms[B])
    watchdog.reset()
    later = log_episode(300).observations + 5.0
    later[40:] += 5.0
    readings = [watchdog.update(row) for row in later]
    first = next(reading for reading in readings if reading.alarm)
    assert 40 <= first.t <= 50


def test_faults_are_watched_while_baseline_rows_are_gathered():
    train, calibration = (nominal_episodes(range(40)), nominal_episodes(range(100, 138)))
    watchdog = Watchdog.fit("mahalanobis", train, calibration, baseline=B)
    rows = log_episode(300).observations
    rows[5:, 1] = np.nan
    readings = [watchdog.update(row) for row in rows[:B]]
    assert readings[-1].faults == {"sensor 1": "missing"}
    assert readings[-1].alarm
    assert np.isnan(readings[-1].score)
