"""One row beside another, and the sentence that comes first."""

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS, in_order, title_of
from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import LEVELS, RANKING, metric_info
from oodd_eval.metrics.ranking import Position, Row, differences
from oodd_eval.names import counted
from oodd_eval.results.board import Board, Conditions, contribution, ranked_by, supervised
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record


def terms_of(records: Iterable[Record], metric: str) -> Row:
    """Return a row's terms of a metric by seed and cell; where lower is better, the sign is turned.

    Failed cells, and those without the metric, are left out.
    """
    sign = -1.0 if metric_info(metric).better == "lower" else 1.0
    row: dict[int, dict[Position, Contribution]] = {}
    for r in records:
        cells = row.setdefault(r.seed, {})
        if r.ok and metric in r.per_trajectory:
            terms = contribution(r, metric)
            cells[r.position] = Contribution(
                sign * terms.numerator,
                terms.denominator,
                nominal=terms.nominal,
                deviations=sign * terms.deviations,
            )
    return row


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """One row beside another.

    Attributes
    ----------
    first, second
        The rows.
    metric
        What is compared.
    values
        Means of both over the cells.
    difference, low, high, p
        As a `PairedDifference`, but in the metric's own sign: with the paired 95 % interval,
        whose ends are NaN where there are too few test seeds for one.
    cells
        Cells that both rows have, over which the means are.
    environments
        Those of these cells.
    note
        Which row learns from failures, where the other does not; empty otherwise.
    """

    first: str
    second: str
    metric: str
    values: tuple[float, ...]
    difference: float
    low: float
    high: float
    p: float
    cells: int
    environments: Sequence[str] = ()
    note: str = ""

    @property
    def verdict(self) -> str:
        """One sentence, and the note: which row is better, or that no difference is shown."""
        info = metric_info(self.metric)
        sign = -1 if (self.difference < 0) != (info.better == "lower") else 1
        rows = (self.first, self.second)[::sign]
        # The advantage of the better row, whatever the better side.
        turn = math.copysign(1.0, self.difference)
        ends = (turn * self.low, turn * self.high)[:: int(turn)]
        amount, low, high = map(info.text, (abs(self.difference), *ends))
        unit = {"percent": " points", "steps": " steps"}.get(info.unit, "")
        scope, end = f"in {info.phrase} {in_words(self.environments)}".rstrip(), f".{self.note}"
        if ends[0] > 0:
            return f"{rows[0]} beats {rows[1]} by {amount}{unit} [{low}, {high}] {scope}{end}"
        return (
            f"No difference is shown between {rows[0]} and {rows[1]} {scope}: "
            f"{amount}{unit} [{low}, {high}], p = {self.p:.2g}{end}"
        )

    def __str__(self) -> str:
        """Return the verdict, and below it both means, and p where the verdict lacks it."""
        info, verdict = metric_info(self.metric), self.verdict
        first, second = map(info.text, self.values)
        unit = _UNITS.get(info.unit, "")
        p = "" if " p = " in verdict else f"p = {self.p:.2g}, "
        return (
            f"{verdict}\n{info.title}: {self.first} {first}{unit}, {self.second} {second}{unit}, "
            f"{p}{counted(self.cells, 'cell(s)')}"
        )


_UNITS: Final = {"percent": " %", "steps": " steps"}


def in_words(environments: Sequence[str]) -> str:
    """Return the names of a few environments, or how many they are, after a preposition."""
    titles = list(map(title_of, environments))
    if len(titles) > _FEW:
        return f"over {len(titles)} environments"
    return "on " + " and ".join(titles) if titles else ""


_FEW: Final = 2  # environments that a sentence names


def row_named(records: Sequence[Record], name: str) -> Setting:
    """Return the row that a detector's name, or a whole setting such as ``rf[trees=9]``, names.

    Raises `UnknownNameError` when there is none, `UsageError` when a name has several rows.
    """
    rows = {str(r.setting): r.setting for r in records}
    if name in rows:
        return rows[name]
    named = [setting for setting in rows.values() if setting.detector == name]
    if not named:
        raise UnknownNameError("row of these results", name, rows)
    if len(named) > 1:
        choice = ", ".join(map(str, named))
        raise UsageError(
            f"{name!r} names {len(named)} rows of these results, expected one of {choice}"
        )
    return named[0]


def compare_rows(
    records: Sequence[Record], first: str, second: str, metric: str = ""
) -> PairedComparison:
    """Compare two rows of one board over the cells in which both have a value.

    Rows are named as tables print them; the metric is any that is a mean over trajectories, by
    default the one that the board ranks by.

    Raises
    ------
    UnknownNameError, UsageError
        For a row or a metric that the records do not have, or a row that is named twice.
    ResultsError
        When the rows have no cell in common, or records of several boards.
    """
    if len({Conditions.of(r) for r in records}) > 1:
        raise ResultsError("records of several splits or limits cannot be compared: select some")
    usual = ranked_by(records)[0] if records else RANKING
    info = metric_info(metric := metric or usual)
    if info.interval == "" or info.median or not info.better:
        raise UsageError(
            f"rows cannot be compared by {metric!r}: expected a mean over trajectories with a "
            f"better side, such as {usual}"
        )
    settings = [row_named(records, name) for name in (first, second)]
    if settings[0] == settings[1]:
        raise UsageError(f"{first!r} and {second!r} are the same row")
    rows = {str(s): terms_of((r for r in records if r.setting == s), metric) for s in settings}
    seeds = [cells for row in rows.values() for cells in row.values()]
    defined = ({c for c, terms in s.items() if not math.isnan(terms.value)} for s in seeds)
    common = sorted(set.intersection(*defined))
    if not common:
        raise ResultsError(f"{first} and {second} have no cell in common with a value of {metric}")
    shared = {
        name: {seed: {cell: cells[cell] for cell in common} for seed, cells in row.items()}
        for name, row in rows.items()
    }
    (test,) = differences(shared, [(str(settings[0]), str(settings[1]))])
    means = (
        nan_mean(nan_mean(c.value for c in cells.values()) for cells in row.values())
        for row in shared.values()
    )
    # Where lower is better, the terms have their sign turned.
    sign = -1 if info.better == "lower" else 1
    low, high = (sign * end for end in (test.low, test.high)[::sign])
    values = tuple(sign * mean for mean in means)
    over = in_order((environment for environment, _ in common), ENVIRONMENTS)
    figures = sign * test.difference, low, high, test.p, len(common)
    knowing = [*supervised(records) & {*settings}]
    note = f" {knowing[0]} learns from failures, the other does not." if len(knowing) == 1 else ""
    return PairedComparison(test.first, test.second, metric, values, *figures, over, note)


def verdict_of(board: Board, level: str = "") -> str:
    """Return the sentence that comes first: the best row against the second, or what one row does.

    Rows that have no value in every cell, or know more than nominal trajectories, are passed over
    where others are left. Rows that learn from failures are never compared with others.

    Parameters
    ----------
    board
        The rows.
    level
        Suffix of the level of guaranteed alarms, by default the board's.

    Returns
    -------
    str
        Empty where no row has a figure.
    """
    over = board.environments, board.anomalies
    means = {entry: board.mean(entry, *over, board.ranking) for entry in board.entries}
    defined = [entry for entry, mean in means.items() if not math.isnan(mean.value)]
    defined = [entry for entry in defined if entry not in board.supervised] or defined
    knowing = {r.setting for r in board.records if r.training != "nominal"}
    eligible = [e for e in defined if not means[e].partial and e not in knowing]
    rows = sorted(eligible if len(eligible) > 1 else defined, key=lambda e: -means[e].value)
    if len(rows) > 1:
        records = [r for r in board.records if r.setting in rows[:2] and r.ok]
        with contextlib.suppress(ResultsError):  # without a cell in common
            return compare_rows(records, str(rows[0]), str(rows[1]), board.ranking).verdict
    first = (rows or board.entries)[0]
    # Of several rows that nothing ranks none speaks for the others.
    return _in_words(board, first, level or board.level) if rows or len(board.entries) == 1 else ""


def _in_words(board: Board, entry: Setting, level: str) -> str:
    """Return the headline figures of a row; empty where it has none."""

    def figures(*names: str) -> str:
        over = board.environments, board.anomalies
        means = {metric_info(n): board.mean(entry, *over, n).value for n in names}
        return ", ".join(
            f"{info.noun} {info.text(mean)}{_UNITS.get(info.unit, '')}"
            for info, mean in means.items()
            if not math.isnan(mean)
        )

    alarms = figures(*(f"{name}_{level}" for name in _IN_WORDS))
    if alarms:
        percent = f"{100 * LEVELS[level]:g} %"
        alarms = f"with alarms in at most {percent} of nominal episodes: {alarms}"
    parts = "; ".join(filter(None, [figures(board.ranking), alarms]))
    return f"{entry} {in_words(board.environments)}: {parts}." if parts else ""


_IN_WORDS: Final = ("delay_censored", "missed", "false_episodes")
