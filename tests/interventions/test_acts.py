"""The shipped acts: valid commands, and what each is for."""

import functools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_own import forget_own

pytest.importorskip("gymnasium", reason="needs the extra gym")

import oodd_worlds
from oodd_common.naming import ReadingModel
from oodd_interventions.acts import ACTS, Compensated, failed
from oodd_interventions.loop import Loop, LoopPair, NamedParts
from oodd_recording.closed_loop import RecordedEpisode, Setup, measure, record_anomalous, return_of
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of

from oodd_eval import Naming, Trajectory
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.registry import register

SEED = 774_000_000
ROW = 60
WORLDS = ("arm", "drone", "tank")
SPECS = [*ACTS, *oodd_worlds.oodd_acts()]
CASES = [
    (environment, spec)
    for spec in SPECS
    for environment in (spec.environments or [*ENVIRONMENTS, *WORLDS])
]


@pytest.fixture(scope="module", autouse=True)
def worlds():
    """The worlds, known in this process as long as these tests run."""
    register([*oodd_worlds.oodd_environments(), *oodd_worlds.oodd_anomalies()])
    yield
    loop_of.cache_clear()
    forget_own()


@functools.cache
def loop_of(environment, cap=None):
    """The loop of an environment, with a model of a few nominal episodes."""
    library = (
        "pybullet" if environment in {"ant", "halfcheetah", "hopper", "walker2d"} else "mujoco"
    )
    library = {"lunarlander": "Box2D"}.get(environment, library)
    if environment not in {"acrobot", "cartpole", "tank"}:
        pytest.importorskip(library, reason="needs its simulator")
    policy = load_policy(environment)
    if environment in WORLDS:
        measure(environment, policy)
    setup = Setup(environment, policy, cap)
    episodes = [setup.record(SEED - 1 - i).trajectory for i in range(3)]
    return Loop(setup, ReadingModel.fit(episodes))


def act_of(name, environment):
    """The spec of an environment's own act."""
    (spec,) = [s for s in SPECS if s.name == name and environment in s.environments]
    return spec


def forced(environment, spec, cap=None, seed=SEED):
    """A nominal episode, and the same with an act from row 60 on that knows of no faulty part."""
    loop = loop_of(environment, cap)
    twin, info = loop.setup.record(seed), info_of(environment)
    nobody = np.zeros(info.observation_dim)
    naming = Naming(nobody, np.zeros(info.action_dim), np.full_like(nobody, np.nan))
    pair, named = LoopPair("", None, "dynamics", twin, twin), {0: NamedParts(naming, ROW)}
    arm = loop.arm(pair, spec, ROW, lambda _, since: named.get(since), nominal=True)
    return twin, arm.episode


@pytest.mark.parametrize(("environment", "spec"), CASES, ids=lambda x: getattr(x, "name", x))
def test_an_act_takes_over_at_its_row_with_valid_commands(environment, spec):
    twin, episode = forced(environment, spec, cap=ROW + 50)
    rows, actions = episode.trajectory.observations, episode.trajectory.actions
    np.testing.assert_array_equal(rows[: ROW + 1], twin.trajectory.observations[: ROW + 1])
    np.testing.assert_array_equal(actions[:ROW], twin.trajectory.actions[:ROW])
    assert len(actions) == ROW + 50 or episode.terminated
    info = info_of(environment)
    if info.discrete:
        assert (actions.sum(axis=1) == 1).all()
    else:
        low, high = info.limits
        assert (actions >= np.float32(low)).all()
        assert (actions <= np.float32(high)).all()
    if spec.name == "stop":
        assert (actions[ROW:] != twin.trajectory.actions[ROW : len(actions)]).any()


@pytest.mark.parametrize("environment", [*ENVIRONMENTS, *WORLDS])
def test_a_mask_of_no_sensor_is_the_policy_bit_for_bit(environment):
    mask = SPECS[0]
    twin, episode = forced(environment, mask, cap=ROW + 50)
    np.testing.assert_array_equal(
        episode.trajectory.observations, twin.trajectory.observations, strict=True
    )
    np.testing.assert_array_equal(episode.rewards, twin.rewards)


def test_the_arm_holds_still_where_it_is():
    rows = forced("arm", act_of("stop", "arm"))[1].trajectory.observations
    # Payload and frictions are not the controller's: it sags by some hundredths of a radian.
    assert np.abs(rows[-100:, :6] - rows[ROW, :6]).max() < 0.1
    assert np.abs(rows[-100:, 6:12].mean(axis=0)).max() < 0.01


def test_the_drone_comes_down_gently_where_it_is():
    rows = forced("drone", act_of("stop", "drone"))[1].trajectory.observations.astype(float)
    assert np.abs(rows[-50:, 2]).max() < 0.25
    assert np.abs(rows[-50:, :2] - rows[ROW, :2]).max() < 0.8
    assert rows[ROW + 50 :, 5].min() > -0.7
    assert np.abs(rows[-50:, 3:6].mean(axis=0)).max() < 0.1


def test_the_tanks_reach_their_fail_safe_set_points():
    rows = forced("tank", act_of("stop", "tank"))[1].trajectory.observations
    np.testing.assert_allclose(rows[-50:, :2], 6.0, atol=0.3)


@pytest.mark.parametrize("environment", ["ant", "hopper"])
def test_a_robot_stands_on_its_feet(environment):
    episode = forced(environment, act_of("stop", environment), cap=400)[1]
    assert len(episode.rewards) == 400
    assert not failed(environment, episode, 400)
    # Columns 3 to 5 are 0.3 times the velocity.
    assert np.abs(episode.trajectory.observations[-100:, 3].mean()) < 0.15


@pytest.mark.parametrize("name", ["stop", "switch"])
def test_the_lander_comes_to_rest(name):
    _, episode = forced("lunarlander", act_of(name, "lunarlander"))
    assert episode.rewards[-1] == 100
    assert episode.terminated


def test_a_pole_is_balanced_in_wind_in_which_the_policy_drops_it():
    loop = loop_of("cartpole")
    twin = loop.setup.record(SEED)
    never = record_anomalous(loop.setup, "wind-l2r", None, twin)
    pair = LoopPair("wind-l2r", None, "dynamics", twin, never)
    arm = loop.oracle(pair, act_of("switch", "cartpole"))
    assert loop.failed(never)
    assert not loop.failed(arm.episode)


@pytest.mark.slow
def test_a_push_on_all_motors_is_found_and_taken_off():
    loop = loop_of("hopper")
    twin = loop.setup.record(SEED)
    never = record_anomalous(loop.setup, "wind-r2l", None, twin)
    pair, acts = LoopPair("wind-r2l", None, "dynamics", twin, never), []

    def make(situation):
        acts.append(Compensated(situation))
        return acts[0]

    spec = type(SPECS[0])("switch", make, "", ("dynamics",))
    arm = loop.oracle(pair, spec)
    push = np.linalg.solve(acts[0]._precision, acts[0]._evidence)
    np.testing.assert_allclose(push, -0.33, atol=0.12)
    assert return_of(arm.episode) > 0.9 * return_of(twin)
    assert loop.failed(never)
    assert not loop.failed(arm.episode)


@pytest.mark.parametrize(
    ("environment", "reward", "terminated", "pitch", "expected"),
    [
        ("hopper", 1.0, True, 0.0, True),
        ("hopper", 1.0, False, 0.0, False),
        ("acrobot", 0.0, True, 0.0, False),
        ("acrobot", -1.0, False, 0.0, True),
        ("lunarlander", 100.0, True, 0.0, False),
        ("lunarlander", -100.0, True, 0.0, True),
        ("lunarlander", 0.1, False, 0.0, True),
        ("halfcheetah", 1.0, False, -1.2, True),
        ("halfcheetah", 1.0, False, 0.9, False),
    ],
)
def test_failures_are_those_of_the_task(environment, reward, terminated, pitch, expected):
    rows = np.zeros((21, 26), np.float32)
    rows[-1, 7] = pitch
    rewards = np.full(20, reward, np.float32)
    episode = RecordedEpisode(Trajectory(rows), rewards, terminated, SEED)
    assert failed(environment, episode, 30) is expected


def test_an_end_at_the_cap_is_no_failure():
    rows = np.zeros((31, 4), np.float32)
    episode = RecordedEpisode(Trajectory(rows), np.ones(30, np.float32), True, SEED)
    assert not failed("cartpole", episode, 30)


@pytest.mark.slow
def test_the_swimmer_of_the_examples_stretches_out(monkeypatch):
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples" / "oodd-swimmer"))
    import oodd_swimmer

    register(oodd_swimmer.oodd_environments())
    (spec,) = oodd_swimmer.oodd_acts()
    twin, episode = forced("swimmer", spec)
    rows, swimming = episode.trajectory.observations, twin.trajectory.observations
    assert np.abs(swimming[-50:, 1:3]).max() > 0.5
    assert np.abs(rows[-50:, 1:3]).max() < 0.05
    assert return_of(episode) < return_of(twin)


def test_listing_acts_imports_no_simulator():
    code = (
        "import sys, oodd_worlds; assert 'oodd_interventions' not in sys.modules; "
        "from oodd_interventions.acts import ACTS; assert ACTS and oodd_worlds.oodd_acts(); "
        "assert not {'mujoco', 'pybullet', 'Box2D', 'gymnasium'} & sys.modules.keys()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
