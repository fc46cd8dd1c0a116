"""The terminal reporter: an observer that prints what the runner does, and tables at its end."""

import contextlib
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.text import Text

from oodd_eval._version import __version__
from oodd_eval.cli import Options, say, say_notes
from oodd_eval.cli.streams import encodable, plain_text, raw
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.data.logs import register_readers
from oodd_eval.data.registry import Spec, register
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.names import counted
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import Plugins, discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.describe import discover_in_sandbox
from oodd_eval.results.board import boards, level_of, ranked_by
from oodd_eval.results.record import STATUSES, Record
from oodd_eval.results.render.text import print_prose, print_sections
from oodd_eval.results.report import Report
from oodd_eval.results.strengths import NO_UNITS
from oodd_eval.scoring.plan import Plan, Unit

SILENCE: Final = 30.0
"""Seconds without a line after which a run says what it is at, where it is no terminal."""

_PART: Final = "trajector(y/ies) of each part"
_MOST_RUNNING: Final = 8  # units that are named at a time

_COLOURS = {"ok": "green", "unavailable": "yellow", "incompatible": "yellow"}


class _Console(Console):
    """Writes styles and moves of the cursor of its own, and of what it is to print `plain_text`."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            text = encodable(plain_text(segment.text), self.encoding)
            yield segment if segment.control else segment._replace(text=text)

    def on_broken_pipe(self) -> None:
        """Raise the error; rich would end the process with the exit code of a failure."""
        raise BrokenPipeError


def make_console(*, quiet: bool = False, stderr: bool = False) -> Console:
    """Return a console on a standard stream: coloured on a terminal, plain text in a pipe."""
    file = raw(sys.stderr if stderr else sys.stdout)
    console = _Console(file=file, highlight=False, markup=False, soft_wrap=True, quiet=quiet)
    if console.width < 1:  # COLUMNS=0, as of terminals that do not know their size
        console.width = 80
    return console


def discovered(options: Options, limits: Limits | None = None) -> Plugins:
    """Discover plug-ins without those of ``-p``; broken ones are reported on standard error.

    With limits that hide paths, only sandboxes load plug-ins: this process imports none.
    """
    if limits is None or limits.hidden is None:
        plugins = discover(options.disabled)
    else:
        plugins = discover_in_sandbox(options.disabled, limits)
        if watching := ", ".join(point.name for point in plugins.observer_points):
            say(f"plug-ins that observe runs are left out of a sandboxed one: {watching}")
    say_notes(plugins.notes)
    plugins.report_broken_to(
        lambda b: say(f"plug-in {b.plugin!r} of {b.distribution} is broken: {b.reason}")
    )
    return plugins


def register_custom(options: Options) -> list[Spec]:
    """Make environments and anomalies of plug-ins known in this process; return them."""
    specs = [spec for spec, _ in discovered(options).custom_specs.values()]
    register(specs)
    return specs


def register_formats(options: Options) -> None:
    """Make formats of logs of plug-ins known in this process."""
    register_readers(reader for reader, _ in discovered(options).readers.values())


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


class TerminalReporter:
    """Print a header, a line per fit, tables, failures and a summary; as a context, until its end.

    On a terminal, what runs stands below a bar; elsewhere a line says so after some `SILENCE`.
    `verbosity` -1 prints the summary only; 1, a line per cell and, from `log`, why fits failed.
    `units` are those of strengths by kind of anomaly. `level` and `paper` are those of a `Report`.
    """

    def __init__(
        self,
        console: Console,
        *,
        verbosity: int = 0,
        intervals: bool = False,
        log: Callable[[str], Path] | None = None,
        units: Mapping[str, str] = NO_UNITS,
        level: str = "",
        paper: bool = False,
    ) -> None:
        self.console, self.verbosity, self.intervals = console, verbosity, intervals
        self._log, self._units = log, units
        self._level, self._paper = level, paper
        self._start = time.perf_counter()
        self._open: dict[tuple[str, str], list[Record]] = {}
        self._sizes: dict[tuple[str, str], int] = {}
        self._resumed = 0
        self._progress: Progress | None = None
        self._live: Live | None = None
        self._running: dict[tuple[str, str], _Running] = {}
        self._several_seeds = False
        self._ended, self._latest = threading.Event(), self._start

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
        """Say what is going to happen."""
        self._start = time.perf_counter()
        self._sizes = {
            (u.environment, u.setting.label(u.seed)): len(u.conditions) for u in plan.units
        }
        self._several_seeds = len({u.seed for u in plan.units}) > 1
        if self.verbosity < 0:
            return
        names = dict.fromkeys(u.setting.detector for u in plan.units)
        limited = f", first {counted(plan.limit, _PART)}" if plan.limit else ""
        self._print(f"oodd-eval {__version__}, protocol {PROTOCOL}")
        self._print(f"split {plan.split}, digest {plan.split_digest[:12]}{limited}")
        self._print(f"detectors: {', '.join(names)}")
        fits, cells = counted(len(plan.units), "fit(s)"), counted(len(plan.cells), "cell(s)")
        self._print(f"{fits}, {cells}\n")
        if not self.console.is_terminal:
            threading.Thread(target=self._break_silence, daemon=True).start()
            return
        columns = (
            BarColumn(20),
            MofNCompleteColumn(),
            TextColumn("cells,"),
            TimeElapsedColumn(),
            TextColumn("so far,"),
            TimeRemainingColumn(),
            TextColumn("left"),
        )
        # A fit may take minutes: the speed is that of the whole run.
        self._progress = Progress(*columns, console=self.console, speed_estimate_period=1e9)
        self._progress.add_task("", total=len(plan.cells))
        self._live = Live(
            get_renderable=self._state, console=self.console, transient=True, refresh_per_second=2
        )
        self._live.start()

    def _state(self) -> RenderableType:
        """Return the bar, with what runs below it."""
        running = (Text(line, no_wrap=True, overflow="ellipsis") for line in self._at_work())
        return Group(*([self._progress] if self._progress else []), *running)

    def _at_work(self) -> list[str]:
        """Return a line on each unit that runs, of many on the first ones."""
        running = list(self._running.values())
        more = len(running) - _MOST_RUNNING
        return [
            *map(str, running[:_MOST_RUNNING]),
            *([f"and {counted(more, 'more fit(s)')}"] if more > 0 else []),
        ]

    def _break_silence(self) -> None:
        """Print what runs after every `SILENCE`, in a thread, until the run has ended."""
        while not self._ended.wait(self._latest + SILENCE - time.perf_counter()):
            if time.perf_counter() < self._latest + SILENCE:
                continue  # A line has come.
            self._latest = time.perf_counter()
            # What reads may be gone: the next line of the run says so.
            with contextlib.suppress(OSError, ValueError):
                if lines := self._at_work():
                    self._print("; ".join(lines))

    @hookimpl
    def oodd_unit_started(self, unit: Unit) -> None:
        """Name what runs."""
        label = unit.setting.label(unit.seed)
        name = label if self._several_seeds else str(unit.setting)
        self._running[unit.environment, label] = _Running(f"{name} on {unit.environment}")

    @hookimpl
    def oodd_fit_progressed(self, unit: Unit, share: float) -> None:
        """Say how far a fit is."""
        if running := self._running.get((unit.environment, unit.setting.label(unit.seed))):
            running.share = share

    @hookimpl
    def oodd_cell_finished(self, record: Record, resumed: bool) -> None:
        """Print a line when the last cell of a fit, or in verbose mode any cell, is finished."""
        self._resumed += resumed
        if self._progress:
            self._progress.advance(self._progress.task_ids[0])
        unit = record.environment, record.cell.label
        finished = self._open.setdefault(unit, [])
        finished.append(record)
        if len(finished) == self._sizes.get(unit):
            self._running.pop(unit, None)
        if self.verbosity > 0:
            self._line(record, str(record.cell), [record], resumed=resumed)
        elif self.verbosity == 0 and len(finished) == self._sizes[unit]:
            self._line(record, "/".join(unit), finished, resumed=resumed)

    @hookimpl
    def oodd_run_finished(self, records: list[Record], interrupted: bool) -> None:
        """Print the tables, the failures and the summary."""
        self.__exit__(None, None, None)
        if self.verbosity >= 0 and any(r.ok for r in records):
            self._print("")
            self.tables(records)
        self.failures(records)
        seconds = time.perf_counter() - self._start
        earlier = f" ({self._resumed} from earlier runs)" if self._resumed else ""
        end = ", interrupted" if interrupted else ""
        self._print(f"{summary(records)}{earlier} in {seconds:.1f} s{end}")

    def tables(self, records: Sequence[Record]) -> None:
        """Print the tables of every board among some records."""
        report = Report(
            records,
            intervals=self.intervals,
            detail="brief",
            units=self._units,
            level=self._level,
            paper=self._paper,
        )
        print_sections(report.sections, self.console)

    def failures(self, records: Sequence[Record]) -> None:
        """Print why fits failed."""
        for record in (record for board in boards(records) for record in board.failures()):
            name = f"{record.environment}/{record.cell.label}"
            print_prose(f"{record.status.upper()} {name}: {record.reason}", self.console, "red")
            if self.verbosity <= 0 or not self._log or not record.scores:
                continue
            if (path := self._log(record.scores)).is_file():
                self._print(f"  {path}:")
                for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
                    self._print(f"    {line}")

    def _line(self, last: Record, name: str, cells: Sequence[Record], *, resumed: bool) -> None:
        parts = [f"{last.status:<12} {name}"]
        if last.ok:
            name = ranked_by(cells)[0]
            if not any(name in r.metrics for r in cells):  # nominal episodes alone
                name = f"false_episodes_{level_of(cells)}"
            info = metric_info(name)
            if any(name in r.metrics for r in cells):  # there are enough calibration episodes
                mean = nan_mean(r.value(info.name) for r in cells)
                parts.append(f"{info.title} {info.text(mean)}")
            spent = last.seconds_fit + last.seconds_score
            if resumed:
                parts.append("from an earlier run")
            elif not math.isnan(spent):
                parts.append(f"{spent:.1f} s")
        self._print("  ".join(parts), _COLOURS.get(last.status, "red"))

    def _print(self, text: str, style: str = "") -> None:
        self._latest = time.perf_counter()
        self.console.print(Text(text, style))


def summary(records: Sequence[Record]) -> str:
    """Return how many cells came to which status, such as ``48 ok, 8 timeout``."""
    counts = Counter(r.status for r in records)
    return ", ".join(f"{counts[s]} {s}" for s in STATUSES if counts[s]) or "no cells"
