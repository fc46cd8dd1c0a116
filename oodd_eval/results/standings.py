"""The rows of a board in order: ranks, tie groups, win rates and cost."""

import contextlib
import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from oodd_eval.data.facts import ENVIRONMENTS, in_order, title_of
from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import LEVELS, RANKING, metric_info
from oodd_eval.metrics.ranking import ALPHA, Position, Ranking, Row, leads, rank, win_rates
from oodd_eval.names import counted
from oodd_eval.plugins.contract import Training, training_mark
from oodd_eval.results.board import (
    Board,
    Conditions,
    cells_with,
    contribution,
    expected_cells,
    grouped,
    ranked_by,
)
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record

SEEDS: Final = 3
"""Detector seeds that a primary row with randomness needs for a rank."""


class Cost(NamedTuple):
    """Mean seconds of a row's fits, microseconds per scored step, and most memory in MB."""

    fit: float = NAN
    step: float = NAN
    peak: float = NAN


@dataclass(frozen=True, slots=True)
class Standing:
    """One row of a board with its rank.

    `rank` is None, and `state` says why, for a row that is not ranked; `alarm_rank` is its rank by
    alarms, None where `alarm_state` says why. `primary` rows are one a detector; the others are
    variants, whose rank is the one that they would have. `ties` are the letters of its tie groups,
    `wins` is the mean of its win rates against the other ranked rows, `lead` says how often its
    mean stays above the next row's without one of the environments, empty for the last row, and
    `inputs` is empty where no record names the detector's inputs.
    """

    entry: Setting
    records: list[Record]
    trivial: bool
    primary: bool
    rank: int | None
    alarm_rank: int | None
    ties: str
    state: str
    alarm_state: str
    wins: float
    lead: str
    inputs: str
    cost: Cost

    @property
    def seeds(self) -> int:
        """The number of detector seeds."""
        return len({r.seed for r in self.records})

    @property
    def training(self) -> Training:
        """The knowledge that its detector declares, see `DetectorSpec`."""
        return next((r.training for r in self.records if r.training != "nominal"), "nominal")

    @property
    def marks(self) -> str:
        """The marks printed behind a row's name: trivial, variant, other training data."""
        marks = " (trivial)" * self.trivial + " (variant)" * (not self.primary)
        mark = training_mark(self.training)
        return marks + (f" ({mark})" if mark else "")


class RankedBoard(NamedTuple):
    """A board with its rankings and win rates, by the labels of the ranked rows.

    All have the order of the standings: ranked rows by rank and mean, then the others by name.
    `alarms` is the ranking by alarms; it has no rows where the board lacks that metric.
    """

    board: Board
    standings: list[Standing]
    ranking: Ranking
    alarms: Ranking
    rates: dict[tuple[str, str], float]


def primary_settings(records: Iterable[Record]) -> set[Setting]:
    """Return one row of each detector: of those with most cells and seeds enough the simplest.

    That is the row with the fewest other than default parameters, and then the least horizon. Cells
    and seeds come first, so that part of a row does not stand for a detector that has a whole one.
    Only `expected_cells` count.
    """
    by_row = grouped(records, lambda r: r.setting)
    expected = expected_cells([r for rows in by_row.values() for r in rows])

    def order(row: Setting) -> tuple[Any, ...]:
        cells, few = expected & {r.position for r in by_row[row]}, has_few_seeds(by_row[row])
        return -len(cells), few, len(row.parameters), *_name(row)

    primary: dict[str, Setting] = {}
    for row in sorted(by_row, key=order):
        primary.setdefault(row.detector, row)
    return set(primary.values())


def ranked(
    records: Sequence[Record],
    primary: Collection[Setting] | None = None,
    *,
    expected: Collection[Position] = (),
) -> RankedBoard:
    """Rank the rows of one board that have a value in every cell, with all their detector seeds.

    Parameters
    ----------
    records
        Records of one split digest, protocol and limit.
    primary
        Rows that push others down, one a detector; by default `primary_settings`. They need three
        detector seeds, unless the seed changes nothing.
    expected
        Environments and conditions that a ranked row needs; by default `expected_cells`. Records
        of other cells change no rank.

    Returns
    -------
    RankedBoard

    Raises
    ------
    ResultsError
        When ranked rows differ in their numbers of test trajectories, or two rows have one name.
    """
    ordered = sorted(records, key=lambda r: (_name(r.setting), r.seed, r.position))
    by_row = grouped(ordered, lambda r: r.setting)
    labels = Counter(map(str, by_row))
    if twice := [label for label, n in labels.items() if n > 1]:
        raise ResultsError(
            f"two rows of a board are both called {twice[0]!r}, expected names and settings that "
            "tell rows apart: give one of the detectors another name"
        )
    first = primary_settings(records) if primary is None else set(primary)
    cells = set(expected or expected_cells(records))

    counted: dict[str, dict[Setting, list[Record]]] = {}
    states: dict[str, dict[Setting, str]] = {}
    by_scores, by_alarms = ranked_by(records)
    for metric in (by_scores, by_alarms):
        # Without twins a metric is one of some cells, such as those whose anomalous rows are known.
        compared = cells if records[0].paired else cells & cells_with(metric, records)
        counted[metric] = {
            e: [r for r in rows if r.position in compared] for e, rows in by_row.items()
        }
        states[metric] = {
            e: _state(rows, compared, metric, e in first) for e, rows in counted[metric].items()
        }

    def ranking_by(metric: str) -> tuple[Ranking, dict[str, Row]]:
        rows = {
            str(e): terms_of(counted[metric][e], metric)
            for e, state in states[metric].items()
            if not state
        }
        return rank(rows, set(map(str, first))), rows

    ranking, rows = ranking_by(by_scores)
    alarms, _ = ranking_by(by_alarms)
    seeds = {label: rows[label].values() for label in ranking.ranks}
    rates = win_rates(
        {
            label: {
                c: nan_mean(seed[c].value for seed in of_row) for c in sorted(next(iter(of_row)))
            }
            for label, of_row in seeds.items()
        }
    )
    wins: dict[str, list[float]] = {}
    for (row, _), rate in rates.items():
        wins.setdefault(row, []).append(rate)
    lead = leads({label: rows[label] for label in ranking.ranks})
    positions = {label: i for i, label in enumerate(ranking.ranks)}
    order = sorted(by_row, key=lambda e: (positions.get(str(e), len(positions)), _name(e)))
    board = Board([record for entry in order for record in by_row[entry]], cells)
    standings = [
        Standing(
            entry=entry,
            records=by_row[entry],
            trivial=board.is_trivial(entry),
            primary=entry in first,
            rank=ranking.ranks.get(str(entry)),
            alarm_rank=alarms.ranks.get(str(entry)),
            ties=ranking.letters(str(entry)),
            state=states[by_scores][entry],
            alarm_state=states[by_alarms][entry],
            wins=nan_mean(wins.get(str(entry), ())),
            lead=str(lead.get(str(entry), "")),
            inputs=next((r.inputs for r in by_row[entry] if r.inputs), ""),
            cost=cost_of(by_row[entry]),
        )
        for entry in order
    ]
    return RankedBoard(board, standings, ranking, alarms, rates)


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


def cost_of(records: Iterable[Record]) -> Cost:
    """Return what the fits behind some records cost; records of one fit share its cost."""
    fits = list({(r.environment, r.seed): r for r in records if r.ok}.values())
    timed = [(r.seconds_score, r.steps_scored) for r in fits if not math.isnan(r.seconds_score)]
    steps = [(seconds, n) for seconds, n in timed if n and n > 0]
    seconds = math.fsum(s for s, _ in steps)
    return Cost(
        nan_mean(r.seconds_fit for r in fits),
        1e6 * seconds / sum(n for _, n in steps) if steps else NAN,
        max((r.peak_rss_mb for r in fits if not math.isnan(r.peak_rss_mb)), default=NAN),
    )


def _state(
    records: Sequence[Record], cells: Collection[Position], metric: str, primary: bool
) -> str:
    """Return why a row is not ranked by a metric; empty if it is."""
    if not cells:
        return f"no cell has {metric_info(metric).title}"
    seeds = len({r.seed for r in records}) or 1
    expected = len(cells) * seeds
    all_cells = counted(expected, "cell(s)")
    failed = Counter(r.status for r in records if not r.ok)
    reasons = [f"{status} in {n} of {all_cells}" for status, n in failed.items()]
    if len(records) < expected:
        reasons.append(f"{expected - len(records)} of {all_cells} missing")
    values = (c.value for cell in terms_of(records, metric).values() for c in cell.values())
    defined = sum(not math.isnan(value) for value in values)
    if undefined := sum(r.ok for r in records) - defined:
        reasons.append(f"undefined in {undefined} of {all_cells}")
    reasons += sorted({training_mark(r.training) for r in records} - {""})
    if primary and has_few_seeds(records):
        reasons.append(f"{seeds} of {SEEDS} detector seeds")
    return ", ".join(reasons)


def has_few_seeds(records: Sequence[Record]) -> bool:
    """Tell whether a row has fewer detector seeds than a primary row needs."""
    seeds = {r.seed for r in records}
    return len(seeds) < SEEDS and not all(r.deterministic for r in records)


def _name(entry: Setting) -> tuple[str, int, str]:
    return entry.detector, entry.horizon, entry.overrides_json


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
    difference, low, high
        Of the first's mean to the second's, with its paired 95 % interval.
    p
        The smaller of the two one-sided p-values, that of "not better" and that of "not worse",
        after Holm's correction for both.
    cells
        Cells that both rows have, over which the means are.
    environments
        Those of these cells.
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

    @property
    def verdict(self) -> str:
        """One sentence: which row is better and by how much, or that no difference is shown.

        A difference is shown where the interval leaves out 0 and the p-value is at most 0.05;
        where it is not, the sentence says which of the two fails.
        """
        info = metric_info(self.metric)
        sign = -1 if (self.difference < 0) != (info.better == "lower") else 1
        rows = (self.first, self.second)[::sign]
        # The advantage of the better row, whatever the better side.
        turn = math.copysign(1.0, self.difference)
        ends = sorted((turn * self.low, turn * self.high))
        amount, low, high = map(info.text, (abs(self.difference), *ends))
        unit = {"percent": " points", "steps": " steps"}.get(info.unit, "")
        scope = f"in {info.phrase} {in_words(self.environments)}".rstrip()
        if ends[0] > 0 and self.p <= ALPHA:
            return f"{rows[0]} beats {rows[1]} by {amount}{unit} [{low}, {high}] {scope}."
        if ends[0] > 0:
            why = f"the interval leaves out 0, but p is above {ALPHA:g}"
        elif self.p <= ALPHA:
            why = f"p is at most {ALPHA:g}, but the interval holds 0"
        else:
            why = f"the interval holds 0, and p is above {ALPHA:g}"
        return (
            f"No difference is shown between {rows[0]} and {rows[1]} {scope}: "
            f"{amount}{unit} [{low}, {high}], p = {self.p:.2g} ({why})."
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
    tests = {test.first: test for test in rank(shared).comparisons}
    first_row, other = shared
    test = tests[first_row]
    means = (
        nan_mean(nan_mean(c.value for c in cells.values()) for cells in row.values())
        for row in shared.values()
    )
    # Where lower is better, the terms have their sign turned.
    sign = -1.0 if info.better == "lower" else 1.0
    low, high = sorted((float(sign * test.low), float(sign * test.high)))
    values = tuple(sign * mean for mean in means)
    p = min(t.p_holm for t in tests.values())
    over = in_order((environment for environment, _ in common), ENVIRONMENTS)
    return PairedComparison(
        first_row, other, metric, values, sign * test.difference, low, high, p, len(common), over
    )


def verdict_of(board: Board, level: str = "") -> str:
    """Return the sentence that comes first: the best row against the second, or what one row does.

    Rows that have no value in every cell, or know more than nominal trajectories, are passed over
    where others are left.

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
    knowing = {r.setting for r in board.records if r.training != "nominal"}
    eligible = [e for e in defined if not means[e].partial and e not in knowing]
    rows = sorted(eligible if len(eligible) > 1 else defined, key=lambda e: -means[e].value)
    if len(rows) > 1:
        records = [r for r in board.records if r.setting in rows[:2] and r.ok]
        with contextlib.suppress(ResultsError):  # without a cell in common
            return compare_rows(records, str(rows[0]), str(rows[1]), board.ranking).verdict
    return _in_words(board, (rows or board.entries)[0], level or board.level)


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
