"""Which unit a free thread goes on with: none that would only wait for another's fit.

Units that share a fit (horizons of one detector, say) cannot fit it twice: the second waits until
the first has kept it. A thread that waits leaves a core idle, so it takes a later unit instead, and
those that share the fit follow when it is there.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError

from oodd_eval.scoring.unit import UnitJob


class Turns:
    """Hands each unit to one of several threads, as early in the plan as can go on at once.

    Parameters
    ----------
    jobs
        In the order of the plan.
    fit_of
        Gives the key of the fit that a unit would make, or wait for while another unit makes it;
        empty when it would do neither. It is asked again at each turn.
    """

    def __init__(
        self, jobs: Sequence[tuple[int, UnitJob]], fit_of: Callable[[UnitJob], str]
    ) -> None:
        self._waiting, self._fit_of = list(jobs), fit_of
        self._fits: list[str] = []
        self._changed = threading.Condition()
        self._stopped = False

    @contextlib.contextmanager
    def take(self) -> Iterator[tuple[int, UnitJob]]:
        """Give a unit and its place; the turn lasts as long as the block.

        Raises
        ------
        CancelledError
            After `stop`.
        """
        with self._changed:
            while (place := self._next()) is None:
                self._changed.wait()
            index, job = self._waiting.pop(place)
            fit = self._fit_of(job)
            self._fits.append(fit)
        try:
            yield index, job
        finally:
            with self._changed:
                self._fits.remove(fit)
                self._changed.notify_all()

    def stop(self) -> None:
        """Give out nothing more."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _next(self) -> int | None:
        """Return the place in the line of the unit that is next; None when all have to wait."""
        if self._stopped:
            raise CancelledError
        under_way = set(self._fits) - {""}
        free = (i for i, (_, job) in enumerate(self._waiting) if self._fit_of(job) not in under_way)
        return next(free, None)
