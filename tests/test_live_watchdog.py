"""A watchdog beside a robot: its promise, its alarm, its memory, and what it keeps on disk."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers_live import first_alarm, rows_of, walk

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError, TrajectoryError, UsageError
from oodd_eval.live import Reading, Watchdog
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.plugins.discovery import discover

pytestmark = pytest.mark.slow

TRAIN = [walk(seed) for seed in range(30)]
WIDE = [*TRAIN, Trajectory(np.linspace(-100, 100, 120)[:, None].repeat(3, 1), np.zeros((119, 1)))]
CALIBRATION = [walk(seed) for seed in range(100, 140)]
NAMES = ["x", "y", "z"]


class Size:
    """Scores rows by themselves, whole episodes only."""

    def __init__(self):
        self.fits = 0

    def fit(self, nominal):
        self.fits += 1

    def score(self, x):
        return np.abs(x.observations).sum(axis=1).astype(np.float64)


class LiveSize(Size):
    """The same row by row, and saved as nothing."""

    def reset(self): ...

    def update(self, observation, action=None):
        self.action = action
        return float(np.abs(observation).astype(np.float64).sum())

    def save(self, directory): ...

    def load(self, directory): ...


@pytest.fixture(scope="module")
def fitted():
    return Watchdog.fit("mewma-a", TRAIN, CALIBRATION, sensors=NAMES)


@pytest.fixture
def watchdog(fitted):
    return fitted.copy()


def big(rows=1, size=50.0):
    return [np.full(3, size + i) for i in range(rows)]


@pytest.mark.parametrize("name", ["mewma-a", "persistence", "range"])
def test_scores_and_alarms_are_those_of_the_benchmark(name):
    watchdog = Watchdog.fit(name, TRAIN, CALIBRATION, 0.1)
    spec = discover().offer(name).spec
    detector = spec.factory(seed=0, horizon=1)
    shown = (lambda x: x) if "actions" in spec.inputs else Trajectory.without_actions
    detector.fit([shown(x) for x in TRAIN])
    rule = GuaranteedAlarm.fit([detector.score(shown(x)) for x in CALIBRATION], 0.1, spec.alarm)
    assert watchdog.rule == rule
    x = walk(7, push=0.2)
    watchdog.reset()
    found = np.array([watchdog.update(*row).score for row in rows_of(x)])
    np.testing.assert_allclose(found, detector.score(shown(x)), atol=1e-5)
    reading = first_alarm(watchdog, rows_of(x))
    assert (reading and reading.t) == rule.first(detector.score(shown(x)))


def test_fresh_nominal_episodes_stay_within_alpha():
    # Averaged over calibrations, as the guarantee is.
    alarms = []
    for draw in range(10):
        calibration = [walk(seed) for seed in range(1000 * draw, 1000 * draw + 40)]
        watchdog = Watchdog.fit("mewma-a", TRAIN, calibration, 0.1)
        fresh = [walk(seed) for seed in range(20_000 + 30 * draw, 20_030 + 30 * draw)]
        scores = map(watchdog._handle.detector.score, fresh)
        alarms += [watchdog.rule.first(s) is not None for s in scores]
        assert not any(map(watchdog._limits.faults, fresh))
    assert 0.03 < np.mean(alarms) < 0.15


def out_of_range(seed, rows=10):
    """A nominal episode with some rows that no sensor of the training shows."""
    x = walk(seed)
    observations = x.observations.copy()
    observations[60 : 60 + rows, 1] = 400.0 + np.arange(rows)
    return Trajectory(observations, x.actions)


def stuck(seed):
    x = walk(seed)
    observations = x.observations.copy()
    observations[60:75, 0] = observations[60, 0]
    return Trajectory(observations, x.actions)


@pytest.mark.parametrize(
    ("episode", "fault"),
    [(out_of_range(5), "y out of range in rows 63 to"), (stuck(5), "x frozen in rows")],
)
def test_one_calibration_episode_with_a_fault_is_named_and_not_a_threshold_without_end(
    episode, fault
):
    twenty = CALIBRATION[:19]
    Watchdog.fit("mewma", TRAIN, twenty, 0.05)
    with pytest.raises(UsageError, match=rf"1 of 19 calibration episodes .*episode 18: {fault}"):
        Watchdog.fit("mewma", TRAIN, [*twenty[1:], episode], 0.05, sensors=NAMES)


def test_calibration_episodes_without_a_score_stay_below_every_threshold(tmp_path):
    """JSON has no infinities: minus infinity is written, and read back with its sign."""
    watchdog = Watchdog.fit("mewma", TRAIN, CALIBRATION, 0.05)
    known = watchdog.calibration
    watchdog.calibration = replace(known, largest=(-np.inf, np.inf, *known.largest[2:]))
    watchdog.save(tmp_path / "kept")
    again = Watchdog.load(tmp_path / "kept").calibration
    assert again == watchdog.calibration
    json.loads((tmp_path / "kept" / "watchdog.json").read_text(), parse_constant=pytest.fail)


def test_a_wider_range_leaves_rows_out_of_it_to_the_detector():
    twenty = [*CALIBRATION[:18], out_of_range(5)]
    watchdog = Watchdog.fit("mewma", TRAIN, twenty, 0.05, margin=np.inf)
    assert np.isfinite(watchdog.calibration.largest).all()
    assert watchdog.calibration.largest[-1] == watchdog.rule.threshold


def test_a_fault_that_the_promise_can_bear_counts_as_an_alarm_and_is_said():
    calibration = [*CALIBRATION[1:], out_of_range(5)]
    watchdog = Watchdog.fit("mewma", TRAIN, calibration, 0.05, sensors=NAMES)
    assert np.isinf(watchdog.calibration.largest[-1])
    (note,) = [note for note in watchdog.notes if "faults of their sensors" in note]
    assert "1 of 40" in note
    assert "episode 39: y out of range in rows 63 to" in note
    # The second largest of 40 is the largest of the others.
    assert watchdog.rule.threshold == max(watchdog.calibration.largest[:-1])
    silent = Watchdog.fit("mewma", TRAIN, CALIBRATION, 0.05)
    assert not [note for note in silent.notes if "faults" in note]


def test_a_push_is_an_alarm_from_then_on(watchdog):
    rows = rows_of(walk(3))[:60] + rows_of(walk(3, push=3.0))[60:]
    reading = first_alarm(watchdog, rows)
    assert 60 <= reading.t < 70
    assert watchdog.raised == reading
    assert reading.statistic > reading.threshold == watchdog.rule.threshold


def test_an_alarm_stays_until_it_is_acknowledged_or_the_episode_ends():
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION, statistic="score")
    zero = lambda i: np.full(3, 0.001 * i)  # noqa: E731
    alarms = [watchdog.update(o, [0.0]).alarm for o in (zero(0), *big(2), zero(1), zero(2))]
    assert alarms == [False, True, True, True, True]
    watchdog.acknowledge()
    assert watchdog.raised is None
    assert not watchdog.update(zero(3), [0.0]).alarm
    assert watchdog.update(*big(), [0.0]).alarm
    # Acknowledged while its cause lasts: silent until that was gone.
    watchdog.acknowledge()
    assert not watchdog.update(big(2)[1], [0.0]).alarm
    assert not watchdog.update(zero(4), [0.0]).alarm
    assert watchdog.update(*big(), [0.0]).alarm
    watchdog.reset()
    assert not watchdog.update(zero(0)).alarm


def test_without_a_latch_an_alarm_lasts_as_long_as_its_cause_and_is_held_off_then():
    watchdog = Watchdog.fit(
        LiveSize(), WIDE, CALIBRATION, statistic="score", latch=False, hold_off=3
    )
    loud, quiet = big(20), [np.full(3, 0.001 * i) for i in range(20)]
    order = [quiet, loud, loud, quiet, loud, loud, loud, loud]
    alarms = [watchdog.update(o[i], [0.0]).alarm for i, o in enumerate(order)]
    assert alarms == [False, True, True, False, False, False, False, True]


def test_a_sum_starts_again_when_its_alarm_is_acknowledged():
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION)
    watchdog.update(np.zeros(3))
    loud = big(30)
    assert watchdog.update(loud[0], [0.0]).alarm
    watchdog.acknowledge()
    assert watchdog.update(np.full(3, 0.01), [0.0]).statistic == 0.0
    assert watchdog.update(loud[1], [0.0]).alarm


@pytest.mark.parametrize(
    ("name", "episodes", "length"), [("mewma-a", 200, 120), ("persistence", 1, 60_000)]
)
def test_endless_operation_keeps_its_promise_within_the_interval(name, episodes, length):
    rate, rows = 50.0, 120
    calibration = [walk(seed, rows) for seed in range(200, 300)]
    hours = 3000 / rate / 3600
    watchdog = Watchdog.fit(name, TRAIN, calibration, hours=hours, rate=rate)
    promise = watchdog.run_length
    assert promise.low < hours < promise.high
    assert promise.observed == pytest.approx(100 * rows / rate / 3600)
    assert f"every {hours:g} h" in watchdog.promise
    assert "tail" not in watchdog.promise
    # One stream without end, or episode after episode; each alarm is acknowledged at once.
    alarms = 0
    for seed in range(episodes):
        watchdog.reset()
        for row in rows_of(walk(50_000 + seed, length)):
            if watchdog.update(*row).alarm:
                alarms += 1
                watchdog.acknowledge()
    assert promise.low < episodes * length / rate / 3600 / alarms < promise.high


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"alpha": 0.01}, "alpha=0.01 takes 99 calibration episodes, got 40"),
        ({"alpha": 0.02, "statistic": "cusum"}, "takes 98 calibration episodes"),
        ({"confidence": 0.9}, "alpha=0.05 takes 45 calibration episodes, got 40"),
        ({"confidence": 1.0}, "confidence=1.0: expected shares between 0 and 1"),
        ({"confidence": 0.0}, "confidence=0.0: expected shares between 0 and 1"),
        ({"confidence": 0.9, "hours": 1, "rate": 50}, "a confidence is of a share of episodes"),
        ({"margin": -1.0}, "margin=-1.0, expected a share of a range"),
        ({"rate": 0}, "rate=0, expected observations in a second"),
        ({"alpha": 0}, "expected shares between 0 and 1"),
        ({"hours": 8}, "needs both"),
        ({"hours": 1e-5, "rate": 50}, "promise more"),
        ({"sensors": ["x"]}, r"1 names of sensors \['x'\], expected 3"),
        ({"sensors": ["x", "x", "y"]}, "all unlike"),
        ({"statistic": "sum"}, "expected 'cusum' or 'score'"),
    ],
)
def test_what_cannot_be_promised_is_said_when_fitting(arguments, message):
    with pytest.raises(UsageError, match=message):
        Watchdog.fit("mewma", TRAIN, CALIBRATION, **arguments)
    with pytest.raises(UsageError, match="needs 20 nominal episodes"):
        Watchdog.fit("mewma", TRAIN, CALIBRATION[:9], hours=1, rate=50)


def test_a_detector_of_whole_episodes_works_slowly_and_says_so():
    with pytest.warns(UserWarning, match="Size has no update: at every row it scores the whole"):
        watchdog = Watchdog.fit(Size(), TRAIN, CALIBRATION, statistic="score")
    live = Watchdog.fit(LiveSize(), WIDE, CALIBRATION, statistic="score")
    assert watchdog.rule == live.rule
    for row in rows_of(walk(3)):
        assert watchdog.update(*row).score == pytest.approx(live.update(*row).score)


def test_a_detector_of_whole_episodes_explains_its_alarm():
    class Explains(Size):
        def explain(self, x):
            size = np.abs(x.observations).astype(np.float64) + 1e-9
            return size / size.sum(axis=1, keepdims=True), np.arange(len(x))

    with pytest.warns(UserWarning, match="no update"):
        watchdog = Watchdog.fit(Explains(), TRAIN, CALIBRATION, statistic="score", sensors=NAMES)
    reading = watchdog.update([0.0, 60.0, 20.0])
    assert list(reading.sensors) == ["y", "z", "x"]
    assert reading.sensor == "y"
    assert str(reading) == "row 0: alarm, y 75%, since row 0"


def test_detectors_are_shown_actions_if_they_look_at_them():
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION)
    watchdog.update(np.zeros(3))
    assert watchdog._handle.detector.action is None
    watchdog.update(np.zeros(3), [0.5])
    assert watchdog._handle.detector.action.tolist() == [0.5]
    assert not Watchdog.fit("mewma", TRAIN, CALIBRATION)._handle.actions


def test_what_was_saved_goes_on_as_it_was(fitted, watchdog, tmp_path):
    endless = Watchdog.fit("persistence", TRAIN, CALIBRATION, hours=1, rate=50, latch=False)
    for name, one in (("alpha", watchdog), ("endless", endless)):
        one.save(tmp_path / name)
        other = Watchdog.load(tmp_path / name)
        assert (other.rule, other.run_length, other.promise) == (
            one.rule, one.run_length, one.promise
        )  # fmt: skip
        assert (other.sensors, other.settings) == (one.sensors, one.settings)
        one.reset()
        for row in rows_of(walk(3, push=1.0)):
            assert other.update(*row) == one.update(*row)
    assert not list(tmp_path.rglob("*.pkl"))


def test_an_instance_is_loaded_into_another(tmp_path):
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION)
    watchdog.save(tmp_path / "kept")
    with pytest.raises(UsageError, match=r"load\(directory, detector\) needs one"):
        Watchdog.load(tmp_path / "kept")
    assert Watchdog.load(tmp_path / "kept", LiveSize()).rule == watchdog.rule
    with pytest.raises(UsageError, match="is not empty"):
        watchdog.save(tmp_path)


@pytest.mark.parametrize("threshold", [float("inf"), float("nan")])
def test_a_saved_threshold_that_nothing_exceeds_is_refused(watchdog, tmp_path, threshold):
    watchdog.save(tmp_path / "kept")
    file = tmp_path / "kept" / "watchdog.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"threshold": threshold}))
    with pytest.raises(FittedStateError, match="which nothing exceeds"):
        Watchdog.load(tmp_path / "kept")


@pytest.mark.parametrize("harm", ["threshold", "sensors", "made", "calibration", "notes", "{"])
def test_a_damaged_watchdog_is_refused(watchdog, tmp_path, harm):
    watchdog.save(tmp_path / "kept")
    file = tmp_path / "kept" / "watchdog.json"
    told = json.loads(file.read_text())
    told.pop(harm, None)
    file.write_text(harm if harm == "{" else json.dumps(told))
    with pytest.raises(FittedStateError, match="cannot be read as a saved watchdog"):
        Watchdog.load(tmp_path / "kept")


def test_readings_of_equal_rows_are_equal_also_undefined_ones(fitted):
    one, other = fitted.copy(), fitted.copy()
    assert np.isnan(one.update(np.zeros(3)).score)
    first, second = one.update(np.ones(3), [0.0]), other.update(np.zeros(3))
    assert first != second
    assert second == fitted.copy().update(np.zeros(3))
    assert isinstance(second, Reading)


def test_an_array_of_another_length_is_a_mistake_and_no_fault(watchdog):
    with pytest.raises(TrajectoryError, match=r"observation of shape \(2,\), expected \(3,\)"):
        watchdog.update(np.zeros(2))
