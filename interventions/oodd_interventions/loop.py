"""The closed loop of a cell: arms that share seeds and faults bit for bit up to an act."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.naming import ReadingModel
from oodd_live.handle import DetectorHandle
from oodd_recording.closed_loop import RecordedEpisode, Setup, record_again, return_of
from oodd_recording.policies import CustomPolicy
from oodd_recording.registered import info_of

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.plugins.explanations import (
    ExplainingDetector,
    Naming,
    checked_explanation,
    naming_of,
)
from oodd_interventions.acts import failed
from oodd_interventions.columns import ARMS
from oodd_interventions.situation import Act, ActSpec, Row, Situation

RENAMED: Final = (1, 2, 3, 4, 5, 20)
"""Rows after an alarm at which its parts are named again."""
KEPT: Final = (0, 20)
"""Rows after an alarm whose namings a cell keeps."""
PARTS: Final = ("sensors", "actuators")
"""Fields of a naming that have a probability for each part."""
FIRST: Final = -20
"""First row of curves, relative to the effect."""


class NamedParts(NamedTuple):
    """The parts at fault, and the row with which the fault began."""

    naming: Naming
    onset: int


Namer = Callable[[Trajectory, int], NamedParts | None]
"""Called with the episode so far and the rows since the alarm; None: as named before."""


class LoopArm(NamedTuple):
    """An episode, the row from which on an act commanded it, and namings by rows since then."""

    episode: RecordedEpisode
    acted: int | None = None
    namings: Mapping[int, NamedParts] = {}


@dataclass(frozen=True, slots=True)
class LoopPair:
    """A nominal episode, and that of its seed under a fault which nobody acts on."""

    kind: str
    strength: float | None
    group: str
    twin: RecordedEpisode
    never: RecordedEpisode

    def truth(self) -> NamedParts:
        """Return the parts at fault with the sizes that the fault has, and its onset."""
        never, parameters = self.never, self.never.parameters
        observations, width = never.trajectory.observations, never.trajectory.action_dim
        sensors, sizes = np.zeros((2, observations.shape[1]))
        faulty, actuator = parameters.get("sensors", []), parameters.get("actuator")
        reported = observations[never.effect :].astype(np.float64)
        errors = reported - np.asarray(never.measured)[never.effect :]
        # Readings that do not change say nothing.
        rms = np.sqrt((errors**2).mean(axis=0))
        sizes[faulty] = np.where(np.ptp(reported, axis=0) == 0, math.inf, rms)[faulty]
        sensors[faulty] = 1.0
        actuators = (np.arange(width) == actuator).astype(float)
        kind = "body" if actuator is None else "actuator"
        kind = "sensor" if self.group == "sensor" else kind
        return NamedParts(Naming(sensors, actuators, sizes, kind), never.onset or 0)


@dataclass(frozen=True, slots=True)
class FittedDetector:
    """A fitted detector, and its guaranteed alarm."""

    handle: DetectorHandle
    rule: GuaranteedAlarm

    def alarm(self, episode: RecordedEpisode) -> int | None:
        """Return the row of the first alarm."""
        return self.rule.first(self.handle.scores(episode.trajectory))

    def name(self, episode: Trajectory, _: int = 0) -> NamedParts:
        """Return what it names at the last row of an episode; nothing where it does not explain."""
        visible, last = self.handle.visible(episode), len(episode) - 1
        detector = self.handle.detector
        if not isinstance(detector, ExplainingDetector):
            sensors = np.zeros(visible.observation_dim)
            return NamedParts(Naming(sensors, np.zeros(0), sensors + math.nan), last)
        explanation = checked_explanation(detector.explain(visible), visible)
        naming = explanation.naming or naming_of(explanation, visible.action_dim)
        onset = int(explanation.onsets[-1])
        return NamedParts(naming, onset if onset >= 0 else last)


@dataclass(frozen=True, slots=True)
class Loop:
    """What all arms of an environment share: policy and noise, and the model of readings."""

    setup: Setup
    model: ReadingModel

    def arm(
        self, pair: LoopPair, spec: ActSpec, row: int | None, name: Namer, *, nominal: bool = False
    ) -> LoopArm:
        """Run the faulty or the `nominal` episode of a pair again, with an act from a row on.

        It is the episode itself where no command follows on the row.
        """
        taken = pair.twin if nominal else pair.never
        if row is None or row >= taken.trajectory.transitions:
            named = name(taken.trajectory, 0) if row == taken.trajectory.transitions else None
            return LoopArm(taken, None, {0: named} if named else {})
        controller = _TakingOver(self, spec, row, name)
        policy = CustomPolicy(self.setup.environment, controller)
        if nominal:
            episode = replace(self.setup, policy=policy).record(taken.seed)
        else:
            drawn = (pair.kind, pair.strength, pair.twin, taken.attempt)
            episode = record_again(self.setup, *drawn, policy)
        return LoopArm(episode, row, controller.namings)

    def oracle(self, pair: LoopPair, spec: ActSpec) -> LoopArm:
        """Return the arm that acts at the effect on the true parts."""
        return self.arm(pair, spec, pair.never.effect, _replayed({0: pair.truth()}))

    def failed(self, episode: RecordedEpisode) -> bool:
        """Tell whether an episode counts as a failure."""
        environment = self.setup.environment
        cap = min(filter(None, (info_of(environment).episode_cap, self.setup.episode_cap)))
        return failed(environment, episode, cap)


class _TakingOver:
    """A controller: the policy of the loop up to a row, then an act."""

    def __init__(self, loop: Loop, spec: ActSpec, row: int, name: Namer) -> None:
        self._loop, self._spec, self._row, self._name = loop, spec, row, name
        self._info = info_of(loop.setup.environment)

    def reset(self) -> None:
        """Begin an episode."""
        policy, cap = self._loop.setup.policy, self._info.episode_cap
        if isinstance(policy, CustomPolicy):
            policy.reset()
        self._rows = np.empty((cap + 1, self._info.observation_dim), np.float32)
        self._actions = np.empty((cap, self._info.action_dim), np.float32)
        self._t = 0
        self._acting: Act = policy
        self.namings: dict[int, NamedParts] = {}

    def act(self, row: Row) -> Any:
        """Return the command for the next row."""
        t, since, setup = self._t, self._t - self._row, self._loop.setup
        self._t, self._rows[t] = t + 1, row
        rows, actions = self._rows[: t + 1], self._actions[:t]
        renamed = since == 0 or since in RENAMED
        named = self._name(Trajectory(rows, actions), since) if renamed else None
        if named is not None:
            self.namings[since] = named
        if since == 0:
            parts = (rows, actions, *self.namings[0], self._loop.model)
            self._situation = Situation(setup.environment, setup.policy, *parts)
            self._acting = self._spec.make(self._situation)
        elif since > 0:
            self._situation.rows, self._situation.actions = rows, actions
            if named is not None:
                self._situation.naming, self._situation.onset = named
        action = self._acting.act(row)
        self._actions[t] = self._command(action, t)
        return action

    def _command(self, action: Any, t: int) -> NDArray[np.float64]:
        """Return a command as trajectories have it; `ContractError` where it is none."""
        width, values = self._info.action_dim, np.ravel(action)
        if self._info.discrete:
            expected = f"a whole number from 0 to {width - 1}"
            fine = np.ndim(action) == 0 and bool(np.isin(action, range(width)).all())
        else:
            expected = f"{width} finite number(s)"
            fine = values.shape == (width,) and values.dtype.kind in "fiu"
            fine = fine and bool(np.isfinite(values).all())
        if not fine:
            act, environment = self._spec.name, self._loop.setup.environment
            raise ContractError(
                f"act {act!r} of {environment} returned {action!r:.80} for row {t}: "
                f"expected {expected}"
            )
        return np.eye(width)[int(action)] if self._info.discrete else values


def run_cell(
    loop: Loop,
    pairs: Sequence[LoopPair],
    oracles: Sequence[LoopArm],
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
        ``"episodes"`` and ``"curves"`` of a raw cell, plain JSON.
    """
    alarms = [detector.alarm(pair.never) for pair in pairs]
    alarmed = zip(pairs, alarms, strict=True)
    watchdogs = [loop.arm(pair, spec, row, detector.name) for pair, row in alarmed]
    replays = [_replayed(arm.namings) for arm in watchdogs]
    arms_of, episodes = [], []
    for i, pair in enumerate(pairs):
        following = [*range(i + 1, len(pairs)), *range(i)]
        j = next((j for j in following if alarms[j] is not None), i)
        rung = detector.alarm(pair.twin)
        arms = {
            "twin": LoopArm(pair.twin),
            "never": LoopArm(pair.never),
            "watchdog": watchdogs[i],
            "oracle": oracles[i],
            "placebo": loop.arm(pair, spec, alarms[j] if j != i else None, replays[j]),
            "false": loop.arm(pair, spec, rung, detector.name, nominal=True),
            "forced": loop.arm(pair, spec, alarms[i], replays[i], nominal=True),
        }
        arms_of.append(arms)
        facts = {name: getattr(pair.never, name) for name in ("seed", "onset", "effect")}
        facts |= {"alarm": alarms[i], "false_alarm": rung}
        facts |= _naming(loop.model, pair, watchdogs[i])
        episodes.append(
            {
                **facts,
                "returns": {name: return_of(arm.episode) for name, arm in arms.items()},
                "rows": {name: len(arm.episode.rewards) for name, arm in arms.items()},
                "failed": {name: loop.failed(arm.episode) for name, arm in arms.items()},
                "acted": {name: arm.acted for name, arm in arms.items()},
            }
        )
    effects = [pair.never.effect or 0 for pair in pairs]
    curves = {name: _curve([arms[name] for arms in arms_of], effects) for name in ARMS}
    return {"episodes": episodes, "curves": {"first": FIRST, "arms": curves}}


def _replayed(namings: Mapping[int, NamedParts]) -> Namer:
    """Return what names parts as they were named once."""
    return lambda _, since: namings.get(since)


def _naming(model: ReadingModel, pair: LoopPair, watchdog: LoopArm) -> dict[str, Any]:
    """Return the parts at fault, those that were named, and the sensors with large readings."""
    truth, rows = pair.truth().naming, watchdog.episode.trajectory.observations
    faulty = {part: np.flatnonzero(getattr(truth, part)).tolist() for part in PARTS}
    named, largest = {}, {}
    for since, (naming, onset) in watchdog.namings.items():
        if since in KEPT:
            probabilities = {part: getattr(naming, part).tolist() for part in PARTS}
            named[str(since)] = {**probabilities, "kind": naming.kind, "onset": onset}
            t = len(rows) - 1 if watchdog.acted is None else watchdog.acted + since
            distances = np.abs(rows[t] - model.sensors.mean) / model.sensors.std
            largest[str(since)] = np.argsort(-distances, kind="stable").tolist()
    return {"parts": {**faulty, "kind": truth.kind}, "named": named, "largest": largest}


def _curve(arms: Sequence[LoopArm], effects: Sequence[int]) -> list[float]:
    """Return the mean rewards by row from `FIRST` on; rows after an end count 0."""
    # An effect is at row 30 or later, as every onset is.
    parts = [arm.episode.rewards[t + FIRST :] for arm, t in zip(arms, effects, strict=True)]
    size = max(map(len, parts))
    table = np.array([np.pad(part, (0, size - len(part))) for part in parts], np.float64)
    return [float(f"{reward:.6g}") for reward in table.mean(axis=0)]
