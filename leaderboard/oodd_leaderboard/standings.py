"""The rows of a board in order: by mean, with what is told from the row above and from the first.

Two questions are asked of ranked rows: is a row told from the row above it, and is it told from the
first? Each is corrected for as many pairs as there are rows below the first.
"""

import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import UNDEFINED, metric_info
from oodd_eval.metrics.ranking import PairedDifference, Position, differences
from oodd_eval.names import counted
from oodd_eval.plugins.contract import Training, training_mark
from oodd_eval.results.board import Board, cells_with, expected_cells, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.standings import terms_of
from oodd_eval.results.tables import best_first
from oodd_leaderboard.entry import Entry

EQUAL: Final = "="
"""Stands beside the place of a row that is not told from the row above it."""


class Cost(NamedTuple):
    """Mean seconds of a row's fits, microseconds per scored step, and most memory in MB."""

    fit: float = NAN
    step: float = NAN
    peak: float = NAN


@dataclass(frozen=True, slots=True)
class Standing:
    """One row of a board.

    Attributes
    ----------
    entry
        The row.
    records
        Its records.
    rank
        Position among ranked rows, 1 for all rows of the first band; None where it is not ranked.
    equal
        Whether it is not told from the ranked row above it.
    band
        Whether it is in the first band: it is the first, or not told from the first.
    state
        Why it is not ranked; empty where it is, or where nothing but a ranking is missing.
    variant
        Whether it is a further row of a detector.
    origin, paper, year, authors
        As its entry says; empty and None without an entry.
    trivial
        Whether it is one of the harness's own rows that need no dynamics.
    training, inputs
        What it learns from, and what it is handed; inputs are empty where no record says it.
    seeds, seed_low, seed_high
        Number of detector seeds, and the means of the lowest and the highest seed.
    cost
        Of its fits.
    """

    entry: Setting
    records: list[Record]
    rank: int | None
    equal: bool
    band: bool
    state: str
    variant: bool
    origin: str
    paper: str
    year: int | None
    authors: str
    trivial: bool
    training: Training
    inputs: str
    seeds: int
    seed_low: float
    seed_high: float
    cost: Cost

    @property
    def printed_rank(self) -> str:
        """The rank as printed, ``3 =`` where the row is not told from the row above it."""
        if self.rank is None:
            return UNDEFINED
        return f"{self.rank} {EQUAL}" if self.equal else str(self.rank)

    @property
    def marks(self) -> str:
        """The marks printed behind a row's name: trivial, variant, other training data."""
        marks = " (trivial)" * self.trivial + " (variant)" * self.variant
        mark = training_mark(self.training)
        return marks + (f" ({mark})" if mark else "")


@dataclass(frozen=True, slots=True)
class OrderedBoard:
    """A board in order, with what is known of differences in the metric that ranks.

    Attributes
    ----------
    board, standings
        Its records and its rows, both in the order of the board.
    above
        By ranked row the ranked row above it minus the row; the first row has none.
    first
        By ranked row the first row minus the row; the first row has none.
    """

    board: Board
    standings: list[Standing]
    above: dict[Setting, PairedDifference]
    first: dict[Setting, PairedDifference]


def ordered(
    records: Sequence[Record],
    entries: Mapping[str, Entry] = MappingProxyType({}),
    *,
    expected: Collection[Position] | None = None,
    ranked: bool = True,
) -> OrderedBoard:
    """Order the rows of one board by their mean, the same for any order of records.

    Parameters
    ----------
    records
        Of one split digest, protocol and limit.
    entries
        By name, that of the rows' detectors: who made a row, and whether it is a variant.
    expected
        Environments and conditions that a ranked row needs; by default `expected_cells`. Records
        of others change no place.
    ranked
        Whether rows are ranked and tested. A ranked row knows nominal trajectories alone, is no
        variant, and has a value in each expected cell with each seed that any row has, one where
        the seed changes nothing.

    Returns
    -------
    OrderedBoard
        Rows that are not ranked stand at the place of their mean, those with missing cells below.

    Raises
    ------
    ResultsError
        When ranked rows differ in their numbers of test trajectories, or two rows have one name.
    """
    in_order = sorted(records, key=lambda r: (_name(r.setting), r.seed, r.position))
    by_row = grouped(in_order, lambda r: r.setting)
    if twice := [label for label, n in Counter(map(str, by_row)).items() if n > 1]:
        raise ResultsError(
            f"two rows of a board are both called {twice[0]!r}, expected names and settings that "
            "tell rows apart: give one of the detectors another name"
        )
    cells = set(expected or expected_cells(records))
    order = best_first(Board(in_order, cells))
    board = Board([record for row in order for record in by_row[row]], cells)
    metric = board.ranking
    # Without twins a metric is one of some cells, such as those whose anomalous rows are known.
    compared = cells if board.paired else cells & cells_with(metric, records)
    counted_records = {e: [r for r in by_row[e] if r.position in compared] for e in order}
    seeds = {r.seed for r in records}
    primary = primary_settings(records)
    variants = {e for e in order if e not in primary or _entry_of(e, entries).variant}
    states = {e: _state(counted_records[e], compared, metric, seeds, e in variants) for e in order}
    training = {e: _training(by_row[e], _entry_of(e, entries)) for e in order}
    for row, known in training.items():
        states[row] = ", ".join(filter(None, [training_mark(known), states[row]]))
    places = [e for e in order if ranked and not states[e]]
    terms = {str(e): terms_of(counted_records[e], metric) for e in places}
    above = _tested(terms, places[1:], itertools.pairwise(places))
    first = _tested(terms, places[1:], ((places[0], e) for e in places[1:]))
    if above:  # both families hold the pair of the first two rows: the larger p-value counts
        second = places[1]
        above[second] = first[second] = max(above[second], first[second], key=lambda d: d.p)
    band = [e for e in places if e not in first or not first[e].told_apart]
    ranks = {e: 1 if e in band else i for i, e in enumerate(places, 1)}
    standings = []
    for row in order:
        entry, means = _entry_of(row, entries), board.seed_means(row, metric)
        standing = Standing(
            entry=row,
            records=by_row[row],
            rank=ranks.get(row),
            equal=row in above and not above[row].told_apart,
            band=row in band,
            state=states[row],
            variant=row in variants,
            origin=entry.origin if row.detector in entries else "",
            paper=entry.paper,
            year=entry.year,
            authors=entry.authors,
            trivial=board.is_trivial(row),
            training=training[row],
            inputs=next((r.inputs for r in by_row[row] if r.inputs), ""),
            seeds=len({r.seed for r in by_row[row]}),
            seed_low=min(means, default=NAN),
            seed_high=max(means, default=NAN),
            cost=cost_of(by_row[row]),
        )
        standings.append(standing)
    return OrderedBoard(board, standings, above, first)


def primary_settings(records: Iterable[Record]) -> set[Setting]:
    """Return one row of each detector: of those with most expected cells the simplest.

    That is the row with the fewest other than default parameters, and then the least horizon.
    """
    by_row = grouped(records, lambda r: r.setting)
    expected = expected_cells([r for rows in by_row.values() for r in rows])

    def order(row: Setting) -> tuple[Any, ...]:
        cells = expected & {r.position for r in by_row[row]}
        return -len(cells), len(row.parameters), *_name(row)

    primary: dict[str, Setting] = {}
    for row in sorted(by_row, key=order):
        primary.setdefault(row.detector, row)
    return set(primary.values())


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


def _tested(
    terms: Mapping[str, Any], rows: Sequence[Setting], pairs: Iterable[tuple[Setting, Setting]]
) -> dict[Setting, PairedDifference]:
    """Return the tests of pairs by their second rows."""
    named = [(str(a), str(b)) for a, b in pairs]
    return dict(zip(rows, differences(terms, named), strict=True)) if named else {}


def _state(
    records: Sequence[Record],
    cells: Collection[Position],
    metric: str,
    seeds: Collection[int],
    variant: bool,
) -> str:
    """Return why a row is not ranked by a metric; empty if it is."""
    if not cells:
        return f"no cell has {metric_info(metric).title}"
    alike = bool(records) and all(r.deterministic for r in records)
    own_seeds = {r.seed for r in records}
    expected = len(cells) * (len(own_seeds) if alike else len(seeds))
    all_cells = counted(expected, "cell(s)")
    failed = Counter(r.status for r in records if not r.ok)
    reasons = [f"{status} in {n} of {all_cells}" for status, n in failed.items()]
    if len(records) < expected:
        reasons.append(f"{expected - len(records)} of {all_cells} missing")
    values = (c.value for cell in terms_of(records, metric).values() for c in cell.values())
    defined = sum(not math.isnan(value) for value in values)
    if undefined := sum(r.ok for r in records) - defined:
        reasons.append(f"undefined in {undefined} of {all_cells}")
    return ", ".join([*reasons, *(["a variant"] if variant else [])])


def _training(records: Iterable[Record], entry: Entry) -> Training:
    """Return what a row learns from, by its records and by its entry."""
    declared = (entry.training, *(r.training for r in records))
    return next((training for training in declared if training != "nominal"), "nominal")


def _entry_of(row: Setting, entries: Mapping[str, Entry]) -> Entry:
    return entries.get(row.detector) or Entry(row.detector)


def _name(row: Setting) -> tuple[str, int, str]:
    return row.detector, row.horizon, row.overrides_json
