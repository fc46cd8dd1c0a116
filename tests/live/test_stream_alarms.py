"""Faults of the stream on one scale with scores: row by row, in runs, beside a robot."""

import dataclasses

import numpy as np
import pytest
from helpers_logs import UNPAIRED, log_parts, write_log_split
from helpers_plugins import local_spec
from oodd_live import Watchdog
from oodd_live.stream import Stream

from oodd_eval import Trajectory, evaluate, load_results, load_split
from oodd_eval.data.baseline import Baseline
from oodd_eval.metrics.alarms import Calibration
from oodd_eval.metrics.faults import ParetoTail, StreamLimits, StreamScale


def process(seed, rows=80, sensors=4):
    """Two sensors that never repeat, one of few values that saturates, one that stands still."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(rows, sensors)).cumsum(axis=0) * 0.1
    x[:, 2] = np.clip(np.round(x[:, 2] * 4) / 4, -0.5, 0.5)
    x[:, 3] = rng.integers(2)
    return x.astype(np.float32)


def spoilt(seed):
    """Rows with everything that can be wrong with them."""
    rng = np.random.default_rng(seed)
    x = process(seed, 120)
    x[rng.random(x.shape) < 0.05] = np.nan
    x[30:45, 0] = x[30, 0]
    x[50:56] = x[50]
    x[60:64] = np.nan
    x[70:80, 1] = 40 + rng.random(10)
    x[90:95, 2] = 1e30
    x[100:, 1] = x[100, 1]
    return x


TRAIN = [process(seed) for seed in range(20)]
CALIBRATION = [process(seed) for seed in range(100, 125)]


@pytest.mark.parametrize("rows", [0, 20])
def test_rows_one_by_one_are_as_surprising_as_whole_episodes_to_the_last_bit(rows):
    train, calibration = ([*map(Trajectory, part)] for part in (TRAIN, CALIBRATION))
    base = Baseline.fit(train, rows) if rows else None
    scale = StreamScale.of_episodes(train, calibration, base)
    loud = 0
    for seed in range(200, 215):
        x = spoilt(seed)
        x[:rows] = process(seed, 120)[:rows]
        stream = Stream(scale, baseline=base)
        live = []
        for row in x:
            held, _ = stream.take(row)
            assert np.isfinite(held).all()
            live.append(stream.surprise)
        judged = None
        if base is not None:
            judged = np.full_like(x, np.nan)
            judged[rows:] = base.shift(x[:rows])(x[rows:])
        expected = scale.surprise(x, judged)
        np.testing.assert_array_equal(live, expected)
        loud += (expected > 5).sum()
    assert loud > 200
    again = StreamScale.of(scale.arrays())
    np.testing.assert_array_equal(again.surprise(x, judged), expected)


def test_faults_are_named_with_the_row_in_which_they_began():
    scale = StreamScale.fit(StreamLimits.fit(TRAIN), [(x, None) for x in CALIBRATION])
    x = process(7, 120)
    assert scale.faults(x, None, 5.0) == []
    x[40:50, 0] = np.nan
    x[60:70, 1] = 40 + np.arange(10)
    x[80:90] = np.nan
    found = scale.faults(x, None, 5.0)
    assert set(found) == {(0, "missing", 40), (1, "out of range", 62), (-1, "missing", 80)}
    x = process(8, 120)
    x[50:80, 1] = x[50, 1]
    assert scale.faults(x, None, 5.0)[0] == (1, "frozen", 51)


def test_a_tail_is_that_of_its_distribution():
    rng = np.random.default_rng(0)
    tail = ParetoTail.fit(rng.exponential(size=20_000))
    assert (tail.share, tail.scale) == pytest.approx((0.3, 1.0), abs=0.05)
    assert tail.surprise(5.0) == pytest.approx(5.0, abs=0.5)
    heavy = ParetoTail.fit(rng.pareto(3, size=20_000))
    assert heavy.shape == pytest.approx(1 / 3, abs=0.05)
    for of in (tail, heavy):
        values = np.linspace(of.start + 1e-3, 20, 30)
        np.testing.assert_allclose(of.value(of.surprise(values)), values)
        assert np.isneginf(of.value([0.0, 1.0])).all()
    # Where a fifth are odd, the others still say how far values go.
    values = rng.exponential(size=400)
    values[:60] += 100
    assert ParetoTail.fit(values, odd=0.2).scale < 3
    assert np.isinf(ParetoTail.fit([np.inf, -np.inf]).start)
    assert ParetoTail.fit([1.0]).start == ParetoTail.fit([1.0] * 9).start == 1.0


@pytest.mark.parametrize("n", [19, 40])
def test_the_promise_is_kept_with_faults_of_the_stream(n):
    """Sensors stand still now and then for heavy-tailed times."""
    rng, alarms, alone = np.random.default_rng(n), [], []
    limits = StreamLimits.fit(TRAIN)

    def episode():
        x = process(int(rng.integers(1 << 30)))
        at, d = rng.integers(60), rng.integers(2)
        x[at : at + int(rng.pareto(1.5)), d] = x[at, d]
        return x, rng.exponential(size=80) ** 2

    for _ in range(60):
        calibration, test = ([episode() for _ in range(k)] for k in (n, 20))
        scale = StreamScale.fit(limits, [(x, None) for x, _ in calibration])
        largest = [scale.without(i).surprise(x).max() for i, (x, _) in enumerate(calibration)]
        fitted = Calibration.fit([s for _, s in calibration], "score", stream=largest)
        rule = fitted.of_statistics.unbounded
        threshold = fitted.threshold(0.1)
        alarms += [rule.largest(fitted.joint(s, scale.surprise(x))) > threshold for x, s in test]
        alone += [scale.surprise(x).max() > 0 for x, _ in test]
    assert 0.05 < np.mean(alarms) < 0.13
    assert np.mean(alone) > 0.02


@pytest.fixture(scope="module")
def parts():
    """A split's episodes in which sensors freeze, saturate and leave their range."""
    parts = log_parts(train=10, calibration=40, nominal=8, anomalies={"slip": [((30, 45),)] * 6})
    for part, episodes in parts.items():
        for i, one in enumerate(episodes):
            x = one.observations
            x[:, 1] = np.round(x[:, 1], 1)
            if part == "calibration" and i % 9 == 1:
                x[20:26, 0] = x[20, 0]
            if part.startswith("test") and i % 2:
                x[25:, 0] = x[25, 0]
            if part.startswith("test") and i % 3 == 2:
                x[30:40, 1] = 9.0
    return parts


@pytest.mark.parametrize("name", ["mahalanobis", "mewma"])
@pytest.mark.parametrize("rows", [0, 15])
def test_a_run_and_a_watchdog_raise_the_same_alarms_in_the_same_rows(tmp_path, parts, name, rows):
    facts = dataclasses.replace(UNPAIRED, baseline=rows)
    path = write_log_split(tmp_path / "arm", parts, facts)
    results = evaluate(local_spec(name), path, output=tmp_path / "out")
    (record,) = results.records
    with load_split(path).opened() as opened:
        data = opened("arm")
        watchdog = Watchdog.fit(name, data, alpha=0.05)
        assert watchdog.rule.threshold == pytest.approx(record.value("threshold_at_5pct"))
        (episodes,) = results._episodes([record])
        faults = set()
        for episode, x in zip(episodes, data.labelled("slip"), strict=True):
            seen = watchdog.replay(x)
            statistic = [reading.statistic for reading in seen]
            expected = np.where(np.isnan(episode.judged), -np.inf, episode.judged)
            bottom = 0.0 if watchdog.rule.standardization else -np.inf
            np.testing.assert_allclose(statistic, np.maximum(expected, bottom), rtol=1e-5)
            assert next((r.t for r in seen if r.alarm), None) == episode.alarm
            faults |= {item for reading in seen for item in reading.faults.items()}
            assert not any(r.faults for r in seen if r.statistic <= r.threshold)
        assert {("q0", "frozen"), ("q1", "out of range")} <= faults
        quiet = [any(reading.alarm for reading in watchdog.replay(x)) for x in data.twins]
    assert np.mean(quiet) == record.value("false_episodes_at_5pct")
    # Tables are made of what was stored.
    again = load_results(tmp_path / "out", split=path)
    assert again.records[0].metrics == record.metrics


def test_one_calibration_episode_with_a_fault_leaves_a_finite_threshold():
    train, calibration = ([*map(Trajectory, part)] for part in (TRAIN, CALIBRATION))
    broken = CALIBRATION[0].copy()
    broken[30:, 0] = broken[30, 0]
    calm = Watchdog.fit("mewma", train, calibration, 0.1)
    watchdog = Watchdog.fit("mewma", train, [Trajectory(broken), *calibration[1:]], 0.1)
    assert np.isfinite(watchdog.calibration.largest).all()
    assert max(watchdog.calibration.largest) > calm.rule.threshold
    assert np.isfinite(watchdog.rule.threshold)
    assert "leaves" not in " ".join(watchdog.notes)
