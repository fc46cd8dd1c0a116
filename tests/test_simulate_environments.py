"""The simulators: what is set is in force, and one episode never reaches another."""

import math

import numpy as np
import pytest
from gymnasium.envs.classic_control.acrobot import AcrobotEnv
from helpers_simulate import SEEDS, Reflex
from oodd_recording.anomalies import VALUES
from oodd_recording.environments import _Acrobot, make
from oodd_recording.record import record_nominal

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.split import load_split

NOMINAL = {
    ("acrobot", "gravity"): 9.8, ("acrobot", "link_length_1"): 1.0,
    ("acrobot", "link_length_2"): 1.0, ("acrobot", "link_mass_1"): 1.0,
    ("acrobot", "link_mass_2"): 1.0, ("cartpole", "gravity"): 9.8,
    ("cartpole", "pole_length"): 0.5, ("cartpole", "pole_mass"): 0.1,
    ("lunarlander", "gravity"): 10.0, ("lunarlander", "main_engine_power"): 13.0,
    ("lunarlander", "side_engine_power"): 0.6, ("ant", "gravity"): 9.8, ("ant", "power"): 2.5,
    ("halfcheetah", "gravity"): 9.8, ("halfcheetah", "power"): 0.9, ("hopper", "gravity"): 9.8,
    ("hopper", "power"): 0.75, ("walker2d", "gravity"): 9.8, ("walker2d", "power"): 0.4,
}  # fmt: skip


@pytest.fixture
def simulator(request):
    made = make(request.param)
    made.reset(SEEDS[request.param])
    yield made
    made.close()


def roll(environment, steps=25, change=None, between=None):
    """Observations of an episode; `change` acts on the simulator after reset."""
    made = make(environment)
    try:
        policy, rows = Reflex(environment), [made.reset(SEEDS[environment])]
        if change:
            change(made)
        for _ in range(steps):
            rows.append(made.step(policy.act(rows[-1]))[0])
            if between:
                between()
    finally:
        made.close()
    return np.array(rows)


@pytest.mark.parametrize(("environment", "attribute"), NOMINAL)
def test_attributes_read_back_what_is_in_force_and_change_what_follows(environment, attribute):
    nominal, value = NOMINAL[environment, attribute], 1.1 * NOMINAL[environment, attribute]
    readings = []

    def change(made):
        readings.append(made.get(attribute))
        made.set(attribute, value)
        readings.append(made.get(attribute))

    changed, usual = roll(environment, 45, change), roll(environment, 45)
    assert readings == pytest.approx([nominal, value])
    assert (changed[0] == usual[0]).all()
    assert (changed != usual).any()


def test_every_component_of_the_anomaly_table_has_a_nominal_value_here():
    listed = {(e, a) for e, attributes in VALUES["components"].items() for a in attributes}
    assert {(e, a) for e, a in NOMINAL if a != "gravity"} == listed


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_changed_simulator_disturbs_no_other_in_the_process(environment):
    other = make(environment)
    other.reset(7)
    for (e, attribute), value in NOMINAL.items():
        if e == environment:
            other.set(attribute, 1.5 * value)
    other.wind = 1
    action = Reflex(environment).act(other.step(Reflex(environment).act(other.reset(8)))[0])
    beside = roll(environment, between=lambda: other.step(action))
    other.close()
    assert beside.tobytes() == roll(environment).tobytes()


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(environment):
    policy, seed = Reflex(environment), SEEDS[environment]
    first, second, other = (
        record_nominal(environment, s, policy=policy, episode_cap=30).trajectory.observations
        for s in (seed, seed, seed + 1)
    )
    assert first.tobytes() == second.tobytes()
    assert first.tobytes() != other[: len(first)].tobytes()
    assert first.shape[1] == ENVIRONMENTS[environment].observation_dim


# Acrobot


def test_acrobot_equations_agree_with_the_stock_ones_at_stock_gravity():
    rng, stock, ours = np.random.default_rng(0), AcrobotEnv(), _Acrobot()
    for env in (stock, ours):
        env.LINK_LENGTH_1, env.LINK_COM_POS_1, env.LINK_COM_POS_2 = 1.3, 0.65, 0.4
        env.LINK_MASS_1, env.LINK_MASS_2 = 0.7, 1.9
    for _ in range(50):
        state = rng.uniform(-3, 3, size=5)
        np.testing.assert_allclose(ours.derivative(state), stock._dsdt(state), rtol=1e-9)


def test_acrobot_swings_with_the_gravity_it_was_given():
    """Small oscillation of both links about rest: the accelerations are linear in gravity."""
    env, state = _Acrobot(), (0.01, -0.02, 0.0, 0.0, 0.0)
    usual = np.array(env.derivative(state))
    env.gravity = 2 * 9.8
    np.testing.assert_allclose(env._dsdt(state)[2:4], 2 * usual[2:4], rtol=1e-12)


@pytest.mark.parametrize("simulator", ["acrobot"], indirect=True)
def test_acrobot_wind_removes_torque_against_it_and_adds_one_unit_with_it(simulator):
    torques = {}
    for wind in (-1, 0, 1):
        simulator.wind = wind
        simulator.step(1)
        torques[wind] = list(simulator.env.AVAIL_TORQUE)
    assert torques == {0: [-1, 0, 1], 1: [0, 0, 2], -1: [-2, 0, 0]}


# CartPole


@pytest.mark.parametrize(
    ("wind", "action", "newton"),
    [(0, 0, -10), (0, 1, 10), (1, 0, 0), (1, 1, 20), (-1, 0, -20), (-1, 1, 0)],
)
@pytest.mark.parametrize("simulator", ["cartpole"], indirect=True)
def test_cartpole_wind_changes_the_force(simulator, wind, action, newton):
    env = simulator.env
    _, _, theta, spin = env.state
    # Barto, Sutton & Anderson (1983), frictionless, solved for the force from the cart's change.
    before = env.state[1]
    simulator.wind = wind
    simulator.step(action)
    pushed = (env.state[1] - before) / 0.02
    m, total, length = 0.1, 1.1, 0.5
    inertia = length * (4 / 3 - m * math.cos(theta) ** 2 / total)
    swing = m * length * spin**2 * math.sin(theta)

    def acceleration(force):
        part = (force + swing) / total
        turn = (9.8 * math.sin(theta) - math.cos(theta) * part) / inertia
        return part - m * length * turn * math.cos(theta) / total

    assert pushed == pytest.approx(acceleration(newton), rel=1e-6)


# LunarLander


def speed_change(wind, action):
    """Sideways change of speed in one step, against the same step with no engine."""
    changes = []
    for command, gust in ((action, wind), (0, 0)):
        made = make("lunarlander")
        made.reset(3)
        made.wind = gust
        # Stepping draws the engines' dispersion; the same in every run, as it is seeded.
        made.step(command)
        changes.append(made.env.lander.linearVelocity.x)
        made.close()
    return changes[0] - changes[1]


def test_lunarlander_engine_1_pushes_to_negative_x_and_wind_doubles_or_stops_it():
    left, right = speed_change(0, 1), speed_change(0, 3)
    assert left < 0 < right
    assert speed_change(-1, 1) == pytest.approx(2 * left, rel=0.02)
    assert speed_change(1, 3) == pytest.approx(2 * right, rel=0.02)
    assert speed_change(1, 1) == speed_change(-1, 3) == 0.0


def test_lunarlander_falls_with_the_gravity_it_was_given():
    falls = []
    for gravity in (None, 9.0):
        made = make("lunarlander")
        made.reset(1)
        if gravity:
            made.set("gravity", gravity)
        before = made.env.lander.linearVelocity.y
        made.step(0)
        falls.append((made.env.lander.linearVelocity.y - before) * 50)  # 50 steps a second
        made.close()
    # Joints to the legs pull a little in the first steps.
    assert falls[1] - falls[0] == pytest.approx(1.0, rel=0.05)


# PyBullet


@pytest.mark.parametrize("simulator", ["hopper"], indirect=True)
def test_bullet_wind_is_added_to_every_motor_and_clipped(simulator):
    seen = []
    simulator.env.step = lambda a: seen.append(a) or (np.zeros(15), 0.0, False, False, {})
    command = np.array([-1.0, 0.0, 0.9], np.float32)
    for wind in (-0.33, 0, 0.33):
        simulator.wind = wind
        simulator.step(command)
    np.testing.assert_allclose(seen, [[-1, -0.33, 0.57], [-1, 0, 0.9], [-0.67, 0.33, 1]], atol=1e-6)
    assert command.tolist() == [-1.0, 0.0, np.float32(0.9)]


# Sensors that anomalies may corrupt


def sensors_to_corrupt(rows):
    """Return the sensors that anomalies may corrupt, from nominal rows of shape (rows, D)."""
    # Bullet's angle to the target is constant up to rounding only.
    varying = (np.abs(rows - np.median(rows, axis=0)) > 1e-6).mean(axis=0) >= 0.01
    distinct = np.array([len(np.unique(column)) for column in rows.T])
    return np.flatnonzero(varying & (distinct > 8))


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_listed_sensors_are_those_that_the_rule_gives_on_the_training_part_of_mini(environment):
    rows = np.concatenate(
        [x.observations for x in load_split("mini").environment(environment).train]
    )
    listed = VALUES["sensors"][environment]
    assert sensors_to_corrupt(rows).tolist() == listed
