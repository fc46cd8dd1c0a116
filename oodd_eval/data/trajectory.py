"""One episode as a detector sees it, and sequences of episodes.

Time runs as in the protocol: observations ``o_0 .. o_T`` (T + 1 rows) and the commanded actions
``a_0 .. a_{T-1}`` between them; ``a_t`` was chosen after ``o_t`` was seen.
"""

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.errors import PrecisionWarning, TrajectoryError


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """One frozen, validated episode: observations and actions, and nothing that tells the answer.

    Parameters
    ----------
    observations : array of shape (T + 1, D)
        Rows ``o_0 .. o_T`` in the simulator's units; stored as read-only float32, as are actions.
    actions : array of shape (T, A), optional
        Rows ``a_0 .. a_{T-1}``, commanded by the policy; a discrete action is a one-hot row. None
        for an episode without known actions: rows of width A = 0.

    Raises
    ------
    TrajectoryError
        When a shape does not fit, an array is empty or a value is not finite, missing or masked.

    Warns
    -----
    PrecisionWarning
        When float32 has too few steps for the spread of a sensor whose readings come with more.

    Examples
    --------
    >>> episode = Trajectory([[0.0, 1.0], [0.1, 1.0], [0.2, 1.0]], [[1.0], [-1.0]])
    >>> len(episode), episode.transitions, episode.observation_dim, episode.action_dim
    (3, 2, 2, 1)
    >>> len(episode[:2])
    2
    >>> episode.without_actions()
    Trajectory(T=2, D=2, A=0)
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]

    def __init__(self, observations: ArrayLike, actions: ArrayLike | None = None) -> None:
        o = _matrix("observations", observations)
        a = _matrix(
            "actions", np.empty((len(o) - 1, 0), np.float32) if actions is None else actions
        )
        if len(o) != len(a) + 1:
            raise TrajectoryError(
                f"a trajectory has one observation more than actions: got {len(o)} observations "
                f"and {len(a)} actions, expected {len(a) + 1} observations (o_0 .. o_T)"
            )
        object.__setattr__(self, "observations", o)
        object.__setattr__(self, "actions", a)

    def __repr__(self) -> str:
        """Return the sizes: the numbers of an episode would fill screens."""
        return f"Trajectory(T={self.transitions}, D={self.observation_dim}, A={self.action_dim})"

    def __len__(self) -> int:
        """Return the number of observations, T + 1: the length of a score sequence."""
        return len(self.observations)

    def __getitem__(self, rows: slice) -> "Trajectory":
        """Return the first n observations as an episode: only ``[:n]`` with n >= 1 is allowed."""
        n = len(range(len(self))[rows]) if isinstance(rows, slice) else 0
        if n < 1 or rows.step not in (None, 1) or rows.start not in (None, 0):
            raise TrajectoryError(
                f"only a non-empty prefix of a trajectory is a trajectory: expected [:n] with "
                f"1 <= n <= {len(self)}, got [{rows}]"
            )
        return Trajectory(self.observations[:n], self.actions[: n - 1])

    def without_actions(self) -> "Trajectory":
        """Return the same observations with actions of width 0.

        Returns
        -------
        Trajectory
            This one where its actions are of width 0 already.
        """
        return Trajectory(self.observations) if self.action_dim else self

    @property
    def transitions(self) -> int:
        """Number of transitions, T."""
        return len(self.actions)

    @property
    def observation_dim(self) -> int:
        """Number of sensors, D."""
        return int(self.observations.shape[1])

    @property
    def action_dim(self) -> int:
        """Width of an action row, A; 0 where actions are not known."""
        return int(self.actions.shape[1])


class TrajectorySequence(Sequence[Trajectory]):
    """Trajectories that are read when asked for; a subclass reads one in `_one`."""

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory]: ...
    def __getitem__(self, index: int | slice) -> Trajectory | list[Trajectory]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self._one(range(len(self))[index])

    @abstractmethod
    def _one(self, i: int) -> Trajectory: ...


def _matrix(name: str, values: ArrayLike) -> NDArray[np.float32]:
    if type(values) is not np.ndarray or values.dtype != np.float32:
        values = _numbers(name, values)
    with np.errstate(over="ignore"):  # it is not finite, see below
        array = np.array(values, dtype=np.float32, order="C", ndmin=1)
    if array.ndim != 2 or (name == "observations" and 0 in array.shape):
        some = " with at least one row and one column" if name == "observations" else ""
        raise TrajectoryError(f"{name} have shape {array.shape}, expected (rows, columns){some}")
    bad = ~np.isfinite(array)
    if bad.any():
        row, column = np.argwhere(bad)[0].tolist()
        raise TrajectoryError(
            f"{name} hold {int(bad.sum())} values that are not finite, missing or masked, expected "
            f"none; the first is at row {row}, column {column}: {array[row, column]}"
        )
    array.flags.writeable = False
    return array


def _numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return numbers in float64; warn where float32 loses what they tell."""
    from oodd_eval.arrays import as_numbers  # noqa: PLC0415  splits have float32
    from oodd_eval.data.offsets import coarse_sensors  # noqa: PLC0415  as above

    numbers = as_numbers(values, f"{name} cannot be read as a float32 matrix: ")
    is_matrix = numbers.ndim == 2 and len(numbers)
    if is_matrix and name == "observations" and (text := coarse_sensors(numbers)):
        warnings.warn(text, PrecisionWarning, stacklevel=4)
    return numbers
