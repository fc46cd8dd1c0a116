"""A plug-in with environments and kinds of anomalies of its own, which needs no simulator."""

import sys

from oodd_eval.data import registry
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS


def forget_own():
    """Forget environments and anomalies that were registered: another test has others."""
    known_by_module = [registry._environments, registry._anomalies]
    if "oodd_recording.info" in sys.modules:
        info = sys.modules["oodd_recording.info"]
        known_by_module += [info._infos, info.MEASURED]
    for known in known_by_module:
        for name in [n for n in known if n not in {*ENVIRONMENTS, *ANOMALIES}]:
            del known[name]


TANK = '''
import gymnasium
import numpy as np
from oodd_eval import AnomalySpec, Attribute, EnvironmentSpec, Quantity, hookimpl


class Tank(gymnasium.Env):
    """Two tanks of water in a row; a pump fills the first, and the level wobbles."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    outflow, viscosity = 0.2, 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = self.np_random.uniform(0.8, 1.2, 2)
        return self._row(0.0), {}

    def step(self, action):
        flow = self.outflow / self.viscosity * self.level
        self.level = self.level + 0.1 * np.array(
            [1 + float(action[0]) - flow[0], flow[0] - flow[1]]
        ) + 0.01 * self.np_random.normal(size=2)
        return self._row(flow[1]), -abs(float(self.level[1]) - 2.0), False, False, {}

    def _row(self, flow):
        return np.array([*self.level, flow], np.float32)


class Valve(Tank):
    """The same with two commands: closed, open."""

    action_space = gymnasium.spaces.Discrete(2)

    def step(self, action):
        return super().step([2.0 * action - 1.0])


def proportional():
    return lambda row: [np.clip(2.0 - row[1], -1, 1)]


def bang():
    return lambda row: row[1] < 2.0


def get_viscosity(env):
    return env.viscosity


def set_viscosity(env, value):
    env.viscosity = value


def leak(strength, rng, simulator):
    from oodd_recording.faults import Fault

    class Leak(Fault):
        def command(self, action, simulator):
            simulator.env.outflow = 0.2 * (1 + strength)
            return action

    return Leak({})


SENSORS = tuple(Quantity(n, u) for n, u in (("upper", "m"), ("lower", "m"), ("outflow", "l/s")))
FRICTION = {"friction": Attribute(get_viscosity, set_viscosity)}


@hookimpl
def oodd_environments():
    valve = Quantity("close", "1"), Quantity("open", "1")
    return [
        EnvironmentSpec("tank", Tank, proportional, SENSORS, (Quantity("pump", "1"),), 90,
                        attributes=FRICTION),
        EnvironmentSpec("valve", Valve, bang, SENSORS, valve, 90),
    ]


@hookimpl
def oodd_anomalies():
    return [AnomalySpec("leak", "dynamics", "water leaves faster", "share of the flow", 3.0, leak)]
'''
