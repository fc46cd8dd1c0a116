"""Carry out what remains of a reproduction, batch by batch, until it is done or time is up.

Whatever kills the process, finished units stay: their scores are files of their own, and the next
run reads them. A batch is a plan of a few minutes for `oodd_eval.scoring.runner.run`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Final

from oodd_eval.data.split import Split
from oodd_eval.paper.costs import correction, duration
from oodd_eval.paper.schedule import Work, next_batch, remaining_seconds
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.hooks import hookimpl
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan
from oodd_eval.scoring.runner import Settings, run

BATCH: Final = 240.0
"""Seconds of wall-clock time that a batch is made for: records are written at its end."""

SHARE: Final = 0.5
"""Share of the remaining budget that a batch is made for, so that the last ones are short."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of it.

    Attributes
    ----------
    attempted
        Units that were run, whether they failed or not.
    left
        Units that were not started.
    interrupted
        Whether it was stopped from outside.
    """

    attempted: int
    left: int
    interrupted: bool = False


@dataclass(eq=False)
class Watch:
    """Counts units as they finish and tells of each, with the time that remains.

    Parameters
    ----------
    works
        All that remains.
    rows
        Observations that a unit of each environment is scored on.
    jobs
        Units at a time.
    tell
        Given a line for every finished unit; None for silence.
    fitted
        Keys of the fits that were there before.
    """

    works: Sequence[Work]
    rows: dict[str, int]
    jobs: int
    tell: Callable[[str], None] | None = None
    fitted: Collection[str] = ()
    finished: dict[tuple[str, str], list[Record]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._works = {(w.unit.environment, w.unit.label): w for w in self.works}
        self._costs: list[Record] = []

    @hookimpl
    def oodd_cell_finished(self, record: Record, resumed: bool) -> None:
        """Tell of a unit when its last cell is there."""
        key = record.environment, record.label
        cells = self.finished.setdefault(key, [])
        cells.append(record)
        work = self._works.get(key)
        if work is None or len(cells) < len(work.unit.anomalies):
            return
        if record.ok and not resumed:
            self._costs.append(record)
        if self.tell:
            self.tell(
                f"[{self.complete}/{len(self.works)}] {'/'.join(key)}  "
                f"{_came_of(record, resumed=resumed)}  ({duration(self.remaining())} left)"
            )

    @property
    def complete(self) -> int:
        """Number of units with all of their cells."""
        return sum(
            len(self.finished.get(key, ())) >= len(work.unit.anomalies)
            for key, work in self._works.items()
        )

    def open(self) -> list[Work]:
        """Return the units that have not finished, in order."""
        return [work for key, work in self._works.items() if key not in self.finished]

    def factor(self) -> float:
        """Return by how much the estimates are off so far."""
        return correction(self._costs, self.rows)

    def remaining(self) -> float:
        """Return the wall-clock seconds that the open units are expected to take."""
        done = {w.fit for key, w in self._works.items() if key in self.finished}
        seconds = remaining_seconds(self.open(), {*self.fitted, *done})
        return self.factor() * seconds / self.jobs


def _came_of(record: Record, *, resumed: bool) -> str:
    if not record.ok:
        return f"{record.status}: {record.reason}"
    took = record.seconds_fit + record.seconds_score
    return "kept" if resumed else "ok" if math.isnan(took) else duration(took)


def carry_out(
    watch: Watch,
    split: Split,
    plugins: Plugins,
    settings: Settings,
    results: ResultsDirectory,
    *,
    budget: float | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Run what remains.

    Parameters
    ----------
    watch
        Knows what remains; observes the run.
    split, plugins, settings, results
        As for `oodd_eval.scoring.runner.run`.
    budget
        Wall-clock seconds after which no unit is started; what is at work then is finished. None
        means no end.
    clock
        Tells the time in seconds.
    """
    start = clock()
    plugins.observe(watch, "reproduce")
    while left := watch.open():
        room = BATCH
        if budget is not None:
            unused = start + budget - clock()
            if unused <= 0:
                return Outcome(watch.complete, len(left))
            room = min(room, SHARE * unused)
        done = {w.fit for w in watch.works if w not in left}
        seconds = room * watch.jobs / watch.factor()
        batch = next_batch(left, seconds, {*watch.fitted, *done})
        plan = Plan(split.name, split.digest, tuple(w.unit for w in batch))
        interrupted = run(plan, split, plugins, settings, results).interrupted
        # A batch of which nothing came would come again for ever.
        if interrupted or len(watch.open()) == len(left):
            return Outcome(watch.complete, len(watch.open()), interrupted=True)
    return Outcome(watch.complete, 0)
