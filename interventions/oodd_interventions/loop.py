"""The closed loop of a cell: arms that share seeds and faults bit for bit up to an act."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.naming import ReadingModel
from oodd_live.handle import DetectorHandle
from oodd_recording.closed_loop import RecordedEpisode, Setup, record_again, return_of
from oodd_recording.policies import CustomPolicy
from oodd_recording.registered import info_of

from oodd_eval.data.facts import Group
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.plugins.explanations import Naming, checked_explanation, explains, naming_of
from oodd_interventions.acts import failed
from oodd_interventions.situation import Act, ActSpec, Situation

Row = NDArray[np.float32]

RENAMED: Final = (1, 2, 3, 4, 5, 20)
"""Rows after an alarm at which its parts are named again."""
KEPT: Final = (0, 20)
"""Rows after an alarm whose namings a cell keeps."""
FIRST: Final = -20
"""First row of curves, relative to the effect."""
ARMS: Final = ("twin", "never", "watchdog", "oracle", "placebo", "false", "forced")


class NamedParts(NamedTuple):
    """The parts at fault, and the row with which the fault began."""

    naming: Naming
    onset: int


Namer = Callable[[Trajectory, int], NamedParts | None]
"""Called with the episode so far and the rows since the alarm; None: as named before."""


class Arm(NamedTuple):
    """An episode, the row from which on an act commanded it, and namings by rows since then."""

    episode: RecordedEpisode
    acted: int | None = None
    namings: Mapping[int, NamedParts] = {}


class TakingOver:
    """A controller: the policy of the loop up to a row, then an act."""

    def __init__(self, loop: Loop, spec: ActSpec, row: int, name: Namer) -> None:
        self._loop, self._spec, self._row, self._name = loop, spec, row, name

    def reset(self) -> None:
        """Begin an episode."""
        setup, info = self._loop.setup, info_of(self._loop.setup.environment)
        if isinstance(setup.policy, CustomPolicy):
            setup.policy.reset()
        self._rows = np.empty((info.episode_cap + 1, info.observation_dim), np.float32)
        self._actions = np.empty((info.episode_cap, info.action_dim), np.float32)
        self._one_hot = np.eye(info.action_dim, dtype=np.float32) if info.discrete else None
        self._t = 0
        self._act: Act | None = None
        self.namings: dict[int, NamedParts] = {}

    def act(self, row: Row) -> Any:
        """Return the command for the next row."""
        t, since = self._t, self._t - self._row
        self._t += 1
        self._rows[t] = row
        if since == 0 or since in RENAMED:
            named = self._name(Trajectory(self._rows[: t + 1], self._actions[:t]), since)
            if named is not None:
                self.namings[since] = named
        if since >= 0:
            self._take_over(t, since)
        action = (self._act or self._loop.setup.policy).act(row)
        self._actions[t] = action if self._one_hot is None else self._one_hot[action]
        return action

    def _take_over(self, t: int, since: int) -> None:
        """Make the act at its row, and keep its situation current."""
        rows, actions = self._rows[: t + 1], self._actions[:t]
        if since == 0:
            setup, model = self._loop.setup, self._loop.model
            parts = (setup.environment, setup.policy, rows, actions, *self.namings[0], model)
            self._situation = Situation(*parts)
            self._act = self._spec.make(self._situation)
        self._situation.rows, self._situation.actions = rows, actions
        if since in self.namings:
            self._situation.naming, self._situation.onset = self.namings[since]


@dataclass(frozen=True, slots=True)
class Loop:
    """What all arms of an environment share: policy and noise, and the model of readings."""

    setup: Setup
    model: ReadingModel

    def failed(self, episode: RecordedEpisode) -> bool:
        """Tell whether an episode counts as a failure."""
        environment, last = self.setup.environment, episode.trajectory.observations[-1]
        cap = min(filter(None, (info_of(environment).episode_cap, self.setup.episode_cap)))
        return failed(environment, episode.rewards, episode.terminated, cap, last)

    def arm(self, pair: Pair, *, nominal: bool, spec: ActSpec, row: int | None, name: Namer) -> Arm:
        """Run the faulty or the `nominal` episode of a pair again, with an act from a row on.

        It is the episode itself where no command follows on the row.
        """
        taken = pair.twin if nominal else pair.never
        if row is None or row >= taken.trajectory.transitions:
            return Arm(taken)
        controller = TakingOver(self, spec, row, name)
        policy = CustomPolicy(self.setup.environment, controller)
        if nominal:
            episode = replace(self.setup, policy=policy).record(taken.seed)
        else:
            drawn = (pair.kind, pair.strength, pair.twin, taken.attempt)
            episode = record_again(self.setup, *drawn, policy)
        return Arm(episode, row, controller.namings)


@dataclass(frozen=True, slots=True)
class Pair:
    """A nominal episode, and that of its seed under a fault which nobody acts on."""

    kind: str
    strength: float | None
    group: Group
    twin: RecordedEpisode
    never: RecordedEpisode

    @property
    def effect(self) -> int:
        """The first row that differs."""
        assert self.never.effect is not None
        return self.never.effect

    def truth(self) -> NamedParts:
        """Return the parts at fault with the sizes that the fault has, and its onset."""
        never, parameters = self.never, self.never.parameters
        observations, actions = never.trajectory.observations, never.trajectory.actions
        sensors, actuators = np.zeros(observations.shape[1]), np.zeros(actions.shape[1])
        sizes = np.full(len(sensors), math.nan)
        faulty = parameters.get("sensors", [])
        sensors[faulty] = 1.0
        reported = observations[self.effect :].astype(np.float64)
        errors = reported - np.asarray(never.measured)[self.effect :]
        rms = np.sqrt((errors**2).mean(axis=0))
        sizes[faulty] = np.where(np.ptp(reported, axis=0) == 0, math.inf, rms)[faulty]
        kind = "sensor"
        if self.group == "dynamics":
            kind = "actuator" if "actuator" in parameters else "body"
        if isinstance(actuator := parameters.get("actuator"), int):
            actuators[actuator] = 1.0
        return NamedParts(Naming(sensors, actuators, sizes, kind), never.onset or 0)


@dataclass(frozen=True, slots=True)
class FittedDetector:
    """A fitted detector, and its guaranteed alarm."""

    handle: DetectorHandle
    rule: GuaranteedAlarm

    def alarm(self, episode: Trajectory) -> int | None:
        """Return the row of the first alarm."""
        return self.rule.first(self.handle.scores(episode))

    def name(self, episode: Trajectory, since: int = 0) -> NamedParts:
        """Return what it names at the last row of an episode; nothing where it does not explain."""
        visible, last = self.handle.visible(episode), len(episode) - 1
        if not explains(self.handle.detector):
            sensors = np.zeros(visible.observation_dim)
            return NamedParts(Naming(sensors, np.zeros(0), np.full_like(sensors, math.nan)), last)
        detector: Any = self.handle.detector
        explanation = checked_explanation(detector.explain(visible), visible)
        naming = explanation.naming or naming_of(explanation, visible.action_dim)
        onset = int(explanation.onsets[-1])
        return NamedParts(naming, onset if onset >= 0 else last)


def oracle_arms(loop: Loop, pairs: Sequence[Pair], spec: ActSpec) -> list[Arm]:
    """Return the arms that act at the effect on the true parts."""
    return [
        loop.arm(
            pair,
            nominal=False,
            spec=spec,
            row=pair.effect,
            name=lambda _, since, pair=pair: None if since else pair.truth(),
        )
        for pair in pairs
    ]


@dataclass(slots=True)
class _Alarms:
    """Where a detector alarms in a pair, and what it names: at first at the alarm alone."""

    alarm: int | None
    false_alarm: int | None
    namings: dict[int, NamedParts] = field(default_factory=dict)


def run_cell(
    loop: Loop,
    pairs: Sequence[Pair],
    oracles: Sequence[Arm],
    spec: ActSpec,
    detector: FittedDetector,
) -> dict[str, Any]:
    """Return the episodes and curves of a cell: one detector, condition and act.

    Parameters
    ----------
    loop, pairs, oracles
        What the detectors share; an oracle's arm a pair.
    spec
        The act.
    detector
        It alarms and names.

    Returns
    -------
    dict
        ``"episodes"`` and ``"curves"`` of a raw cell, plain JSON but for NaN.
    """
    alarms = [detector.alarm(pair.never.trajectory) for pair in pairs]
    false_alarms = [detector.alarm(pair.twin.trajectory) for pair in pairs]
    watchdogs = [
        loop.arm(pair, nominal=False, spec=spec, row=row, name=detector.name)
        for pair, row in zip(pairs, alarms, strict=True)
    ]
    namings: list[Mapping[int, NamedParts]] = []
    for pair, row, arm in zip(pairs, alarms, watchdogs, strict=True):
        # Nothing acts at an alarm of the last row, but its parts are named.
        last = {} if row is None else {0: row}
        namings.append(
            arm.namings
            or {since: detector.name(pair.never.trajectory[: t + 1]) for since, t in last.items()}
        )
    episodes, by_arm = [], {name: [] for name in ARMS}
    for i, pair in enumerate(pairs):
        others = [*range(i + 1, len(pairs)), *range(i)]
        other = next((j for j in others if alarms[j] is not None), i)
        again = {"spec": spec, "row": alarms[i], "name": _replayed(namings[i])}
        borrowed = {"row": None if other == i else alarms[other], "name": _replayed(namings[other])}
        rung = {"row": false_alarms[i], "name": detector.name}
        arms = {
            "twin": Arm(pair.twin),
            "never": Arm(pair.never),
            "watchdog": watchdogs[i],
            "oracle": oracles[i],
            "placebo": loop.arm(pair, nominal=False, **(again | borrowed)),
            "false": loop.arm(pair, nominal=True, **(again | rung)),
            "forced": loop.arm(pair, nominal=True, **again),
        }
        for name, arm in arms.items():
            by_arm[name].append(arm.episode)
        seen = watchdogs[i].episode.trajectory.observations
        truth = pair.truth().naming
        episodes.append(
            {
                "seed": pair.never.seed,
                "onset": pair.never.onset,
                "effect": pair.effect,
                "alarm": alarms[i],
                "false_alarm": false_alarms[i],
                "parts": {
                    "sensors": np.flatnonzero(truth.sensors).tolist(),
                    "actuators": np.flatnonzero(truth.actuators).tolist(),
                    "kind": truth.kind,
                },
                "named": {
                    str(since): _plain(named)
                    for since, named in namings[i].items()
                    if since in KEPT
                },
                "largest": {
                    str(since): _largest(loop.model, seen[(alarms[i] or 0) + since])
                    for since in namings[i]
                    if since in KEPT
                },
                "returns": {name: return_of(arm.episode) for name, arm in arms.items()},
                "rows": {name: len(arm.episode.rewards) for name, arm in arms.items()},
                "failed": {name: loop.failed(arm.episode) for name, arm in arms.items()},
                "acted": {name: arm.acted for name, arm in arms.items()},
            }
        )
    effects = [pair.effect for pair in pairs]
    curves = {name: _curve(by_arm[name], effects) for name in ARMS}
    return {"episodes": episodes, "curves": {"first": FIRST, "arms": curves}}


def _replayed(namings: Mapping[int, NamedParts]) -> Namer:
    return lambda _, since: namings.get(since)


def _plain(named: NamedParts) -> dict[str, Any]:
    """Return named parts as a cell has them."""
    naming, onset = named
    sensors, actuators = naming.sensors.tolist(), naming.actuators.tolist()
    return {"sensors": sensors, "actuators": actuators, "kind": naming.kind, "onset": onset}


def _largest(model: ReadingModel, row: Row) -> list[int]:
    """Return the numbers of the sensors, the one farthest from its mean in training first."""
    distances = np.abs(row - model.sensors.mean) / model.sensors.std
    return [int(i) for i in np.argsort(-distances, kind="stable")]


def _curve(episodes: Sequence[RecordedEpisode], effects: Sequence[int]) -> list[float | None]:
    """Return the mean rewards by row from `FIRST` on; rows after an end count 0."""
    length = max(len(e.rewards) - effect for e, effect in zip(episodes, effects, strict=True))
    rewards = np.zeros((len(episodes), length - FIRST))
    for row, episode, effect in zip(rewards, episodes, effects, strict=True):
        # The effect is at row 30 or later, as every onset is.
        part = episode.rewards[effect + FIRST :]
        row[: len(part)] = part
    return [float(f"{reward:.6g}") for reward in rewards.mean(axis=0)]
