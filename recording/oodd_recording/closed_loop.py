"""Recording: a trajectory is a pure function of environment, anomaly, seed, cap and policy.

The anomalous episode of a seed replays its nominal twin's actions up to the onset, which the policy
would choose anyway, since the observations are the same. An episode that equals its twin, or ends
soon after its onset, is drawn again: onset and parameters.
"""

import copy
import functools
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import FIRST_ONSET
from oodd_eval.data.registry import Fault, environment_spec
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import SimulationError
from oodd_eval.names import check_known
from oodd_recording.anomalies import draw
from oodd_recording.environments import make
from oodd_recording.faults import make_fault
from oodd_recording.policies import CustomPolicy, Policy
from oodd_recording.registered import MEASURED, Measured, info_of, kinds_of
from oodd_recording.simulator import Simulator
from oodd_recording.values import spread_of

_Rows = NDArray[np.float32]
FaultMaker = Callable[[Simulator, np.random.Generator], Fault]

GENERATOR_VERSION: Final = 2  # raised by every change that gives other bytes for the same seed

LAST_ONSET_SHARE: Final = 0.6
SHORTEST_TWIN: Final = 50
SHORTEST_TAIL: Final = 20
"""An anomalous episode has more than this many transitions beyond the onset, if any draw does."""

MAX_REDRAWS: Final = 100
MEASURED_EPISODES: Final = 10
EVALUATION_SEED: Final = 900_000_000  # outside every split and training


@dataclass(frozen=True, slots=True)
class Setup:
    """The policy, the cap and the noise of all episodes of an environment.

    `episode_cap` is the longest episode in transitions, None for the simulator's own limit; `noise`
    is that of every sensor in every row, in shares of the sensor's spread.
    """

    environment: str
    policy: Policy
    episode_cap: int | None = None
    noise: float = 0.0

    def record(self, seed: int) -> "RecordedEpisode":
        """Record the nominal episode of a seed; `SimulationError` for a negative one."""
        if seed < 0:
            raise SimulationError(f"seed is {seed}, expected a whole number from 0")
        return _run(self, seed)


class TwinTooShortError(SimulationError):
    """A nominal episode of under 50 transitions: it gives way to the next seed."""


@dataclass(frozen=True, slots=True)
class RecordedEpisode:
    """One recorded episode; `terminated` is True when the simulator, not the cap, ended it.

    `onset` is the index of the first observation that may differ from the twin's, `effect` of the
    first that does, both None when nominal; `parameters` are what the anomaly drew, `redraws`
    counts rejected draws, and `attempt` is the one that was taken: an episode can be run again.
    `measured` has the rows before the anomaly corrupted sensors.
    """

    trajectory: Trajectory
    rewards: NDArray[np.float32]
    terminated: bool
    seed: int
    onset: int | None = None
    effect: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    redraws: int = 0
    attempt: int = 0
    measured: _Rows | None = None


def record_seed(
    environment: str,
    seed: int,
    conditions: Iterable[Condition] | Mapping[Condition, float | None] = (),
    *,
    policy: Policy,
    episode_cap: int | None = None,
    noise: float = 0.0,
) -> dict[Condition | None, RecordedEpisode]:
    """Record the nominal twin of a seed (key None) and one episode per condition.

    Parameters
    ----------
    environment, seed
        Name, and the seed of its reset.
    conditions
        Anomalies with the values of Table 1; or strengths by condition, such as
        ``{Condition("iid", "kept99"): 0.1}``, where None stands for Table 1's values.
    policy
        It acts on the observations as stored.
    episode_cap
        Longest episode in transitions, None for the simulator's own limit.
    noise
        Noise of every sensor in every row, in shares of the sensor's spread.

    Raises
    ------
    TwinTooShortError
        When an onset would not fit.
    SimulationError
        When an anomaly changes nothing in 100 redraws.
    """
    strengths = conditions if isinstance(conditions, Mapping) else dict.fromkeys(conditions)
    kinds = [condition.anomaly for condition in strengths]
    check_known(f"anomaly that {environment} can have", kinds_of(environment), *kinds)
    setup = Setup(environment, policy, episode_cap, noise)
    twin = setup.record(seed)
    if strengths and twin.trajectory.transitions < SHORTEST_TWIN:
        raise TwinTooShortError(
            f"the nominal episode of {environment} with seed {seed} has "
            f"{twin.trajectory.transitions} transitions, expected at least {SHORTEST_TWIN}"
        )
    episodes: dict[Condition | None, RecordedEpisode] = {None: twin}
    episodes |= {c: record_anomalous(setup, c.anomaly, strengths[c], twin) for c in strengths}
    return episodes


def evaluate_policy(
    environment: str,
    policy: Policy,
    *,
    episodes: int = 100,
    seed: int = EVALUATION_SEED,
    noise: float = 0.0,
) -> NDArray[np.float64]:
    """Return the returns of nominal episodes, a fresh simulator each, seeds ``seed + i``."""
    if noise:
        measure(environment, policy)
    setup = Setup(environment, policy, noise=noise)
    return np.array([return_of(setup.record(seed + i)) for i in range(episodes)])


def measure(environment: str, policy: Policy) -> None:
    """Measure the sensors of a custom environment, once, in ten nominal episodes.

    Sensors that may break vary as the benchmark's do: they differ from their median in at least 1 %
    of the rows, and have more than 8 distinct values.
    """
    if environment in MEASURED:
        return
    setup = Setup(environment, policy)
    episodes = [setup.record(EVALUATION_SEED + i).trajectory for i in range(MEASURED_EPISODES)]
    rows = np.concatenate([episode.observations for episode in episodes]).astype(np.float64)
    moves = (rows != np.median(rows, axis=0)).mean(axis=0) >= 0.01
    measured = [sensor.measured for sensor in environment_spec(environment).sensors]
    may_break = [
        i for i, x in enumerate(rows.T) if measured[i] and moves[i] and len(np.unique(x)) > 8
    ]
    if not may_break:
        raise SimulationError(
            f"no sensor of {environment} varies under its policy, expected one that is measured "
            "and has more than 8 values in ten nominal episodes"
        )
    MEASURED[environment] = Measured(tuple(rows.std(axis=0).tolist()), tuple(may_break))


def return_of(episode: RecordedEpisode) -> float:
    """Return the sum of an episode's rewards."""
    return float(episode.rewards.sum(dtype=np.float64))


def generator(environment: str, anomaly: str, seed: int, attempt: int) -> np.random.Generator:
    """Return the anomaly's own generator for one attempt at one trajectory."""
    names = (zlib.crc32(environment.encode()), zlib.crc32(anomaly.encode()))
    return np.random.default_rng([GENERATOR_VERSION, *names, seed, attempt])


def record_anomalous(
    setup: Setup,
    kind: str,
    strength: float | None,
    twin: RecordedEpisode,
    *,
    redraws: int = MAX_REDRAWS,
) -> RecordedEpisode:
    """Record the episode of a twin's seed under one kind of anomaly; see `record_seed`.

    After so many `redraws` the longest episode is taken.
    """
    environment, maker = setup.environment, _maker(setup.environment, kind, strength)
    longest: RecordedEpisode | None = None
    tail = -1
    for attempt in range(redraws + 1):
        episode = record_attempt(setup, kind, twin, maker, attempt)
        length = len(episode.rewards) - (episode.onset or 0)
        if episode.effect is None or length <= tail:
            continue
        tail, longest = length, episode
        if tail > SHORTEST_TAIL:
            return longest
    if longest is None and strength is not None:
        # Too weak to be felt: the episode stays, and counts from its onset on.
        return replace(
            twin,
            onset=episode.onset,
            effect=episode.onset,
            parameters=episode.parameters,
            redraws=redraws,
            attempt=redraws,
            measured=episode.measured,
        )
    if longest is None:
        raise SimulationError(
            f"no {kind} episode of {environment} with seed {twin.seed} differs from its twin "
            f"in {redraws} redraws, expected one: the policy or the simulator ignores the anomaly"
        )
    return replace(longest, redraws=redraws)


def record_again(
    setup: Setup,
    kind: str,
    strength: float | None,
    twin: RecordedEpisode,
    attempt: int,
    policy: Policy,
) -> RecordedEpisode:
    """Record an attempt of `record_anomalous` again, with another policy from the first row on.

    Up to the first command that differs, rows and commands are the same, bit for bit.
    """
    maker = _maker(setup.environment, kind, strength)
    return record_attempt(setup, kind, twin, maker, attempt, policy)


def _maker(environment: str, kind: str, strength: float | None) -> FaultMaker:
    """Return what draws a fault: of Table 1 without a strength."""
    if strength is None:
        return functools.partial(draw, environment, kind)
    return functools.partial(make_fault, kind, strength)


def record_attempt(
    setup: Setup,
    kind: str,
    twin: RecordedEpisode,
    maker: FaultMaker,
    attempt: int = 0,
    policy: Policy | None = None,
) -> RecordedEpisode:
    """Record the episode of a twin's seed under what `maker` makes, whatever comes of it.

    The attempt decides the onset and the generator that `maker` is given. A `policy` acts in place
    of the setup's.
    """
    commands = list(twin.trajectory.actions)
    if info_of(setup.environment).discrete:
        commands = [int(row.argmax()) for row in commands]
    rng = generator(setup.environment, kind, twin.seed, attempt)
    onset = int(rng.integers(FIRST_ONSET, int(LAST_ONSET_SHARE * len(commands)) + 1))
    acting = replace(setup, policy=policy or setup.policy)
    episode = _run(acting, twin.seed, [] if policy else commands[: onset - 1], (maker, rng, onset))
    effect = first_difference(episode.trajectory.observations, twin.trajectory.observations)
    return replace(episode, onset=onset, effect=effect, redraws=attempt, attempt=attempt)


def first_difference(rows: _Rows, twin: _Rows) -> int | None:
    """Return the index of the first row that differs from the twin's; None without such a row."""
    common = min(len(rows), len(twin))
    differs = (rows[:common] != twin[:common]).any(axis=1)
    return int(differs.argmax()) if differs.any() else None


def _run(
    setup: Setup,
    seed: int,
    replayed: Sequence[Any] = (),
    anomaly: tuple[FaultMaker, np.random.Generator, int] | None = None,
) -> RecordedEpisode:
    """Run an episode: replayed actions first, then the policy, under an anomaly from its onset."""
    environment, policy, fault = setup.environment, setup.policy, None
    simulator, info, noisy = make(environment), info_of(environment), _noise(setup, seed)
    cap = min(info.episode_cap, setup.episode_cap or info.episode_cap)
    actions: list[Any] = []
    rewards: list[float] = []
    over = False
    try:
        rows = [simulator.reset(seed)]
        if rows[0].shape != (info.observation_dim,):
            raise SimulationError(
                f"{environment}'s simulator gave an observation of shape {rows[0].shape}, expected "
                f"({info.observation_dim},): install the version that oodd-eval[sim] names, or "
                "mend the environment's spec"
            )
        rows[0] = noisy(rows[0])
        measured = [rows[0]]
        memory = isinstance(policy, CustomPolicy) and policy.has_memory
        if isinstance(policy, CustomPolicy):
            policy.reset()
        while not over and (step := len(rewards)) < cap:
            replay = step < len(replayed)
            # A controller with memory has to see the rows that others need not see again.
            action = policy.act(rows[-1]) if memory or not replay else replayed[step]
            if replay and not np.array_equal(action, replayed[step]):
                raise SimulationError(
                    f"the policy of {environment} gives {action} for row {step} of seed {seed}, "
                    f"and gave {replayed[step]}: expected the same actions for the same rows; let "
                    "reset() forget all that act() remembers, and draw nothing at random"
                )
            actions.append(action)
            if anomaly is not None and step == anomaly[2] - 1:
                fault = anomaly[0](simulator, anomaly[1])
                fault.begin(simulator, rows)
            # A copy: what the policy commanded is stored, whatever becomes of it.
            command = action if fault is None else fault.command(copy.copy(action), simulator)
            row, reward, over = simulator.step(command)
            row = noisy(row)
            measured.append(row)
            rows.append(row if fault is None else fault.observe(row, len(rows)))
            rewards.append(reward)
    finally:
        simulator.close()
    one_hot = np.eye(info.action_dim, dtype=np.float32)
    commands = one_hot[actions] if info.discrete else np.array(actions, np.float32)
    return RecordedEpisode(
        Trajectory(np.array(rows, np.float32), commands),
        np.array(rewards, np.float32),
        over,
        seed,
        parameters=fault.parameters if fault is not None else {},
        measured=np.array(measured, np.float32) if fault is not None else None,
    )


def _noise(setup: Setup, seed: int) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return what adds the noise of nominal operation to a row; a seed's draws are the same."""
    sensors = environment_spec(setup.environment).sensors
    std = np.array([sensor.noise for sensor in sensors])
    if setup.noise:
        measured = np.array([sensor.measured for sensor in sensors])
        std = np.hypot(std, setup.noise * spread_of(setup.environment) * measured)
    if not std.any():
        return lambda row: row
    rng = generator(setup.environment, "", seed, 0)
    return lambda row: (row + std * rng.normal(size=len(std))).astype(np.float32)
