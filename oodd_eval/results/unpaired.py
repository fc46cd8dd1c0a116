"""Tables and sentences of a board whose episodes have no twins."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from oodd_eval.metrics import catalogue
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results import tables
from oodd_eval.results.board import Board, Value, cells_with, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.standings import Standing
from oodd_eval.results.tables import Mean, Table

POOLED: Final = ("auc_pool", "auc_pool_null", "auc_rows")
"""Metrics of rows that are known to be anomalous, in the order of the headline's columns."""

_ALARMS: Final = (
    "events_found",
    "delay_censored",
    "found_within_100",
    "missed",
    "false_episodes",
    "early",
    "false_alarms_per_hour",
)

ROWS: Final = tuple(name for name, info in catalogue.METRICS.items() if info.request)
"""Metrics of published tables, which rank nothing."""

_CLOCK: Final = "clock"  # the row that knows the phase of an episode and nothing else
_SENSELESS: Final = (*tables.BLIND, "random")  # rows whose AUC nobody takes for the dynamics


@dataclass(frozen=True, slots=True)
class UnpairedTables:
    """The tables of a board without twins.

    Attributes
    ----------
    board
        The board.
    intervals
        Whether all means have their 95 % interval; false episodes always have.
    standings
        Where there are some, rows are in their order and have their places; else they are in the
        order of their means, the best first.
    level
        Suffix of the level of guaranteed alarms, by default the board's.
    """

    board: Board
    intervals: bool = False
    standings: Sequence[Standing] = ()
    level: str = ""

    def overview(self, *, whole: bool = False) -> list[Table]:
        """Return all of them, the most important one first.

        With `whole` each of several environments has a headline of its own, too.
        """
        several = self._environments if whole else []
        first = self.headline(), self.outcomes(), self.nominal(), self.apart()
        candidates = [*first, *(self.headline([name]) for name in several), self.rows()]
        return [table for table in candidates if table]

    def headline(self, environments: Sequence[str] = ()) -> Table | None:
        """Return separability and guaranteed alarms side by side; None without anomalous rows.

        Parameters
        ----------
        environments
            Those that means are over; by default all.
        """
        alarms = self._at_level(*_ALARMS)
        if not self._present((POOLED[-1], alarms[0]), environments):
            return None
        title = "Separability (%, higher is better)"
        title += " and guaranteed alarms" * bool(self._present(alarms, environments))
        note = tables.CENSORED if self._present([f"delay_censored_{self._level}"]) else ""
        if not environments:
            note = " ".join(filter(None, [self._explained(alarms[0]), note]))
        return self._of_metrics(title, (*POOLED, *alarms), environments, note)

    def _explained(self, intervals_found: str) -> str:
        """Return what the columns show that no other table has."""
        names = {_heading(name): name for name in self._present((*POOLED[:2], intervals_found))}
        return tables.explained(names)

    def outcomes(self) -> Table | None:
        """Return what is found of episodes known by their outcome alone; None without any."""
        if not self._present(["auc_outcome"]):
            return None
        names = ["auc_outcome", *self._at_level("found_outcome", "found_outcome_null")]
        if self.headline() is None:
            names += [*POOLED, *self._at_level("false_episodes", "false_alarms_per_hour")]
        note = "Episodes are compared up to the same row, as failures run into the time limit."
        if all(entry.detector != _CLOCK for entry in self.board.entries):
            note += (
                f" Add the row {_CLOCK} (--detector ...,{_CLOCK}) to see how much of this the "
                "phase of the episode alone gives."
            )
        return self._of_metrics("Episodes known by their outcome alone (%)", names, note=note)

    def nominal(self) -> Table | None:
        """Return alarms in the environments that have nominal test episodes alone; else None."""
        names = self._at_level("false_episodes", "false_alarms_per_hour")
        others = (*POOLED, "auc_outcome")
        alone = [e for e in self.board.environments if not self._present(others, [e])]
        if not self._present(names, alone) or not alone:
            return None
        title = "Alarms on nominal test episodes alone"
        several = alone if alone != self.board.environments else ()
        return self._of_metrics(title, names, several)

    def apart(self) -> Table | None:
        """Return the metric that ranks by environment and group; None where there is only one."""
        board, metric = self.board, self.board.ranking
        several, kinds = self._compared, board.anomalies
        columns = [Mean(e, metric, [e], kinds, self.intervals) for e in several]
        groups = board.groups.items()
        columns += [Mean(g, metric, board.environments, a, self.intervals) for g, a in groups]
        if not columns or not self._present([metric]):
            return None
        by = " and ".join(["environment"] * bool(several) + ["group"] * bool(groups))
        title = metric_info(metric).title
        title = f"{title[0].upper()}{title[1:]} (%) by {by}"
        table = self._of(title, columns)
        if several:
            means = [tables.show_value(self._mean(entry), metric) for entry in self._entries]
            for row, text in zip((table.header, *table.rows), ("mean", *means), strict=True):
                row.insert(table.labels, text)
            table = replace(table, note="The mean is that of the environments, each counting once.")
        return table

    def rows(self) -> Table | None:
        """Return metrics of published tables; None where no record has any."""
        title = "Metrics of rows, for comparison with published tables; they rank nothing"
        return self._of_metrics(title, ROWS) if self._present(ROWS) else None

    @property
    def _environments(self) -> list[str]:
        """The environments where there are several."""
        return self.board.environments if len(self.board.environments) > 1 else []

    @property
    def _compared(self) -> list[str]:
        """The environments that have the metric that ranks, where there are several."""
        metric = self.board.ranking
        compared = [e for e in self.board.environments if self._present([metric], [e])]
        return compared if len(compared) > 1 else []

    @property
    def _entries(self) -> list[Setting]:
        return [row.entry for row in self.standings] or tables.best_first(self.board)

    @property
    def _level(self) -> str:
        return self.level or self.board.level

    def _at_level(self, *names: str) -> list[str]:
        return [f"{name}_{self._level}" for name in names]

    def _present(self, names: Iterable[str], environments: Sequence[str] = ()) -> list[str]:
        """Return the metrics that any record has, of some environments or of all."""
        records = self.board.records
        chosen = [r for r in records if not environments or r.environment in environments]
        return [name for name in names if cells_with(name, chosen)]

    def _of_metrics(
        self, title: str, names: Iterable[str], environments: Sequence[str] = (), note: str = ""
    ) -> Table:
        """Return means of the metrics that the board has."""
        level = f"{100 * catalogue.LEVELS[self._level]:g} %"
        over = environments or self.board.environments, self.board.anomalies
        columns = []
        for name in self._present(names, environments):
            info = metric_info(name)
            text = _heading(name)
            text += " (steps)" if info.unit == "steps" else ""
            text += f" (≤ {level})" if name.startswith("false_episodes") else ""
            columns.append(Mean(text, name, *over, self.intervals or info.interval == "exact"))
        title += f" at {level}" if any(metric_info(c.metric).level for c in columns) else ""
        title += f": {', '.join(environments)}" if environments else ""
        asked = self.level or catalogue.HEADLINE
        if f"false_episodes_{asked}" not in [c.metric for c in columns]:
            lowered = tables.lowered_level(self.board, asked, self._level)
            note = " ".join(filter(None, [note, *lowered]))
        return self._of(title, columns, note)

    def _of(self, title: str, columns: Sequence[Mean], note: str = "") -> Table:
        """Return columns with a row per detector, or per standing with its place."""
        by_row = grouped(self.board.records, lambda r: r.setting)
        board = Board([r for entry in self._entries for r in by_row[entry]])
        return tables.by_metric(board, title, columns, self.standings, note)

    def _mean(self, entry: Setting) -> Value:
        """Return a row's mean over environments, each counting once."""
        board = self.board
        means = [board.mean(entry, [e], board.anomalies, board.ranking) for e in self._compared]
        known = [mean for mean in means if mean.state or not math.isnan(mean.value)]
        state = next((mean.state for mean in known if mean.state), "")
        partial = 0 < len(known) < len(means) or any(mean.partial for mean in known)
        value = nan_mean(mean.value for mean in known)
        run = sum(mean.cells for mean in means)
        return Value(value, state=state, cells=run, partial=partial)


def _heading(name: str) -> str:
    """Return the heading of a metric's column."""
    return "null" if name == POOLED[1] else metric_info(name).noun


def phase_findings(board: Board) -> list[str]:
    """Return a sentence where what knows the time alone does as well as detectors within episodes.

    Left out are rows that nobody takes for a detector of dynamics, rows at chance, which follow no
    phase either, and environments whose episodes have no phase that they share: their pooled AUC
    compares rows of all numbers, where that of the clock is not one half by ties alone.
    """
    info = metric_info("auc_rows")
    sentences = []
    for clock in (entry for entry in board.entries if entry.detector == _CLOCK):
        phased = [
            name
            for name in board.environments
            if board.mean(clock, [name], board.anomalies, POOLED[0]).value == 0.5
        ]
        records = [record for record in board.records if record.environment in phased]
        if not records:
            continue
        part = Board(records)
        listed = []
        for entry in (entry for entry in part.entries if entry.detector not in _SENSELESS):
            phase, value, _ = part.compare(clock, entry, info.name)
            mean = part.mean(entry, phased, part.anomalies, info.name, intervals=True)
            if phase >= value and not mean.low <= 0.5 <= mean.high:
                listed.append(f"{entry} ({info.text(value)} against {info.text(phase)})")
        if listed:
            sentences.append(
                f"{clock}, which knows the time alone, is as good as or better than these rows in "
                f"{info.title}, which then is the phase of the episode, not the dynamics: "
                f"{', '.join(listed)}."
            )
    return sentences
