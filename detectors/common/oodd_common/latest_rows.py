"""Names the parts at fault by the latest rows of an episode, recorded or live."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from typing import Any, Final, Self, TypeAlias

from numpy.typing import NDArray

from oodd_common.charts import Floats
from oodd_common.naming import ORDER, PartNamer
from oodd_eval import Naming, Trajectory
from oodd_eval.plugins.state import Arrays

MOST_SENSORS: Final = 64
"""Sensors beyond which no parts are named: the time of a naming grows with their square."""
ROWS: Final = 100
"""Latest rows that a naming looks at: it costs the same however long an episode is."""

_SeenRow: TypeAlias = tuple[NDArray[Any], NDArray[Any] | None]
"""A row, and the action commanded since the one before."""


class LatestRowsNamer:
    """Names the parts at fault by the latest `ROWS` rows of an episode.

    A live episode's rows are only kept until somebody asks for names, since most never alarm.

    Parameters
    ----------
    namer
        What names the parts; None where no parts are named.
    """

    def __init__(self, namer: PartNamer | None) -> None:
        self._namer = namer
        self.reset()

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> Self:
        """Fit to nominal episodes; of more than `MOST_SENSORS` sensors no parts are named."""
        few = nominal[0].observation_dim <= MOST_SENSORS
        return cls(PartNamer.fit(nominal) if few else None)

    @classmethod
    def of(cls, arrays: Arrays) -> Self:
        """Return the fit among saved arrays; `FittedStateError` for a damaged one."""
        saved = any(name.startswith("naming_") for name in arrays)
        return cls(PartNamer.of(arrays) if saved else None)

    def arrays(self) -> dict[str, Floats]:
        """Return the fit as arrays of numbers, by name."""
        return self._namer.arrays() if self._namer else {}

    def __call__(self, episode: Trajectory, since: int = 0) -> Naming | None:
        """Return the parts at fault as seen at the last row; none began before row `since`."""
        pairs = zip(episode.observations, [None, *episode.actions], strict=True)
        return self._named([*pairs][-ROWS:], len(episode), since)

    def reset(self) -> None:
        """Begin a new live episode."""
        self._count = 0
        self._latest: deque[_SeenRow] = deque(maxlen=ROWS)

    def update(self, row: NDArray[Any], action: NDArray[Any] | None) -> None:
        """Take the next row and the action commanded since the one before; both are kept."""
        self._count += 1
        self._latest.append((row, action))

    def last(self, since: int = 0) -> Naming | None:
        """Return the parts at fault as seen at the latest `update`, as for the episode so far."""
        return self._named(self._latest, self._count, since)

    def _named(self, latest: Collection[_SeenRow], count: int, since: int) -> Naming | None:
        if self._namer is None:
            return None
        hidden = count - len(latest)
        # The first forecasts behind hidden rows lack what they are made from.
        live = self._namer.begin(max(since - hidden, min(hidden, ORDER)))
        for row, action in latest:
            live.update(row, action)
        return live.name()[0]
