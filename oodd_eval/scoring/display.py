"""The display of a running plan: a bar, and below it what is being fitted and for how long."""

import contextlib
import math
import threading
import time
from dataclasses import dataclass, field
from datetime import timedelta
from types import TracebackType
from typing import Final, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from oodd_eval.names import counted
from oodd_eval.plugins import hookimpl
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan, Unit

SILENCE: Final = 30.0
"""Seconds without a line after which a run says what it is at, where it is no terminal."""

_MOST_RUNNING: Final = 8  # units that are named at a time


@dataclass(slots=True)
class _Running:
    """A unit that is being fitted or scored, since when, and how far the fit is if that is told."""

    name: str
    share: float | None = None
    start: float = field(default_factory=time.perf_counter)

    def __str__(self) -> str:
        """Return a line such as ``riqn on acrobot: fitting 40 %, 32 s``."""
        doing = "scoring" if self.share == 1 else "fitting"
        done = f" {self.share:.0%}".replace("%", " %") if self.share and self.share < 1 else ""
        return f"{self.name}: {doing}{done}, {time.perf_counter() - self.start:.0f} s"


@dataclass(slots=True)
class Pace:
    """Number of finished cells, or other parts, and the time for the others at the same speed.

    Cells of an earlier run take no time, so that they say nothing of the speed. A unit's cells come
    all at once: between two units the speed stays that of the last.

    Attributes
    ----------
    total, start
        Number of cells, and when the run began, in seconds.
    done, noun
        Number of those that are finished, and their name.
    """

    total: int
    start: float
    done: int = 0
    noun: str = "cells"
    _fresh: int = 0
    _latest: float = 0.0

    def add(self, now: float, *, resumed: bool) -> None:
        """Count a cell that is finished."""
        self.done += 1
        if not resumed:
            self._fresh, self._latest = self._fresh + 1, now

    def left(self, now: float) -> float:
        """Return the seconds until the end; NaN where that is not known.

        No cell of this run may be finished, or its last units take longer than those before.
        """
        if not self._fresh:
            return math.nan
        each = (self._latest - self.start) / self._fresh
        left = (self.total - self.done) * each - (now - self._latest)
        return left if left > 0 or self.done == self.total else math.nan

    def __str__(self) -> str:
        """Return a line such as ``8/16 cells, 0:00:32 so far, 0:00:32 left``."""
        now = time.perf_counter()
        spent, left = now - self.start, self.left(now)
        ahead = "" if math.isnan(left) else f", {timedelta(seconds=math.ceil(left))} left"
        done = f"{self.done}/{self.total} {self.noun}"
        return f"{done}, {timedelta(seconds=int(spent))} so far{ahead}"

    def __rich__(self) -> Table:
        """Return a bar with the line beside it."""
        bar = Table.grid(padding=(0, 1))
        bar.add_row(ProgressBar(max(self.total, 1), self.done, 20), Text(str(self), no_wrap=True))
        return bar


class Display:
    """An observer that shows on a console what runs; as a context, until its end.

    On a terminal it stands below a bar; elsewhere a line says so after some `SILENCE`.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self._running: dict[tuple[str, str], _Running] = {}
        self._waiting: dict[tuple[str, str], int] = {}  # for so many cells of a unit
        self._several_seeds = False
        self._pace = Pace(0, 0.0)
        self._live: Live | None = None
        self._ended, self._latest = threading.Event(), time.perf_counter()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Take away what stands below the lines, however the run has ended."""
        self._ended.set()
        if self._live:
            self._live.stop()

    @hookimpl
    def oodd_run_started(self, plan: Plan) -> None:
        """Begin to show what runs."""
        self._pace = Pace(len(plan.cells), time.perf_counter())
        self._waiting = {_key(unit): len(unit.conditions) for unit in plan.units}
        self._several_seeds = len({u.seed for u in plan.units}) > 1
        if not (self.console.is_terminal or self.console.is_jupyter):
            threading.Thread(target=self._break_silence, daemon=True).start()
            return
        self._live = Live(
            get_renderable=self._state, console=self.console, transient=True, refresh_per_second=2
        )
        self._live.start()

    @hookimpl
    def oodd_unit_started(self, unit: Unit) -> None:
        """Name what runs."""
        name = unit.setting.label(unit.seed) if self._several_seeds else str(unit.setting)
        self._running[_key(unit)] = _Running(f"{name} on {unit.environment}")

    @hookimpl
    def oodd_fit_progressed(self, unit: Unit, share: float) -> None:
        """Say how far a fit is."""
        if running := self._running.get(_key(unit)):
            running.share = share

    @hookimpl
    def oodd_cell_finished(self, record: Record, resumed: bool) -> None:
        """Count a cell, and name its unit no more when it was the last."""
        self._pace.add(time.perf_counter(), resumed=resumed)
        unit = record.environment, record.cell.label
        self._waiting[unit] = self._waiting.get(unit, 0) - 1
        if not self._waiting[unit]:
            self._running.pop(unit, None)

    def line(self, text: str, style: str = "") -> None:
        """Print a line, above the bar where there is one."""
        self._latest = time.perf_counter()
        self.console.print(Text(text, style))

    def _state(self) -> RenderableType:
        """Return the bar, with what runs below it."""
        running = (Text(line, no_wrap=True, overflow="ellipsis") for line in self._at_work())
        return Group(self._pace, *running)

    def _at_work(self) -> list[str]:
        """Return a line on each unit that runs, of many on the first ones."""
        running = list(self._running.values())
        more = len(running) - _MOST_RUNNING
        lines = [str(unit) for unit in running[:_MOST_RUNNING]]
        return lines + [f"and {counted(more, 'more fit(s)')}"] * (more > 0)

    def _break_silence(self) -> None:
        """Print what runs after every `SILENCE`, in a thread, until the run has ended."""
        while not self._ended.wait(self._latest + SILENCE - time.perf_counter()):
            if time.perf_counter() < self._latest + SILENCE:
                continue  # A line has come.
            self._latest = time.perf_counter()
            # What reads may be gone: the next line of the run says so.
            with contextlib.suppress(OSError, ValueError):
                if lines := self._at_work():
                    self.line("; ".join(lines))


def _key(unit: Unit) -> tuple[str, str]:
    return unit.environment, unit.setting.label(unit.seed)
