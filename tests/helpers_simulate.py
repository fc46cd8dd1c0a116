"""Controllers that need no file and keep every simulator alive long enough for an onset."""

import numpy as np

from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ENVIRONMENTS

SEEDS = {"acrobot": 1, "cartpole": 1, "lunarlander": 1, "ant": 2, "halfcheetah": 1, "hopper": 0,
         "walker2d": 4}  # fmt: skip
"""Environment seeds whose nominal episodes under `Reflex` have at least 50 transitions."""

_GAIN = {"ant": 0.3, "halfcheetah": 0.3, "hopper": -0.3, "walker2d": -0.3}


class Reflex:
    """A fixed controller that depends on the observation."""

    def __init__(self, environment):
        self.environment = environment
        self.digest = f"reflex-{environment}"
        self._joints = ENVIRONMENTS[environment].action_dim

    def act(self, row):
        match self.environment:
            case "cartpole":
                return int(row[2] + 0.5 * row[3] + 0.05 * row[1] > 0)
            case "acrobot":
                return 0 if row[4] < 0 else 2
            case "lunarlander":
                return int(abs(row[0] * 1000)) % 4
        joints = row[8 : 8 + 2 * self._joints].astype(np.float64)
        push = np.tanh(-joints[::2] - 0.1 * joints[1::2])
        return (_GAIN[self.environment] * push).astype(np.float32)


def record(environment, anomaly, seed, *, policy, episode_cap=None):
    """Record one episode: nominal, or with an anomaly from a random onset on."""
    from oodd_recording.closed_loop import record_seed

    condition = None if anomaly is None else Condition(anomaly)
    options = {"policy": policy, "episode_cap": episode_cap}
    conditions = [condition] if condition else []
    return record_seed(environment, seed, conditions, **options)[condition]
