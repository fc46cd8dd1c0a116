"""Anomalies with a scalar strength: in force as stated, nothing at zero, more with more."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_simulate import Reflex
from hypothesis import given, settings
from hypothesis import strategies as st
from oodd_recording.closed_loop import Setup, record_anomalous, record_seed
from oodd_recording.environments import make
from oodd_recording.faults import make_fault
from oodd_recording.policies import load_policy
from oodd_recording.values import VALUES, bound_of, spread_of

from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.split import load_split

pytestmark = pytest.mark.slow

CHEAP = ("cartpole", "hopper")
PLAIN = [kind for kind in ANOMALIES if not kind.endswith("-intermittent")]
SENSOR = [kind for kind in PLAIN if ANOMALIES[kind].group == "sensor"]


def drawn(environment, kind, strength, seed=0):
    simulator = make(environment)
    simulator.reset(3)
    rng = np.random.default_rng(seed)
    return make_fault(kind, strength, simulator, rng), simulator


def observed(environment, kind, strength, rows, seed=0):
    """Rows as a sensor fault reports them; the first 40 are before its onset."""
    simulator = SimpleNamespace(environment=environment)
    fault = make_fault(kind, strength, simulator, np.random.default_rng(seed))
    fault.begin(None, list(rows[:40]))
    return fault, np.array([fault.observe(row, 40 + t) for t, row in enumerate(rows[40:])])


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(1)
    return (rng.normal(size=(4040, 28)) + 3).astype(np.float32)


def test_spreads_are_those_of_minis_training_rows():
    split = load_split("mini")
    for name in ENVIRONMENTS:
        episodes = [t.observations for t in split.environment(name).train]
        rows = np.concatenate(episodes).astype(np.float64)
        np.testing.assert_allclose(spread_of(name), rows.std(axis=0), rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_at_strength_zero_every_kind_equals_the_twin(environment):
    setup = Setup(environment, load_policy(environment), 90)
    twin = setup.record(950_000_001)
    for kind in ANOMALIES:
        episode = record_anomalous(setup, kind, 0.0, twin, redraws=0)
        assert episode.onset == episode.effect, kind
        assert (episode.trajectory.observations == twin.trajectory.observations).all(), kind
        assert (episode.rewards == twin.rewards).all(), kind


@pytest.mark.parametrize("environment", CHEAP)
def test_every_kind_acts_from_the_onset_on_and_never_before(environment):
    policy = load_policy(environment)
    strengths = {Condition(kind, "x"): bound_of(environment, kind) / 4 for kind in ANOMALIES}
    found = record_seed(environment, 950_000_002, strengths, policy=policy, episode_cap=90)
    twin = found.pop(None).trajectory.observations
    for condition, episode in found.items():
        before = episode.trajectory.observations[: episode.effect]
        assert (before == twin[: episode.effect]).all(), condition
        late = 0 if ANOMALIES[condition.anomaly].group == "sensor" else 20
        assert episode.effect - episode.onset <= late, condition
        assert episode.parameters["strength"] == strengths[condition]


def test_an_anomaly_too_weak_to_be_felt_keeps_its_episode_and_counts_from_its_onset():
    setup = Setup("cartpole", Reflex("cartpole"), 60)
    twin = setup.record(5)
    episode = record_anomalous(setup, "wind-l2r", 1e-12, twin, redraws=3)
    assert (episode.effect, episode.redraws) == (episode.onset, 3)
    assert episode.trajectory is twin.trajectory


def test_two_strengths_of_a_kind_share_onset_sensors_and_noise(rows):
    (weak, a), (strong, b) = (observed("ant", "iid", s, rows[:60]) for s in (0.5, 1.0))
    assert weak.sensors.tolist() == strong.sensors.tolist()
    clean = rows[40:60]
    np.testing.assert_allclose(b - clean, 2 * (a - clean), atol=1e-5)


@pytest.mark.parametrize("kind", ["iid", "ar1", "varma"])
def test_noise_has_the_stated_deviation_in_each_sensor_from_the_first_row_on(rows, kind):
    fault, found = observed("ant", kind, 2.0, rows)
    noise = (found - rows[40:])[:, fault.sensors] / spread_of("ant")[fault.sensors]
    np.testing.assert_allclose(noise.std(axis=0), 2.0, rtol=0.25)
    first = []
    for seed in range(300):
        one, changed = observed("ant", kind, 2.0, rows[:41], seed)
        first.append(((changed[0] - rows[40]) / spread_of("ant"))[one.sensors])
    assert np.std(first) == pytest.approx(2.0, rel=0.1)


def correlation(noise, lag):
    return np.mean([np.corrcoef(c[lag:], c[: len(c) - lag])[0, 1] for c in noise.T])


def test_noise_is_correlated_as_stated(rows):
    long = np.concatenate([rows] * 5)

    def noise(kind):
        fault, found = observed("ant", kind, 1.0, long)
        return (found - long[40:])[:, fault.sensors]

    ar1, varma, iid = map(noise, ("ar1", "varma", "iid"))
    assert correlation(ar1, 1) == pytest.approx(0.9, abs=0.02)
    assert correlation(ar1, 5) == pytest.approx(0.9**5, abs=0.06)
    assert abs(correlation(iid, 1)) < 0.02
    assert 0.6 < correlation(varma, 1) < 0.95
    between = [np.corrcoef(x.T) - np.eye(x.shape[1]) for x in (varma, ar1)]
    assert between[0].max() > 0.4
    assert np.abs(between[1]).max() < 0.12


DIGESTS_OF_NOISE = """
import hashlib
import numpy as np
from types import SimpleNamespace
from oodd_recording.faults import make_fault

for environment in ("ant", "halfcheetah", "hopper", "acrobot"):
    simulator = SimpleNamespace(environment=environment)
    for seed in range(4):
        fault = make_fault("varma", 1.0, simulator, np.random.default_rng(seed))
        none = np.zeros(len(fault.sensors))
        noise = np.array([fault._change(none, t) for t in range(300)])  # before float32 hides bits
        print(environment, seed, hashlib.sha256(noise.tobytes()).hexdigest())
"""


def test_correlated_noise_is_the_same_on_every_processor():
    """OpenBLAS adds in another order on each kind; without rounding the last bits differ."""

    def digests(kind):
        environment = os.environ | {"OPENBLAS_CORETYPE": kind}
        command = [sys.executable, "-c", DIGESTS_OF_NOISE]
        return subprocess.run(
            command, env=environment, capture_output=True, text=True, check=True
        ).stdout

    found = digests("Haswell")
    assert len(found.splitlines()) == 16
    assert digests("Nehalem") == found


@given(st.floats(0, 19.5), st.integers(0, 30))
@settings(max_examples=40, deadline=None)
def test_a_delay_reports_what_was_measured_so_many_steps_ago(strength, t):
    rows = np.arange(80, dtype=np.float32)[:, None] * np.ones(4, np.float32)
    fault, found = observed("cartpole", "delay", strength, rows)
    sensor = fault.sensors[0]
    assert found[t, sensor] == pytest.approx(40 + t - strength, abs=1e-4)
    assert (np.delete(found[t], sensor) == 40 + t).all()


@given(st.sampled_from(["calibration", "shutdown", "stuck", "drift"]), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_deterministic_sensor_faults_worked_by_hand(kind, strength):
    rows = np.arange(60, dtype=np.float32)[:, None] * np.ones(4, np.float32)
    fault, found = observed("cartpole", kind, strength, rows)
    sensor = fault.sensors[0]
    now, step, last = 50.0, 50, 39.0
    expected = {
        "calibration": now * (1 + strength),
        "shutdown": now * (1 - strength),
        "stuck": (1 - strength) * now + strength * last,
        "drift": now + strength * spread_of("cartpole")[sensor] * step,
    }[kind]
    assert found[10, sensor] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_intermittent_faults_act_on_10_rows_and_rest_for_40(rows):
    fault, found = observed("ant", "shutdown-intermittent", 1.0, rows[:160])
    sensors = fault.parameters["sensors"]
    off = (found[:, sensors] == 0).all(axis=1)
    assert off.tolist() == ([True] * 10 + [False] * 40) * 2 + [True] * 10 + [False] * 10


def test_an_intermittent_gain_gives_the_force_back():
    fault, simulator = drawn("cartpole", "gain-intermittent", 0.6)
    fault.begin(simulator, [])
    forces = []
    for t in range(60):
        simulator.command(fault.command(1, simulator))
        forces.append(simulator.env.force_mag)
        fault.observe(np.zeros(4, np.float32), t)
    assert np.allclose(forces[:10], 4.0)
    assert np.allclose(forces[10:50], 10.0)
    assert np.allclose(forces[50:], 4.0)


READ_BACK = {"gravity": ("gravity", 1.5), "mass": ("body_mass", 1.5), "friction": ("friction", 0.5)}


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("kind", READ_BACK)
def test_what_the_simulator_holds_has_the_stated_strength(environment, kind):
    name, factor = READ_BACK[kind]
    fault, simulator = drawn(environment, kind, 0.5)
    nominal = simulator.get(name)
    fault.begin(simulator, [])
    fault.command(simulator_action(environment), simulator)
    expected = nominal * factor if nominal else 0.5  # there is no friction, then some
    assert simulator.get(name) == pytest.approx(expected, rel=1e-5)
    simulator.step(simulator_action(environment))
    assert simulator.get(name) == pytest.approx(expected, rel=1e-5)
    simulator.close()


def simulator_action(environment):
    info = ENVIRONMENTS[environment]
    return 1 if info.discrete else np.full(info.action_dim, 0.1, np.float32)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_components_scale_the_attributes_that_they_name(environment):
    for seed in range(4):
        fault, simulator = drawn(environment, "components", 0.25, seed)
        names = fault.parameters["attributes"]
        nominal = {name: simulator.get(name) for name in VALUES["components"][environment]}
        fault.command(simulator_action(environment), simulator)
        for name, value in nominal.items():
            factor = (0.75 if "power" in name else 1.25) if name in names else 1.0
            assert simulator.get(name) == pytest.approx(value * factor), name
        simulator.close()


def commands(environment, kind, strength, actions, seed=0):
    simulator = SimpleNamespace(
        environment=environment, wind=0, set=lambda *_: None, scale=lambda *_: None
    )
    fault = make_fault(kind, strength, simulator, np.random.default_rng(seed))
    fault.begin(simulator, [])
    return fault, np.array([fault.command(a, simulator) for a in actions])


@given(st.floats(0, 1), st.integers(0, 20))
@settings(max_examples=40, deadline=None)
def test_faults_of_one_motor_leave_the_others_alone(strength, seed):
    actions = np.random.default_rng(seed).uniform(-1, 1, size=(6, 8)).astype(np.float32)
    for kind in ("gain", "bias", "stuck-joint"):
        fault, found = commands("ant", kind, strength, actions, seed)
        j = fault.parameters["actuator"]
        sign = fault.parameters.get("direction", 0)
        expected = {
            "gain": (1 - strength) * actions[:, j],
            "bias": np.clip(actions[:, j] + sign * strength, -1, 1),
            "stuck-joint": (1 - strength) * actions[:, j] + strength * actions[0, j],
        }[kind]
        np.testing.assert_allclose(found[:, j], expected, atol=1e-6)
        assert (np.delete(found, j, axis=1) == np.delete(actions, j, axis=1)).all()


@given(st.floats(0, 9.5))
@settings(max_examples=30, deadline=None)
def test_commands_act_so_many_steps_late(strength):
    actions = np.arange(30, dtype=np.float32)[:, None] / 100 * np.ones(3, np.float32)
    _, found = commands("hopper", "latency", strength, actions)
    np.testing.assert_allclose(found[20], (20 - strength) / 100, atol=1e-6)
    np.testing.assert_allclose(found[0], actions[0])


@pytest.mark.parametrize("kind", ["action-noise", "stuck-joint"])
def test_discrete_commands_change_with_the_stated_probability(kind):
    actions = [2] * 3000
    _, found = (
        commands("lunarlander", kind, 0.3, actions)
        if kind == "action-noise"
        else commands("lunarlander", kind, 0.3, [0, *actions])
    )
    changed = (found[-3000:] != 2).mean()
    expected = 0.3 * (3 / 4 if kind == "action-noise" else 1)
    assert changed == pytest.approx(expected, abs=5 * (expected / 3000) ** 0.5)


def test_action_noise_has_the_stated_deviation_and_stays_within_the_bounds():
    actions = np.zeros((4000, 3), np.float32)
    _, found = commands("hopper", "action-noise", 0.2, actions)
    assert found.std() == pytest.approx(0.2, rel=0.05)
    _, found = commands("hopper", "action-noise", 2.0, actions)
    assert np.abs(found).max() == 1.0


@pytest.mark.parametrize("environment", ["acrobot", "cartpole", "lunarlander"])
def test_a_bias_pushes_to_the_side_that_it_names(environment):
    found = {}
    for seed in range(8):
        fault, simulator = drawn(environment, "bias", 1.0, seed)
        action = {"acrobot": 1, "cartpole": 1, "lunarlander": 0}[environment]
        fault.begin(simulator, [])
        for _ in range(5):
            row, *_ = simulator.step(fault.command(action, simulator))
        velocity = {"acrobot": 5, "cartpole": 1, "lunarlander": 2}[environment]
        found.setdefault(fault.parameters["direction"], []).append(row[velocity])
        simulator.close()
    assert min(found[1]) > max(found[-1])


@pytest.mark.parametrize("kind", SENSOR)
def test_sensor_faults_corrupt_a_fifth_of_the_sensors_and_name_them(rows, kind):
    for environment in ENVIRONMENTS:
        dimension = ENVIRONMENTS[environment].observation_dim
        fault, found = observed(environment, kind, 0.5, rows[:60, :dimension])
        sensors = fault.parameters["sensors"]
        assert len(sensors) == max(1, dimension // 5)
        assert set(sensors) <= set(VALUES["sensors"][environment])
        rest = [i for i in range(dimension) if i not in sensors]
        assert (found[:, rest] == rows[40:60, rest]).all()


def test_noise_of_nominal_operation_is_that_of_the_twin_and_has_the_stated_deviation():
    clean, noisy = (
        record_seed("cartpole", 950_000_003, [Condition("gravity")] if n else [],
                    policy=Reflex("cartpole"), episode_cap=200, noise=n)
        for n in (0.0, 0.05)
    )  # fmt: skip
    a, b = (found[None].trajectory.observations for found in (clean, noisy))
    noise = ((b - a) / spread_of("cartpole"))[: min(len(a), len(b))]
    assert noise[0].any()
    episode = noisy[Condition("gravity")]
    assert (episode.trajectory.observations[: episode.effect] == b[: episode.effect]).all()
    setup = Setup("cartpole", None, noise=0.05)
    change = faults_of_noise(setup)
    assert change.std() == pytest.approx(0.05, rel=0.05)


def faults_of_noise(setup):
    from oodd_recording.closed_loop import _noise

    add = _noise(setup, 7)
    return np.array([add(np.zeros(4, np.float32)) for _ in range(2000)]) / spread_of("cartpole")
