"""The worlds: arm, drone and tank. Known answers, what a seed decides, and what faults do."""

import functools
import itertools
import math

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra worlds")
import mujoco
from helpers_own import forget_own
from oodd_recording.calibrate import loss_of
from oodd_recording.closed_loop import Setup, record_anomalous, record_seed
from oodd_recording.environments import make
from oodd_recording.faults import make_fault
from oodd_recording.policies import load_policy
from oodd_recording.values import bound_of
from oodd_worlds import KINDS, ROWS, oodd_anomalies, oodd_environments
from oodd_worlds.arm import WORLD as ARM
from oodd_worlds.arm import model_xml
from oodd_worlds.drone import WORLD as DRONE
from oodd_worlds.drone import hover_speed, wrench
from oodd_worlds.facts import ASSUMED, read_world
from oodd_worlds.tank import PI, Tank, derivative, steady_levels

from oodd_eval.data.condition import Condition
from oodd_eval.data.registry import register

WORLDS = ("arm", "drone", "tank")
PAIRS = [(world, kind) for world, kind, *_ in KINDS]
SEED = 981_000_000


@pytest.fixture(autouse=True)
def worlds():
    register([*oodd_environments(), *oodd_anomalies()])
    yield
    forget_own()


@functools.cache
def setup(world):
    register([*oodd_environments(), *oodd_anomalies()])
    return Setup(world, load_policy(world))


@functools.cache
def first_twin(world):
    """The nominal episode of the first seed; tests must not change it."""
    return setup(world).record(SEED)


# Known answers


def test_the_stretched_arm_weighs_what_its_masses_and_lengths_say():
    """Joint 2 carries the links beyond it; joint axes 4 to 6 pass through one point but for d."""
    mass, a = ARM.value("mass"), ARM.value("a")
    upper, lower = -a[1], -a[2]
    moment = mass[1] * ARM.value("centre x")[1] + mass[2] * (upper + lower - 0.15)
    moment += mass[3:].sum() * (upper + lower)
    model = mujoco.MjModel.from_xml_string(model_xml())
    model.body_mass[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "payload")] = 0.0
    data = mujoco.MjData(model)
    mujoco.mj_inverse(model, data)
    torque = abs(data.qfrc_inverse[1])
    # Centres of the wrist that lie beside its axis: along y of frames 4 and 5, z of frame 6.
    assert torque == pytest.approx(moment * ARM.value("gravity"), abs=1e-3)
    assert torque == pytest.approx(59.7564, abs=1e-4)


def test_a_hovering_drone_carries_its_weight_and_drag_is_the_product_of_speed_and_wind():
    def force(speed, wind):
        return wrench([speed] * 4, thrust, [1.0, 0.0, 0.0, 0.0], [0.0] * 3, (wind, 0.0))

    thrust, weight = DRONE.value("thrust").tolist(), DRONE.value("mass") * DRONE.value("gravity")
    np.testing.assert_allclose(force(hover_speed(), 0.0), [0, 0, weight, 0, 0, 0], atol=1e-12)
    drag = force(400.0, 2.0)[0] - force(400.0, 0.0)[0]
    assert drag == pytest.approx(DRONE.value("rotor drag") * 1600 * 2.0, rel=1e-12)


def test_levels_at_three_volts_are_those_of_the_closed_form():
    tank = Tank()
    tank.reset(seed=1)
    expected = [12.263, 12.783, 1.634, 1.409]  # cm
    np.testing.assert_allclose(steady_levels(Tank(), [3.0, 3.0]), expected, atol=5e-4)
    for _ in range(2000):
        tank.step(np.full(2, 3.0, np.float32))
    np.testing.assert_allclose(tank.level, steady_levels(tank, [3.0, 3.0]), atol=1e-6)


@pytest.mark.parametrize("world", WORLDS)
def test_every_number_has_a_unit_and_a_source(world):
    facts = read_world(world)
    for fact in facts.facts.values():
        assert fact.unit, fact.name
        assert fact.source.startswith(ASSUMED) or any(c.isupper() for c in fact.source), fact.name
    for sensor in facts.sensors:
        assert (sensor.noise > 0) == sensor.measured, sensor.name


# What a seed decides


@pytest.mark.parametrize("world", WORLDS)
def test_episodes_differ_in_their_parameters(world):
    names = {"arm": ("payload",), "drone": ("thrust", "wind"), "tank": ("pump_gain", "orifice")}
    drawn = []
    for seed in (SEED, SEED, SEED + 1):
        simulator = make(world)
        simulator.reset(seed)
        drawn.append([np.copy(getattr(simulator.env, name)) for name in names[world]])
        simulator.close()
    for same, again, other in zip(*drawn, strict=True):
        np.testing.assert_array_equal(same, again)
        assert not np.array_equal(same, other)


@pytest.mark.parametrize("world", WORLDS)
def test_rows_have_the_noise_of_the_table(world):
    """Measured minus true: the simulator's own rows for the same actions, without noise."""
    twin = first_twin(world)
    simulator = make(world)
    rows = [simulator.reset(SEED), *(simulator.step(a)[0] for a in twin.trajectory.actions)]
    noise = twin.trajectory.observations.astype(np.float64) - np.array(rows)
    table = read_world(world).noise()
    # 401 draws: the standard deviation is within 15 % in all but one of 10 000 sensors.
    np.testing.assert_allclose(noise.std(axis=0), table, rtol=0.15, atol=1e-9)
    assert not noise[:, table == 0].any()


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_the_controller_never_fails_in_200_nominal_episodes(world):
    nominal = setup(world)
    for i in range(200):
        episode = nominal.record(SEED + i)
        assert not episode.terminated
        assert len(episode.rewards) == ROWS
        assert episode.rewards.min() >= 0
        assert episode.rewards.max() <= 1
        assert episode.rewards.mean() > 0.6


# What faults do


@pytest.mark.parametrize(("world", "kind"), PAIRS)
def test_a_fault_begins_at_its_onset_and_is_nothing_at_strength_zero(world, kind):
    nominal, twin = setup(world), first_twin(world)
    nothing = record_anomalous(nominal, kind, 0.0, twin, redraws=0)
    rows = twin.trajectory.observations
    assert nothing.trajectory.observations.tobytes() == rows.tobytes()
    episode = record_anomalous(nominal, kind, bound_of(world, kind), twin)
    changed = episode.trajectory.observations
    assert changed[: episode.onset].tobytes() == rows[: episode.onset].tobytes()
    common = min(len(changed), len(rows))
    assert (changed[episode.effect : common] != rows[episode.effect : common]).any()
    sensors = read_world(world).sensors
    assert all(sensors[i].measured for i in episode.parameters.get("sensors", []))


@pytest.mark.slow
@pytest.mark.parametrize(("world", "kind"), PAIRS)
def test_a_stronger_fault_takes_episodes_farther_and_costs_more(world, kind):
    nominal = setup(world)
    twins = [nominal.record(SEED + i) for i in range(12)]
    distances, losses = [], []
    for part in (0.02, 0.15, 1.0):
        strength = part * bound_of(world, kind)
        episodes = [record_anomalous(nominal, kind, strength, t, redraws=0) for t in twins]
        gaps = []
        for episode, twin in zip(episodes, twins, strict=True):
            rows, others = episode.trajectory.observations, twin.trajectory.observations
            common = slice(episode.onset, min(len(rows), len(others)))
            gaps.append(np.abs(rows[common] - others[common]).mean())
        distances.append(np.mean(gaps))
        losses.append(np.mean([loss_of(episode, ROWS) for episode in episodes]))
    assert all(a < b for a, b in itertools.pairwise(distances)), distances
    assert losses[0] < losses[2], losses


def test_a_worn_pump_fills_its_tanks_slower_by_the_share_of_its_flow_that_is_lost():
    simulator = make("tank")
    simulator.reset(SEED)
    tank = simulator.env
    state, flow = (*tank.level, *tank.flow_voltage), tank.pump_gain[0] * tank.flow_voltage[0]
    before = derivative(tank, state, [3.0, 3.0])
    fault = make_fault("pump-wear", 0.3, simulator, np.random.default_rng(1))
    assert fault.parameters["actuator"] == 0
    fault.command(np.full(2, 3.0, np.float32), simulator)
    after = derivative(tank, state, [3.0, 3.0])
    lost = [b - a for a, b in zip(after, before, strict=True)]
    share, area = tank.split[0], [28.0, 32.0, 28.0, 32.0]
    expected = [0.3 * share * flow / area[0], 0, 0, 0.3 * (1 - share) * flow / area[3], 0, 0]
    np.testing.assert_allclose(lost, expected, atol=1e-12)


def test_an_episode_of_the_tank_under_control_costs_what_its_loop_costs():
    """A drift of a level reaches the controller: the same loop, written out, costs the same."""
    twin = first_twin("tank")
    episode = record_seed(
        "tank", SEED, {Condition("level-drift"): 0.001}, policy=load_policy("tank")
    )[Condition("level-drift")]
    sensor = episode.parameters["sensors"][0]
    sign = episode.parameters["direction"]
    tank, controller = Tank(), PI()
    tank.reset(seed=SEED)
    rewards = []
    for row in episode.trajectory.observations[:-1]:
        _, reward, *_ = tank.step(controller.act(row))
        rewards.append(reward)
    np.testing.assert_array_equal(np.array(rewards, np.float32), episode.rewards)
    # What is stored drifts by the slope against the tank's own level, but for noise.
    steps = np.arange(len(episode.trajectory.observations)) - (episode.onset - 1)
    drift = sign * 0.001 * np.maximum(steps, 0)
    other = [1 - sensor, 2, 3]
    rows = episode.trajectory.observations
    assert (rows[:, other] != twin.trajectory.observations[:, other]).any()
    replay = Tank()
    true = [replay.reset(seed=SEED)[0], *(replay.step(a)[0] for a in episode.trajectory.actions)]
    residual = rows[:, sensor] - np.array(true)[:, sensor] - drift
    assert abs(residual.mean()) < 5 * 0.02 / math.sqrt(len(rows))
