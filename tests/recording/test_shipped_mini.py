"""The shipped split keeps the protocol's promises, and stock simulators give its bytes again."""

import contextlib
import zlib

import numpy as np
import pytest

pytest.importorskip("gymnasium")
from gymnasium.envs.box2d import lunar_lander
from gymnasium.envs.classic_control.acrobot import AcrobotEnv
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from oodd_recording.anomalies import VALUES
from oodd_recording.closed_loop import record_seed
from oodd_recording.policies import load_policy
from pybullet_envs_gymnasium import gym_locomotion_envs

from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS, TABLE1
from oodd_eval.data.split import SHIPPED, load_split

SENSOR = [a for a in TABLE1 if ANOMALIES[a].group == "sensor"]


AGAIN = [(e, TABLE1[(i + 4 * k) % 8]) for i, e in enumerate(ENVIRONMENTS) for k in range(2)]
"""Two anomalies of each environment; stock simulators give 24 others again."""


@pytest.fixture
def data(environment):
    with contextlib.closing(load_split("mini").environment(environment)) as opened:
        yield opened


def test_it_is_the_published_one_and_at_most_25_mb():
    split, definition = load_split("mini"), SPLITS["mini"]
    assert split.name == "mini"
    assert (definition.train, definition.calibration, definition.test) == (40, 40, 10)
    assert split.manifest["definition"]["seed_base"] == definition.seed_base
    assert sum(f.stat().st_size for f in (SHIPPED / "mini").iterdir()) <= 25e6
    entries = split.manifest["environments"]
    policies = {e: load_policy(e).digest for e in ENVIRONMENTS}
    assert {e: entry["policy"] for e, entry in entries.items()} == policies


@pytest.mark.parametrize(("environment", "anomaly"), AGAIN)
def test_recording_gives_the_shipped_episodes_again(data, anomaly):
    """Each anomaly alone, though the split's were recorded one after another on one twin."""
    info = ENVIRONMENTS[data.id]
    assert (data.sensors, data.actions) == (info.sensors, info.actions)
    part, i, condition = data.anomalous(anomaly), len(data.twins) - 1, Condition(anomaly)
    recorded = record_seed(
        data.id, int(part.seeds[i]), [condition],
        policy=load_policy(data.id), episode_cap=SPLITS["mini"].episode_cap,
    )  # fmt: skip
    for episode, stored in ((recorded[None], data.twins), (recorded[condition], part)):
        x = stored[i]
        assert episode.trajectory.observations.tobytes() == x.observations.tobytes()
        assert episode.trajectory.actions.tobytes() == x.actions.tobytes()
        assert episode.rewards.tobytes() == stored.rewards(i).tobytes()
        assert episode.terminated == stored.terminated[i]
    e = recorded[condition]
    assert (e.onset, e.effect, e.redraws) == (part.onsets[i], part.effects[i], part.redraws[i])
    assert e.parameters == part.parameters[i]


# Stock simulators, driven by nothing but what the split stores

CASES = [
    ("acrobot", "iid"), ("acrobot", "wind-l2r"), ("acrobot", "components"),
    ("cartpole", "calibration"), ("cartpole", "wind-r2l"), ("cartpole", "gravity"),
    ("lunarlander", "drift"), ("lunarlander", "wind-l2r"), ("lunarlander", "components"),
    ("lunarlander", "gravity"), ("lunarlander", "wind-r2l"), ("acrobot", "wind-r2l"),
    ("ant", "shutdown"), ("ant", "wind-r2l"), ("ant", "gravity"),
    ("halfcheetah", "iid"), ("halfcheetah", "wind-l2r"), ("halfcheetah", "components"),
    ("hopper", "calibration"), ("hopper", "wind-l2r"), ("hopper", "gravity"),
    ("walker2d", "drift"), ("walker2d", "wind-r2l"), ("walker2d", "components"),
]  # fmt: skip


class Stock:
    """A simulator as its authors ship it, with the changes of an anomaly made by hand."""

    def __init__(self, environment, monkeypatch):
        classic = {"acrobot": AcrobotEnv, "cartpole": CartPoleEnv,
                   "lunarlander": lunar_lander.LunarLander}  # fmt: skip
        robot = f"{ENVIRONMENTS[environment].title}BulletEnv"
        self.kind, self.patch = environment, monkeypatch
        self.env = (classic.get(environment) or getattr(gym_locomotion_envs, robot))()

    def change(self, name, value):
        env, kind = self.env, self.kind
        if kind == "acrobot":
            what, number = name.split("_")[1:]
            setattr(env, f"LINK_{what.upper()}_{number}", value)
            if what == "length":
                setattr(env, f"LINK_COM_POS_{number}", value / 2)
        elif kind == "cartpole":
            stock = {"gravity": "gravity", "pole_length": "length", "pole_mass": "masspole"}
            setattr(env, stock[name], value)
            env.total_mass = env.masspole + env.masscart
            env.polemass_length = env.masspole * env.length
        elif kind == "lunarlander" and name == "gravity":
            env.world.gravity = (0, -value)
        elif kind == "lunarlander":
            self.patch.setattr(lunar_lander, name.upper(), value)
        elif name == "gravity":
            env._p.setGravity(0, 0, -value)
        else:
            env.robot.power = value

    def step(self, action, wind):
        """Step with wind blowing (-1, 0, 1)."""
        env, kind = self.env, self.kind
        if kind == "acrobot":
            push = action - 1
            torque = push if not wind else 2 * push if push == wind else 0
            env.AVAIL_TORQUE = [torque] * 3
        elif kind == "cartpole":
            pushes = 1 if action == 1 else -1
            env.force_mag = {pushes: 20.0, -pushes: 0.0}.get(wind, 10.0)
        elif kind == "lunarlander":
            pushes = {1: -1, 3: 1}.get(action, 0)
            power = 1.2 if wind and pushes == wind else 0.6
            if wind:
                action = 0 if pushes == -wind else action
                self.patch.setattr(lunar_lander, "SIDE_ENGINE_POWER", power)
        elif wind:
            action = np.clip(action + np.float32(wind * 0.33), -1, 1)
        row = np.asarray(env.step(action)[0], np.float32)
        if kind == "lunarlander" and wind:
            self.patch.setattr(lunar_lander, "SIDE_ENGINE_POWER", 0.6)
        return row


def corrupted(anomaly, row, t, parameters, rng):
    chosen, row = parameters["sensors"], row.copy()
    true = row[chosen].astype(float)
    row[chosen] = {
        "iid": lambda: true + rng.normal(parameters["mean"], parameters["std"], len(chosen)),
        "shutdown": lambda: 0 * true,
        "calibration": lambda: true * parameters["factor"],
        "drift": lambda: true + parameters["slope"] * t,
    }[anomaly]()
    return row


@pytest.mark.parametrize(("environment", "anomaly"), CASES)
def test_stock_simulators_give_the_same_bits_again(environment, anomaly, monkeypatch):
    data, info = load_split("mini").environment(environment), ENVIRONMENTS[environment]
    part, policy = data.anomalous(anomaly), load_policy(environment)
    i = int(part.redraws.argmin())
    onset, parameters, seed = int(part.onsets[i]), part.parameters[i], int(part.seeds[i])
    # The anomaly's own stream of random numbers: first the onset, then what it draws.
    names = [zlib.crc32(name.encode()) for name in (environment, anomaly)]
    rng = np.random.default_rng([2, *names, seed, int(part.redraws[i])])
    assert rng.integers(30, int(0.6 * data.twins.lengths[i]) + 1) == onset
    if anomaly in SENSOR:
        listed, count = VALUES["sensors"][environment], len(parameters["sensors"])
        assert sorted(rng.choice(listed, count, replace=False)) == parameters["sensors"]
    stock, x = Stock(environment, monkeypatch), part[i]
    rows = [np.asarray(stock.env.reset(seed=seed)[0], np.float32)]
    for t, stored in enumerate(x.actions, start=1):
        action = policy.act(x.observations[t - 1])
        assert (np.eye(info.action_dim)[action] if info.discrete else action).tolist() == (
            stored.tolist()
        ), f"the policy acts on what is stored, row {t - 1}"
        wind = parameters.get("direction", 0) if t >= onset else 0
        if wind and info.discrete and rng.random() >= parameters["probability"]:
            wind = 0
        if t == onset and anomaly in {"gravity", "components"}:
            for name, value in parameters.items():
                stock.change(name, value)
        row = stock.step(action, wind)
        if t >= onset and anomaly in SENSOR:
            row = corrupted(anomaly, row, t, parameters, rng)
        rows.append(row)
    stock.env.close()
    data.close()
    assert np.array_equal(np.array(rows), x.observations)
