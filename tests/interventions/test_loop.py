"""Arms of a cell: the same bytes up to the act, and what detectors and acts bring about."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers_simulate import Reflex
from oodd_common.naming import ReadingModel
from oodd_interventions.acts import ACTS
from oodd_interventions.loop import RENAMED, FittedDetector, Loop, LoopPair, run_cell
from oodd_interventions.situation import ActSpec
from oodd_live.handle import DetectorHandle
from oodd_recording.closed_loop import Setup, record_again, record_anomalous, return_of
from oodd_recording.policies import CustomPolicy, load_policy

from oodd_eval import Explanation, Naming
from oodd_eval.errors import ContractError
from oodd_eval.metrics.alarms import GuaranteedAlarm

CAP = 120
SEEDS = 4
GROUPS = {"iid": "sensor", "shutdown": "sensor", "wind-l2r": "dynamics"}
MASK = next(act for act in ACTS if act.name == "mask")


@pytest.fixture(scope="module")
def loop():
    setup = Setup("cartpole", load_policy("cartpole"), CAP)
    return Loop(setup, ReadingModel.fit([setup.record(seed).trajectory for seed in range(10)]))


@pytest.fixture(scope="module")
def pairs(loop):
    return {kind: [pair_of(loop.setup, kind, 100 + s) for s in range(SEEDS)] for kind in GROUPS}


def pair_of(setup, kind, seed):
    twin = setup.record(seed)
    return LoopPair(kind, None, GROUPS[kind], twin, record_anomalous(setup, kind, None, twin))


class Judge:
    """A detector whose scores and naming are functions of an episode."""

    def __init__(self, scores, naming=None):
        self._scores, self._naming = scores, naming
        if naming is not None:
            self.explain = self._explain

    def fit(self, nominal):
        """Learn nothing."""

    def score(self, x):
        return np.asarray(self._scores(x), float)

    def _explain(self, x):
        shares = np.full(x.observations.shape, 1 / x.observation_dim)
        return Explanation(shares, np.arange(len(x)), self._naming)


def detector_of(scores, naming=None):
    handle = DetectorHandle(Judge(scores, naming), "score", True, False, {})
    return FittedDetector(handle, GuaranteedAlarm(None, 0.5))


def naming_of_sensor(d, size=math.inf):
    sensors = np.zeros(4)
    sensors[d] = 1.0
    return Naming(sensors, np.zeros(2), np.full(4, size), "sensor")


def zeros(x):
    return np.zeros(len(x))


def from_row(t):
    return lambda x: np.arange(len(x)) >= t


def cell_of(loop, pairs, act, detector):
    return run_cell(loop, pairs, [loop.oracle(pair, act) for pair in pairs], act, detector)


@pytest.mark.parametrize("kind", GROUPS)
def test_a_recorded_fault_can_be_run_again_bit_for_bit(loop, pairs, kind):
    for pair in pairs[kind]:
        again = record_again(
            loop.setup, kind, None, pair.twin, pair.never.attempt, loop.setup.policy
        )
        assert (again.onset, again.effect) == (pair.never.onset, pair.never.effect)
        for name in ("observations", "actions"):
            of = [getattr(e.trajectory, name).tobytes() for e in (again, pair.never)]
            assert of[0] == of[1]
        assert again.rewards.tobytes() == pair.never.rewards.tobytes()


def test_measured_rows_are_those_before_the_fault(pairs):
    for pair in pairs["shutdown"]:
        never, faulty = pair.never, pair.never.parameters["sensors"]
        reported = never.trajectory.observations
        assert (reported[never.onset :, faulty] == 0).all()
        assert (never.measured[never.onset :, faulty] != 0).any()
        sound = np.setdiff1d(range(4), faulty)
        np.testing.assert_array_equal(never.measured[:, sound], reported[:, sound])


def test_the_truth_has_sizes(pairs):
    pair = pairs["iid"][0]
    naming, onset = pair.truth()
    [faulty] = pair.never.parameters["sensors"]
    errors = (pair.never.trajectory.observations - pair.never.measured)[pair.never.effect :, faulty]
    assert naming.sizes[faulty] == pytest.approx(math.sqrt((errors.astype(float) ** 2).mean()))
    assert (onset, naming.kind) == (pair.never.onset, "sensor")
    assert np.flatnonzero(naming.sensors).tolist() == [faulty]
    assert math.isinf(pairs["shutdown"][0].truth().naming.sizes.max())
    wind = pairs["wind-l2r"][0].truth().naming
    assert (wind.sensors.sum(), wind.actuators.sum(), wind.kind) == (0, 0, "body")


@pytest.mark.parametrize("kind", GROUPS)
@pytest.mark.parametrize("memory", [False, True])
def test_arms_share_all_bytes_up_to_the_act(loop, kind, memory):
    if memory:
        setup = Setup("cartpole", CustomPolicy("cartpole", Smoothed()), CAP)
        loop = Loop(setup, loop.model)
    pair = pair_of(loop.setup, kind, 100)
    truth = pair.truth()
    last = pair.never.trajectory.transitions - 1
    for row, nominal in itertools.product((5, pair.never.effect, last), (False, True)):
        arm = loop.arm(pair, constant(1), row, lambda *_: truth, nominal=nominal)
        taken = pair.twin if nominal else pair.never
        assert arm.acted == row
        for name, n in (("observations", row + 1), ("actions", row)):
            rows = [getattr(e.trajectory, name)[:n].tobytes() for e in (arm.episode, taken)]
            assert rows[0] == rows[1]
        assert arm.episode.trajectory.actions[row:, 1].all()
        assert set(arm.namings) <= {0, *RENAMED}


class Smoothed:
    """A controller with memory."""

    def reset(self):
        self.mean = np.zeros(4)

    def act(self, row):
        self.mean = 0.3 * self.mean + 0.7 * row
        return Reflex("cartpole").act(self.mean)


def constant(action):
    class Constant:
        def __init__(self, situation):
            assert len(situation.rows) == len(situation.actions) + 1

        def act(self, row):
            return action

    return ActSpec("constant", Constant, "the same command", ("sensor", "dynamics"))


@pytest.mark.parametrize("action", [2, -1, 0.5, math.nan, None, "left", [0, 1], np.zeros(3)])
def test_an_act_that_returns_no_command_is_told_what_one_is(loop, pairs, action):
    pair = pairs["iid"][0]
    with pytest.raises(ContractError, match=r"'constant' of cartpole returned .* from 0 to 1"):
        loop.arm(pair, constant(action), 5, lambda *_: pair.truth())


def test_a_detector_that_never_alarms_has_exactly_never(loop, pairs):
    for episode in cell_of(loop, pairs["iid"], MASK, detector_of(zeros))["episodes"]:
        returns = episode["returns"]
        assert returns["watchdog"] == returns["placebo"] == returns["never"]
        assert returns["false"] == returns["forced"] == returns["twin"]
        assert (episode["alarm"], episode["false_alarm"], episode["named"]) == (None, None, {})
        assert {a for arm, a in episode["acted"].items() if arm != "oracle"} == {None}


def test_a_detector_that_always_alarms_shows_its_harm(loop, pairs):
    always = detector_of(from_row(0), naming_of_sensor(2))
    episodes = cell_of(loop, pairs["iid"], constant(0), always)["episodes"]
    for episode in episodes:
        returns = episode["returns"]
        assert returns["false"] < returns["twin"]
        assert returns["forced"] == returns["false"]
        assert returns["watchdog"] < returns["never"]
        assert episode["acted"]["watchdog"] == episode["false_alarm"] == 0
        assert episode["failed"]["false"]


def test_the_placebo_has_row_and_names_of_the_next_alarm(loop, pairs):
    chosen = pairs["shutdown"]
    by_first = {p.never.trajectory.observations[0].tobytes(): i for i, p in enumerate(chosen)}
    rows = {0: 10, 2: 20}  # the others never alarm

    def scores(x):
        t = rows.get(by_first[x.observations[0].tobytes()], 10**6)
        return np.arange(len(x)) >= t

    episodes = cell_of(loop, chosen, MASK, detector_of(scores, naming_of_sensor(1)))["episodes"]
    assert [e["alarm"] for e in episodes] == [10, None, 20, None]
    assert [e["acted"]["placebo"] for e in episodes] == [20, 20, 10, 10]
    assert [e["acted"]["forced"] for e in episodes] == [10, None, 20, None]
    rows.pop(2)
    episodes = cell_of(loop, chosen, MASK, detector_of(scores, naming_of_sensor(1)))["episodes"]
    assert [e["acted"]["placebo"] for e in episodes] == [None, 10, 10, 10]


def test_parts_are_named_at_the_alarm_and_later(loop, pairs):
    seen = []

    class Listening(FittedDetector):
        def name(self, episode, since=0):
            seen.append((len(episode) - 1, since))
            return super().name(episode, since)

    judge = detector_of(from_row(40), naming_of_sensor(3, 0.5))
    listening = Listening(judge.handle, judge.rule)
    cell = cell_of(loop, pairs["iid"][:1], MASK, listening)
    assert seen[:7] == [(40 + since, since) for since in (0, *RENAMED)]
    [episode] = cell["episodes"]
    assert list(episode["named"]) == list(episode["largest"]) == ["0", "20"]
    assert episode["named"]["20"]["onset"] == 60
    assert sorted(episode["largest"]["0"]) == [0, 1, 2, 3]


def test_an_alarm_at_the_last_row_is_named_and_nothing_acts(loop, pairs):
    pair = pairs["iid"][0]
    last = len(pair.never.trajectory) - 1
    judge = detector_of(lambda x: np.arange(len(x)) == last, naming_of_sensor(0))
    arm = loop.arm(pair, MASK, judge.alarm(pair.never), judge.name)
    assert arm.episode is pair.never
    assert (arm.acted, list(arm.namings)) == (None, [0])


def test_the_oracle_saves_what_sensor_faults_cost(loop, pairs):
    for kind in ("iid", "shutdown"):
        returns = np.array(
            [
                [return_of(e) for e in (p.twin, p.never, loop.oracle(p, MASK).episode)]
                for p in pairs[kind]
            ]
        ).mean(axis=0)
        assert returns[2] == returns[0] >= returns[1]


def test_curves_begin_before_the_effect_and_sum_up_to_the_returns(loop, pairs):
    chosen = pairs["shutdown"]
    cell = cell_of(loop, chosen, MASK, detector_of(zeros))
    curve = cell["curves"]["arms"]["never"]
    rewards = [p.never.rewards[p.never.effect + cell["curves"]["first"] :] for p in chosen]
    assert len(curve) == max(map(len, rewards))
    assert sum(curve) == pytest.approx(sum(map(np.sum, rewards)) / SEEDS)


def test_each_arm_acts_at_its_row_on_its_own_namings(loop, pairs):
    """The act leaves all to the policy, and writes down what it knows at each row."""
    chosen = pairs["shutdown"][:3]
    at = {0: 40, 2: 50}
    rows = {chosen[i].never.trajectory.observations.tobytes(): t for i, t in at.items()}
    rows[chosen[0].twin.trajectory.observations.tobytes()] = 60
    numbers = {p.twin.trajectory.observations[0].tobytes(): i for i, p in enumerate(chosen)}
    heard = []

    class Judging(Judge):
        def _explain(self, x):
            sensor = (len(x) + numbers[x.observations[0].tobytes()]) % 4
            shares = np.full(x.observations.shape, 0.25)
            onsets = np.maximum(np.arange(len(x)) - 3, 0)
            return Explanation(shares, onsets, naming_of_sensor(sensor))

    class Writing:
        def __init__(self, situation):
            self.situation, self.lines = situation, []
            heard.append(self.lines)

        def act(self, row):
            now = self.situation
            assert np.array_equal(now.rows[-1], row)
            [sensor] = np.flatnonzero(now.naming.sensors)
            self.lines.append((len(now.rows) - 1, int(sensor), now.onset))
            return now.policy.act(row)

    def expected(episode, begin, from_episode, first):
        """Lines of an arm that acts from a row on, with the namings of a watchdog's rows."""
        lines = []
        for t in range(begin, episode.trajectory.transitions):
            since = max(k for k in (0, *RENAMED) if k <= t - begin)
            sensor = (first + since + 1 + from_episode) % 4
            lines.append((t, sensor, first + since - 3))
        return lines

    def scores(x):
        return np.arange(len(x)) >= rows.get(x.observations.tobytes(), 10**6)

    judge = FittedDetector(
        DetectorHandle(Judging(scores, True), "score", True, False, {}), GuaranteedAlarm(None, 0.5)
    )
    writing = ActSpec("writing", Writing, "the policy goes on", ("sensor",))
    oracles = [loop.oracle(pair, writing) for pair in chosen]
    assert [lines[0][0] for lines in heard] == [pair.never.effect for pair in chosen]
    assert [lines[0][2] for lines in heard] == [pair.never.onset for pair in chosen]
    assert [lines[0][1] for lines in heard] == [p.never.parameters["sensors"][0] for p in chosen]
    heard.clear()
    cell = run_cell(loop, chosen, oracles, writing, judge)
    never, twin = [p.never for p in chosen], [p.twin for p in chosen]
    assert heard == [
        expected(never[0], 40, 0, 40),  # watchdogs
        expected(never[2], 50, 2, 50),
        expected(never[0], 50, 2, 50),  # placebo, false and forced, then of the next episodes
        expected(twin[0], 60, 0, 60),
        expected(twin[0], 40, 0, 40),
        expected(never[1], 50, 2, 50),
        expected(never[2], 40, 0, 40),
        expected(twin[2], 50, 2, 50),
    ]
    acted = [e["acted"] for e in cell["episodes"]]
    assert [a["watchdog"] for a in acted] == [40, None, 50]
    assert [a["placebo"] for a in acted] == [50, 50, 40]
    assert [a["false"] for a in acted] == [60, None, None]
    assert [a["forced"] for a in acted] == [40, None, 50]
    assert [a["oracle"] for a in acted] == [pair.never.effect for pair in chosen]


def test_returns_are_those_of_their_arms(loop, pairs):
    """Of the two commands each arm has one from its row on, so that all returns differ."""
    pair, other = pairs["iid"][:2]
    effect = pair.never.effect
    episodes = (pair.never, other.never, pair.twin)
    first = (effect + 9, effect + 4, effect + 14)
    rows = {e.trajectory.observations.tobytes(): t for e, t in zip(episodes, first, strict=True)}

    def scores(x):
        return np.arange(len(x)) >= rows.get(x.observations.tobytes(), 10**6)

    spec, judge = constant(0), detector_of(scores, naming_of_sensor(1))
    episode, _ = cell_of(loop, [pair, other], spec, judge)["episodes"]
    arms = {
        "twin": (None, True), "never": (None, False), "watchdog": (effect + 9, False),
        "oracle": (effect, False), "placebo": (effect + 4, False), "false": (effect + 14, True),
        "forced": (effect + 9, True),
    }  # fmt: skip
    for arm, (row, nominal) in arms.items():
        alone = loop.arm(pair, spec, row, judge.name, nominal=nominal).episode
        assert episode["returns"][arm] == return_of(alone), arm
        assert episode["rows"][arm] == len(alone.rewards)
        assert episode["failed"][arm] == loop.failed(alone)
    assert len({episode["returns"][arm] for arm in ("watchdog", "placebo", "oracle")}) == 3


def test_detectors_judge_and_name_what_they_may_see(pairs):
    widths = []

    class Watching(Judge):
        def score(self, x):
            widths.append(x.action_dim)
            return super().score(x)

        def _explain(self, x):
            widths.append(x.action_dim)
            return super()._explain(x)

    for actions, width in ((True, 2), (False, 0)):
        naming = naming_of_sensor(1)._replace(actuators=np.zeros(width))
        handle = DetectorHandle(Watching(zeros, naming), "score", actions, False, {})
        fitted = FittedDetector(handle, GuaranteedAlarm(None, 0.5))
        fitted.alarm(pairs["iid"][0].never)
        fitted.name(pairs["iid"][0].never.trajectory)
        assert widths == [width] * 2
        widths.clear()


def test_an_actuator_at_fault_is_true(pairs):
    pair = pairs["wind-l2r"][0]
    parameters = {"actuator": 1, "share": 0.5}
    naming, _ = replace(pair, never=replace(pair.never, parameters=parameters)).truth()
    assert (naming.sensors.sum(), naming.actuators.tolist(), naming.kind) == (0, [0, 1], "actuator")


def test_the_largest_readings_are_in_standard_deviations(loop, pairs):
    pair, scale = pairs["iid"][0], loop.model.sensors
    rows = pair.never.trajectory.observations.astype(float)
    orders, raw = (
        np.argsort(-np.abs(x), axis=1, kind="stable")
        for x in ((rows - scale.mean) / scale.std, rows)
    )
    t = int((orders != raw).any(axis=1)[30:-1].argmax()) + 30
    judge = detector_of(from_row(t), naming_of_sensor(3))
    [episode] = cell_of(loop, [pair], MASK, judge)["episodes"]
    assert episode["largest"]["0"] == orders[t].tolist() != raw[t].tolist()
