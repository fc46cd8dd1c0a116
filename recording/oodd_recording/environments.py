"""Fresh simulators of registered environments."""

from typing import Any

import numpy as np

from oodd_eval.data.registry import EnvironmentSpec, environment_spec
from oodd_recording.simulator import Simulator


class Custom(Simulator):
    """A plug-in's environment; wind adds to every command of continuous actions."""

    def __init__(self, env: Any, spec: EnvironmentSpec) -> None:
        super().__init__(env)
        self._attributes = spec.attributes

    def command(self, action: Any) -> Any:
        """Return what the environment is given for an action in the present wind."""
        if not self.wind:
            return action
        box = self.env.action_space
        pushed = action + np.float32(self.wind) * (box.high - box.low) / 2
        return np.clip(pushed, box.low, box.high)

    def set(self, attribute: str, value: float) -> None:
        self._attributes[attribute].set(self.env, value)

    def get(self, attribute: str) -> float:
        return float(self._attributes[attribute].get(self.env))


def make(environment: str) -> Simulator:
    """Return a fresh simulator of an environment, to be used for one episode and closed."""
    spec = environment_spec(environment)
    env = spec.make()
    simulator = env if isinstance(env, Simulator) else Custom(env, spec)
    simulator.environment = environment
    return simulator
