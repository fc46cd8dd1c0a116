"""A watchdog beside a robot: its promise, its alarm, its memory, and what it keeps on disk."""

import io
import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from helpers_live import first_alarm, rows_of, walk
from oodd_live import Reading, TerminalMonitor, Watchdog
from rich.console import Console

from oodd_eval import Naming, Trajectory, load_split
from oodd_eval.errors import (
    ContractError,
    FittedStateError,
    OutputError,
    TrajectoryError,
    UsageError,
)
from oodd_eval.metrics.alarms import Calibration
from oodd_eval.metrics.faults import StreamScale
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.state import PackedState, read_state, write_state

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
    """The same row by row, with nothing to hand over."""

    def reset(self): ...

    def update(self, observation, action=None):
        self.action = action
        return float(np.abs(observation).astype(np.float64).sum())

    def state(self):
        return {}

    def restore(self, state): ...


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
    scale = StreamScale.of_episodes(TRAIN, CALIBRATION)
    faults = [scale.without(i).surprise(x.observations) for i, x in enumerate(CALIBRATION)]
    scores = [detector.score(shown(x)) for x in CALIBRATION]
    rule = Calibration.fit(scores, spec.alarm, stream=[rows.max() for rows in faults]).rule(0.1)
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
        alarms += [first_alarm(watchdog, rows_of(x)) is not None for x in fresh]
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


@pytest.mark.parametrize("episode", [out_of_range(5), stuck(5)])
def test_one_calibration_episode_with_a_fault_is_no_threshold_without_end(episode):
    twenty = [*CALIBRATION[1:19], episode]
    watchdog = Watchdog.fit("mewma", TRAIN, twenty, 0.05, sensors=NAMES)
    assert np.isfinite(watchdog.calibration.largest).all()
    assert watchdog.calibration.largest[-1] == watchdog.rule.threshold


def test_calibration_episodes_without_a_score_stay_below_every_threshold(tmp_path):
    """JSON has no infinities: minus infinity is written, and read back with its sign."""
    watchdog = Watchdog.fit("mewma", TRAIN, CALIBRATION, 0.05)
    known = watchdog.calibration
    watchdog.calibration = replace(known, largest=(-np.inf, np.inf, *known.largest[2:]))
    watchdog.save(tmp_path / "kept")
    again = Watchdog.load(tmp_path / "kept").calibration
    assert again == watchdog.calibration
    json.loads(read_state(tmp_path / "kept").text, parse_constant=pytest.fail)


def test_a_fault_that_the_promise_can_bear_counts_as_an_alarm():
    calibration = [*CALIBRATION[1:], out_of_range(5)]
    watchdog = Watchdog.fit("mewma", TRAIN, calibration, 0.05, sensors=NAMES)
    # The second largest of 40 is the largest of the others.
    assert watchdog.rule.threshold == max(watchdog.calibration.largest[:-1])
    assert watchdog.calibration.largest[-1] > 2 * watchdog.rule.threshold


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
    # A sum starts again.
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION)
    watchdog.update(np.zeros(3))
    loud = big(30)
    assert watchdog.update(loud[0], [0.0]).alarm
    watchdog.acknowledge()
    assert watchdog.update(np.full(3, 0.01), [0.0]).statistic == 0.0
    assert watchdog.update(loud[1], [0.0]).alarm


def test_without_a_latch_an_alarm_lasts_as_long_as_its_cause_and_is_held_off_then():
    watchdog = Watchdog.fit(
        LiveSize(), WIDE, CALIBRATION, statistic="score", latch=False, hold_off=3
    )
    loud, quiet = big(20), [np.full(3, 0.001 * i) for i in range(20)]
    order = [quiet, loud, loud, quiet, loud, loud, loud, loud]
    alarms = [watchdog.update(o[i], [0.0]).alarm for i, o in enumerate(order)]
    assert alarms == [False, True, True, False, False, False, False, True]


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
        ({"rate": 0}, "rate=0, expected observations in a second"),
        ({"alpha": 0}, "expected shares between 0 and 1"),
        ({"hours": 8}, "needs both"),
        ({"hours": 1e-5, "rate": 50}, "promise more"),
        ({"sensors": ["x"]}, r"1 names of sensors \['x'\], expected 3"),
        ({"sensors": ["x", "x", "y"]}, "all unlike"),
        ({"statistic": "sum"}, "expected one of 'cusum', 'score'"),
        ({"seed": True}, "seed is True, expected a whole number of at least 0"),
        ({"horizon": 0}, "horizon is 0, expected a whole number of at least 1"),
    ],
)
def test_what_cannot_be_promised_is_said_when_fitting(arguments, message):
    with pytest.raises(UsageError, match=message):
        Watchdog.fit("mewma", TRAIN, CALIBRATION, **arguments)
    with pytest.raises(UsageError, match="needs 20 nominal episodes"):
        Watchdog.fit("mewma", TRAIN, CALIBRATION[:9], hours=1, rate=50)


def test_a_detector_of_whole_episodes_works_slowly_and_says_so():
    live = Watchdog.fit(LiveSize(), WIDE, CALIBRATION, statistic="score")
    for kind, name in ((Size(), "Size"), (Bare, "Bare")):
        with pytest.warns(UserWarning, match=f"{name} has no update: at every row it scores"):
            watchdog = Watchdog.fit(kind, WIDE, CALIBRATION, statistic="score")
        assert watchdog.rule.threshold == pytest.approx(live.rule.threshold)
        for row in rows_of(walk(3)):
            assert watchdog.update(*row).score == pytest.approx(live.update(*row).score)
        live.reset()


class Bare:
    """Two methods, and scores in a list of float32."""

    def fit(self, nominal): ...

    def score(self, x):
        return list(np.abs(x.observations).sum(axis=1))


class Scaled(LiveSize):
    def __init__(self, seed, scale=1.0):
        super().__init__()
        self.seed, self.scale = seed, scale

    def score(self, x):
        return self.scale * super().score(x)


def test_a_class_makes_the_detector(tmp_path):
    expected = Watchdog.fit(LiveSize(), WIDE, CALIBRATION, statistic="score").rule
    watchdog = Watchdog.fit(
        Scaled, WIDE, CALIBRATION, statistic="score", seed=np.int8(7), parameters={"scale": 2.0}
    )
    assert watchdog.rule.threshold == 2 * expected.threshold
    watchdog.save(tmp_path / "scaled")
    loaded = Watchdog.load(tmp_path / "scaled", Scaled)
    assert (loaded._handle.detector.seed, loaded._handle.detector.scale) == (7, 2.0)
    assert repr(loaded) == f"Watchdog(Scaled, 3 sensors: {watchdog.promise})"
    with pytest.raises(UsageError, match="5 is no detector: expected a name"):
        Watchdog.fit(5, WIDE, CALIBRATION)


class Short(Bare):
    def score(self, x):
        return super().score(x)[1:]


class Complex(Bare):
    def score(self, x):
        return [score + 1j for score in super().score(x)]


class Locked(LiveSize):
    def fit(self, nominal):
        self.lock = threading.Lock()


class Forgets(LiveSize):
    def restore(self, state):
        raise RuntimeError("forgot how")


def test_what_a_detector_does_wrong_is_said(watchdog, tmp_path):
    for detector, message in (
        (Short, r"shape \(119,\), expected \(120,\)"),
        (Complex, "expected real"),
    ):
        with pytest.raises(ContractError, match=message):
            Watchdog.fit(detector, WIDE, CALIBRATION)
    locked = Watchdog.fit(Locked, WIDE, CALIBRATION)
    with pytest.raises(UsageError, match=r"Locked cannot be copied, .* attribute 'lock' .*__getst"):
        locked.copy()
    Watchdog.fit(LiveSize(), WIDE, CALIBRATION).save(tmp_path / "kept")
    with pytest.raises(FittedStateError, match="forgot how"):
        Watchdog.load(tmp_path / "kept", Forgets())
    with pytest.raises(TrajectoryError, match=r"observation of shape \(2,\), expected \(3,\)"):
        watchdog.update(np.zeros(2))


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
    assert (reading.parts, reading.kind) == ({"y": 1.0}, "")  # it carries half alone
    reading = watchdog.update([48.0, 61.0, 21.0])
    assert reading.parts == {"y": 1.0, "x": 1.0}
    assert str(reading) == "row 1: alarm, y 47%, x 37%, since row 1"
    calm = watchdog.copy().update([0.1, 0.2, 0.3])
    assert (calm.alarm, calm.parts, calm.kind) == (False, {}, "")


class NamesParts(LiveSize):
    """Names a sensor and an actuator in every row."""

    said = Naming(np.array([0.2, 0.9, 0.0]), np.array([0.7, 0.0]), np.ones(3), "actuator")

    def explain_last(self):
        return np.array([0.5, 0.3, 0.2]), self.rows - 1, self.said

    def reset(self):
        self.rows = 0

    def update(self, observation, action=None):
        self.rows += 1
        return super().update(observation, action)


def test_a_reading_names_sensors_and_actuators_and_the_kind():
    rng = np.random.default_rng(0)
    train, calibration = (
        [Trajectory(x.observations, rng.normal(size=(x.transitions, 2))) for x in of]
        for of in (TRAIN, CALIBRATION)
    )
    watchdog = Watchdog.fit(NamesParts(), train, calibration, statistic="score", sensors=NAMES)
    watchdog.update([0.1, 0.2, 0.3])
    reading = watchdog.update([0.0, 60.0, 20.0], [0.1, 0.2])
    assert reading.alarm
    assert list(reading.parts.items()) == [("y", 0.9), ("actuator 0", 0.7), ("x", 0.2)]
    assert list(reading.sensors) == ["x", "y", "z"]
    assert reading.kind == "actuator"
    assert str(reading) == "row 1: alarm, actuator fault, y 30%, actuator 0, since row 1"
    episode = Trajectory([[0.1, 0.2, 0.3], [0.0, 60.0, 20.0]], [[0.1, 0.2]])
    (alarm,) = watchdog.explain(episode)
    assert (alarm.parts, alarm.kind) == (reading.parts, reading.kind)
    assert str(alarm) == str(reading).replace("row 1:", "rows 1 to 1:", 1)
    console = Console(file=io.StringIO(), width=60)
    monitor = TerminalMonitor("cart", console)
    monitor.update(reading)
    console.print(monitor.picture())
    lines = console.file.getvalue().splitlines()
    at_fault = [line.strip("│ ").split("%")[0] for line in lines if "at fault" in line]
    assert [line.split(maxsplit=1)[0] for line in at_fault] == ["y", "actuator"]
    assert [line.rpartition("at fault ")[2][:3] for line in lines if "at fault" in line] == [
        "90%", "70%"
    ]  # fmt: skip


class NamesBarely(NamesParts):
    """Its naming is a tuple."""

    said = tuple(NamesParts.said)


def test_a_naming_may_be_a_tuple_and_is_checked(monkeypatch):
    watchdog = Watchdog.fit(NamesBarely(), TRAIN, CALIBRATION, statistic="score", sensors=NAMES)
    monkeypatch.setattr(NamesBarely, "said", (*NamesBarely.said[:1], np.zeros(0), np.ones(3), ""))
    reading = watchdog.update([0.0, 60.0, 20.0])
    assert reading.parts == {"y": 0.9, "x": 0.2}
    monkeypatch.setattr(NamesBarely, "said", (np.zeros(2), np.zeros(0), np.ones(3), ""))
    with pytest.raises(ContractError, match=r"shape \(2,\), expected float64 of shape \(3,\)"):
        watchdog.update([0.0, 60.0, 20.0])


def test_actuators_have_the_names_of_a_split_also_after_loading(tmp_path):
    with load_split("mini").opened() as opened:
        data = opened("cartpole")
        watchdog = Watchdog.fit("mewma-a", data)
        names = [*watchdog.sensors, *(action.name for action in data.actions)]
        assert watchdog._parts == names
        watchdog.save(tmp_path / "cart.npz")
        assert Watchdog.load(tmp_path / "cart.npz")._parts == names
        assert Watchdog.fit("mahalanobis", data)._parts == watchdog.sensors


class Explaining(LiveSize):
    """Scores are sums of sizes; a sensor's share is its part of the sum, since that row."""

    def explain_last(self):
        return self.row / self.row.sum(), self.rows - 1

    def reset(self):
        self.rows = 0

    def update(self, observation, action=None):
        self.row, self.rows = np.abs(observation).astype(np.float64) + 1e-9, self.rows + 1
        return super().update(observation, action)


@pytest.mark.parametrize("latch", [True, False])
def test_an_episode_is_explained_by_its_alarms(latch):
    watchdog = Watchdog.fit(
        Explaining, WIDE, CALIBRATION, statistic="score", sensors=NAMES, latch=latch
    )
    rows = 0.1 * walk(3).observations
    rows[20:25, 1] = [60, 61, 62, 61, 60]
    rows[24, 0] = 90.0
    rows[60] = [-30.0, 0.0, 90.0]
    episode = Trajectory(rows, np.zeros((119, 1)))
    watchdog.update([0.1, 0.2, 0.3])
    first, second = watchdog.explain(episode)
    assert (first.first, first.last, first.onset, next(iter(first.sensors))) == (20, 24, 20, "y")
    assert first.sensors["y"] > 0.9
    assert (second.first, second.last, second.onset) == (60, 60, 60)
    assert second.sensors == pytest.approx({"z": 0.75, "x": 0.25, "y": 0.0}, abs=1e-6)
    assert str(second) == "rows 60 to 60: alarm, z 75%, since row 60"
    # It stays in the episode that it is in.
    assert watchdog.update([0.2, 0.1, 0.3]).t == 1
    assert watchdog.settings.latch is latch
    assert watchdog.explain(Trajectory(0.1 * walk(4).observations, np.zeros((119, 1)))) == []
    with pytest.raises(TrajectoryError, match="the episode is a ndarray, expected a Trajectory"):
        watchdog.explain(rows)


def test_an_explained_episode_names_faults_of_sensors(watchdog):
    x = walk(3)
    rows = x.observations.copy()
    rows[70:, 2] = rows[69, 2]
    (alarm,) = watchdog.explain(Trajectory(rows, x.actions))
    assert (alarm.faults, alarm.sensors, alarm.onset) == ({"z": "frozen"}, {"z": 1.0}, 70)
    assert (alarm.parts, alarm.kind) == ({"z": 1.0}, "sensor")
    assert 70 < alarm.first < 100
    assert alarm.last == 119
    assert str(alarm) == f"rows {alarm.first} to 119: alarm, z frozen, since row 70"


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
    assert sorted(p.name for p in tmp_path.iterdir()) == ["alpha", "endless"]


def test_an_instance_is_loaded_into_another_and_other_files_are_refused(tmp_path):
    watchdog = Watchdog.fit(LiveSize(), WIDE, CALIBRATION)
    watchdog.save(tmp_path / "kept")
    with pytest.raises(UsageError, match=r"load\(path, detector\) needs the class"):
        Watchdog.load(tmp_path / "kept")
    assert Watchdog.load(tmp_path / "kept", LiveSize()).rule == watchdog.rule
    with pytest.raises(OutputError, match="is a directory, as earlier versions"):
        watchdog.save(tmp_path)
    (tmp_path / "old").mkdir()
    for name, message in (("absent", "there is no saved fit"), ("old", "fit again")):
        with pytest.raises(FittedStateError, match=message):
            Watchdog.load(tmp_path / name)
    content = (tmp_path / "kept").read_bytes()
    for size in (0, 4, len(content) // 2, len(content) - 1):
        (tmp_path / "kept").write_bytes(content[:size])
        with pytest.raises(FittedStateError):
            Watchdog.load(tmp_path / "kept", LiveSize())


def rewritten(watchdog, file, change):
    """Save a watchdog, and change its values or arrays behind its back."""
    watchdog.save(file)
    packed = read_state(file)
    values, arrays = packed.values(), dict(packed.arrays)
    change(values, arrays)
    write_state(file, PackedState(arrays, json.dumps(values)))


def set_value(*path, to):
    def change(values, _):
        for name in path[:-1]:
            values = values[name]
        values[path[-1]] = to

    return change


def drop(*path):
    def change(values, arrays):
        if path[0] in arrays:
            del arrays[path[0]]
            return
        for name in path[:-1]:
            values = values[name]
        del values[path[-1]]

    return change


HARM = {
    "another kind": set_value("kind", to="watchdog/2"),
    "a kind that is a list": set_value("kind", to=[[]]),
    "a kind that is an array": lambda values, arrays: arrays.update(kind=np.zeros(3)),
    "an infinite threshold": set_value("watchdog", "threshold", to=1e999),
    "a threshold of text": set_value("watchdog", "threshold", to="1"),
    "no threshold": drop("watchdog", "threshold"),
    "no sensors": drop("watchdog", "sensors"),
    "a sensor less": set_value("watchdog", "sensors", to=["x", "y"]),
    "a number of sensors": set_value("watchdog", "sensors", to=3),
    "nothing made": set_value("watchdog", "made", to=None),
    "a seed of text": set_value("watchdog", "made", "seed", to="one"),
    "a list of parameters": set_value("watchdog", "made", "parameters", to=[1]),
    "a text of baseline rows": set_value("watchdog", "made", "baseline", to="three"),
    "a text calibration": set_value("watchdog", "calibration", to="x"),
    "no calibration": drop("watchdog", "calibration"),
    "a rate of text": set_value("watchdog", "settings", "rate", to="fast"),
    "unknown settings": set_value("watchdog", "settings", to={}),
    "no notes": drop("watchdog", "notes"),
    "a number of notes": set_value("watchdog", "notes", to=1),
    "values that are a list": set_value("watchdog", to=[]),
    "a detector that is a list": set_value("detector", to=[1]),
    "an empty detector": set_value("detector", to={}),
    "another detector's settings": set_value("detector", "settings", to={}),
    "no array of the detector": drop("detector.coefficients"),
    "no limits": drop("mean"),
    "no offsets": drop("offsets"),
}


@pytest.mark.parametrize("change", HARM.values(), ids=HARM)
def test_a_damaged_watchdog_is_refused(watchdog, tmp_path, change):
    rewritten(watchdog, tmp_path / "kept", change)
    with pytest.raises(FittedStateError):
        Watchdog.load(tmp_path / "kept")


def test_readings_of_equal_rows_are_equal_also_undefined_ones(fitted):
    one, other = fitted.copy(), fitted.copy()
    assert np.isnan(one.update(np.zeros(3)).score)
    first, second = one.update(np.ones(3), [0.0]), other.update(np.zeros(3))
    assert first != second
    assert second == fitted.copy().update(np.zeros(3))
    assert isinstance(second, Reading)
