"""Explanations of detectors: what they are, their checks, and what the harness keeps of them."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import Detector, StreamingDetector

Named: TypeAlias = NDArray[np.int32]
"""The sensor named first at a row, the onset, the number of the kind, and 1 for each named part.

Of shape (3 + D + A,): sensors come before actuators. `KINDS` has the numbers; -1 without a naming.
"""

NAMED: Final = 0.5
"""Least probability of a part that is named."""

FLIPPED: Final = 0.05
"""Share of rows in which rounding may turn the sensor named first, or the onset, into another."""

_ROUNDING: Final = 1e-5  # of a sum of shares


KINDS: Final = ("", "sensor", "actuator", "body", "environment")
"""Places that a naming may give to a fault; an empty text gives none."""


class Naming(NamedTuple):
    """The parts that are at fault, as seen at the last row of an episode.

    A part with a probability of one half or more is named.

    Attributes
    ----------
    sensors : float64 array of shape (D,)
        Probability of each sensor being faulty, from 0 to 1.
    actuators : float64 array of shape (A,)
        The same of each actuator; of shape (0,) from a detector that does not see actions.
    sizes : float64 array of shape (D,)
        Size of each sensor's fault in the sensor's unit, a standard deviation about what it should
        read. NaN where it is not known, and infinite where the sensor's reading says nothing.
    kind
        One of `KINDS`.
    """

    sensors: NDArray[np.float64]
    actuators: NDArray[np.float64]
    sizes: NDArray[np.float64]
    kind: str = ""


class Explanation(NamedTuple):
    """Shares of the sensors in each score of one episode with T transitions, and onsets.

    Attributes
    ----------
    shares : float64 array of shape (T + 1, D)
        Share of each sensor in the evidence of each row: not negative, with the sum 1. Equal shares
        where there is no evidence; a row of NaN where the score is undefined.
    onsets : int64 array of shape (T + 1,)
        The row, at most t, with which an anomaly would have begun as seen at row t; -1 where the
        score is undefined.
    naming
        The parts at fault as seen at the last row, from a detector that names them as a set.
    """

    shares: NDArray[np.float64]
    onsets: NDArray[np.int64]
    naming: Naming | None = None


@runtime_checkable
class ExplainingDetector(Detector, Protocol):
    """A detector that tells which sensors its scores are from, and since when."""

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return what the scores of an episode are due to; as causal as `score`.

        The one sensor with the largest share at a row is named first for it. The parts that are at
        fault at the last row are those of the naming, else those of `naming_of`. A tuple of two or
        three values will do.

        Parameters
        ----------
        trajectory : Trajectory
            One episode, which a fitted detector may not have scored.

        Returns
        -------
        Explanation
        """


@runtime_checkable
class StreamingExplainer(StreamingDetector, Protocol):
    """A detector that tells beside a robot, too, which sensors its scores are from."""

    def explain_last(
        self,
    ) -> tuple[NDArray[np.float64], int] | tuple[NDArray[np.float64], int, Naming]:
        """Return what the score of the latest `update` is due to: that row of ``explain``.

        Returns
        -------
        shares : float64 array of shape (D,)
            Share of each sensor, with the sum 1; NaN where the score is undefined.
        onset : int
            The row since the latest ``reset`` with which an anomaly would have begun, or -1.
        naming : Naming, optional
            The parts at fault as seen at this row, where ``explain`` names them as a set.
        """


def explains(detector: object) -> bool:
    """Tell whether a detector offers explanations."""
    return isinstance(detector, ExplainingDetector)


def explain_chunk(detector: Any, chunk: Sequence[Trajectory]) -> list[object]:
    """Return what is `Named` at the last rows of episodes, after all rows were checked."""
    return [_named(checked_explanation(detector.explain(x), x), x.action_dim) for x in chunk]


def _named(explanation: Explanation, actions: int) -> Named:
    naming = naming_of(explanation, actions)
    # Of several with the largest share the first one is named.
    sensor = np.nan_to_num(explanation.shares[-1]).argmax()
    kind = KINDS.index(naming.kind) if explanation.naming else -1
    parts = np.concatenate([naming.sensors, naming.actuators]) >= NAMED
    return np.array([sensor, explanation.onsets[-1], kind, *parts], dtype=np.int32)


def checked_explanation(returned: Any, trajectory: Trajectory) -> Explanation:
    """Return what ``explain`` returned for a trajectory; `ContractError` against the contract."""
    rows, sensors = trajectory.observations.shape
    try:
        shares, onsets, naming = returned if len(returned) > 2 else (*returned, None)
    except (TypeError, ValueError):
        kind = type(returned).__name__
        expected = "shares, onsets and perhaps a Naming"
        raise ContractError(f"explain returned {kind}, expected {expected}") from None
    _check_form("shares", shares, f"float64 of shape {(rows, sensors)}")
    _check_form("onsets", onsets, f"int64 of shape {(rows,)}")
    undefined = np.isnan(shares).all(axis=1)
    parts = (shares >= 0).all(axis=1) & (np.abs(shares.sum(axis=1) - 1) <= _ROUNDING)
    valid = np.where(undefined, onsets == -1, (onsets >= 0) & (onsets <= np.arange(rows)))
    for name, array, fine, expected in (
        ("shares", shares, undefined | parts, "parts of 1, or NaN alone where it is undefined"),
        ("onset", onsets, valid, "a row from 0 to t, or -1 where the shares are NaN"),
    ):
        if not fine.all():
            t = int(fine.argmin())
            raise ContractError(f"explain gives the {name} {array[t]} at t = {t}: {expected}")
    if naming is not None:
        naming = checked_naming(naming, sensors, trajectory.action_dim)
    return Explanation(shares, onsets, naming)


def checked_naming(returned: Any, sensors: int, actions: int) -> Naming:
    """Return a naming that came back from ``explain`` or ``explain_last``, checked.

    Parameters
    ----------
    returned
        A `Naming`, or a tuple of its four values.
    sensors, actions
        Numbers of the sensors and of the actions that the detector sees.

    Returns
    -------
    Naming

    Raises
    ------
    ContractError
        For another type, shape or kind, a probability outside of 0 to 1, or a negative size.
    """
    try:
        naming = Naming(*returned)
    except TypeError:
        kind = type(returned).__name__
        raise ContractError(f"explain names parts as {kind}, expected a Naming") from None
    seen = actions if np.size(naming.actuators) else 0
    for name, n in (("sensors", sensors), ("actuators", seen), ("sizes", sensors)):
        _check_form(name, values := getattr(naming, name), f"float64 of shape {(n,)}")
        most, range_ = (np.inf, "0 or more, or NaN") if name == "sizes" else (1.0, "0 to 1")
        bad = (values < 0) | (values > most) | (np.isnan(values) & (name != "sizes"))
        if bad.any():
            d = int(bad.argmax())
            raise ContractError(f"explain names {name} with {values[d]} at {d}, expected {range_}")
    if naming.kind not in KINDS:
        expected = ", ".join(map(repr, KINDS))
        raise ContractError(f"explain names the kind {naming.kind!r}, expected one of {expected}")
    return naming


def naming_of(explanation: Explanation, actions: int) -> Naming:
    """Return the parts that an explanation names at its last row.

    One that has shares alone names the fewest sensors that together carry half of the last row's
    shares, and none where these are undefined.

    Parameters
    ----------
    explanation
        Of an episode until now.
    actions
        Number of actuators in the naming; those of a detector that sees none are not at fault.

    Returns
    -------
    Naming

    Examples
    --------
    >>> shares = np.array([[0.1, 0.4, 0.2, 0.3]])
    >>> naming_of(Explanation(shares, np.array([0])), actions=1).sensors
    array([0., 1., 0., 1.])
    """
    if naming := explanation.naming:
        return naming if len(naming.actuators) else naming._replace(actuators=np.zeros(actions))
    shares = np.nan_to_num(explanation.shares[-1])
    order = np.argsort(-shares, kind="stable")
    before = np.cumsum(shares[order]) - shares[order]
    sensors = np.zeros(len(shares))
    sensors[order[(before < 0.5 - _ROUNDING) & (shares[order] > 0)]] = 1.0
    return Naming(sensors, np.zeros(actions), np.full(len(shares), np.nan))


def _check_form(name: str, array: Any, form: str) -> None:
    """Raise `ContractError` for another type or shape than ``"float64 of shape (3,)"``."""
    is_array = isinstance(array, np.ndarray) and not np.ma.is_masked(array)
    actual = f"{array.dtype} of shape {array.shape}" if is_array else type(array).__name__
    if actual != form:
        raise ContractError(f"explain returned {name} as {actual}, expected {form}")
