"""Recording: a trajectory is a pure function of environment, anomaly, seed, cap and policy.

The anomalous episode of a seed replays its nominal twin's actions up to the onset, which the policy
would choose anyway, since the observations are the same. An episode that equals its twin, or ends
soon after its onset, is drawn again: onset and parameters.
"""

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.simulate.anomalies import draw
from oodd_eval.data.simulate.environments import make
from oodd_eval.data.simulate.policies import Policy
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import SimulationError
from oodd_eval.names import check_known

_Rows = NDArray[np.float32]

GENERATOR_VERSION: Final = 2  # raised by every change that gives other bytes for the same seed

FIRST_ONSET: Final = 30
LAST_ONSET_SHARE: Final = 0.6
SHORTEST_TWIN: Final = 50
SHORTEST_TAIL: Final = 20
"""An anomalous episode has more than this many transitions beyond the onset, if any draw does."""

MAX_REDRAWS: Final = 100
EVALUATION_SEED: Final = 900_000_000  # outside every split and training


class TwinTooShortError(SimulationError):
    """A nominal episode of under 50 transitions: it gives way to the next seed."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One recorded episode; `terminated` is True when the simulator, not the cap, ended it.

    `onset` is the index of the first observation that may differ from the twin's, `effect` of the
    first that does, both None when nominal; `parameters` are what the anomaly drew, `redraws`
    counts rejected draws.
    """

    trajectory: Trajectory
    rewards: NDArray[np.float32]
    terminated: bool
    seed: int
    onset: int | None = None
    effect: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    redraws: int = 0


def record_seed(
    environment: str, seed: int, anomalies: Iterable[str], *, policy: Policy,
    episode_cap: int | None = None,
) -> dict[str | None, Episode]:  # fmt: skip
    """Record the nominal twin of a seed (key None) and one episode per anomaly.

    Raises `TwinTooShortError` when an onset would not fit, `SimulationError` when an anomaly
    changes nothing in 100 redraws.
    """
    names = list(anomalies)
    check_known("anomaly", ANOMALIES, *names)
    twin = record_nominal(environment, seed, policy=policy, episode_cap=episode_cap)
    if names and twin.trajectory.transitions < SHORTEST_TWIN:
        raise TwinTooShortError(
            f"the nominal episode of {environment} with seed {seed} has "
            f"{twin.trajectory.transitions} transitions, expected at least {SHORTEST_TWIN}"
        )
    episodes: dict[str | None, Episode] = {None: twin}
    episodes |= {n: _record_anomalous(environment, n, twin, policy, episode_cap) for n in names}
    return episodes


def record_nominal(
    environment: str, seed: int, *, policy: Policy, episode_cap: int | None = None
) -> Episode:
    """Record the nominal episode of a seed, a whole number from 0."""
    if seed < 0:
        raise SimulationError(f"seed is {seed}, expected a whole number from 0")
    rows, actions, rewards, over, _ = _run(environment, seed, policy, episode_cap)
    return Episode(Trajectory(rows, actions), rewards, over, seed)


def evaluate_policy(
    environment: str, policy: Policy, *, episodes: int = 100, seed: int = EVALUATION_SEED
) -> NDArray[np.float64]:
    """Return the returns of nominal episodes, a fresh simulator each, seeds ``seed + i``."""
    recorded = (record_nominal(environment, seed + i, policy=policy) for i in range(episodes))
    return np.array([float(episode.rewards.sum(dtype=np.float64)) for episode in recorded])


def generator(environment: str, anomaly: str, seed: int, attempt: int) -> np.random.Generator:
    """Return the anomaly's own generator for one attempt at one trajectory."""
    names = (zlib.crc32(environment.encode()), zlib.crc32(anomaly.encode()))
    return np.random.default_rng([GENERATOR_VERSION, *names, seed, attempt])


def _record_anomalous(
    environment: str, anomaly: str, twin: Episode, policy: Policy, episode_cap: int | None
) -> Episode:
    commands = list(twin.trajectory.actions)
    if ENVIRONMENTS[environment].discrete:
        commands = [int(row.argmax()) for row in commands]
    last = int(LAST_ONSET_SHARE * len(commands))
    longest: Episode | None = None
    tail = -1
    for attempt in range(MAX_REDRAWS + 1):
        rng = generator(environment, anomaly, twin.seed, attempt)
        onset = int(rng.integers(FIRST_ONSET, last + 1))
        given = (commands[: onset - 1], (anomaly, rng))
        rows, actions, rewards, over, parameters = _run(
            environment, twin.seed, policy, episode_cap, *given
        )
        effect = first_difference(rows, twin.trajectory.observations)
        if effect is None or len(rewards) - onset <= tail:
            continue
        tail, drawn = len(rewards) - onset, (onset, effect, parameters, attempt)
        longest = Episode(Trajectory(rows, actions), rewards, over, twin.seed, *drawn)
        if tail > SHORTEST_TAIL:
            return longest
    if longest is None:
        raise SimulationError(
            f"no {anomaly} episode of {environment} with seed {twin.seed} differs from its twin in "
            f"{MAX_REDRAWS} redraws, expected one: the policy or the simulator ignores the anomaly"
        )
    return replace(longest, redraws=MAX_REDRAWS)


def first_difference(rows: _Rows, twin: _Rows) -> int | None:
    """Return the index of the first row that differs from the twin's; None without such a row."""
    common = min(len(rows), len(twin))
    differs = (rows[:common] != twin[:common]).any(axis=1)
    return int(differs.argmax()) if differs.any() else None


def _run(
    environment: str, seed: int, policy: Policy, episode_cap: int | None,
    replayed: Sequence[Any] = (), anomaly: tuple[str, np.random.Generator] | None = None,
) -> tuple[_Rows, _Rows, _Rows, bool, dict[str, Any]]:  # fmt: skip
    """Run an episode: replayed actions first, then the policy, under an anomaly if there is one."""
    simulator, drawn, info = make(environment), None, ENVIRONMENTS[environment]
    cap = info.episode_cap if episode_cap is None else min(info.episode_cap, episode_cap)
    actions: list[Any] = []
    rewards: list[float] = []
    over = False
    try:
        rows = [simulator.reset(seed)]
        if rows[0].shape != (info.observation_dim,):
            raise SimulationError(
                f"{environment}'s simulator gave an observation of shape {rows[0].shape}, expected "
                f"({info.observation_dim},): install the version that oodd-eval[sim] names"
            )
        while not over and (step := len(rewards)) < cap:
            if anomaly is not None and step == len(replayed):
                drawn, rng = draw(environment, anomaly[0], simulator, anomaly[1]), anomaly[1]
            actions.append(replayed[step] if step < len(replayed) else policy.act(rows[-1]))
            if drawn is not None:
                drawn.apply(simulator, rng, first=step == len(replayed))
            row, reward, over = simulator.step(actions[-1])
            rows.append(row if drawn is None else drawn.corrupt(row, len(rows), rng))
            rewards.append(reward)
    finally:
        simulator.close()
    one_hot = np.eye(info.action_dim, dtype=np.float32)
    commands = one_hot[actions] if info.discrete else np.array(actions, np.float32)
    parameters = drawn.parameters if drawn is not None else {}
    return np.array(rows, np.float32), commands, np.array(rewards, np.float32), over, parameters
