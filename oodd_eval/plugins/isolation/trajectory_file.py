"""Trajectories in a temporary file: a sequence that may be larger than memory."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Sequence
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError


class _Place(NamedTuple):
    start: int
    observations: tuple[int, int]
    actions: tuple[int, int]


class Spool(Sequence[Trajectory]):
    """What an iterable gave, written to a file without a name and read when asked for.

    Every access reads the trajectory again, so that only those that somebody holds are in memory.
    The file lies in the system's temporary directory (``TMPDIR``) and goes away with the process
    at the latest.

    Parameters
    ----------
    trajectories
        Taken one at a time.

    Raises
    ------
    OSError
        When the temporary directory is full.
    """

    def __init__(self, trajectories: Iterable[Trajectory]) -> None:
        self._places: list[_Place] = []
        self._file = tempfile.TemporaryFile(prefix="oodd-eval-")  # noqa: SIM115  open as long as self
        for t in trajectories:
            here = self._file.tell()
            self._places.append(_Place(here, t.observations.shape, t.actions.shape))
            self._file.write(t.observations.data)
            self._file.write(t.actions.data)
        self._file.flush()

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory]: ...
    def __getitem__(self, index: int | slice) -> Trajectory | list[Trajectory]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = self._places[index]
        middle = place.start + 4 * int(np.prod(place.observations))
        return Trajectory(
            self._matrix(place.start, place.observations), self._matrix(middle, place.actions)
        )

    def close(self) -> None:
        """Give the file back; nothing can be read any more."""
        self._file.close()

    def _matrix(self, start: int, shape: tuple[int, int]) -> NDArray[np.float32]:
        # Reading at a place leaves alone the position that forked processes share.
        content = os.pread(self._file.fileno(), 4 * int(np.prod(shape)), start)
        if len(content) != 4 * int(np.prod(shape)):
            raise TrajectoryError("the temporary file of training trajectories was cut short")
        return np.frombuffer(content, dtype=np.float32).reshape(shape)
