"""A plug-in with environments and kinds of anomalies of its own, which needs no simulator."""

import sys

from oodd_eval.data import registry
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS


def forget_own():
    """Forget environments and anomalies that were registered: another test has others."""
    known_by_module = [registry._environments, registry._anomalies]
    if "oodd_recording.registered" in sys.modules:
        info = sys.modules["oodd_recording.registered"]
        known_by_module += [info._infos, info.MEASURED]
    for known in known_by_module:
        for name in [n for n in known if n not in {*ENVIRONMENTS, *ANOMALIES}]:
            del known[name]


BASIN = '''
import gymnasium
import numpy as np
from oodd_eval import AnomalySpec, Attribute, EnvironmentSpec, Quantity, hookimpl


class Basin(gymnasium.Env):
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


class Valve(Basin):
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


def seep(strength, rng, simulator):
    from oodd_recording.faults import Fault

    class Seep(Fault):
        def command(self, action, simulator):
            simulator.env.outflow = 0.2 * (1 + strength)
            return action

    return Seep({})


SENSORS = tuple(Quantity(n, u) for n, u in (("upper", "m"), ("lower", "m"), ("outflow", "l/s")))
FRICTION = {"friction": Attribute(get_viscosity, set_viscosity)}


@hookimpl
def oodd_environments():
    valve = Quantity("close", "1"), Quantity("open", "1")
    return [
        EnvironmentSpec("basin", Basin, proportional, SENSORS, (Quantity("pump", "1"),), 90,
                        attributes=FRICTION),
        EnvironmentSpec("valve", Valve, bang, SENSORS, valve, 90),
    ]


@hookimpl
def oodd_anomalies():
    return [AnomalySpec("seep", "dynamics", "water leaves faster", "share of the flow", 3.0, seep)]
'''


CISTERN = '''
import gymnasium
import numpy as np
from oodd_eval import AnomalySpec, EnvironmentSpec, Fault, Quantity, hookimpl
from oodd_recording.faults import SensorFault

ROWS = 120


class Cistern(gymnasium.Env):
    """A level that a pump of 0 to 8 V raises and an outlet lowers, and a set point that moves."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    action_space = gymnasium.spaces.Box(0.0, 8.0, (1,))
    gain, inflow, volts = 0.1, 0.0, 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level, self.goal = self.np_random.uniform(0.8, 1.2), 1.0
        return self._row(), {}

    def step(self, action):
        self.volts = float(action[0])
        self.level += 0.2 * (self.gain * self.volts + self.inflow - 0.3 * self.level)
        if self.np_random.random() < 0.03:
            self.goal = self.np_random.uniform(0.8, 1.4)
        return self._row(), max(0.0, 1.0 - abs(self.level - self.goal)), False, False, {}

    def _row(self):
        return np.array([self.level, self.gain * self.volts, self.goal], np.float32)


class Integral:
    """A controller with memory, in steps of 1/1024 V, which float32 holds in any range."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.sum = 0.0

    def act(self, row):
        error = float(row[2]) - float(row[0])
        self.sum += 0.2 * error
        return [np.round(min(max(3.0 + 4.0 * error + self.sum, 0.0), 8.0) * 1024) / 1024]


def clog(strength, rng, simulator):
    """Wear: the pump loses a share of its gain."""
    class Clog(Fault):
        def command(self, action, simulator):
            simulator.env.gain = 0.1 * (1 - self.share * strength)
            return action

    return Clog({})


def surge(strength, rng, simulator):
    """More water comes in for a while."""
    class Surge(Fault):
        def begin(self, simulator, rows):
            simulator.env.inflow = strength

        def end(self, simulator):
            simulator.env.inflow = 0.0

    return Surge({})


def offset(strength, rng, simulator):
    """The level is measured too high."""
    return SensorFault(np.array([0]), lambda x, _: x + strength)


SENSORS = (Quantity("level", "m", noise=0.01), Quantity("flow", "m/s", noise=0.002),
           Quantity("goal", "m", "reference"))


@hookimpl
def oodd_environments():
    return [EnvironmentSpec("cistern", Cistern, Integral, SENSORS, (Quantity("pump", "V"),), ROWS,
                            task="loss", packages=("click",))]


@hookimpl
def oodd_anomalies():
    where = ("cistern",)
    return [
        AnomalySpec("clog", "dynamics", "a pump wears", "share of it", 0.9, clog, where, ramp=20),
        AnomalySpec("surge", "dynamics", "a surge", "m/s", 0.4, surge, where, lasts=15,
                    ),
        AnomalySpec("offset", "sensor", "the level is off", "m", 0.5, offset, where,
                    intermittent=True),
    ]
'''
