"""The replay memory that both algorithms sample from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class Replay:
    """The last transitions of a training as flat float32 rows."""

    def __init__(self, size: int, width: int) -> None:
        self.rows = np.zeros((size, width), np.float32)
        self.count = 0

    def add(self, *parts: Sequence[float] | NDArray[np.float32]) -> None:
        """Store one transition, in the place of the oldest when all places are taken."""
        self.rows[self.count % len(self.rows)] = np.concatenate(parts)
        self.count += 1

    def sample(self, batch: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Return random transitions, of shape (batch, width)."""
        rows: NDArray[np.float32] = self.rows[
            rng.integers(0, min(self.count, len(self.rows)), batch)
        ]
        return rows
