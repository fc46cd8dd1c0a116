"""The oracle of Acrobot, CartPole and LunarLander: equations against the simulators, and filter."""

import math
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym")
import gymnasium
from oodd_worlds import make_gym_oracle
from oodd_worlds.classic import (
    AcrobotEquations,
    CartPoleEquations,
    ExtendedFilter,
    derivative,
    noise_of,
)
from oodd_worlds.gym import ENVIRONMENTS, LanderJudge
from oodd_worlds.lander import (
    GRAVITY,
    SECONDS,
    SWING,
    UNITS,
    LanderEquations,
    Ranges,
    changes,
    jitter,
)

from oodd_eval import Trajectory, load_split
from oodd_eval.errors import FittedStateError, NotFittedError
from oodd_eval.plugins.state import pack

pytestmark = pytest.mark.slow

CLASSIC = {"Acrobot-v1": AcrobotEquations, "CartPole-v1": CartPoleEquations}


def simulated(name, seed, rows, actions):
    """Return rows and one-hot actions of a simulator of Gymnasium, until it ends."""
    env = gymnasium.make(name).unwrapped
    observations, taken = [env.reset(seed=seed)[0]], []
    rng = np.random.default_rng(seed)
    for t in range(rows):
        action = actions(t, rng)
        row, _, ended, *_ = env.step(action)
        observations.append(row)
        taken.append(np.eye(env.action_space.n)[action])
        if ended:
            break
    return Trajectory(np.array(observations, np.float32), np.array(taken, np.float32))


@pytest.fixture(scope="module")
def mini():
    """A few episodes of each environment: training and twins."""
    parts = {}
    with load_split("mini").opened() as opened:
        for name in ENVIRONMENTS.values():
            data = opened(name)
            parts[name] = [*islice(data.train, 8)], [*islice(data.twins, 2)]
    return parts


@pytest.fixture(scope="module")
def fitted(mini):
    return {name: make_gym_oracle().fit(train) for name, (train, _) in mini.items()}


# Equations


@pytest.mark.parametrize("name", CLASSIC)
def test_a_step_is_the_simulators_own(name):
    env, equations = gymnasium.make(name).unwrapped, CLASSIC[name]()
    rng = np.random.default_rng(0)
    compared = 0
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(60):
            state = np.array(env.state, np.float64)
            action = int(rng.integers(env.action_space.n))
            row, _, ended, *_ = env.step(action)
            after = equations.step(state[None], np.eye(env.action_space.n)[action])
            assert np.abs(equations.measure(after)[0] - row).max() < 1e-6
            assert np.abs(np.sin(after[0] - env.state)).max() < 1e-12  # angles but for turns
            compared += 1
            if ended:
                break
    assert compared > 50


@pytest.mark.parametrize("name", CLASSIC)
def test_a_row_shows_the_state(name):
    equations = CLASSIC[name]()
    states = np.random.default_rng(1).uniform(-1, 1, size=(20, 4))
    np.testing.assert_allclose(equations.start(equations.measure(states)), states, rtol=1e-12)


def test_rates_of_acrobot_end_at_its_limits():
    limits = np.array([4 * math.pi, 9 * math.pi])
    rng, env = np.random.default_rng(4), gymnasium.make("Acrobot-v1").unwrapped
    env.reset(seed=0)
    clipped = 0
    for angles, rates in zip(rng.uniform(-3, 3, (50, 2)), rng.uniform(-1, 1, (50, 2)), strict=True):
        env.state = np.concatenate([angles, rates * limits])
        after = AcrobotEquations().step(env.state[None], np.array([0.0, 0.0, 1.0]))[0]
        env.step(2)
        np.testing.assert_allclose(after[2:], env.state[2:], rtol=1e-9)
        clipped += bool((np.abs(after[2:]) == limits).any())
    assert 5 < clipped < 45


def test_a_numerical_derivative_is_that_of_a_known_function():
    at = np.array([0.4, -1.1])
    slope = derivative(lambda x: np.column_stack([np.sin(x[:, 0]) * x[:, 1], x[:, 1] ** 2]), at)
    expected = [[math.cos(0.4) * -1.1, math.sin(0.4)], [0, -2.2]]
    np.testing.assert_allclose(slope, expected, atol=1e-9)


def test_a_lander_without_engines_does_what_gravity_and_kinematics_tell():
    x = simulated("LunarLander-v3", 3, 70, lambda *_: 0)
    parts, _, classes = changes(x.observations.astype(float), x.actions.astype(float))
    assert classes.tolist() == [8] * SWING + [0] * (len(classes) - SWING)
    # Positions are of the body's origin, which is not quite its centre of mass.
    assert np.abs(parts[SWING:]).max() < 1e-3
    assert np.abs(parts[SWING:, 3:6]).max() < 1e-4
    assert np.abs(parts[SWING:, 5]).max() < 1e-6
    # A step of the filter's equations says the same of the rows.
    lander, rows = LanderEquations(), x.observations.astype(float)
    before = lander.start(rows[SWING:-1])
    after = lander.measure(lander.step(before, np.eye(4)[0]))
    assert np.abs(after[:, 2:6] - rows[SWING + 1 :, 2:6]).max() < 2e-5


def test_an_engines_impulse_is_as_bounded_as_its_dispersion():
    # Gymnasium: the main engine's power is 13, its parts (4 / 30 + 2 d) and d, |d| < 1 / 30.
    choices = [simulated("LunarLander-v3", s, 80, lambda t, _: 2 * (t % 2)) for s in range(30)]
    parts, causes, classes = (
        np.concatenate(every)
        for every in zip(
            *(changes(x.observations.astype(float), x.actions.astype(float)) for x in choices),
            strict=True,
        )
    )
    up, right, turn = parts[classes == 2, 3:6].T
    assert len(up) > 500
    mass = 13 * (4 / 30) / up.mean()
    assert mass == pytest.approx(4.96, rel=0.02)
    for part, low, high in ((up, 2 / 30, 6 / 30), (right, -1 / 30, 1 / 30)):
        assert part.min() * mass / 13 == pytest.approx(low, abs=4e-3)
        assert part.max() * mass / 13 == pytest.approx(high, abs=4e-3)
    # Two draws move three velocities: a turn follows from the rest.
    told = causes[classes == 2] @ np.linalg.lstsq(causes[classes == 2], turn, rcond=None)[0]
    assert np.abs(turn - told).max() < 3e-3 * np.abs(turn).max()
    mean, upwards, sideways, _ = LanderEquations.MAIN
    assert [up.mean(), up.std(), right.std()] == pytest.approx([mean, upwards, sideways], rel=0.05)


def test_wind_gravity_and_power_leave_the_ranges_of_flight(mini):
    train, (twin, _) = mini["lunarlander"]
    ranges = Ranges.fit(train)
    rows, actions = twin.observations.astype(float), twin.actions.astype(float)
    parts, causes, classes = changes(rows, actions)
    flying = np.flatnonzero(classes == 0)[:5]
    nominal = ranges.excess(parts, causes, classes)
    heavier = parts.copy()
    heavier[:, 3] -= 0.01 * GRAVITY * SECONDS
    assert (ranges.excess(heavier, causes, classes)[flying] > 5 * nominal.max() + 5).all()
    drifting = rows.copy()
    drifting[:, 0] += 1e-2 * np.arange(len(rows)) / UNITS[0]
    excess = ranges.excess(*changes(drifting, actions))
    assert (excess[flying] > 5 * nominal.max() + 5).all()


def test_the_unit_of_an_excess_in_flight_is_what_one_episode_adds_to_the_others():
    rng = np.random.default_rng(2)
    episodes = []
    for level in (1.0, 2.0, 5.0):
        rows = np.zeros((SWING + 12, 8))
        rows[:, 2] = np.cumsum(rng.choice([-level, level], len(rows))) / UNITS[2]
        actions = np.tile(np.eye(4)[0], (len(rows) - 1, 1))
        episodes.append(Trajectory(rows, actions))
    ranges = Ranges.fit(episodes)
    assert ranges.high[0, 4] == pytest.approx(5, abs=1e-5)  # to the right, upright
    assert ranges.unit[0, 4] == pytest.approx(3, abs=1e-5)
    assert np.isinf(ranges.unit[2]).all()  # the main engine never ran


# The filter


def noisy(seed, share):
    x = simulated("CartPole-v1", seed, 120, lambda t, rng: int(rng.integers(2)))
    rows = x.observations + share * np.random.default_rng(seed).normal(size=x.observations.shape)
    return Trajectory(rows.astype(np.float32), x.actions)


def test_noise_is_found_from_what_the_equations_do_not_tell():
    share = np.array([0.02, 0.05, 0.004, 0.03])
    noise = np.sqrt(noise_of(CartPoleEquations, [noisy(seed, share) for seed in range(10)]))
    np.testing.assert_allclose(noise, share, rtol=0.25)


def test_innovations_of_nominal_rows_are_white_and_of_unit_size():
    share = np.array([0.02, 0.05, 0.004, 0.03])
    white = []
    for seed in range(40):
        x = noisy(seed, share)
        tracker = ExtendedFilter(CartPoleEquations(), share**2, x.observations[0].astype(float))
        pairs = zip(x.observations[1:].astype(float), x.actions.astype(float), strict=True)
        white.append(np.array([tracker.update(*pair)[0] for pair in pairs]))
    every = np.concatenate(white)
    assert len(every) > 500
    np.testing.assert_allclose(np.cov(every.T), np.eye(4), atol=0.12)
    later = np.concatenate([w[1:] * w[:-1] for w in white]).mean(axis=0)
    assert np.abs(later).max() < 0.12


# The detector


@pytest.mark.parametrize("name", ENVIRONMENTS.values())
def test_rows_one_by_one_and_a_restored_fit_have_the_same_scores(mini, fitted, name):
    detector, (_, (x, _)) = fitted[name], mini[name]
    scores = detector.score(x)
    assert np.isnan(scores).tolist() == [True] + [False] * (len(x) - 1)
    np.testing.assert_array_equal(detector.score(x[:21]), scores[:21])
    other = make_gym_oracle()
    with pytest.raises(NotFittedError):
        other.score(x)
    packed = pack(detector.state())
    other.restore(packed.state())
    actions = [None, *x.actions]
    streamed = [other.update(row, a) for row, a in zip(x.observations, actions, strict=True)]
    np.testing.assert_array_equal(streamed, scores)
    with pytest.raises(FittedStateError, match=r"\(\d, 9\), expected one of"):
        make_gym_oracle().restore({**packed.state(), "actions": np.array(9)})


@pytest.mark.parametrize("name", ENVIRONMENTS.values())
def test_a_small_change_of_one_sensor_is_seen_at_once(mini, fitted, name):
    detector, (_, (x, _)) = fitted[name], mini[name]
    rows = np.array(x.observations)
    rows[SWING + 10 :, 2] += 1e-3
    scores, nominal = detector.score(Trajectory(rows, x.actions)), detector.score(x)
    assert scores[SWING + 10] > 3 * np.nanmax(nominal)
    np.testing.assert_array_equal(scores[: SWING + 10], nominal[: SWING + 10])


def test_noisy_rows_of_the_lander_are_left_to_the_filter(mini, fitted):
    train, _ = mini["lunarlander"]
    assert isinstance(fitted["lunarlander"]._judge_, LanderJudge)
    rng = np.random.default_rng(3)
    rough = [
        Trajectory(x.observations + 0.01 * rng.normal(size=x.observations.shape), x.actions)
        for x in train[:3]
    ]
    assert jitter(train) < 1e-5
    assert jitter(rough) > 1e-3
    assert not isinstance(make_gym_oracle().fit(rough)._judge_, LanderJudge)


def test_what_it_has_no_equations_of_is_refused():
    x = Trajectory(np.zeros((9, 5)), np.zeros((8, 2)))
    with pytest.raises(NotImplementedError, match=r"acrobot \(6, 3\), .* got .* \[\(5, 2\)\]: run"):
        make_gym_oracle().fit([x])
    with pytest.raises(NotImplementedError, match="horizon 2: use 1"):
        make_gym_oracle(horizon=2)
