"""The contract between harness and detectors, and the checks that scores honour it.

Higher scores mean more anomalous: the reverse of scikit-learn's ``score_samples`` and
``decision_function``, so negate theirs.

A detector is fitted on nominal trajectories and then gives one score per observation row: a real
number of any type, which becomes float64.
It is causal: ``score(x)[:n]`` equals ``score(x[:n])`` for every prefix, so that a score at time t
uses nothing after t (randomness has to be keyed by seed and time, not by call order). NaN means
"not defined yet" and stands only in a leading block of at most ``max(horizon, warm_up)`` rows.
"""

from __future__ import annotations

import copy
import inspect
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Literal,
    Protocol,
    TypeAlias,
    TypeVar,
    runtime_checkable,
)

from oodd_eval.errors import ContractError, UsageError

# Every plug-in imports this module when detectors are listed, which should not take numpy's time.
if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from oodd_eval.data.trajectory import Trajectory
    from oodd_eval.plugins.state import State

CONTRACT: Final = 3
"""Version of how the harness fits and scores, part of every key of scores and fits.

Raise it by hand when a change of the harness changes scores.
"""

MAX_WARM_UP: Final = 20
"""Longest leading block, in rows, that a detector may declare undefined beyond its horizon."""

TOLERANCE: Final = 1e-3
"""Difference that stands for the same score where matrices differ in shape.

Summation orders, and so the last digits, depend on it. The same computation gives the same bits.
"""

ROLLOUT_TOLERANCE: Final = 5e-3
"""The same at larger horizons: ten steps in single precision have reached 1.4e-3."""

PROGRESS_SECONDS: Final = 0.5
"""Between two shares of a fit that are passed on, at least."""

Scores: TypeAlias = "NDArray[np.float64]"
Copied = TypeVar("Copied")

Progress: TypeAlias = Callable[[float], object]
"""A function that a long fit may call with the share of it that is done, from 0 to 1."""

Alarm = Literal["cusum", "score", "column", "flag"]
"""Statistic of a detector's guaranteed alarms, see `oodd_eval.metrics.alarms.GuaranteedAlarm`."""

Training = Literal["nominal", "simulation", "anomalies", "failures", "external", "oracle"]
"""The knowledge that a detector declares, see `DetectorSpec`."""


def training_mark(training: Training) -> str:
    """Return how lists and boards mark a detector by what it knows; empty for nominal data alone.

    Examples
    --------
    >>> training_mark("nominal"), training_mark("external"), training_mark("oracle")
    ('', 'trained on external', 'oracle')
    """
    if training == "nominal":
        return ""
    return training if training == "oracle" else f"trained on {training}"


@runtime_checkable
class Detector(Protocol):
    """A detector, as a plug-in's factory returns it.

    A detector may also have

    - ``score_many(trajectories) -> list of score arrays``: the same scores, for many trajectories
      at once, where batching is faster;
    - ``fit(nominal, progress=None)``: `progress` is then a function, or None, which a long fit
      calls now and then with the share that is done, from 0 to 1; it decides nothing;
    - ``fit(nominal, failures=None)``, for one that declares ``training="failures"``: `failures` are
      then failed episodes, a sequence of Trajectory; None where it is fitted without;
    - ``warm_up``: an int of at most 20, rows at the start that it leaves NaN beyond the horizon;
    - ``reset()`` and ``update(observation, action=None) -> float``: see `StreamingDetector`;
    - ``state()`` and ``restore(state)``: see `StorableDetector`;
    - ``explain(trajectory)`` and ``explain_last()``: see `oodd_eval.plugins.explanations`;
    - ``voices(trajectory) -> mapping``: where the score is the largest of several statistics, each
      of these by name, in the score's units: see `oodd_eval.plugins.voices`.
    """

    def fit(self, nominal: Sequence[Trajectory]) -> object:
        """Learn from nominal trajectories, forgetting any earlier fit.

        Parameters
        ----------
        nominal : sequence of Trajectory
            Training trajectories, all with the same numbers of sensors and actions.

        Returns
        -------
        object
            Ignored.
        """

    def score(self, trajectory: Trajectory) -> Scores:
        """Return one score per observation row, higher meaning more anomalous.

        Parameters
        ----------
        trajectory : Trajectory
            One episode with T transitions.

        Returns
        -------
        array of real numbers of shape (T + 1,)
            NaN in the leading undefined rows only. A list and other dtypes than float64 do, too.

        Raises
        ------
        NotFittedError
            Before `fit`.
        TrajectoryError
            For another number of sensors than in training.
        """


@runtime_checkable
class StreamingDetector(Detector, Protocol):
    """A detector that can run beside a robot, one observation at a time.

    Several episodes may run at a time, each in a deep copy of the fitted detector: keep what an
    episode leaves behind in attributes, not in a module, a class or a closure.
    """

    def reset(self) -> None:
        """Begin a new episode; `fit` does so too."""

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation: that of `score`.

        They may differ by 1e-5 of the spread of scores, 1e-4 at horizons above 1.

        Parameters
        ----------
        observation : float32 array of shape (D,)
            The newest sensor readings.
        action : float32 array of shape (A,), optional
            ``a_{t-1}``, commanded since the previous observation; None at the first one. Detectors
            that do not look at actions are given None or an action of width 0.

        Returns
        -------
        float
            NaN where the score is undefined.

        Raises
        ------
        TrajectoryError
            For another number of readings than in training, or a reading that is not finite.
        """


@runtime_checkable
class StorableDetector(Detector, Protocol):
    """A detector whose fit can be handed over as data: never as code, as it may be anybody's.

    A sandboxed run scores each group in a process of its own, which takes over the state of one
    fit; without these methods the detector is fitted again in each of them.
    """

    def state(self) -> State:
        """Return the fitted state by name.

        Returns
        -------
        mapping
            NumPy arrays of numbers (at most 512 MB in all), and values that JSON knows (at most
            1 MB): numbers, texts, truth values, None, lists and mappings of these.
        """

    def restore(self, state: State) -> None:
        """Take over a state instead of `fit`: scores are the same, bit for bit.

        Parameters
        ----------
        state : mapping
            From `state` of a detector with the same parameters, except those that do not decide the
            fit (`oodd_eval.plugins.parameters.parameter`). Arrays have their dtypes and shapes;
            tuples have become lists.

        Raises
        ------
        FittedStateError
            For another state.
        """


AnyDetector: TypeAlias = str | Detector | Callable[..., Detector]
"""A detector as scripts have it: a name, an object, a class or function that makes one."""


@dataclass(frozen=True, slots=True)
class DetectorSpec:
    """A detector as a plug-in offers it.

    Parameters
    ----------
    name
        The name on the command line: lower-case letters, digits and hyphens.
    factory
        Called as ``factory(seed=..., horizon=..., **parameters)``; returns an unfitted `Detector`.
        ``seed`` decides every random draw, ``horizon`` is the prediction horizon in steps. One that
        does not take one of these two is called without it, unless it takes ``**parameters``.
    summary
        One line for ``oodd-eval list``.
    reference
        Where the method is from.
    inputs
        What the scores depend on: observations alone, or commanded actions too. A detector that
        declares observations is handed trajectories whose actions have width 0.
    with_actions
        Name of the plug-in's detector that takes this one's place where episodes have actions,
        unless both are named or the parameter ``actions`` is ``"no"``. It has the same other
        parameters. Results name the detector that was run.
    deterministic
        Whether the seed changes nothing: results of one seed are then those of all.
    training
        What it learns from beyond parameters: ``"nominal"``, the trajectories given to `fit`, and
        nothing else; ``"simulation"``, nominal episodes of its own besides; ``"anomalies"``,
        anomalous ones; ``"failures"``, failed episodes of training tasks, which `fit` is handed;
        ``"external"``, other data, such as pretrained weights; ``"oracle"``, it has
        the true equations of the environment. Boards rank the first.
    alarm
        The statistic of the guaranteed alarms: ``"cusum"`` of standardized scores, or ``"score"``,
        the score itself, for a detector that accumulates by itself. Of a monitor's recorded number,
        which faults of the sensors do not join: ``"column"``, the number itself, and ``"flag"``, an
        alarm already, where the number is not 0, whatever the level.
    columns
        Names of columns of logs, sensors or recorded scores, that it is handed in place of the
        sensors; a name stands for NAME[0], NAME[1] and so on, too. Empty for the sensors.
    adapts
        ``"baseline"`` for a detector that learns from the first rows of each episode by itself,
        where these are declared nominal. Its factory is then called with their number, too, as
        ``baseline=B``, and it is handed whole episodes as they were recorded, whose first B scores
        count for nothing. Others are handed the rows behind them, brought to training's mean and
        spread (`oodd_eval.data.baseline`).
    roles
        Whether the factory is also called with the roles of the sensors, ``roles=(...)``, one of
        `oodd_eval.Quantity`'s a sensor, where any of them says more than ``"measured"``.
    parameters
        A frozen dataclass whose fields are the parameters that ``--param`` may set, each declared
        with `oodd_eval.plugins.parameters.parameter`. None when there are none.
    other_parameters
        Whether ``--param`` may set others than those, whose names only the factory knows.
    requires
        Modules that it needs beyond oodd-eval's core; without them it is listed as unavailable.
    extra
        What to install when one of `requires` is missing, such as ``"oodd-eval[reference]"``.
    version
        Of the library that does the work, where that is not the plug-in itself, such as
        ``"scikit-learn.1.9.1"``: scores of another version are not taken for these.
    horizon_decides_fit
        Whether the horizon changes the fitted detector; if not, one saved fit serves all horizons.
    seconds
        About how long a fit takes on the split ``mini``: a run begins long fits first. 0 stands for
        10 where the detector `requires` further modules.
    fit_name
        Detectors of one plug-in with the same name here share fits; default `name`.
    """

    name: str
    factory: Callable[..., Detector]
    summary: str
    reference: str = ""
    inputs: Literal["observations", "observations+actions"] = "observations"
    with_actions: str = ""
    deterministic: bool = False
    training: Training = "nominal"
    alarm: Alarm = "cusum"
    columns: tuple[str, ...] = ()
    adapts: Literal["", "baseline"] = ""
    roles: bool = False
    parameters: type | None = None
    other_parameters: bool = False
    requires: tuple[str, ...] = ()
    extra: str = ""
    version: str = ""
    horizon_decides_fit: bool = True
    seconds: float = 0.0
    fit_name: str = ""


def make_detector(
    factory: Callable[..., Detector],
    *,
    seed: int,
    horizon: int,
    parameters: Mapping[str, Any],
    baseline: int = 0,
    roles: Sequence[str] = (),
) -> Detector:
    """Return an unfitted detector; raise `ContractError` for anything without `fit` and `score`.

    `baseline` is the number of baseline rows for one that adapts to them, `roles` are those of the
    sensors for one that declares them.
    """
    declared: dict[str, Any] = {"baseline": baseline} if baseline else {}
    declared |= {"roles": tuple(roles)} if roles else {}
    detector = factory(**accepted(factory, seed=seed, horizon=horizon), **declared, **parameters)
    if not isinstance(detector, Detector):
        expected = "an object with the methods fit(nominal) and score(trajectory)"
        raise ContractError(f"the factory returned {type(detector).__name__}, expected {expected}")
    return detector


def accepted(factory: Callable[..., object], **arguments: Any) -> dict[str, Any]:
    """Return those of some arguments that a factory takes; all where its signature is not known.

    >>> accepted(lambda seed: seed, seed=0, horizon=1)
    {'seed': 0}
    """
    try:
        taken = inspect.signature(factory).parameters
    except (TypeError, ValueError):  # of some compiled functions
        return arguments
    if any(p.kind is p.VAR_KEYWORD for p in taken.values()):
        return arguments
    return {name: value for name, value in arguments.items() if name in taken}


def factory_of(detector: object) -> Callable[..., Detector]:
    """Return what makes a detector: a class or function as it is, of an object its copies.

    Raises `UsageError` for anything else.
    """
    if isinstance(detector, Detector) and not isinstance(detector, type):
        return lambda: copied(detector)
    if callable(detector):
        return detector
    raise UsageError(
        f"{detector!r:.80} is no detector: expected a name, a DetectorSpec, a class or "
        "function that makes one, or an object with fit(nominal) and score(trajectory)"
    )


def copied(whole: Copied, detector: object = None) -> Copied:
    """Return a deep copy; `UsageError` names the attribute of the detector that prevents it.

    The detector is the whole, or part of it.
    """
    try:
        return copy.deepcopy(whole)
    except Exception as error:  # a lock raises another one than an open file or a tensor
        detector = whole if detector is None else detector
        name = type(detector).__name__
        culprit = next(filter(_fails, getattr(detector, "__dict__", {}).items()), None)
        because = f", because of its attribute {culprit[0]!r}" if culprit else ""
        raise UsageError(
            f"{name} cannot be copied{because} ({type(error).__name__}: {error}): pass the class "
            f"or a function that makes it, or define __getstate__ of {name} without what cannot be "
            "copied, and __setstate__, which makes it again"
        ) from error


def _fails(attribute: tuple[str, object]) -> bool:
    try:
        copy.deepcopy(attribute[1])
    except Exception:  # noqa: BLE001  whatever it raises
        return True
    return False


def ignore_progress(share: float) -> None:
    """Ignore which share of a fit is done: a `Progress` for those who do not ask."""
    del share


def takes_progress(detector: Detector) -> bool:
    """Tell whether a detector's `fit` has a parameter ``progress``."""
    try:
        return "progress" in inspect.signature(detector.fit).parameters
    except (TypeError, ValueError):  # of a compiled function, say
        return False


def fit_detector(
    detector: Detector,
    nominal: Sequence[Trajectory],
    progress: Progress | None = None,
    failures: Sequence[Trajectory] | None = None,
) -> None:
    """Fit a detector; if it can tell, `progress` hears now and then which share is done.

    Failed episodes are handed to one that declares that it learns from them. Shares are heard in
    this process and during the fit only. `ContractError`: the detector calls what it is handed with
    something else than a share, or takes no failures.
    """
    further = {} if failures is None else {"failures": failures}
    if further and not accepted(detector.fit, **further):
        expected = "expected fit(nominal, failures=None)"
        raise ContractError(f'it declares training="failures", and its fit takes none: {expected}')
    if progress is None or not takes_progress(detector):
        detector.fit(nominal, **further)
        return
    latest, lock = -math.inf, threading.Lock()

    def report(share: float) -> None:
        nonlocal latest
        if not 0 <= share <= 1:
            raise ContractError(f"fit called progress with {share!r:.80}, expected 0 to 1")
        with lock:
            if (now := time.monotonic()) - latest >= PROGRESS_SECONDS:
                latest = now
                progress(float(share))

    detector.fit(nominal, progress=report, **further)  # type: ignore[call-arg]
    with lock:
        latest = math.inf  # A detector may keep the function, and call it later.


def score_chunk(detector: Detector, chunk: Sequence[Trajectory]) -> list[object]:
    """Return unchecked scores of some trajectories, scored all at once if the detector can.

    Raises `ContractError` when ``score_many`` returns another number of score arrays.
    """
    score_many = getattr(detector, "score_many", None)
    scores = list(score_many(chunk)) if score_many else [detector.score(x) for x in chunk]
    if len(scores) != len(chunk):
        expected = f"{len(chunk)}: one for each trajectory"
        raise ContractError(f"score_many returned {len(scores)} score arrays, expected {expected}")
    return scores


def float_scores(returned: object, subject: str = "score", where: str = "") -> Scores:
    """Return scores of any real type, a list or an array, as a float64 array of the same shape.

    An array of float64 is returned as it is. `ContractError` names what else a detector returned.
    """
    import numpy as np  # noqa: PLC0415  see above

    # A detector that returns masked arrays has imported numpy.ma; others would pay 50 ms for it.
    # While another thread imports it, it has no names yet.
    is_masked = getattr(sys.modules.get("numpy.ma"), "is_masked", None)
    if is_masked and is_masked(returned):
        # Only its data would go on, with whatever stands where it is masked.
        expected = "expected NaN where it is undefined"
        raise ContractError(f"{subject} returned a masked array{where}, {expected}")
    kind, array = type(returned).__name__, None
    if isinstance(returned, list | tuple) or hasattr(returned, "__array__"):
        try:
            array = np.asarray(returned)
        except Exception as error:  # noqa: BLE001  lists of unequal lengths, tensors with gradients
            kind = f"{kind} that is no array ({error})"
        else:
            kind = f"{kind} of {array.dtype}"
    if array is None or array.dtype.kind not in "biuf":
        raise ContractError(f"{subject} returned {kind}{where}, expected real numbers in an array")
    return array.astype(np.float64, copy=False)


def check_scores(
    scores: object,
    trajectory: Trajectory | int,
    *,
    horizon: int,
    warm_up: object,
    detector: str,
    where: str,
    baseline: int = 0,
) -> Scores:
    """Return the scores as a float64 array if they honour the contract.

    Parameters
    ----------
    scores : object
        The value that the detector returned.
    trajectory : Trajectory or int
        The scored episode, or its number of observations.
    horizon, warm_up : int
        Rows: NaN may stand in the leading ``max(horizon, warm_up)`` only.
    detector, where : str
        Names for messages, such as ``"rf"`` and ``"hopper/test/iid[7]"``.
    baseline : int
        Rows more at the start, of which a detector that adapts learns.

    Returns
    -------
    float64 array of shape (T + 1,)
        The scores.

    Raises
    ------
    ContractError
        When they do not honour the contract, or `warm_up` is no int from 0 to `MAX_WARM_UP`.
    """
    import numpy as np  # noqa: PLC0415  see above

    if not isinstance(warm_up, int) or isinstance(warm_up, bool) or not 0 <= warm_up <= MAX_WARM_UP:
        expected = f"expected an int between 0 and {MAX_WARM_UP}"
        raise ContractError(f"detector {detector!r} declares warm_up = {warm_up!r}, {expected}")
    rows = trajectory if isinstance(trajectory, int) else len(trajectory)
    block = baseline + max(horizon, warm_up)
    scores = float_scores(scores, f"detector {detector!r}", f" for {where}")
    if scores.ndim != 1:
        shape = f"an array of shape {scores.shape} for {where}"
        wrong = f"{shape}, expected ({rows},): one score per observation"
    elif len(scores) != rows:
        wrong = f"{len(scores)} scores for {where}, expected {rows} (one per observation)"
    elif (bad := ~np.isfinite(scores) & ~(np.isnan(scores) & (np.arange(rows) < block))).any():
        t = int(bad.argmax())
        behind = f", behind {baseline} baseline rows" if baseline else ""
        allowed = f"t < {block} (the larger of horizon and declared warm-up{behind})"
        wrong = f"{scores[t]} at t = {t} of {where}, expected finite scores, or NaN for {allowed}"
    elif (late := np.flatnonzero(np.diff(np.isnan(scores).astype(int)) > 0)).size:
        wrong = f"NaN at t = {late[0] + 1} of {where}, expected it in one leading block only"
    else:
        return scores
    raise ContractError(f"detector {detector!r} returned {wrong}")
