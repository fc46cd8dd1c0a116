"""Detectors of watchdogs: made by name or passed in, fed row by row even if they do not stream."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Self, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.baseline import Baseline, undefined
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, UsageError
from oodd_eval.metrics.alarms import RECORDED, STATISTICS, AlarmKind
from oodd_eval.names import read, whole_number
from oodd_eval.plugins.contract import (
    AnyDetector,
    Detector,
    DetectorSpec,
    StorableDetector,
    StreamingDetector,
    factory_of,
    fit_detector,
    float_scores,
    make_detector,
)
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.explanations import ExplainingDetector
from oodd_eval.plugins.state import State, pack

DETECTOR: Final = "detector."
"""Prefix of a detector's arrays among those of a state that it is part of."""

Row = NDArray[np.float32]
Floats = NDArray[np.float64]


def has_actions(episodes: Iterable[Trajectory]) -> bool:
    """Tell whether all of some episodes have actions; not of none."""
    widths = {episode.actions.shape[1] for episode in episodes}
    return bool(widths) and 0 not in widths


def columns_of(detector: AnyDetector) -> tuple[str, ...]:
    """Return the columns that a named detector is handed; none where it is handed the sensors."""
    return discover().offer(detector).spec.columns if isinstance(detector, str) else ()


@dataclass(frozen=True, slots=True)
class DetectorHandle:
    """A detector, with what it takes to make it again.

    `alarm` is the statistic of its alarms, `actions` tells whether it gets actions, `adapts`
    whether it learns from baseline rows by itself, and `supervised` whether it learns from failed
    episodes. `state` has JSON values that `from_state` reads; its name is empty for a class, a
    function or an instance that was passed in.
    """

    detector: Detector
    alarm: AlarmKind
    actions: bool
    adapts: bool
    state: Mapping[str, Any]
    supervised: bool = False

    @classmethod
    def make(
        cls,
        detector: AnyDetector,
        statistic: str | None,
        seed: int,
        horizon: int,
        parameters: Mapping[str, Any],
        baseline: int = 0,
        roles: Sequence[str] = (),
        *,
        actions: bool = False,
    ) -> Self:
        """Make a detector of a name or class, or take an instance.

        `baseline` rows and the sensors' `roles` are handed to one that declares them. With
        `actions` it is the one that takes them, see `Plugins.taking_actions`.
        """
        seed = read("seed", partial(whole_number, least=0), seed)
        horizon = read("horizon", partial(whole_number, least=1), horizon)
        kind: AlarmKind | None = next((kind for kind in STATISTICS if kind == statistic), None)
        if kind is None and statistic is not None:
            raise UsageError(f"{statistic=}, expected one of {', '.join(map(repr, STATISTICS))}")
        how: dict[str, Any] = {"seed": seed, "horizon": horizon, "parameters": parameters}
        # A class or an instance declares nothing.
        spec = DetectorSpec("", Detector, "", inputs="observations+actions")
        if isinstance(detector, str):
            plugins = discover()
            offer = plugins.offer(detector)
            if actions:
                offer, how["parameters"] = plugins.taking_actions(offer, parameters)
            offer.require()
            spec = offer.spec
            rows, declared = baseline if spec.adapts else 0, roles if spec.roles else ()
            detector = make_detector(spec.factory, baseline=rows, roles=declared, **how)
        elif isinstance(detector, type) or not isinstance(detector, Detector):
            detector = make_detector(factory_of(detector), **how)
        alarm: AlarmKind = kind or spec.alarm
        how["parameters"] = dict(how["parameters"])
        state = {"name": spec.name, "statistic": alarm, "baseline": baseline, "roles": [*roles]}
        learns = bool(spec.adapts), how | state, spec.training == "failures"
        return cls(detector, alarm, spec.inputs != "observations", *learns)

    def fit(
        self,
        nominal: Iterable[Trajectory],
        base: Baseline | None = None,
        failures: Sequence[Trajectory] = (),
    ) -> None:
        """Fit the detector on what it may see; a supervised one takes failed episodes, too.

        `UsageError` where it lacks these, or a named one learns from nominal episodes alone.
        """
        if self.state["name"] and self.supervised != bool(failures):
            learns = "failed episodes, too: failures= has them, or an environment of imported logs"
            learns = learns if self.supervised else "nominal episodes alone: leave out failures"
            raise UsageError(f"{self.state['name']} learns from {learns}")
        visible = [self.visible(x, base) for x in nominal]
        failed = [self.visible(x, base) for x in failures] if failures else None
        fit_detector(self.detector, visible, failures=failed)

    def visible(self, trajectory: Trajectory, base: Baseline | None = None) -> Trajectory:
        """Return what the detector may see of an episode: all rows if it learns from the first."""
        judged = trajectory if base is None or self.adapts else base.judged(trajectory)
        return judged if self.actions else judged.without_actions()

    def scores(self, trajectory: Trajectory, base: Baseline | None = None) -> Floats:
        """Return the scores of a whole episode, undefined in its baseline rows."""
        visible = self.visible(trajectory, base)
        scores = float_scores(self.detector.score(visible))
        if scores.shape != (len(visible),):
            expected = f"expected ({len(visible)},): one score per observation"
            raise ContractError(f"score returned an array of shape {scores.shape}, {expected}")
        rows = base.rows if base else 0
        return undefined(scores[len(scores) - len(trajectory) + rows :], rows)

    def fitted(self) -> dict[str, Any]:
        """Return the fit of a detector that is storable, as part of a state."""
        detector = cast(StorableDetector, self.detector)
        packed = pack(detector.state(), self.state["name"] or type(detector).__name__)
        arrays = {DETECTOR + name: array for name, array in packed.arrays.items()}
        return {"detector": packed.values(), **arrays}

    def restore(self, state: State) -> None:
        """Take up the fit of a detector that is storable, from a state that has `fitted`."""
        arrays = {n.removeprefix(DETECTOR): a for n, a in state.items() if n.startswith(DETECTOR)}
        cast(StorableDetector, self.detector).restore({**state["detector"], **arrays})

    @classmethod
    def from_state(cls, state: Mapping[str, Any], detector: AnyDetector | None) -> Self:
        """Make a saved detector again, not fitted; one without a name is `detector`."""
        if not state["name"] and detector is None:
            raise UsageError(
                "this watchdog was fitted with a detector without a name: load(path, detector) "
                "needs the class, or an instance with the same parameters"
            )
        statistic = None if state["statistic"] in RECORDED else state["statistic"]
        how = int(state["seed"]), int(state["horizon"]), state["parameters"], int(state["baseline"])
        roles = tuple(map(str, state.get("roles", ())))
        return cls.make(detector or state["name"], statistic, *how, roles)


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
        return float(float_scores(self._detector.score(self._sofar))[-1])

    def _explain_last(self) -> tuple[Any, ...]:
        shares, onsets, *naming = self._detector.explain(self._sofar)
        return shares[-1], int(onsets[-1]), *naming
