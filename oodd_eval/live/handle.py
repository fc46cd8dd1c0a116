"""Detectors of watchdogs: made by name or passed in, fed row by row even if they do not stream."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import UsageError
from oodd_eval.metrics.alarms import AlarmKind
from oodd_eval.plugins.contract import Detector, StreamingDetector, make_detector
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.explanations import ExplainingDetector

Row = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class DetectorHandle:
    """A detector, with what it takes to make it again.

    `alarm` is the statistic of its alarms, and `actions` tells whether it gets actions. `state` has
    JSON values that `from_state` reads; its name is empty for an instance that was passed in.
    """

    detector: Detector
    alarm: AlarmKind
    actions: bool
    state: Mapping[str, Any]

    @classmethod
    def make(
        cls,
        detector: str | Detector,
        statistic: str | None,
        seed: int,
        horizon: int,
        parameters: Mapping[str, Any],
    ) -> Self:
        """Make the detector of that name, or take an instance."""
        if statistic not in {None, "cusum", "score"}:
            raise UsageError(f"statistic={statistic!r}, expected 'cusum' or 'score'")
        kind, name, actions = cast("AlarmKind | None", statistic), "", True
        if isinstance(detector, str):
            offer = discover().offer(detector)
            offer.require()
            spec = offer.spec
            detector = make_detector(
                spec.factory, seed=seed, horizon=horizon, parameters=parameters
            )
            kind, name, actions = kind or spec.alarm, spec.name, spec.inputs != "observations"
        elif not isinstance(detector, Detector):
            expected = "a name or an object with the methods fit(nominal) and score(trajectory)"
            raise UsageError(f"detector is {type(detector).__name__}, expected {expected}")
        state = {"name": name, "statistic": kind or "cusum", "seed": seed, "horizon": horizon}
        return cls(detector, kind or "cusum", actions, {**state, "parameters": dict(parameters)})

    def visible(self, trajectory: Trajectory) -> Trajectory:
        """Return an episode as the detector may see it."""
        return trajectory if self.actions else trajectory.without_actions()

    @classmethod
    def from_state(cls, state: Mapping[str, Any], detector: Detector | None) -> Self:
        """Make a saved detector again, not fitted; one without a name is `detector`."""
        if not state["name"] and detector is None:
            raise UsageError(
                "this watchdog was fitted with an instance: load(directory, detector) needs one "
                "with the same parameters"
            )
        return cls.make(
            detector or state["name"],
            state["statistic"],
            int(state["seed"]),
            int(state["horizon"]),
            state["parameters"],
        )


def streaming(detector: Detector) -> StreamingDetector:
    """Return a detector that takes one observation at a time; warn where that is slow."""
    if isinstance(detector, StreamingDetector):
        return detector
    warnings.warn(
        f"{type(detector).__name__} has no update: at every row it scores the whole episode so far,"
        " which takes longer and longer until reset",
        stacklevel=4,
    )
    return _Prefixes(detector)


class _Prefixes:
    """A detector that scores whole episodes, fed row by row."""

    def __init__(self, detector: Any) -> None:
        self._detector = detector
        self.fit, self.score = detector.fit, detector.score
        if isinstance(detector, ExplainingDetector):
            self.explain_last = self._explain_last
        self.reset()

    def reset(self) -> None:
        self._observations: list[Row] = []
        self._actions: list[Row] = []

    def update(self, observation: Row, action: Row | None = None) -> float:
        self._observations.append(observation)
        if action is not None:
            self._actions.append(action)
        self._sofar = Trajectory(self._observations, self._actions or None)
        return float(self._detector.score(self._sofar)[-1])

    def _explain_last(self) -> tuple[NDArray[np.float64], int]:
        shares, onsets = self._detector.explain(self._sofar)
        return shares[-1], int(onsets[-1])
