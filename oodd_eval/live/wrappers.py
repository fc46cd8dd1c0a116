"""A watchdog around a Gymnasium environment, or around several that step together."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import MissingExtraError, UsageError
from oodd_eval.live.watchdog import Watchdog

try:
    import gymnasium
    from gymnasium.spaces import Discrete
    from gymnasium.utils import RecordConstructorArgs
    from gymnasium.vector import AutoresetMode
except ImportError as error:
    raise MissingExtraError(f"wrappers need {error.name}: pip install 'oodd-eval[gym]'") from error

KEY: Final = "oodd"
"""The key of a reading in the info of a step."""


class WatchdogWrapper(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """An environment whose ``info["oodd"]`` is the watchdog's `Reading` of each observation.

    A discrete action is shown to the detector as a one-hot row, anything else flat.

    Parameters
    ----------
    env
        The environment; observations are arrays of the watchdog's sensors.
    watchdog
        Reset with the environment.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], watchdog: Watchdog) -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, watchdog=watchdog)
        super().__init__(env)
        self.watchdog = watchdog

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a new episode, of the watchdog too."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.watchdog.reset()
        return observation, info | {KEY: self.watchdog.update(np.ravel(observation))}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and judge what was observed."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        reading = self.watchdog.update(np.ravel(observation), as_row(self.action_space, action))
        return observation, reward, terminated, truncated, info | {KEY: reading}


class VectorWatchdogWrapper(gymnasium.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """Environments that step together, each with a copy of the watchdog.

    ``info["oodd"]`` is an array of `Reading`, one for each environment.

    Parameters
    ----------
    env
        The environments, however they start anew at the end of an episode.
    watchdog
        Copied for each of them: `watchdogs`.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], watchdog: Watchdog) -> None:
        super().__init__(env)
        self.watchdogs = [watchdog.copy() for _ in range(env.num_envs)]
        mode = env.metadata.get("autoreset_mode")
        if not isinstance(mode, AutoresetMode):
            raise UsageError(
                f"the environments' metadata give autoreset_mode={mode!r}: expected a "
                "gymnasium.vector.AutoresetMode, as the watchdogs have to start anew with them"
            )
        self._mode = mode
        self._over: NDArray[np.bool_] = np.zeros(env.num_envs, dtype=bool)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes: of all, or of those in ``options["reset_mask"]``."""
        chosen = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        mask = np.array(chosen, dtype=bool)
        observations, info = self.env.reset(seed=seed, options=options)
        self._over = np.where(mask, False, self._over)
        return observations, self._with_readings(info, observations, None, mask, ~mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all, and judge what was observed."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        over = np.logical_or(terminated, truncated)
        # The observation after the last one of an episode is the first of the next: one step
        # later, or at once.
        new = {AutoresetMode.NEXT_STEP: self._over, AutoresetMode.SAME_STEP: over}.get(
            self._mode, np.zeros(self.num_envs, dtype=bool)
        )
        info = self._with_readings(info, observations, actions, new, np.zeros_like(new))
        self._over = over
        return observations, rewards, terminated, truncated, info

    def _with_readings(
        self,
        info: dict[str, Any],
        observations: Any,
        actions: Any,
        new: NDArray[np.bool_],
        skipped: NDArray[np.bool_],
    ) -> dict[str, Any]:
        readings = np.empty(self.num_envs, dtype=object)
        for i, watchdog in enumerate(self.watchdogs):
            if skipped[i]:
                continue
            if new[i]:
                watchdog.reset()
            began = new[i] or actions is None
            action = None if began else as_row(self.single_action_space, actions[i])
            readings[i] = watchdog.update(np.ravel(observations[i]), action)
        return info | {KEY: readings, f"_{KEY}": ~skipped}


def as_row(space: gymnasium.Space[Any], action: Any) -> NDArray[np.float32]:
    """Return an action as detectors see it: float32 of shape (A,), one-hot where it is discrete.

    >>> as_row(Discrete(3), 1).tolist()
    [0.0, 1.0, 0.0]
    """
    if isinstance(space, Discrete):
        row = np.zeros(int(space.n), dtype=np.float32)
        row[int(action) - int(space.start)] = 1.0
        return row
    return np.ravel(action).astype(np.float32)
