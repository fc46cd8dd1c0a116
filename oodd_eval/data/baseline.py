"""Baseline rows: the first rows of every episode, which are nominal and bring it to training's.

Machines differ from day to day. Each sensor's mean and spread over an episode's first rows are
brought to those of the training episodes' first rows, and a detector sees the rows behind them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError

Floats = NDArray[np.float64]

SHRINKAGE: Final = 0.5
"""Weight of training's variance in that of an episode: a few rows know a spread badly."""

CONSTANT: Final = 1e-6
"""Spread below which a sensor stands still in training's baseline rows, and is not stretched."""


class Shift(NamedTuple):
    """Shift of one episode to training's level: ``(row - mean) * factor + reference``, in float64.

    Attributes
    ----------
    mean, factor, reference
        Arrays of shape (D,).
    """

    mean: Floats
    factor: Floats
    reference: Floats

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return rows, (..., D), as a detector sees them."""
        return (
            (rows.astype(np.float64) - self.mean) * self.factor + self.reference
        ).astype(np.float32)  # fmt: skip

    def inverse(self, values: Floats) -> Floats:
        """Return which values, (D,), would become these, which may be infinite."""
        return (values - self.reference) / self.factor + self.mean


@dataclass(frozen=True, slots=True, eq=False)
class Baseline:
    """The first rows of the training episodes, to which other episodes are brought.

    Parameters
    ----------
    rows
        Number B of rows at the start of every episode.
    mean
        Mean of the training episodes' means, (D,).
    std
        Root mean square of their spreads, (D,).
    """

    rows: int
    mean: Floats
    std: Floats

    @classmethod
    def fit(cls, train: Iterable[Trajectory], rows: int) -> "Baseline":
        """Learn from the first rows of training episodes.

        Parameters
        ----------
        train
            Nominal episodes, as they were recorded.
        rows
            Number of rows.

        Returns
        -------
        Baseline

        Raises
        ------
        TrajectoryError
            When an episode has no further row.
        """
        firsts = [_first(x, rows, f"training episode {i}") for i, x in enumerate(train)]
        if not firsts:
            raise TrajectoryError("there are no training episodes, expected some for the baseline")
        mean = np.mean([first.mean(axis=0) for first in firsts], axis=0)
        std = np.sqrt(np.mean([first.var(axis=0) for first in firsts], axis=0))
        return cls(rows, mean, std)

    def shift(self, first: NDArray[np.float32]) -> Shift:
        """Return what brings an episode to training's.

        Parameters
        ----------
        first : float32 array of shape (B, D)
            Its first rows.

        Returns
        -------
        Shift
        """
        rows = np.array(first, dtype=np.float64, order="C")
        variance = (1 - SHRINKAGE) * rows.var(axis=0) + SHRINKAGE * self.std**2
        moving = self.std > CONSTANT
        factor = np.where(moving, self.std / np.sqrt(np.where(moving, variance, 1.0)), 1.0)
        return Shift(rows.mean(axis=0), factor, self.mean)

    def judged(self, trajectory: Trajectory, name: str = "an episode") -> Trajectory:
        """Return the rows behind an episode's first, brought to training's.

        Parameters
        ----------
        trajectory
            The whole episode.
        name
            Of the episode, in messages.

        Returns
        -------
        Trajectory
            With B rows less; its first action is that after its first row.

        Raises
        ------
        TrajectoryError
            When there are no such rows.
        """
        _first(trajectory, self.rows, name)
        shift = self.shift(trajectory.observations[: self.rows])
        return Trajectory(
            shift(trajectory.observations[self.rows :]), trajectory.actions[self.rows :]
        )


def episode_means(
    episodes: Iterable[Trajectory], base: Baseline | None = None
) -> tuple[Floats, NDArray[np.int64]]:
    """Return what episodes are in the mean, as far as they are judged.

    Parameters
    ----------
    episodes
        n episodes, as they were recorded.
    base
        The baseline that they are brought to; None where none is declared.

    Returns
    -------
    means : float64 array of shape (n, D)
        Of each sensor.
    lengths : int64 array of shape (n,)
        Rows that are judged.
    """
    means, lengths = [], []
    for episode in episodes:
        judged = episode if base is None else base.judged(episode)
        means.append(judged.observations.mean(axis=0, dtype=np.float64))
        lengths.append(len(judged))
    return np.stack(means) if means else np.empty((0, 0)), np.array(lengths, np.int64)


def undefined(scores: Floats, rows: int) -> Floats:
    """Return scores of the rows behind the first `rows` as those of the whole episode."""
    return np.concatenate([np.full(rows, np.nan), scores])


def check_baseline(lengths: Iterable[int], rows: int, part: str) -> None:
    """Raise `TrajectoryError` unless all episodes have a row behind their first `rows`.

    `lengths` are observations of the episodes of a part.
    """
    for i, n in enumerate(lengths):
        if n <= rows:
            raise TrajectoryError(_too_short(f"{part}[{i}]", n, rows))


def _first(trajectory: Trajectory, rows: int, name: str) -> Floats:
    if len(trajectory) <= rows:
        raise TrajectoryError(_too_short(name, len(trajectory), rows))
    return trajectory.observations[:rows].astype(np.float64)


def _too_short(name: str, n: int, rows: int) -> str:
    return (
        f"{name} has {n} rows, expected more than baseline={rows}, as the first {rows} rows of "
        "every episode are not judged: declare fewer, or leave the episode out"
    )
