"""The oracle of the worlds: its equations, its filter, and what a detector owes the harness."""

import functools
import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra worlds")
from helpers_own import forget_own
from oodd_recording.closed_loop import Setup, record_anomalous
from oodd_recording.environments import make
from oodd_recording.policies import load_policy
from oodd_worlds import make_oracle, oodd_anomalies, oodd_detectors, oodd_environments
from oodd_worlds.facts import read_world
from oodd_worlds.oracles import (
    CLIP,
    JUMP,
    LIMIT,
    MODELS,
    WEIGHTS,
    Filter,
    InnovationCharts,
    charts_of,
    exponential,
    judged,
    standards_of,
    worlds,
)

from oodd_eval import Trajectory
from oodd_eval.data.registry import register
from oodd_eval.errors import FittedStateError, TrajectoryError
from oodd_eval.metrics.auc import auc

WORLDS = ("arm", "drone", "tank")
KINDS = [
    ("arm", "payload", 0.1),
    ("arm", "encoder-offset", 0.05),
    ("drone", "rotor-loss", 0.02),
    ("drone", "gyro-bias", 0.05),
    ("tank", "leak", 0.009),
    ("tank", "pump-wear", 0.05),
]
SEED = 982_000_000
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def registered_worlds():
    register([*oodd_environments(), *oodd_anomalies()])
    yield
    forget_own()


@functools.cache
def recorded(world, seed):
    """A nominal episode; tests must not change it."""
    return Setup(world, load_policy(world)).record(seed)


def episodes(world, count, first=SEED):
    return [recorded(world, first + i) for i in range(count)]


@pytest.fixture(scope="module")
def detectors():
    """A fit of each world, and three nominal episodes that it has not seen."""
    register([*oodd_environments(), *oodd_anomalies()])
    made = {}
    for world in WORLDS:
        train, fresh = (
            [episode.trajectory for episode in episodes(world, 3, first)]
            for first in (SEED + 10, SEED + 20)
        )
        detector = make_oracle()
        detector.fit(train)
        made[world] = detector, fresh
    return made


def drawn(world, seed):
    """Return the parameters that a seed's reset draws, as the state has them."""
    simulator = make(world)
    simulator.reset(seed)
    return MODELS[world]().drawn(simulator.env)


# Equations


@pytest.mark.parametrize("world", WORLDS)
def test_a_step_with_the_drawn_parameters_is_the_worlds_own(world):
    """The world's own steps, from its true first row, without what is drawn in a row."""
    simulator, model, policy = make(world), MODELS[world](), load_policy(world)
    policy.reset()
    row = simulator.reset(SEED)
    env = simulator.env
    if world == "drone":
        env._blow = lambda: None
    mean, _ = model.start(row.astype(np.float64))
    mean[model.parameters] = model.drawn(env)
    if world == "tank":
        mean[:6] = *env.level, *env.flow_voltage
    if world == "arm":
        env._ripple = np.zeros(6)
        mean[:6] = env.data.qpos
    if world == "drone":
        mean[:3] = env.data.qpos[:3]
    for _ in range(100):
        action = policy.act(row)
        row, *_ = simulator.step(action)
        mean, *_ = model.step(mean, action.astype(np.float64))
        # Rows are stored in single precision.
        np.testing.assert_allclose(mean[: model.measured], row[: model.measured], 1e-6, 1e-6)
    np.testing.assert_array_equal(mean[model.parameters], model.drawn(env))


@pytest.mark.parametrize("world", WORLDS)
def test_the_derivative_is_that_of_finite_differences(world):
    (episode,) = episodes(world, 1)
    rows, actions = episode.trajectory.observations, episode.trajectory.actions
    model = MODELS[world]()
    tracker = Filter(model, read_world(world).noise(), rows[0].astype(np.float64))
    speed = None
    for t in range(60):
        tracker.update(rows[t + 1].astype(np.float64), actions[t].astype(np.float64))
        if t % 10:
            continue
        mean, action = tracker.mean.copy(), actions[t + 1].astype(np.float64)
        speed = getattr(model._env, "speed", None)

        def step(state, action=action, speed=speed):
            if speed is not None:  # of the rotors, which the model keeps
                model._env.speed = speed
            return model.step(state, action)

        derivative = step(mean)[1]
        shifts = 1e-5 * np.eye(len(mean))
        columns = [(step(mean + s)[0] - step(mean - s)[0]) / 2e-5 for s in shifts]
        step(mean)
        model._env.speed = speed
        expected = np.stack(columns, axis=1)
        # Terms that the models leave out are below 3 % of the largest derivative by a column.
        scale = np.maximum(np.abs(expected).max(axis=0), 1)
        assert (np.abs(derivative - expected) / scale).max() < 0.03


def test_the_exponential_of_a_rotation_is_its_sine_and_cosine():
    angle = 0.7
    turned = exponential(np.array([[0.0, -angle], [angle, 0.0]]))
    sine, cosine = math.sin(angle), math.cos(angle)
    np.testing.assert_allclose(turned, [[cosine, -sine], [sine, cosine]], atol=1e-7)


# The filter


class Walk:
    """A random walk that starts at 0 with variance 1, and whose steps have variance 1."""

    measured, parameters = 1, slice(1, 2)

    def start(self, row):
        return np.array([0.0, 5.0]), np.array([1.0, 1.0])

    def step(self, mean, action):
        return mean.copy(), np.eye(2), np.diag([1.0, 0.0])


def test_a_filter_of_a_random_walk_has_the_gains_of_the_textbook():
    """Prior variance 2, innovation's 3, gain 2/3; then 5/3, 8/3 and 5/8."""
    tracker = Filter(Walk(), np.array([1.0]), np.zeros(1))
    assert tracker.update(np.array([3.0]), np.zeros(0))[0] == pytest.approx(3 / math.sqrt(3))
    np.testing.assert_allclose(tracker.mean, [2.0, 5.0], rtol=1e-12)
    np.testing.assert_allclose(tracker.covariance, np.diag([2 / 3, 1.0]), rtol=1e-12)
    assert tracker.update(np.array([1.0]), np.zeros(0))[0] == pytest.approx(-1 / math.sqrt(8 / 3))
    np.testing.assert_allclose(tracker.mean, [2 - 5 / 8, 5.0], rtol=1e-12)
    assert tracker.covariance[0, 0] == pytest.approx(5 / 8)


def test_the_state_follows_a_far_row_by_a_few_deviations_and_begins_anew_at_a_farther_one():
    far, farther = 10 * math.sqrt(3), (JUMP + 1) * math.sqrt(3)
    tracker = Filter(Walk(), np.array([1.0]), np.zeros(1))
    assert tracker.update(np.array([far]), np.zeros(0))[0] == pytest.approx(10)
    assert tracker.mean[0] == pytest.approx(2 / 3 * CLIP * math.sqrt(3))
    tracker = Filter(Walk(), np.array([1.0]), np.zeros(1))
    assert tracker.update(np.array([farther]), np.zeros(0))[0] == pytest.approx(JUMP + 1)
    np.testing.assert_allclose(tracker.mean, [farther, 5.0], rtol=1e-12)
    np.testing.assert_allclose(tracker.covariance, np.eye(2), rtol=1e-12)


def test_known_parameters_stay_as_they_are():
    tracker = Filter(Walk(), np.array([1.0]), np.zeros(1), np.array([7.0]))
    tracker.update(np.array([3.0]), np.zeros(0))
    assert tracker.mean[1] == 7.0
    assert tracker.covariance[1, 1] == 0.0


@pytest.mark.parametrize("world", WORLDS)
def test_innovations_of_nominal_episodes_are_white_and_parameters_are_learnt(world):
    whites, errors, left = [], [], []
    noise = read_world(world).noise()
    for episode in episodes(world, 3):
        rows = episode.trajectory.observations.astype(np.float64)
        model = MODELS[world]()
        tracker = Filter(model, noise, rows[0])
        prior = np.sqrt(np.diag(tracker.covariance))[model.parameters]
        actions = episode.trajectory.actions.astype(np.float64)
        whites.append([tracker.update(*pair) for pair in zip(rows[1:], actions, strict=True)])
        spread = np.sqrt(np.diag(tracker.covariance))[model.parameters]
        errors.append((tracker.mean[model.parameters] - drawn(world, episode.seed)) / spread)
        left.append(spread / prior)
    white = np.array(whites)
    n = white[..., 0].size
    assert np.abs((white**2).mean(axis=(0, 1)) - 1).max() < 5 * math.sqrt(2 / n)
    assert np.abs((white[:, 1:] * white[:, :-1]).mean(axis=(0, 1))).max() < 5 / math.sqrt(n)
    assert np.sqrt(np.mean(np.square(errors))) < 2  # in standard deviations that the filter states
    # Ripple hides some of the arm's frictions.
    assert np.median(left) < 0.5
    assert np.max(left) < 1


# InnovationCharts


def test_charts_of_quiet_rows_have_no_length_and_the_least_size(monkeypatch):
    monkeypatch.setitem(MODELS, "tank", Still)
    charts = InnovationCharts("tank", np.zeros(6, np.float32))
    quiet = charts.update(np.zeros(6, np.float32), np.zeros(2, np.float32))
    # No square of four innovations: 4 below their mean, in deviations of sqrt(8).
    np.testing.assert_allclose(quiet, [0] * 5 + [-math.sqrt(2)] * 5, atol=1e-12)
    noise = read_world("tank").noise()[0]
    row = np.zeros(6)
    row[0] = 2 * LIMIT * noise
    loud = charts.update(row.astype(np.float32), np.zeros(2, np.float32))
    assert loud[0] == pytest.approx(LIMIT)  # the newest innovation alone, as far as it counts
    assert loud[5] == pytest.approx((LIMIT**2 - 4) / math.sqrt(8))


class Still:
    """Four quantities that are known to be 0."""

    measured, parameters = 4, slice(4, 4)

    def start(self, row):
        return np.zeros(4), np.zeros(4)

    def step(self, mean, action):
        return mean.copy(), np.eye(4), np.zeros((4, 4))


def test_standards_are_of_each_episodes_largest_charts_and_the_farthest_chart_counts():
    charts = [np.array([[1.0, 0.0], [3.0, 2.0]]), np.array([[5.0, 2.0], [4.0, 1.0]])]
    standards = standards_of(charts)
    np.testing.assert_array_equal(standards, [[4.0, 2.0], [1.0, 1.0]])  # a chart without spread
    np.testing.assert_array_equal(judged(charts[0], standards), [-2.0, 0.0])


# The detector


@pytest.mark.parametrize("world", WORLDS)
def test_rows_one_by_one_and_a_restored_fit_have_the_same_bits(world, detectors):
    detector, nominal = detectors[world]
    trajectory = nominal[2][:60]
    scores = detector.score(trajectory)
    other = make_oracle()
    other.restore(detector.state())
    other.reset()
    streamed = [other.update(trajectory.observations[0])]
    pairs = zip(trajectory.observations[1:], trajectory.actions, strict=True)
    streamed += [other.update(*pair) for pair in pairs]
    np.testing.assert_array_equal(streamed, scores)
    np.testing.assert_array_equal(other.score(nominal[2])[:60], scores)
    assert math.isnan(scores[0])
    assert np.isfinite(scores[1:]).all()


@pytest.mark.parametrize(("world", "kind", "strength"), KINDS)
def test_a_fault_that_costs_little_scores_above_its_twin_in_nearly_all_rows(
    world, kind, strength, detectors
):
    detector, _ = detectors[world]
    (twin,) = episodes(world, 1)
    episode = record_anomalous(Setup(world, load_policy(world)), kind, strength, twin)
    scores, reference = (detector.score(e.trajectory) for e in (episode, twin))
    np.testing.assert_array_equal(scores[: episode.effect], reference[: episode.effect])
    assert auc(scores[episode.effect :], reference[episode.effect :]) > 0.9


@pytest.mark.parametrize("world", WORLDS)
def test_a_fault_of_any_size_leaves_scores_finite(world, detectors):
    """Readings far beyond what a body can do, and back: numbers stay numbers, and high."""
    detector, nominal = detectors[world]
    rows = nominal[0].observations.copy()
    rows[100:110, : MODELS[world].measured] *= -1000
    scores = detector.score(Trajectory(rows, nominal[0].actions))
    assert np.isfinite(scores[1:]).all()
    assert scores[100:110].min() > np.nanmax(detector.score(nominal[0]))


def test_worlds_are_told_by_their_columns_and_others_are_refused():
    oracles = [s for s in oodd_detectors() if s.name.startswith("oracle")]
    assert {(s.name, s.training, s.alarm, s.deterministic) for s in oracles} == {
        ("oracle", "oracle", "score", True), ("oracle-gym", "oracle", "score", True),
    }  # fmt: skip
    assert worlds() == {(30, 6): "arm", (18, 4): "drone", (6, 2): "tank"}
    strange = [Trajectory(np.zeros((5, 3)), np.zeros((4, 2)))] * 2
    with pytest.raises(NotImplementedError, match=r"arm \(30, 6\).*\(3, 2\).*--env arm,drone,tank"):
        make_oracle().fit(strange)
    with pytest.raises(NotImplementedError, match="horizon 2"):
        make_oracle(horizon=2)
    with pytest.raises(TrajectoryError, match="0 trajectories"):
        make_oracle().fit([])


def test_a_fit_of_another_shape_is_refused(detectors):
    state = detectors["tank"][0].state()
    for changes in ({"actions": np.array(5)}, {"chart_spread": np.zeros(2 * len(WEIGHTS))}):
        with pytest.raises(FittedStateError):
            make_oracle().restore(state | changes)


# The ceiling


@pytest.mark.slow  # a script of benchmarks
def test_the_ceilings_script_has_the_parameters_of_each_seed(capsys):
    path = ROOT / "benchmarks" / "worlds_oracles.py"
    spec = importlib.util.spec_from_file_location("worlds_oracles", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    (episode,) = episodes("tank", 1)
    oracle = script.Oracle("tank", informed=True)
    expected = charts_of("tank", episode.trajectory, drawn("tank", episode.seed))
    np.testing.assert_array_equal(oracle.charts(episode), expected)
    sizes = ["--train", "2", "--calibration", "19", "--test", "2"]
    script.main(["--env", "tank", "--anomaly", "leak", "--cells", *sizes])
    lines = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    (leak,) = (line for line in lines if line[1].strip() == "leak@loss100")
    assert [float(cell) for cell in leak[2:]] == pytest.approx([100] * 4, abs=3)
    with pytest.raises(SystemExit):
        script.main(["--calibration", "18"])
