"""Recording: a trajectory is a pure function of environment, anomaly, seed, cap and policy.

Every episode runs in a fresh simulator. The anomalous episode of a seed replays its nominal twin's
actions up to the onset, which the policy would choose anyway, since the observations are the same.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.simulate.anomalies import Draw, draw
from oodd_eval.data.simulate.environments import check_observation, make
from oodd_eval.data.simulate.policies import Policy
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import SimulationError, UnknownNameError

GENERATOR_VERSION: Final = 1
"""Raised by every change that gives other bytes for the same seed."""

FIRST_ONSET: Final = 30
LAST_ONSET_SHARE: Final = 0.6
SHORTEST_TWIN: Final = 50
SHORTEST_TAIL: Final = 5
"""An anomalous episode has more than this many transitions beyond the onset."""

MAX_REDRAWS: Final = 100


class TwinTooShortError(SimulationError):
    """A nominal episode of under 50 transitions: it gives way to the next seed."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One recorded episode with everything the harness knows about it.

    Attributes
    ----------
    trajectory
        What a detector will see.
    rewards : float32 array of shape (T,)
    terminated
        Whether the simulator ended the episode, rather than the cap.
    seed
        Environment seed.
    onset
        Index of the first observation that may differ from the twin's; None when nominal.
    parameters
        What the anomaly drew.
    redraws
        How many draws were rejected before this one.
    """

    trajectory: Trajectory
    rewards: NDArray[np.float32]
    terminated: bool
    seed: int
    onset: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    redraws: int = 0


def record_seed(
    environment: str,
    seed: int,
    anomalies: Iterable[str],
    *,
    policy: Policy,
    episode_cap: int | None = None,
) -> dict[str | None, Episode]:
    """Record the nominal twin of a seed (key None) and one episode per anomaly.

    Raises
    ------
    TwinTooShortError
        When anomalies are asked for and the twin has under 50 transitions.
    SimulationError
        When 100 redraws gave no acceptable anomalous episode.
    UnknownNameError
        For unknown environments and anomalies.
    """
    names = list(anomalies)
    for name in names:
        if name not in ANOMALIES:
            raise UnknownNameError("anomaly", name, ANOMALIES)
    twin = record_nominal(environment, seed, policy=policy, episode_cap=episode_cap)
    if names and twin.trajectory.transitions < SHORTEST_TWIN:
        raise TwinTooShortError(
            f"the nominal episode of {environment} with seed {seed} has "
            f"{twin.trajectory.transitions} transitions, expected at least {SHORTEST_TWIN} so that "
            "an onset fits: use the next seed"
        )
    episodes: dict[str | None, Episode] = {None: twin}
    for name in names:
        episodes[name] = _record_anomalous(environment, name, twin, policy, episode_cap)
    return episodes


def record(
    environment: str,
    anomaly: str | None,
    seed: int,
    *,
    policy: Policy,
    episode_cap: int | None = None,
) -> Episode:
    """Record one episode: nominal, or with an anomaly from a random onset on.

    Raises what `record_seed` raises.
    """
    names = [] if anomaly is None else [anomaly]
    return record_seed(environment, seed, names, policy=policy, episode_cap=episode_cap)[anomaly]


def record_nominal(
    environment: str, seed: int, *, policy: Policy, episode_cap: int | None = None
) -> Episode:
    """Record the nominal episode of a seed, a whole number from 0."""
    if seed < 0:
        raise SimulationError(f"seed is {seed}, expected a whole number from 0")
    rows, actions, rewards, over = _run(environment, seed, policy, episode_cap)
    return Episode(_trajectory(environment, rows, actions), rewards, over, seed)


def generator(environment: str, anomaly: str, seed: int, attempt: int) -> np.random.Generator:
    """Return the anomaly's own generator for one attempt at one trajectory."""
    names = (zlib.crc32(environment.encode()), zlib.crc32(anomaly.encode()))
    return np.random.default_rng([GENERATOR_VERSION, *names, seed, attempt])


def _record_anomalous(
    environment: str, anomaly: str, twin: Episode, policy: Policy, episode_cap: int | None
) -> Episode:
    rows = twin.trajectory.observations
    last = int(LAST_ONSET_SHARE * twin.trajectory.transitions)
    for attempt in range(MAX_REDRAWS + 1):
        rng = generator(environment, anomaly, twin.seed, attempt)
        onset = int(rng.integers(FIRST_ONSET, last + 1))
        found, actions, rewards, over, drawn = _run_anomalous(
            environment, anomaly, twin, onset, policy, episode_cap, rng
        )
        same = found.shape == rows.shape and np.array_equal(found, rows)
        if not same and len(rewards) > onset + SHORTEST_TAIL:
            trajectory = _trajectory(environment, found, actions)
            return Episode(
                trajectory, rewards, over, twin.seed, onset, drawn.parameters, redraws=attempt
            )
    raise SimulationError(
        f"no acceptable {anomaly} episode of {environment} with seed {twin.seed} in "
        f"{MAX_REDRAWS} redraws: each equalled its twin or ended within {SHORTEST_TAIL} steps of "
        "its onset; check that the policy is the one the split names"
    )


Recorded = tuple[NDArray[np.float32], list[Any], NDArray[np.float32], bool]


def _run(environment: str, seed: int, policy: Policy, episode_cap: int | None) -> Recorded:
    simulator = make(environment)
    try:
        row = simulator.reset(seed)
        check_observation(environment, row)
        rows, over = [row], False
        actions: list[Any] = []
        rewards: list[float] = []
        while not over and len(rewards) < _cap(environment, episode_cap):
            actions.append(policy.act(rows[-1]))
            row, reward, over = simulator.step(actions[-1])
            rows.append(row)
            rewards.append(reward)
    finally:
        simulator.close()
    return np.array(rows, np.float32), actions, np.array(rewards, np.float32), over


def _run_anomalous(
    environment: str,
    anomaly: str,
    twin: Episode,
    onset: int,
    policy: Policy,
    episode_cap: int | None,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], list[Any], NDArray[np.float32], bool, Draw]:
    simulator = make(environment)
    try:
        rows = [simulator.reset(twin.seed)]
        actions, rewards, over = _commands(environment, twin.trajectory)[: onset - 1], [], False
        for action in actions:
            row, reward, over = simulator.step(action)
            rows.append(row)
            rewards.append(reward)
        # Before the transition onto the onset: its action is still the twin's.
        drawn = draw(environment, anomaly, simulator, rng)
        while not over and len(rewards) < _cap(environment, episode_cap):
            actions.append(policy.act(rows[-1]))
            drawn.apply(simulator, rng, first=len(rows) == onset)
            row, reward, over = simulator.step(actions[-1])
            rows.append(drawn.corrupt(row, len(rows), rng))
            rewards.append(reward)
    finally:
        simulator.close()
    return np.array(rows, np.float32), actions, np.array(rewards, np.float32), over, drawn


def _cap(environment: str, episode_cap: int | None) -> int:
    longest = ENVIRONMENTS[environment].episode_cap
    return longest if episode_cap is None else min(longest, episode_cap)


def _trajectory(environment: str, rows: NDArray[np.float32], actions: list[Any]) -> Trajectory:
    info = ENVIRONMENTS[environment]
    if not info.discrete:
        return Trajectory(rows, np.array(actions, np.float32))
    return Trajectory(rows, np.eye(info.action_dim, dtype=np.float32)[actions])


def _commands(environment: str, trajectory: Trajectory) -> list[Any]:
    """Return the actions as the simulator takes them."""
    if ENVIRONMENTS[environment].discrete:
        return [int(a) for a in trajectory.actions.argmax(axis=1)]
    return list(trajectory.actions)
