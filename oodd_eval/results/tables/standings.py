"""The rows of one board in the order of their ranks, and what each of them cost."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.ranking import Cell, Ranking, Row, rank, win_rates
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.tables.board import Board, contribution

METRIC: Final = "auc_matched"
"""The metric that ranks."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a row's fits cost; NaN where no record says so.

    Attributes
    ----------
    fit
        Mean seconds of a fit.
    step
        Microseconds per scored observation, over all fits.
    peak
        Largest resident memory of a fit, in MB.
    """

    fit: float = NAN
    step: float = NAN
    peak: float = NAN


@dataclass(frozen=True, slots=True)
class Standing:
    """One row of a board with its place.

    Attributes
    ----------
    entry
        The row.
    records
        Its cells, with all its detector seeds.
    trivial
        Whether it is one of the harness's own trivial rows.
    rank
        1 + the number of significantly better rows; None for a row that is not ranked.
    ties
        Letters of its tie groups.
    state
        Why it is not ranked, such as ``"timeout in 8 of 56 cells"``; empty if it is.
    wins
        Mean of its win rates against the other ranked rows.
    inputs
        What its scores depend on; empty where no record says so.
    cost
        Of its fits.
    """

    entry: Setting
    records: list[Record]
    trivial: bool
    rank: int | None
    ties: str
    state: str
    wins: float
    inputs: str
    cost: Cost

    @property
    def seeds(self) -> int:
        """Number of detector seeds."""
        return len({r.seed for r in self.records})


@dataclass(frozen=True, slots=True)
class RankedBoard:
    """A board with its ranking.

    Attributes
    ----------
    board
        Its rows in the order of `standings`, so that all its tables have that order.
    standings
        Ranked rows by rank and mean, then the others by name.
    ranking
        Of the ranked rows, by their labels.
    rates
        Win rates of the ranked rows, by pairs of labels.
    """

    board: Board
    standings: list[Standing]
    ranking: Ranking
    rates: dict[tuple[str, str], float]


def ranked(records: Sequence[Record]) -> RankedBoard:
    """Rank the rows of one board.

    A row is ranked when each of its detector seeds has a value in every cell that any row has.

    Parameters
    ----------
    records
        Of one split digest, protocol and limit, in any order.

    Raises
    ------
    ResultsError
        When complete rows differ in their numbers of test trajectories, or two rows have one name.
    """
    by_row: dict[Setting, list[Record]] = {}
    for record in sorted(records, key=_order):
        by_row.setdefault(record.setting, []).append(record)
    labels = Counter(str(entry) for entry in by_row)
    if twice := [label for label, n in labels.items() if n > 1]:
        raise ResultsError(
            f"two rows of a board are both called {twice[0]!r}, expected names and settings that "
            "tell rows apart: give one of the detectors another name"
        )
    cells = {(r.environment, r.anomaly) for r in records}
    states = {entry: _state(own, len(cells)) for entry, own in by_row.items()}
    rows = {str(e): _row(own) for e, own in by_row.items() if not states[e]}
    ranking = rank(rows)
    rates = win_rates({label: _means(rows[label]) for label in ranking.ranks})
    place = {label: i for i, label in enumerate(ranking.ranks)}
    order = sorted(by_row, key=lambda e: (place.get(str(e), len(place)), _text(e)))
    board = Board([record for entry in order for record in by_row[entry]])
    standings = [
        Standing(
            entry=entry,
            records=by_row[entry],
            trivial=board.is_trivial(entry),
            rank=ranking.ranks.get(str(entry)),
            ties=ranking.letters(str(entry)),
            state=states[entry],
            wins=mean(rate for (one, _), rate in rates.items() if one == str(entry)),
            inputs=_inputs(by_row[entry]),
            cost=cost_of(by_row[entry]),
        )
        for entry in order
    ]
    return RankedBoard(board, standings, ranking, rates)


def cost_of(records: Iterable[Record]) -> Cost:
    """Return what the fits behind some records cost; records of one fit share its cost."""
    fits = list({(r.environment, r.seed): r for r in records if r.ok}.values())
    timed = [(r.seconds_score, r.steps_scored) for r in fits]
    steps = [(s, n) for s, n in timed if isinstance(n, int) and n > 0 and not math.isnan(s)]
    seconds = math.fsum(s for s, _ in steps)
    peaks = [r.peak_rss_mb for r in fits if not math.isnan(r.peak_rss_mb)]
    return Cost(
        mean(r.seconds_fit for r in fits),
        1e6 * seconds / sum(n for _, n in steps) if steps else NAN,
        max(peaks, default=NAN),
    )


def mean(values: Iterable[float]) -> float:
    """Return the mean of the values that are not NaN; NaN without any."""
    defined = [v for v in values if not math.isnan(v)]
    return math.fsum(defined) / len(defined) if defined else NAN


def _state(records: Sequence[Record], cells: int) -> str:
    """Return why a row is not ranked; empty if it is."""
    expected = cells * len({r.seed for r in records})
    failed = Counter(r.status for r in records if not r.ok)
    reasons = [f"{status} in {n} of {expected} cells" for status, n in failed.items()]
    if len(records) < expected:
        reasons.append(f"{expected - len(records)} of {expected} cells missing")
    undefined = sum(r.ok and math.isnan(_value(r)) for r in records)
    if undefined:
        reasons.append(f"undefined in {undefined} of {expected} cells")
    return ", ".join(reasons)


def _row(records: Iterable[Record]) -> Row:
    row: dict[int, dict[Cell, Contribution]] = {}
    for r in records:
        row.setdefault(r.seed, {})[r.environment, r.anomaly] = contribution(r, METRIC)
    return row


def _means(row: Row) -> dict[Cell, float]:
    """Return a row's value in each cell, over its detector seeds."""
    return {cell: mean(cells[cell].value for cells in row.values()) for cell in row[min(row)]}


def _value(record: Record) -> float:
    return contribution(record, METRIC).value if METRIC in record.per_trajectory else NAN


def _inputs(records: Iterable[Record]) -> str:
    named = dict.fromkeys(r.inputs for r in records)
    return next((name for name in named if isinstance(name, str)), "")


def _order(record: Record) -> tuple[tuple[str, int, str], int, str, str]:
    return _text(record.setting), record.seed, record.environment, record.anomaly


def _text(entry: Setting) -> tuple[str, int, str]:
    return entry.detector, entry.horizon, entry.overrides_json
