"""Checks of custom environments and anomalies, before days of recording rest on them."""

import copy
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from oodd_eval.data.registry import AnomalySpec, Fault, Spec, anomaly_spec, environment_spec
from oodd_eval.errors import OoddError, SimulationError
from oodd_recording.closed_loop import (
    SHORTEST_TWIN,
    RecordedEpisode,
    Setup,
    measure,
    record_anomalous,
    record_attempt,
)
from oodd_recording.faults import make_fault
from oodd_recording.policies import CustomPolicy, Policy, load_policy
from oodd_recording.registered import info_of
from oodd_recording.simulator import Row, Simulator
from oodd_recording.values import bound_of

SEEDS: Final = range(960_000_000, 960_000_008)  # outside every split and training
PARTS: Final = (1 / 16, 1 / 4, 1.0)  # of the bound: strengths whose effects are compared
SLACK: Final = 0.9  # a stronger anomaly may seem this much weaker: trajectories are few


@dataclass(frozen=True)
class Subject:
    """An environment to check, and a kind of anomaly in it; an empty kind is none."""

    environment: str
    kind: str = ""

    @functools.cached_property
    def policy(self) -> Policy:
        """The environment's policy."""
        return load_policy(self.environment)

    @functools.cached_property
    def setup(self) -> Setup:
        """The policy and limits of all episodes; their sensors are measured first."""
        measure(self.environment, self.policy)
        return Setup(self.environment, self.policy)

    @functools.cached_property
    def twins(self) -> list[RecordedEpisode]:
        """Nominal episodes that are long enough for an onset."""
        episodes = (Setup(self.environment, self.policy).record(seed) for seed in SEEDS)
        long = [e for e in episodes if e.trajectory.transitions >= SHORTEST_TWIN]
        if len(long) < len(SEEDS) / 2:
            raise SimulationError(
                f"{len(long)} of {len(SEEDS)} nominal episodes have {SHORTEST_TWIN} transitions, "
                f"expected at least {len(SEEDS) // 2}, for onsets: a better policy is needed"
            )
        return long

    def anomalous(self, part: float) -> list[RecordedEpisode]:
        """Return an episode for each twin, at a part of the largest strength."""
        strength = part * bound_of(self.environment, self.kind)
        return [record_anomalous(self.setup, self.kind, strength, t, redraws=0) for t in self.twins]

    def driven(self, drive: Callable[[Fault], Fault], part: float = 1.0) -> list[RecordedEpisode]:
        """Return an episode for each twin, in which `drive` decides when the kind's fault acts."""
        strength = part * bound_of(self.environment, self.kind)

        def maker(simulator: Simulator, rng: np.random.Generator) -> Fault:
            return drive(anomaly_spec(self.kind).make(strength, rng, simulator))

        return [record_attempt(self.setup, self.kind, twin, maker) for twin in self.twins]

    def check_twins(self, episodes: Sequence[RecordedEpisode], when: str) -> None:
        """Fail unless episodes are their twins, bit for bit."""
        for episode, twin in zip(episodes, self.twins, strict=True):
            if _content(episode) != _content(twin):
                raise SimulationError(f"with seed {twin.seed} it differs from its twin {when}")


class Around(Fault):
    """A fault that does what another one does."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.parameters)
        self.fault = fault

    def begin(self, simulator: Any, rows: Sequence[Row]) -> None:
        self.fault.begin(simulator, rows)

    def command(self, action: Any, simulator: Any) -> Any:
        return self.fault.command(action, simulator)


class Blinking(Around):
    """A fault that begins and ends again before every transition."""

    rows: Sequence[Row] = ()

    def begin(self, simulator: Any, rows: Sequence[Row]) -> None:
        self.rows = rows

    def command(self, action: Any, simulator: Any) -> Any:
        self.fault.begin(simulator, self.rows)
        self.fault.command(copy.copy(action), simulator)
        self.fault.end(simulator)
        simulator.restore()
        return action


class Shareless(Around):
    """A fault of which a share of 0 is in force; rows are mixed by it elsewhere."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        fault.share = 0.0


class Watched(Around):
    """A fault whose rows are compared: `corrupted` are the numbers of the columns that differ."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        self.corrupted: set[int] = set()

    def observe(self, row: Row, step: int) -> Row:
        changed = self.fault.observe(row.copy(), step)
        self.corrupted |= {int(i) for i in np.flatnonzero(changed != row)}
        return changed


def _content(episode: RecordedEpisode) -> bytes:
    arrays = episode.trajectory.observations, episode.trajectory.actions, episode.rewards
    return b"".join(array.tobytes() for array in arrays)


def _fail(message: str) -> None:
    raise SimulationError(message)


def check_columns(subject: Subject) -> None:
    """Half of the nominal episodes are long enough, as wide as the spec says, and finite."""
    info = info_of(subject.environment)
    for twin in subject.twins[:2]:
        widths = twin.trajectory.observation_dim, twin.trajectory.action_dim
        if widths != (info.observation_dim, info.action_dim):
            _fail(f"an episode has {widths[0]} sensors and {widths[1]} actions")
        if not np.isfinite(twin.rewards).all():
            _fail(f"the rewards of seed {twin.seed} are not finite")


def check_seed(subject: Subject) -> None:
    """Equal seeds give equal episodes in any order; other seeds, other ones."""
    again = [subject.setup.record(twin.seed) for twin in reversed(subject.twins)]
    for first, second in zip(subject.twins, reversed(again), strict=True):
        if _content(first) != _content(second):
            _fail(
                f"two episodes of seed {first.seed} differ: draw everything from the generator "
                "that reset(seed=...) seeds, and keep nothing between episodes"
            )
    if len({_content(twin) for twin in subject.twins}) < len(subject.twins):
        _fail("different seeds give the same episode, expected another start or noise")


def check_policy(subject: Subject) -> None:
    """Actions follow from the row alone, or from all rows since reset(); they are within limits."""
    twin, info = subject.twins[0].trajectory, info_of(subject.environment)
    policy, order = load_policy(subject.environment), list(range(twin.transitions))
    if isinstance(policy, CustomPolicy) and policy.has_memory:
        for row in subject.twins[-1].trajectory.observations:  # something to forget
            policy.act(row)
        policy.reset()
        advice = "after reset(): let it forget all that act() remembers, and draw nothing at random"
    else:
        order.reverse()
        advice = (
            "when it is asked alone: it may not draw at random, and a controller that remembers "
            "rows is an object with act(row) and reset()"
        )
    low, high = (np.array(ends, np.float32) for ends in info.limits)
    for t in order:
        action = policy.act(twin.observations[t])
        row = np.eye(twin.action_dim, dtype=np.float32)[action] if info.discrete else action
        if not np.array_equal(row, twin.actions[t]):
            _fail(f"the policy gives another action for row {t} of seed {SEEDS[0]} {advice}")
        if not info.discrete and not ((low <= row) & (row <= high)).all():
            _fail(
                f"the policy commands {np.array(row).tolist()} in row {t} of seed {SEEDS[0]}, "
                f"expected {low.tolist()} to {high.tolist()}: let it keep to the limits, since "
                "what it commands is stored"
            )


def check_rewards(subject: Subject) -> None:
    """Where the task is a loss, rewards lie in [0, 1]."""
    if environment_spec(subject.environment).task != "loss":
        return
    for episode in subject.anomalous(1.0) if subject.kind else subject.twins:
        low, high = episode.rewards.min(), episode.rewards.max()
        if not (low >= 0 and high <= 1):
            _fail(
                f"rewards of seed {episode.seed} are {low:g} to {high:g}, expected 0 to 1: the "
                "task is a loss, 1 - reward a row"
            )


def check_zero_strength(subject: Subject) -> None:
    """At strength 0 an episode is its twin, bit for bit."""
    subject.check_twins(subject.driven(lambda fault: fault, 0.0), "at strength 0")


def check_onset(subject: Subject) -> None:
    """At the largest strength episodes differ from their twins, and not before the onset."""
    different = 0
    for episode, twin in zip(subject.anomalous(1.0), subject.twins, strict=True):
        rows, others = episode.trajectory.observations, twin.trajectory.observations
        onset = episode.onset or 0
        if rows[:onset].tobytes() != others[:onset].tobytes():
            _fail(f"with seed {twin.seed} it differs from its twin before its onset, row {onset}")
        different += rows.tobytes() != others.tobytes()
    if different < len(subject.twins):
        equal = len(subject.twins) - different
        _fail(f"at the largest strength {equal} of {len(subject.twins)} episodes equal their twins")


def check_draws(subject: Subject) -> None:
    """The same is drawn at every strength, and episodes come again."""
    weak, strong = subject.anomalous(PARTS[0]), subject.anomalous(1.0)
    for one, other in zip(weak, strong, strict=True):
        drawn = [{k: v for k, v in e.parameters.items() if k != "strength"} for e in (one, other)]
        if drawn[0] != drawn[1]:
            _fail(f"with seed {one.seed} it draws {drawn[0]} or {drawn[1]}, by its strength")
    if [*map(_content, subject.anomalous(1.0))] != [*map(_content, strong)]:
        _fail("two recordings differ: draw from the generator that make is given, nothing else")


def check_strength(subject: Subject) -> None:
    """A stronger anomaly takes episodes farther from their twins."""
    distances = []
    for part in PARTS:
        gaps = []
        for episode, twin in zip(subject.anomalous(part), subject.twins, strict=True):
            rows, others = episode.trajectory.observations, twin.trajectory.observations
            common = slice(episode.onset, min(len(rows), len(others)))
            gaps.append(np.abs(rows[common] - others[common]).mean())
        distances.append(float(np.mean(gaps)))
    if any(b < SLACK * a for a, b in itertools.pairwise(distances)):
        profile = ", ".join(f"{d:.3g} at {p:g}" for d, p in zip(distances, PARTS, strict=True))
        _fail(f"the mean distance from the twins is {profile} of the bound, expected it to grow")


def check_sensors(subject: Subject) -> None:
    """Only measured sensors are corrupted, and all that are stand in the fault's parameters."""
    columns = environment_spec(subject.environment).sensors
    strength = bound_of(subject.environment, subject.kind)
    for twin in subject.twins:
        watched: list[Watched] = []

        def maker(simulator: Simulator, rng: np.random.Generator) -> Fault:
            watched.append(Watched(make_fault(subject.kind, strength, simulator, rng)))  # noqa: B023
            return watched[0]  # noqa: B023

        record_attempt(subject.setup, subject.kind, twin, maker)
        named = watched[0].parameters.get("sensors", ())
        for i in sorted(watched[0].corrupted):
            if not columns[i].measured:
                _fail(
                    f"with seed {twin.seed} it corrupts {columns[i].name!r} ({columns[i].role}), "
                    "expected sensors that are measured"
                )
            if i not in named:
                _fail(
                    f"with seed {twin.seed} it corrupts {columns[i].name!r}, number {i}, expected "
                    f'it among the "sensors" of its parameters, {[*named]}'
                )


def check_end(subject: Subject) -> None:
    """A fault that ended leaves nothing: it may end before every transition, and its twin stays."""
    when = "though it ended before each transition: let end() put back what begin() and command() "
    subject.check_twins(subject.driven(Blinking), when + "change")


def check_share(subject: Subject) -> None:
    """A fault that grows changes no command and no dynamics while its share is 0."""
    when = "while its share is 0: let command() weaken what it does by self.share"
    subject.check_twins(subject.driven(Shareless), when)


_ENVIRONMENT: Final = (check_columns, check_seed, check_policy, check_rewards)
_ANOMALY: Final = (
    check_zero_strength,
    check_onset,
    check_draws,
    check_strength,
    check_sensors,
    check_rewards,
)


def _checks_of(spec: Spec) -> Iterator[Callable[[Subject], None]]:
    """Yield the checks of a spec: how a fault ends and grows matters where it does."""
    yield from _ANOMALY if isinstance(spec, AnomalySpec) else _ENVIRONMENT
    if isinstance(spec, AnomalySpec) and (spec.lasts or spec.pulses or spec.intermittent):
        yield check_end
    if isinstance(spec, AnomalySpec) and spec.ramp:
        yield check_share


def custom_checks(spec: Spec, environment: str) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield the name of each check, and what carries it out: it returns what is wrong, or nothing.

    `environment` is the one in which an anomaly is tried.
    """
    subject = Subject(environment, spec.name if isinstance(spec, AnomalySpec) else "")
    for check in _checks_of(spec):
        name = check.__name__.removeprefix("check_").replace("_", "-")
        yield name, functools.partial(_carried_out, check, subject)


def _carried_out(check: Callable[[Subject], None], subject: Subject) -> str:
    try:
        check(subject)
    except OoddError as error:
        return str(error)
    except Exception as error:  # noqa: BLE001  code of one's own may raise anything
        return f"it raised {type(error).__name__}: {error}"
    return ""
