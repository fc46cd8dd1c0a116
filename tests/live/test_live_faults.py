"""Faults in the stream of a robot's sensors: no exception, an alarm soon, the right name."""

import math

import numpy as np
import pytest
from helpers_live import FAULTS, SENSOR_FAULTS, first_alarm, rows_of, walk, with_fault
from oodd_live import Watchdog
from oodd_live.stream import Stream

from oodd_eval import Trajectory, load_split
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.metrics.faults import ParetoTail, StreamLimits, StreamScale

pytestmark = pytest.mark.slow

TRAIN = [walk(seed, contact=True) for seed in range(20)]


NORTHING = 5_412_345.0
CALIBRATION = [walk(seed, contact=True) for seed in range(50, 80)]
USUAL = ParetoTail(0.0, 1.0, 0.0, 1.0)
"""Of a statistic that is as large as it is surprising."""


def stream_of(train, calibration=None, **facts):
    return Stream(StreamScale.of_episodes(train, calibration or train), [0.0], **facts)


def faults(stream):
    return stream.faults(USUAL, 3.0)


@pytest.fixture
def stream():
    return stream_of(TRAIN, CALIBRATION)


def taken(stream, *observations):
    return [stream.take(o, [0.0])[0] for o in observations]


def row(i, *broken, value=np.nan):
    o = np.array([i, i, 0.0]) * 0.01 + [0.1, 0.2, 0.0]
    o[list(broken)] = value
    return o


def test_scales_are_of_what_sensors_do_in_nominal_episodes(stream):
    scale = stream.scale
    assert scale.limits.moving.tolist() == [1, 1, 0]
    assert scale.per_unit[1].tolist() == [1, 1, 0]
    # Before the first good reading it is the mean.
    np.testing.assert_allclose(taken(stream, None)[0], scale.limits.mean, rtol=1e-6)
    single = stream_of([Trajectory(np.arange(50.0)[:, None])])
    taken(single, [1.0], *[[np.nan]] * 5)
    assert faults(single) == {0: "missing"}


def test_runs_are_counted_as_they_are_long():
    o = np.arange(40.0).reshape(20, 2)
    o[5:9, 0] = 3.0
    limits = StreamLimits.fit([o])
    assert limits.usual.tolist() == [3, 0]
    o[10:13] = o[9]
    assert StreamLimits.fit([o]).repeated == 3.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, 1e300])
def test_what_is_no_measurement_is_the_last_good_one_for_the_detector(stream, value):
    first, *rest = taken(stream, row(0), *[row(i, 1, value=value) for i in range(1, 6)])
    assert all(o[1] == first[1] for o in rest)
    assert rest[-1][0] == np.float32(0.15)
    assert faults(stream) == {1: "missing"}
    assert stream.suspects == [1]
    assert stream.since[1] == 1


def test_a_constant_sensor_may_have_any_reading_that_is_one():
    episodes = [Trajectory(np.pad(x.observations, ((0, 0), (0, 1)))) for x in TRAIN]
    stream = stream_of(episodes)
    for value, expected in ((5.0, {}), (1e30, {3: "missing"})):
        stream.reset()
        taken(stream, *[[*row(i), value] for i in range(6)])
        assert faults(stream) == expected


@pytest.mark.parametrize(
    ("rows", "expected", "suspects"),
    [
        ([row(i, 0, value=0.5) for i in range(9)], {0: "frozen"}, None),  # and no contact
        ([row(0), row(1, 0)], {}, [0]),
        ([row(0), row(1, 0), *map(row, range(2, 30))], {}, []),
        ([row(0)] * 6, {"observation": "repeated"}, []),
        ([row(0), *[None] * 6], {"observation": "missing"}, []),
    ],
)
def test_faults_and_suspects_of_rows(stream, rows, expected, suspects):
    taken(stream, *rows)
    assert faults(stream) == expected
    assert suspects is None or stream.suspects == suspects


def test_readings_beyond_those_of_training_are_a_fault_after_a_few(stream):
    far = 2 * stream.scale.limits.high[0] + 0.1
    found = taken(stream, row(0), *[row(i, 0, value=far + 0.01 * i) for i in range(1, 5)])
    assert faults(stream) == {0: "out of range"}
    # They are measurements, though, and the detector sees them.
    assert found[-1][0] == np.float32(far + 0.04)


def test_an_action_that_does_not_come_is_the_last_one_and_a_fault(stream):
    assert stream.take(row(0))[1] is None
    assert stream.take(row(1), [0.7])[1] == np.float32(0.7)
    for i in range(2, 7):
        assert stream.take(row(i), None if i % 2 else [np.nan])[1] == np.float32(0.7)
    assert faults(stream) == {"action": "missing"}


def stamped(*stamps, rate=50.0):
    """The faults after rows with these time stamps, and actions as old as the rows before."""
    stream = stream_of(TRAIN, rate=rate)
    for i, time in enumerate(stamps):
        stream.take(row(i), [0.0], time, time and time - 0.02)
    return faults(stream)


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        (np.arange(20) * 0.02 + 1e9, {}),
        (np.arange(20) * 0.027, {}),
        (np.arange(20) * 0.04, {"observation": "irregular"}),
        (np.arange(20) * 0.008, {"observation": "irregular"}),
        ([0.0, 0.02, *[math.nan] * 6], {"observation": "irregular", "action": "late"}),
        ([0.0, None, None, 0.06, None, 0.1, None, None, None, 0.18], {}),
        ([0.0, 0.02, 5.0, 5.02, 5.04, 5.06, 5.08], {}),
    ],
)
def test_rows_come_one_interval_after_the_other(stamps, expected):
    assert stamped(*stamps) == expected


def test_actions_from_before_the_row_before_are_late():
    watchdog = Watchdog.fit("mewma-a", TRAIN, TRAIN, 0.1, rate=10)
    for i in range(8):
        reading = watchdog.update(row(i), [0.0], 0.1 * i, 0.1 * i - 0.2)
    assert reading.faults == {"action": "late"}
    assert reading.alarm
    for rate, stamps in ((None, {"time": 1.0}), (50, {"acted": 1.0})):
        watchdog = Watchdog.fit("persistence", TRAIN, TRAIN, 0.1, rate=rate)
        with pytest.raises(UsageError, match="time stamps need a watchdog fitted with rate="):
            watchdog.update(row(0), **stamps)


def test_readings_come_by_name_too():
    watchdog = Watchdog.fit("persistence", TRAIN, TRAIN, 0.1, sensors=["x", "y", "contact"])
    for i in range(6):
        reading = watchdog.update({"x": 0.01 * i, "contact": 0.0}, [0.0])
    assert reading.faults == {"y": "missing"}
    assert reading.sensors == {"y": 1.0}
    assert str(reading) == "row 5: alarm, y missing, since row 0"
    # An acknowledged fault stays silent while it lasts; another one does not.
    watchdog.acknowledge()
    assert not watchdog.update({"x": 0.07, "contact": 0.0}, [0.0]).alarm
    readings = [watchdog.update({"contact": 0.0, "x": np.nan}, [0.0]) for _ in range(4)]
    assert readings[-1].alarm


MISSING = {
    "masked": np.ma.masked_array([0.0, 9999.0, 1.0], [0, 1, 0]),
    "masked whole numbers": np.ma.masked_array([0, 9999, 1], [0, 1, 0]),
    "masked in a list": [0.0, np.ma.masked, 1.0],
    "None": [0.0, None, 1.0],
    "None by name": {"x": 0.0, "y": None, "contact": 1.0},
    "masked by name": {"x": 0.0, "y": np.ma.masked, "contact": 1.0},
}


@pytest.mark.parametrize("offset", [0.0, NORTHING])
@pytest.mark.parametrize("form", MISSING)
def test_what_is_missing_in_any_form_is_no_reading(offset, form):
    episodes = [x.observations + np.array([0.0, offset, 0.0]) for x in TRAIN]
    names = ["x", "y", "contact"]
    watchdog = Watchdog.fit("mahalanobis", episodes, episodes, 0.1, sensors=names)
    assert bool(watchdog._nominal.offsets.any()) == bool(offset)
    expected = watchdog.update([0.0, np.nan, 1.0])
    watchdog.reset()
    assert watchdog.update(MISSING[form]) == expected
    for _ in range(6):
        faulty = watchdog.update(MISSING[form])
    assert faulty.faults["y"] == "missing"


@pytest.mark.parametrize(
    ("episode", "word"),
    [
        (np.ma.masked_equal([[0.0, 9.0]] * 9, 9), "masked"),
        ([*np.ma.masked_equal([[0.0, 9.0]] * 9, 9)], "masked"),
        ((np.ma.masked_equal([[0.0, 9.0]] * 9, 9), np.zeros((8, 1))), "masked"),
        ((np.zeros((9, 2)), np.ma.masked_equal([[0.0, 9.0]] * 8, 9)), "actions.*masked"),
        (np.zeros((9, 2), complex), "complex"),
        (np.array([["x"]]), "no real numbers"),
    ],
)
def test_a_watchdog_is_fitted_on_what_was_read(episode, word):
    with pytest.raises(TrajectoryError, match=word):
        Watchdog.fit("mahalanobis", [episode] * 20, [episode] * 20)


def test_a_reading_that_is_no_number_is_a_mistake_of_the_caller():
    watchdog = Watchdog.fit("persistence", TRAIN, TRAIN, 0.1)
    for row in (["a", "b", "c"], [0.0, 1j, 0.0], np.zeros(3, "M8[s]")):
        with pytest.raises(TrajectoryError, match="real numbers"):
            watchdog.update(row)


@pytest.mark.parametrize(
    ("sensors", "name", "message"),
    [
        (["pole angle", "y", "z"], "pole angel", "'pole angel': did you mean 'pole angle'"),
        (None, "x", "unknown sensor 'x': Known: sensor 0, sensor 1, sensor 2"),
        (None, 0, "unknown sensor 0: Known: sensor 0"),
    ],
)
def test_a_reading_of_an_unknown_sensor_is_a_mistake_of_the_caller(sensors, name, message):
    watchdog = Watchdog.fit("persistence", TRAIN, TRAIN, 0.1, sensors=sensors)
    with pytest.raises(UsageError, match=message):
        watchdog.update({name: 1.0})
    assert watchdog.update(dict.fromkeys(watchdog.sensors, 0.0)).t == 0


@pytest.fixture(scope="module")
def cartpole():
    data = load_split("mini").environment("cartpole")
    watchdog = Watchdog.fit(
        "pe-a", data.train, data.calibration, sensors=data.sensors,
        parameters={"updates": 300, "width": 32},
    )  # fmt: skip
    return watchdog, list(data.twins)


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_raises_an_alarm_within_20_rows_with_its_sensor_first(cartpole, kind):
    watchdog, episodes = cartpole
    rng, found, named = np.random.default_rng(1), [], []
    for x in episodes:
        at = int(rng.integers(30, len(x) - 25))
        rows, sensors = with_fault(kind, x, at, range(4), rng)
        reading = first_alarm(watchdog, rows[: at + 20])
        found.append(reading is not None and reading.t >= at)
        if reading and kind in SENSOR_FAULTS:
            named.append(reading.sensor in {watchdog.sensors[d] for d in sensors})
    assert np.mean(found) >= 0.9
    assert np.mean(named or [1]) >= 0.9


def test_the_same_episodes_without_a_fault_are_quiet(cartpole):
    watchdog, episodes = cartpole
    assert sum(first_alarm(watchdog, rows_of(x)) is not None for x in episodes) <= 1
