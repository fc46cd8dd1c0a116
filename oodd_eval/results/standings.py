"""One row beside another, and the sentence that comes first."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS, in_order, title_of
from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import RANKING, UNDEFINED, metric_info
from oodd_eval.metrics.ranking import Position, Row, differences
from oodd_eval.names import counted
from oodd_eval.results.board import Board, Column, Conditions, contribution, ranked_by, supervised
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.tables import best_first, ordering_metric

SHIPPED: Final = "oodd-eval"
"""The distribution whose detectors are no reader's own."""


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
    def told_apart(self) -> bool:
        """True if the interval excludes 0."""
        return self.low > 0 or self.high < 0

    @property
    def first_is_better(self) -> bool:
        """True if the first row has the better mean, or both have the same."""
        return self.difference == 0 or (
            (self.difference < 0) == (metric_info(self.metric).better == "lower")
        )

    @property
    def amount(self) -> str:
        """The advantage of the better row with its interval, as ``6.0 points [4.1, 7.9]``."""
        # The advantage of the better row, whatever the better side.
        turn = math.copysign(1.0, self.difference)
        low, high = (turn * self.low, turn * self.high)[:: int(turn)]
        return with_interval(abs(self.difference), low, high, self.metric)

    @property
    def verdict(self) -> str:
        """One sentence, and the note: which row is better, or that no difference is shown."""
        rows = (self.first, self.second)[:: 1 if self.first_is_better else -1]
        scope = f"in {metric_info(self.metric).phrase} {in_words(self.environments)}".rstrip()
        if self.told_apart:
            return f"{rows[0]} beats {rows[1]} by {self.amount} {scope}.{self.note}"
        return (
            f"No difference is shown between {rows[0]} and {rows[1]} {scope}: "
            f"{self.amount}, p = {self.p:.2g}.{self.note}"
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


def with_interval(difference: float, low: float, high: float, metric: str) -> str:
    """Return a difference with its interval, of as many digits as tell its ends from 0.

    Parameters
    ----------
    difference, low, high
        The difference of two means and its interval, NaN where it has no end.
    metric
        What they are means of.

    Returns
    -------
    str
        Such as ``6.0 points [4.1, 7.9]``.
    """
    info = metric_info(metric)
    scale, unit = {"percent": (100, " points"), "steps": (1, " steps")}.get(info.unit, (1, ""))
    ends = [scale * end for end in (low, high) if not math.isnan(end)]
    least = 1 if unit else 3
    is_told = low > 0 or high < 0
    seen = all if is_told else any
    digits = (n for n in range(least, _MOST_DIGITS) if seen(round(end, n) for end in ends))
    n = next(digits, _MOST_DIGITS if is_told else least)
    amount = f"{scale * difference:z.{n}f}{unit}"
    if not ends:
        return f"{amount} (no interval: too few test episodes)"
    texts = (UNDEFINED if math.isnan(end) else f"{scale * end:z.{n}f}" for end in (low, high))
    return f"{amount} [{', '.join(texts)}]"


_MOST_DIGITS: Final = 4


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


def own_row(board: Board) -> Setting:
    """Return the reader's own row: the best that oodd-eval does not ship, else the first record's.

    What an adapter makes of a name with a colon is the reader's, too.
    """
    plugins = {r.setting: r.plugin for r in board.records}
    shipped = {row for row, name in plugins.items() if name.startswith(f"{SHIPPED}:")}
    foreign = (row for row in best_first(board) if row not in shipped or ":" in row.detector)
    return next(foreign, board.entries[0])


def verdict_of(board: Board, level: str = "") -> str:
    """Return the sentence that comes first: where the reader's own row stands, see `own_row`.

    It is compared with the row above it, or the second where it is the first. Rows that know more
    than nominal trajectories are passed over, and those that learn from failures are compared with
    one another alone.

    Parameters
    ----------
    board
        The rows, in the order in which they were named.
    level
        Suffix of the level of guaranteed alarms, by default the board's.

    Returns
    -------
    str
        Empty where the row has no figure that rows are compared by, and others have.
    """
    mine, metric = own_row(board), ordering_metric(board)
    knowing = {r.setting for r in board.records if r.training not in ("nominal", "failures")}
    band = [
        row
        for row in best_first(board)
        if (row in board.supervised) == (mine in board.supervised)
        and (row == mine or row not in knowing)
    ]
    if len(band) == 1:
        return _in_words(board, mine, level or board.level)
    i, n = band.index(mine), len(band)
    rival = band[i - 1] if i else band[1]
    many = f"number {i + 1} of {n}"
    would = ", not ranked for what it knows, would be" if mine in knowing else " is"
    rank = f"{mine}{would} {many if n > len(_PLACES) else f'{_PLACES[i]} of {_NUMBERS[n - 1]}'}"
    if len(board.entries) > n:
        rank += f" {'rows that learn from failures' if mine in board.supervised else 'ranked rows'}"
    means = [board.of(row, Column(metric)) for row in (mine, rival)]
    try:
        test = compare_rows([r for r in board.records if r.ok], str(mine), str(rival), metric)
    except (ResultsError, UnknownNameError):  # without a cell in common, or without any
        if means[0].state:
            return f"{mine} has no place: {means[0].state}."
        return "" if math.isnan(means[0].value) else f"{rank}: {rival} has no figure beside it."
    ahead = "ahead of" if test.first_is_better else "behind"
    scope = f" in {metric_info(metric).phrase}"
    # Means of the table are over other cells where some of a row have no figure.
    if any(
        mean.state or mean.partial or not math.isclose(mean.value, value)
        for mean, value in zip(means, test.values, strict=True)
    ):
        scope += f", over the {counted(test.cells, 'cell(s)')} that both have"
    if test.told_apart:
        return f"{rank}, {test.amount} {ahead} {rival}{scope}."
    return f"{rank} and cannot be told from {rival}: {test.amount} {ahead} it{scope}."


_PLACES: Final = (
    *("first", "second", "third", "fourth", "fifth"),
    *("sixth", "seventh", "eighth", "ninth", "tenth"),
)
_NUMBERS: Final = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


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

    figures_of_alarms = (f"{name}_{level}" for name in _IN_WORDS)
    parts = figures(board.ranking, *figures_of_alarms)
    return f"{entry} {in_words(board.environments)}: {parts}." if parts else ""


_IN_WORDS: Final = ("found_within_20", "found_outcome", "missed", "false_episodes")
