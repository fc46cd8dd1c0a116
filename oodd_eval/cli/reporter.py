"""The terminal reporter: an observer that prints what the runner does, and tables at its end."""

import math
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from oodd_eval._version import __version__
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.names import counted
from oodd_eval.plugins import hookimpl
from oodd_eval.prose import print_prose, print_sections
from oodd_eval.results.board import boards, level_of, ranked_by
from oodd_eval.results.directory import REPORT
from oodd_eval.results.record import Record, summary
from oodd_eval.results.report import Report
from oodd_eval.scoring.display import Display
from oodd_eval.scoring.plan import Plan

_PART: Final = "trajector(y/ies) of each part"

_COLOURS = {"ok": "green", "unavailable": "yellow", "incompatible": "yellow"}


class TerminalReporter(Display):
    """Print a header, a line per fit, failures and a summary; as a context, until its end.

    What runs is shown between the lines, but for a negative verbosity.
    `verbosity` -1 prints the summary only; 1, a line per cell and, from `log`, why fits failed.
    """

    def __init__(
        self, console: Console, *, verbosity: int = 0, log: Callable[[str], Path] | None = None
    ) -> None:
        super().__init__(console)
        self.verbosity, self._log = verbosity, log
        self._start = time.perf_counter()
        self._open: dict[tuple[str, str], list[Record]] = {}
        self._resumed = 0

    @hookimpl
    def oodd_run_started(self, plan: Plan) -> None:
        """Say what is going to happen."""
        self._start = time.perf_counter()
        if self.verbosity < 0:
            return
        names = dict.fromkeys(u.setting.detector for u in plan.units)
        limited = f", first {counted(plan.limit, _PART)}" if plan.limit else ""
        self.line(f"oodd-eval {__version__}, protocol {PROTOCOL}")
        self.line(f"split {plan.split}, digest {plan.split_digest[:12]}{limited}")
        self.line(f"detectors: {', '.join(names)}")
        fits, cells = counted(len(plan.units), "fit(s)"), counted(len(plan.cells), "cell(s)")
        self.line(f"{fits}, {cells}\n")
        super().oodd_run_started(plan)

    @hookimpl
    def oodd_cell_finished(self, record: Record, resumed: bool) -> None:
        """Print a line when the last cell of a fit, or in verbose mode any cell, is finished."""
        super().oodd_cell_finished(record, resumed)
        self._resumed += resumed
        unit = record.environment, record.cell.label
        finished = self._open.setdefault(unit, [])
        finished.append(record)
        if self.verbosity > 0:
            self._line(record, str(record.cell), [record], resumed=resumed)
        elif self.verbosity == 0 and not self._waiting[unit]:
            self._line(record, "/".join(unit), finished, resumed=resumed)

    @hookimpl
    def oodd_run_finished(self, records: list[Record], interrupted: bool) -> None:
        """Print the failures and the summary."""
        self.__exit__(None, None, None)
        self.failures(records)
        seconds = time.perf_counter() - self._start
        earlier = f" ({self._resumed} from earlier runs)" if self._resumed else ""
        end = ", interrupted" if interrupted else ""
        self.line(f"{summary(records)}{earlier} in {seconds:.1f} s{end}")

    def failures(self, records: Sequence[Record]) -> None:
        """Print why fits failed."""
        for record in (record for board in boards(records) for record in board.failures()):
            name = f"{record.environment}/{record.cell.label}"
            print_prose(f"{record.status.upper()} {name}: {record.reason}", self.console, "red")
            if self.verbosity <= 0 or not self._log or not record.scores:
                continue
            if (path := self._log(record.scores)).is_file():
                self.line(f"  {path}:")
                for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
                    self.line(f"    {line}")

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
        self.line("  ".join(parts), _COLOURS.get(last.status, "red"))


def print_report(report: Report, console: Console, path: Path) -> None:
    """Print a report of results in a directory, and where all is that a brief one leaves out."""
    print_sections(report.sections, console)
    if report.detail == "brief" and not report.detector:
        more = f", {path / REPORT}" * (path / REPORT).is_file()
        console.print(f"everything else: oodd-eval show {shlex.quote(str(path))} --wide{more}")
