"""A detector whose score is a recorded column."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.contract import Scores
from oodd_eval.plugins.state import State, labelled, unlabelled


class RecordedColumn:
    """Scores of one column as it was recorded, which learns nothing.

    Parameters
    ----------
    kind
        ``"column"``, the column itself; ``"mean"``, its mean since the episode began; ``"flag"``,
        1 where it is not 0.
    sign
        1, or -1 where low values are anomalous.
    size
        Whether the column counts without its own sign.
    """

    def __init__(self, kind: str, sign: int, size: bool) -> None:
        self.kind, self._sign, self._size = kind, sign, size
        self.reset()

    def fit(self, nominal: Sequence[Trajectory]) -> None:  # noqa: ARG002  nothing is learnt
        """Learn nothing."""
        self.reset()

    def score(self, trajectory: Trajectory) -> Scores:
        """Return one score per observation.

        Raises
        ------
        TrajectoryError
            For more columns than one.
        """
        column = self._column(trajectory.observations)
        if self.kind == "mean":
            return column.cumsum() / np.arange(1, len(column) + 1)
        return column

    def reset(self) -> None:
        """Begin a new live episode."""
        self._sum, self._rows = 0.0, 0

    def update(self, observation: ArrayLike, action: object = None) -> float:  # noqa: ARG002
        """Return the score of the next observation, which holds the column alone."""
        score = float(self._column(Trajectory(np.asarray(observation)[None]).observations)[0])
        self._sum, self._rows = self._sum + score, self._rows + 1
        return self._sum / self._rows if self.kind == "mean" else score

    def state(self) -> State:
        """Return the state of a detector without a fit."""
        return labelled("column/1", {}, {})

    def restore(self, state: State) -> None:
        """Take over a state; `FittedStateError` for another detector's."""
        unlabelled(state, "column/1", {})
        self.reset()

    def _column(self, rows: ArrayLike) -> Scores:
        columns = np.asarray(rows, np.float64)
        if columns.shape[1] != 1:
            raise TrajectoryError(
                f"got {columns.shape[1]} columns, expected 1: of several columns that are called "
                "NAME[0], NAME[1] and so on name one"
            )
        column: Scores = columns[:, 0]
        if self.kind == "flag":
            return np.asarray(column != 0, np.float64)
        return self._sign * (np.abs(column) if self._size else column)
