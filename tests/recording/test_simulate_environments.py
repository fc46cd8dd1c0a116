"""The simulators: what is set is in force, and one episode never reaches another."""

import numpy as np
import pytest
from helpers_simulate import SEEDS, Reflex
from oodd_recording.anomalies import VALUES
from oodd_recording.classic import _Acrobot
from oodd_recording.environments import make

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


# Acrobot


def test_acrobot_swings_with_the_gravity_it_was_given():
    """Small oscillation of both links about rest: the accelerations are linear in gravity."""
    env, state = _Acrobot(), (0.01, -0.02, 0.0, 0.0, 0.0)
    usual = np.array(env.derivative(state))
    env.gravity = 2 * 9.8
    np.testing.assert_allclose(env._dsdt(state)[2:4], 2 * usual[2:4], rtol=1e-12)


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
