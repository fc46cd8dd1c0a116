"""A watchdog around Gymnasium's environments, and in a terminal."""

import io
import re
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
from oodd_live import Reading, TerminalMonitor, Watchdog
from rich.console import Console

from oodd_eval import load_split
from oodd_eval.errors import UsageError

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from oodd_live import VectorWatchdogWrapper, WatchdogWrapper  # noqa: E402
from oodd_live.wrappers import as_row  # noqa: E402

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def fitted():
    data = load_split("mini").environment("cartpole")
    return Watchdog.fit("mewma-a", data.train, data.calibration, sensors=data.sensors)


def warned(env):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_env(env)
    # It prefers environments without a wrapper.
    return [str(w.message) for w in told if "unwrapped version" not in str(w.message)]


def test_the_wrapper_is_an_environment_as_clean_as_what_it_wraps(fitted, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    wrapped = WatchdogWrapper(gymnasium.make("CartPole-v1"), fitted.copy())
    assert warned(wrapped) == warned(gymnasium.make("CartPole-v1").unwrapped)


def test_info_has_the_reading_of_each_observation(fitted):
    env, alone = WatchdogWrapper(gymnasium.make("CartPole-v1"), fitted.copy()), fitted.copy()
    for seed in (1, 2):
        observation, info = env.reset(seed=seed)
        alone.reset()
        assert info["oodd"] == alone.update(observation)
        for action in (0, 1, 1, 0):
            observation, _, _, _, info = env.step(action)
            assert info["oodd"] == alone.update(observation, np.eye(2)[action])
    assert info["oodd"].t == 4


class Falling(gymnasium.Env):
    """Calm episodes of as many rows as their number says; the last row is a crash."""

    observation_space = gymnasium.spaces.Dict(
        {
            "mode": gymnasium.spaces.Discrete(2),
            "pose": gymnasium.spaces.Tuple([gymnasium.spaces.Box(-99, 99, (1, 2), np.float64)] * 2),
        }
    )
    action_space = gymnasium.spaces.Discrete(2, start=5)

    def __init__(self, first=20):
        self._rows = first

    def _observed(self, size=0.1):
        pose = self.np_random.normal(scale=0.1, size=(2, 1, 2)) + (size if size > 1 else 0)
        return {"mode": self._t % 2, "pose": (pose[0], pose[1])}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._t, self._rows = 0, self._rows + 3
        return self._observed(), {"height": 1.0}

    def step(self, action):
        assert action in self.action_space
        self._t += 1
        over = self._t == self._rows
        return self._observed(50.0 * over), 0.0, over, False, {"height": float(not over)}


def push(observation):
    """An action that hangs on what was observed last alone, and soon makes the pole fall."""
    return int(observation[2] < 0)


def single_episodes(env, seed, n, act):
    """Readings of each row of some episodes, one after the other in one environment."""
    episodes = []
    for _ in range(n):
        observation, info = env.reset(seed=None if episodes else seed)
        episodes.append([info["oodd"]])
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(act(observation))
            episodes[-1].append(info["oodd"])
            over = terminated or truncated
    return episodes


def vector_episodes(env, seed, steps, act, each):
    """The same of environments that step together: all rows of all episodes, by environment."""
    disabled = env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    observations, info = env.reset(seed=seed)
    episodes = [[[reading]] for reading in info["oodd"]]
    for _ in range(steps):
        actions = np.array([act(observation) for observation in each(observations)])
        observations, _, terminated, truncated, info = env.step(actions)
        infos = [info["final_info"], info] if "final_info" in info else [info]
        if disabled and (over := terminated | truncated).any():
            observations, later = env.reset(options={"reset_mask": over})
            assert later["_oodd"].tolist() == over.tolist()
            infos.append(later)
        for readings in infos:
            for i in np.flatnonzero(readings["_oodd"]):
                reading = readings["oodd"][i]
                if reading.t == 0:
                    episodes[i].append([])
                episodes[i][-1].append(reading)
    return episodes


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_environments_that_step_together_are_judged_as_each_alone(fitted, mode):
    arguments = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    together = VectorWatchdogWrapper(gymnasium.make_vec("CartPole-v1", 3, **arguments), fitted)
    episodes = vector_episodes(together, 1, 60, push, list)
    for i, several in enumerate(episodes):
        assert len(several) > 3
        alone = WatchdogWrapper(gymnasium.make("CartPole-v1"), fitted.copy())
        expected = single_episodes(alone, 1 + i, len(several) - 1, push)
        assert several[:-1] == expected  # the last one is not over
        assert min(map(len, expected)) > 5


@pytest.fixture(scope="module")
def calm():
    """A watchdog of episodes that do not crash."""
    env, episodes = Falling(), []
    for seed in range(60):
        rows = [env.reset(seed=seed)[0], *(env.step(5)[0] for _ in range(20))]
        episodes.append([gymnasium.spaces.flatten(env.observation_space, row) for row in rows])
        env = Falling()
    return Watchdog.fit("range", episodes[:20], episodes[20:])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_crash_in_the_last_row_is_found_however_environments_start_anew(calm, mode):
    envs = gymnasium.vector.SyncVectorEnv([Falling] * 4, autoreset_mode=mode)
    env = VectorWatchdogWrapper(envs, calm)

    episodes = vector_episodes(env, 1, 30, lambda _: 5, lambda _: range(4))
    for several in episodes:
        crashed, going_on = several
        assert [r.t for r in crashed] == list(range(24))  # 23 steps
        assert [r.t for r in crashed if r.alarm] == [23]
        assert not any(r.alarm for r in going_on)


class Mute(gymnasium.vector.VectorWrapper):
    def step(self, actions):
        *step, info = self.env.step(actions)
        return *step, {k: v for k, v in info.items() if "final" not in k}


def test_the_infos_of_a_step_in_which_an_episode_ends_keep_what_environments_say(calm, fitted):
    envs = gymnasium.vector.SyncVectorEnv(
        [lambda: Falling(0), lambda: Falling(1)], autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = VectorWatchdogWrapper(envs, calm)
    env.reset(seed=3)
    for _ in range(3):
        *_, info = env.step([5, 5])
    assert info["final_info"]["height"].tolist() == [0.0, 0.0]
    assert info["height"].tolist() == [1.0, 1.0]
    assert info["_final_info"].tolist() == info["final_info"]["_oodd"].tolist() == [True, False]
    assert (info["final_info"]["oodd"][0].t, [r.t for r in info["oodd"]]) == (3, [0, 3])
    assert info["_oodd"].all()
    # Environments that keep the last observation to themselves, or how they start anew.
    envs = gymnasium.vector.SyncVectorEnv(
        [lambda: Falling(-2)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = VectorWatchdogWrapper(Mute(envs), calm)
    env.reset(seed=3)
    with pytest.raises(UsageError, match=r"environment 0 .*final_obs.*: use AutoresetMode.NEXT_S"):
        env.step([5, 5])
    env = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync")
    env.metadata = {}
    with pytest.raises(UsageError, match="autoreset_mode=None"):
        VectorWatchdogWrapper(env, fitted)


def test_observations_and_actions_are_rows():
    spaces = gymnasium.spaces
    for action in (6, np.int64(6), np.array([6]), np.array(6.0)):
        assert as_row(spaces.Discrete(2, start=5), action).tolist() == [0, 1]
    assert as_row(spaces.Box(-1, 1, (2, 1)), np.array([[0.5], [1.0]])).tolist() == [0.5, 1.0]
    assert as_row(spaces.MultiDiscrete([2, 3]), np.array([1, 0])).tolist() == [0, 1, 1, 0, 0]
    # float32, the dtype of the space, has no digits for a tenth of a metre of a northing.
    assert as_row(spaces.Box(0, 1e7, (1,)), np.array([5_400_000.1])).tolist() == [5_400_000.1]
    nested = spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Tuple([spaces.MultiBinary(2)])})
    # In the order of the keys as the space has them, which sorts them.
    for mode in (1, np.array([1])):
        assert as_row(nested, {"b": mode, "a": ([1, 0],)}).tolist() == [1, 0, 0, 1]


def test_a_wrapper_flattens_what_is_nested(calm):
    env, alone = WatchdogWrapper(Falling(), calm.copy()), calm.copy()
    observation, info = env.reset(seed=5)
    commanded = None
    for action in (5, 6, 5):
        (x, y), mode = observation["pose"], observation["mode"]
        row = [mode == 0, mode == 1, *x[0], *y[0]]
        assert info["oodd"] == alone.update(row, commanded)
        observation, *_, info = env.step(action)
        commanded = [action == 5, action == 6]


@pytest.mark.parametrize(
    ("part", "named"),
    [
        (gymnasium.spaces.Text(5), "the observation space has Text ['a'][1], which is no fixed"),
        (gymnasium.spaces.Sequence(gymnasium.spaces.Discrete(2)), "has Sequence ['a'][1], which"),
        (gymnasium.spaces.Discrete(2), r"has 3 readings, and the watchdog was fitted on 4 sensors"),
    ],
)
def test_observations_that_are_no_row_of_the_sensors_are_refused_by_name(fitted, part, named):
    env = gymnasium.make("CartPole-v1")
    unit = gymnasium.spaces.Box(0, 1, (1,))
    env.observation_space = gymnasium.spaces.Dict({"a": gymnasium.spaces.Tuple([unit, part])})
    with pytest.raises(UsageError, match=re.escape(named)):
        WatchdogWrapper(env, fitted)


def test_a_terminal_shows_statistic_threshold_and_sensors(fitted):
    watchdog, console = fitted.copy(), Console(file=io.StringIO(), width=80, force_terminal=True)
    with TerminalMonitor("cart", console) as monitor:
        console.print(monitor.picture())
        for i in range(80):
            reading = watchdog.update([1e-4 * i, np.nan, 2e-4 * i, 3e-4 * i], [1, 0])
            monitor.update(reading)
        console.print(monitor.picture())
    shown = console.file.getvalue()
    for text in ("waiting", "cart", "alarm", "cart velocity missing", "100%", "threshold"):
        assert text in shown
    assert f"{reading.threshold:.4g}" in shown


def run_example(name, **given):
    module = types.ModuleType(name.removesuffix(".py"))
    module.__dict__.update(given)
    # Its dataclasses look their module up.
    sys.modules[module.__name__] = module
    text = (ROOT / "examples" / name).read_text()
    exec(compile(text, name, "exec"), module.__dict__)  # noqa: S102
    return module


def test_a_loop_on_a_bus_names_the_topic_with_a_fault(capsys):
    loop = run_example("bus_loop.py")
    for fault, told in (("silent", "missing"), ("stuck", "frozen"), ("nan", "missing")):
        reading = loop.main(["--fault", fault, "--fast", "--steps", "140"])
        assert reading.faults == {"pole angle": told}
        assert (reading.onset, reading.sensor) == (100, "pole angle")
        assert f"pole angle {told}, since row 100" in capsys.readouterr().out
    # Random scores: only the time stamps tell.
    reading = loop.main(["--detector", "random", "--fault", "skipping", "--fast"])
    assert str(reading) == "row 103: alarm, observation irregular"
    assert loop.main(["--fault", "none", "--fast"]) is None
    for arguments in (["--topic", "nope"], ["--detector", "nope"]):
        with pytest.raises(SystemExit) as ended:
            loop.main([*arguments, "--fast"])
        assert ended.value.code == 2
        assert "nope" in capsys.readouterr().err


class BaseCallback:
    """What stable-baselines3 documents of its own: the hooks, and what they may look at."""

    def __init__(self, verbose=0):
        self.verbose, self.locals, self.globals = verbose, {}, {}
        self.num_timesteps, self.n_calls, self.logger = 0, 0, None

    def on_step(self):
        self.n_calls += 1
        return self._on_step()


class Logger:
    def __init__(self):
        self.means = {}

    def record_mean(self, key, value):
        self.means.setdefault(key, []).append(value)


@pytest.fixture
def callbacks(monkeypatch):
    names = ("stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.callbacks")
    for name in names:
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules[names[-1]].BaseCallback = BaseCallback
    return run_example("sb3_callback.py")


def reading(t, alarm):
    return {"oodd": Reading(t, 0.5, 2.0 * alarm, 1.0, alarm, {}, None, {})}


def test_training_logs_alarms_and_ends_at_one_if_asked(callbacks, capsys):
    callback = callbacks.WatchdogCallback(stop=True, verbose=1)
    callback.logger = Logger()
    for alarm in (False, True):
        callback.locals = {"infos": [reading(1, alarm=False), reading(1, alarm=alarm)]}
        assert callback.on_step() != alarm
    assert callback.logger.means == {"oodd/alarms": [0.0, 0.5], "oodd/statistic": [0.0, 1.0]}
    assert capsys.readouterr().out == "environment 1, row 1: alarm\n"
    callback.locals = {"infos": [{}]}
    assert callback.on_step()
    for first in (9, 3, 9):
        for t in range(1, 6):
            callback.on_evaluation({"info": reading(t, alarm=t >= first)}, {})
    callback.on_evaluation({"info": {}}, {})
    assert callback.evaluated == [None, 3, None]
