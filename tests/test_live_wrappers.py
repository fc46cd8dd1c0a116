"""A watchdog around Gymnasium's environments, in a terminal, and in the README."""

import contextlib
import io
import re
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from oodd_eval import load_split
from oodd_eval.errors import UsageError
from oodd_eval.live import Reading, TerminalMonitor, Watchdog

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from oodd_eval.live import VectorWatchdogWrapper, WatchdogWrapper  # noqa: E402
from oodd_eval.live.wrappers import as_row  # noqa: E402

ROOT = Path(__file__).parents[1]


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


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_environments_that_step_together_have_a_watchdog_each(fitted, mode):
    env = VectorWatchdogWrapper(
        gymnasium.make_vec(
            "CartPole-v1", 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
        ),
        fitted,
    )
    rng = np.random.default_rng(0)
    alone, over = [fitted.copy() for _ in range(3)], np.zeros(3, bool)
    observations, info = env.reset(seed=1)
    readings = [w.update(o) for w, o in zip(alone, observations, strict=True)]
    assert info["oodd"].tolist() == readings
    began = 0
    for _ in range(60):
        actions = rng.integers(0, 2, 3)
        observations, _, terminated, truncated, info = env.step(actions)
        before, over = over, terminated | truncated
        new = {AutoresetMode.NEXT_STEP: before, AutoresetMode.SAME_STEP: over}.get(
            mode, over & ~over
        )
        for i, watchdog in enumerate(alone):
            if new[i]:
                watchdog.reset()
                began += 1
            action = None if new[i] else np.eye(2)[actions[i]]
            assert info["oodd"][i] == watchdog.update(observations[i], action)
        if mode is AutoresetMode.DISABLED and over.any():
            observations, info = env.reset(options={"reset_mask": over})
            assert info["_oodd"].tolist() == over.tolist()
            for i in np.flatnonzero(over):
                alone[i].reset()
                began += 1
                assert info["oodd"][i] == alone[i].update(observations[i])
    assert began > 3


def test_environments_that_do_not_say_how_they_start_anew_are_refused(fitted):
    env = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync")
    env.metadata = {}
    with pytest.raises(UsageError, match="autoreset_mode=None"):
        VectorWatchdogWrapper(env, fitted)


def test_actions_are_rows():
    spaces = gymnasium.spaces
    assert as_row(spaces.Discrete(2, start=5), 6).tolist() == [0, 1]
    assert as_row(spaces.Box(-1, 1, (2, 1)), np.array([[0.5], [1.0]])).tolist() == [0.5, 1.0]


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


def example(name):
    return (ROOT / "examples" / name).read_text()


def run_example(name, **given):
    module = types.ModuleType(name.removesuffix(".py"))
    module.__dict__.update(given)
    # Its dataclasses look their module up.
    sys.modules[module.__name__] = module
    exec(compile(example(name), name, "exec"), module.__dict__)  # noqa: S102
    return module


@pytest.mark.parametrize(
    ("fault", "told"), [("silent", "missing"), ("stuck", "frozen"), ("nan", "missing")]
)
def test_a_loop_on_a_bus_names_the_topic_with_a_fault(fault, told, monkeypatch, capsys):
    loop = run_example("bus_loop.py")
    reading = loop.main(["--fault", fault, "--fast", "--steps", "140"])
    assert reading.faults == {"pole angle": told}
    assert (reading.onset, reading.sensor) == (100, "pole angle")
    assert f"pole angle {told}, since row 100" in capsys.readouterr().out


def test_a_loop_that_skips_messages_is_found():
    loop = run_example("bus_loop.py")
    # Random scores: only the time stamps tell.
    reading = loop.main(["--detector", "random", "--fault", "skipping", "--fast"])
    assert str(reading) == "row 103: alarm, observation irregular"


def test_a_loop_on_a_bus_is_quiet_without_a_fault():
    assert run_example("bus_loop.py").main(["--fault", "none", "--fast"]) is None


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


def test_evaluation_keeps_the_first_alarm_of_each_episode(callbacks):
    callback = callbacks.WatchdogCallback()
    for first in (9, 3, 9):
        for t in range(1, 6):
            callback.on_evaluation({"info": reading(t, alarm=t >= first)}, {})
    callback.on_evaluation({"info": {}}, {})
    assert callback.evaluated == [None, 3, None]


@pytest.mark.docs
def test_the_snippet_of_the_readme_prints_what_it_says():
    (snippet,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(snippet.splitlines()) <= 12
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(snippet, "README.md", "exec"), {})  # noqa: S102
    said = re.search(r"print\(info\[\"oodd\"\]\)  # (row \d+: alarm, [a-z ]+) \d+%", snippet)[1]
    assert printed.getvalue().startswith(said)
