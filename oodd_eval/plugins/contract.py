"""The contract between harness and detectors: higher scores mean more anomalous.

That is the reverse of scikit-learn's ``score_samples`` and ``decision_function``: negate theirs.

A detector is fitted on nominal trajectories and then gives one float64 score per observation row.
It is causal: ``score(x)[:n]`` equals ``score(x[:n])`` for every prefix, so that a score at time t
uses nothing after t (randomness has to be keyed by seed and time, not by call order). NaN means
"not defined yet" and stands only in a leading block of at most ``max(horizon, warm_up)`` rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError

MAX_WARM_UP: Final = 20
"""Longest leading block, in rows, that a detector may declare undefined beyond its horizon."""

Scores = NDArray[np.float64]


@runtime_checkable
class Detector(Protocol):
    """What a plug-in's factory returns.

    A detector may also have

    - ``score_many(trajectories) -> list of score arrays``: the same scores, for many trajectories
      at once, where batching is faster;
    - ``warm_up``: an int of at most 20, rows at the start that it leaves NaN beyond the horizon;
    - ``reset()`` and ``update(observation, action=None) -> float``: see `StreamingDetector`;
    - ``save(directory)`` and ``load(directory)``: see `StorableDetector`.
    """

    def fit(self, nominal: Sequence[Trajectory]) -> object:
        """Learn from nominal trajectories, forgetting any earlier fit. The result is ignored."""
        ...

    def score(self, trajectory: Trajectory) -> Scores:
        """Return float64 scores of shape (T + 1,), higher meaning more anomalous."""
        ...


@runtime_checkable
class StreamingDetector(Detector, Protocol):
    """A detector that can run beside a robot, one observation at a time."""

    def reset(self) -> None:
        """Begin a new episode; `fit` does so too."""
        ...

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation, NaN where it is undefined.

        The scores of an episode are those of `score` on the whole of it, to a relative 1e-5.

        Parameters
        ----------
        observation : array of shape (D,)
            ``o_t``.
        action : array of shape (A,), optional
            ``a_{t-1}``, commanded since the previous observation; None at the first one, and for
            detectors that do not look at actions.
        """
        ...


@runtime_checkable
class StorableDetector(Detector, Protocol):
    """A detector whose fit can be kept in plain files.

    Neither method may use pickle: what is loaded may come from anywhere. Paths are directories.
    """

    def save(self, directory: Path) -> None:
        """Write the fitted state as files into an empty directory."""
        ...

    def load(self, directory: Path) -> None:
        """Take over what `save` wrote.

        Called instead of `fit` on a new detector, made with the same parameters but for those that
        `DetectorSpec.fit_ignores` names. Scores are then the same, bit for bit.

        Raises
        ------
        FittedStateError
            When the files are not what this detector saves.
        """
        ...


@dataclass(frozen=True, slots=True)
class DetectorSpec:
    """A detector as a plug-in offers it.

    Parameters
    ----------
    name
        The name on the command line: lower-case letters, digits and hyphens.
    factory
        Called as ``factory(seed=..., horizon=..., **parameters)``; returns an unfitted `Detector`.
        ``seed`` decides every random draw, ``horizon`` is the prediction horizon in steps.
    summary
        One line for ``oodd-eval list``.
    reference
        Where the method is from.
    inputs
        What the scores depend on: observations alone, or commanded actions too.
    parameters
        Names and defaults of the parameters that ``--param`` may set.
    other_parameters
        Whether ``--param`` may set others than those, whose names only the factory knows.
    requires
        Importable modules that the detector needs beyond oodd-eval's core, checked without
        importing them; without them it is listed as unavailable.
    extra
        What to install when one of `requires` is missing, such as ``"oodd-eval[reference]"``.
    version
        Version of the library that does the work, where that is not the plug-in itself, such as
        ``"scikit-learn.1.9.1"``: scores of another version are not taken for these.
    fit_ignores
        Parameters, and ``"horizon"``, that decide scores but not the fit: one saved fit then serves
        all their values.
    fit_name
        Detectors of one plug-in with the same name here share fits; default `name`.
    """

    name: str
    factory: Callable[..., Detector]
    summary: str
    reference: str = ""
    inputs: Literal["observations", "observations+actions"] = "observations"
    parameters: dict[str, Any] = field(default_factory=dict)
    other_parameters: bool = False
    requires: tuple[str, ...] = ()
    extra: str = ""
    version: str = ""
    fit_ignores: tuple[str, ...] = ()
    fit_name: str = ""


def check_scores(
    scores: object, trajectory: Trajectory, *, horizon: int, warm_up: int, detector: str, where: str
) -> Scores:
    """Return the scores as a float64 array if they honour the contract.

    Parameters
    ----------
    scores
        What the detector returned.
    trajectory
        What it was given.
    horizon, warm_up
        Prediction horizon and declared warm-up, in rows: NaN may stand in the leading
        ``max(horizon, warm_up)`` rows only.
    detector, where
        Names for the message, such as ``"rf"`` and ``"hopper/test/iid[7]"``.

    Raises
    ------
    ContractError
        Naming the detector, the trajectory, what was expected and what came.
    """
    who = f"detector {detector!r} returned"
    if not isinstance(warm_up, int) or isinstance(warm_up, bool) or not 0 <= warm_up <= MAX_WARM_UP:
        raise ContractError(
            f"detector {detector!r} declares warm_up = {warm_up!r}, "
            f"expected an int between 0 and {MAX_WARM_UP}"
        )
    if not isinstance(scores, np.ndarray):
        raise ContractError(
            f"{who} {type(scores).__name__} for {where}, expected a numpy array of float64"
        )
    if scores.ndim != 1:
        raise ContractError(
            f"{who} an array of shape {scores.shape} for {where}, expected ({len(trajectory)},): "
            "one score per observation"
        )
    if len(scores) != len(trajectory):
        raise ContractError(
            f"{who} {len(scores)} scores for {where}, expected {len(trajectory)} "
            "(one per observation)"
        )
    if scores.dtype != np.float64:
        raise ContractError(f"{who} {scores.dtype} scores for {where}, expected float64")
    finite = np.isfinite(scores)
    block = max(horizon, warm_up)
    leading = np.arange(len(scores)) < block
    wrong = ~finite & ~(leading & np.isnan(scores))
    if wrong.any():
        t = int(np.flatnonzero(wrong)[0])
        raise ContractError(
            f"{who} {scores[t]} at t = {t} of {where}, expected finite scores: NaN is allowed only "
            f"for t < {block} (the larger of horizon and declared warm-up)"
        )
    defined = np.flatnonzero(finite)
    if defined.size and not finite[defined[0] :].all():
        t = int(np.flatnonzero(~finite[defined[0] :])[0] + defined[0])
        raise ContractError(
            f"{who} NaN at t = {t} of {where}, after a defined score at t = {int(defined[0])}: "
            "expected NaN in one leading block only"
        )
    return scores
