"""A watchdog around a Gymnasium environment, or around several that step together."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import MissingExtraError, UsageError
from oodd_live.watchdog import Watchdog

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import RecordConstructorArgs
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import iterate
except ImportError as error:
    raise MissingExtraError(f"wrappers need {error.name}: pip install 'oodd-eval[gym]'") from error

KEY: Final = "oodd"
"""The key of a reading in the info of a step."""


class WatchdogWrapper(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """An environment whose ``info["oodd"]`` is the watchdog's `Reading` of each observation.

    Observations and actions are shown to the detector as flat rows, as `gymnasium.spaces.flatten`
    makes them of discrete, Dict and Tuple spaces: what is discrete is one-hot.

    Parameters
    ----------
    env
        The environment; a flat observation has the watchdog's sensors.
    watchdog
        Reset with the environment.

    Raises
    ------
    UsageError
        For observations or actions that are no fixed number of readings, or another number.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], watchdog: Watchdog) -> None:
        _check_spaces(env.observation_space, env.action_space, watchdog)
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, watchdog=watchdog)
        super().__init__(env)
        self.watchdog = watchdog

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a new episode, of the watchdog too."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.watchdog.reset()
        row = as_row(self.env.observation_space, observation)
        return observation, info | {KEY: self.watchdog.update(row)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and judge what was observed."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        row = as_row(self.env.observation_space, observation)
        reading = self.watchdog.update(row, as_row(self.env.action_space, action))
        return observation, reward, terminated, truncated, info | {KEY: reading}


class VectorWatchdogWrapper(gymnasium.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """Environments that step together, each with a copy of the watchdog.

    ``info["oodd"]`` is an array of `Reading`, one for each environment. Where an environment starts
    anew in the step in which an episode ends (``AutoresetMode.SAME_STEP``), it is the reading of
    the first observation of the next episode, and that of the last one, ``info["final_obs"]``, is
    in ``info["final_info"]["oodd"]``.

    Parameters
    ----------
    env
        The environments, however they start anew at the end of an episode.
    watchdog
        Copied for each of them: `watchdogs`.

    Raises
    ------
    UsageError
        As `WatchdogWrapper` does, and for environments that do not say how they start anew.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], watchdog: Watchdog) -> None:
        super().__init__(env)
        _check_spaces(env.single_observation_space, env.single_action_space, watchdog)
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
        reset_mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        mask = np.array(reset_mask, dtype=bool)
        observations, info = self.env.reset(seed=seed, options=options)
        self._over = np.where(mask, False, self._over)
        return observations, info | self._readings(self._rows(observations), None, mask, mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all, and judge what was observed."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        over = np.logical_or(terminated, truncated)
        everywhere, rows = np.ones_like(over), self._rows(observations)
        taken = iterate(self.env.action_space, actions)
        commands = [as_row(self.single_action_space, action) for action in taken]
        if self._mode is AutoresetMode.SAME_STEP:
            # An episode that ends has its last observation apart, behind which the next begins.
            last = [self._final(info, i) if over[i] else row for i, row in enumerate(rows)]
            readings = self._readings(last, commands, ~everywhere, everywhere)
            if over.any():
                final = info.get("final_info", {}) | readings | {f"_{KEY}": over}
                info = info | {"final_info": final, "_final_info": over}
                first = self._readings(rows, None, over, over)[KEY]
                readings[KEY] = np.where(over, first, readings[KEY])
        else:
            # One step behind the end of an episode the next one begins, whatever the action.
            new = self._over & (self._mode is AutoresetMode.NEXT_STEP)
            readings = self._readings(rows, commands, new, everywhere)
        self._over = over
        return observations, rewards, terminated, truncated, info | readings

    def _rows(self, observations: Any) -> list[NDArray[Any]]:
        """Return what each environment observed as a row."""
        each = iterate(self.env.observation_space, observations)
        return [as_row(self.single_observation_space, observation) for observation in each]

    def _final(self, info: dict[str, Any], i: int) -> NDArray[Any]:
        """Return the last observation of an episode that has just ended as a row."""
        final = info.get("final_obs", [None] * self.num_envs)[i]
        if final is None:
            raise UsageError(
                f"environment {i} has ended an episode and started anew in the same step, without "
                "its last observation in info['final_obs']: use AutoresetMode.NEXT_STEP"
            )
        return as_row(self.single_observation_space, final)

    def _readings(
        self,
        rows: list[NDArray[Any]],
        commands: list[NDArray[Any]] | None,
        new: NDArray[np.bool_],
        judged: NDArray[np.bool_],
    ) -> dict[str, Any]:
        """Return the readings of those rows that are judged; an episode begins where it is new."""
        readings = np.empty(self.num_envs, dtype=object)
        for i in np.flatnonzero(judged):
            if new[i]:
                self.watchdogs[i].reset()
            command = None if new[i] or commands is None else commands[i]
            readings[i] = self.watchdogs[i].update(rows[i], command)
        return {KEY: readings, f"_{KEY}": judged}


def as_row(space: gymnasium.Space[Any], value: Any) -> NDArray[Any]:
    """Return an observation or action as detectors see it: flat, one-hot where it is discrete.

    >>> as_row(spaces.Discrete(3), 1).tolist()
    [0, 1, 0]
    """
    if isinstance(space, spaces.Box):
        return np.ravel(value)  # in its dtype, which may have more digits than that of the space
    if isinstance(space, spaces.Discrete):
        value = np.asarray(value).astype(np.int64)
    return np.asarray(spaces.flatten(space, value))


_FIXED: Final = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)


def _check_spaces(
    observations: gymnasium.Space[Any], actions: gymnasium.Space[Any], watchdog: Watchdog
) -> None:
    """Raise `UsageError` unless both spaces are flat rows, and observations of the sensors."""
    for name, space in (("observation", observations), ("action", actions)):
        if unfit := next(_unfit(space), None):
            raise UsageError(
                f"the {name} space has {unfit}, which is no fixed number of readings: leave it out "
                "with a wrapper below this one, such as gymnasium.wrappers.FilterObservation"
            )
    readings, sensors = spaces.flatdim(observations), len(watchdog.sensors)
    if readings != sensors:
        raise UsageError(
            f"a flat observation of {observations} has {readings} readings, and the watchdog "
            f"was fitted on {sensors} sensors: fit it on rows of "
            "gymnasium.spaces.flatten(env.observation_space, observation)"
        )


def _unfit(space: gymnasium.Space[Any], name: str = "") -> Iterator[str]:
    """Yield the parts of a space that cannot be flattened, with their keys."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for key, part in parts:
            yield from _unfit(part, f"{name}[{key!r}]")
    elif not isinstance(space, _FIXED):
        yield f"{type(space).__name__} {name}".rstrip()
