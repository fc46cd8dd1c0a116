"""Entries sorted into the boards of the leaderboard."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.entry import SubmittedEntry, Trust, row_of
from oodd_eval.results import strengths, tables
from oodd_eval.results.board import Board, boards, expected_cells, grouped
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.standings import RankedBoard, primary_settings, ranked
from oodd_eval.results.tables import Table

TABLES: Final = "tables"  # directory of the CSV files
SUITES: Final = "suites"  # directory of results on further test suites, one directory a split

_SPLITS_FIRST: Final = ("standard", "paper", "reduced", "mini")
"""Order of the boards: the leaderboard's own split, then from the most data to the least."""


@dataclass(frozen=True, slots=True)
class LeaderboardSection:
    """One board with its ranking, its entries by id, and by row the entry it is from."""

    ranks: RankedBoard
    entries: list[SubmittedEntry]
    sources: dict[Setting, SubmittedEntry]

    @property
    def trust(self) -> dict[Setting, Trust]:
        """Trust level by row: that of its entry."""
        return {row: entry.trust for row, entry in self.sources.items()}

    @property
    def name(self) -> str:
        """Name in file names, such as ``mini-8fb95f205861-protocol1``."""
        board = self.ranks.board
        split = re.sub(r"[^A-Za-z0-9-]+", "-", board.split.partition("@")[0])
        limit = f"-limit{board.limit}" if board.limit is not None else ""
        return f"{split}-{board.digest[:12]}-protocol{board.protocol}{limit}"

    def file(self, kind: str) -> str:
        """Return the relative name of the section's CSV file of a kind."""
        return f"{TABLES}/{self.name}-{kind}.csv"

    @property
    def order(self) -> tuple[int, str, int, int, str]:
        """Order of the boards, see `sections`."""
        board = self.ranks.board
        name = board.split.partition("@")[0]
        known = _SPLITS_FIRST.index(name) if name in _SPLITS_FIRST else len(_SPLITS_FIRST)
        # Whole splits before limited ones, the newest protocol first.
        limit = -1 if board.limit is None else int(board.limit)
        return known, name, limit, -board.protocol, board.digest


@dataclass(frozen=True, slots=True)
class SuiteSection:
    """Results on a further test suite: its directory's name, records, tables.

    It is `graded` where its anomalies have several strengths.
    """

    name: str
    board: Board
    tables: list[Table]
    graded: bool


def suite_sections(directory: Path) -> list[SuiteSection]:
    """Return what a leaderboard's directory has of results on further test suites."""
    suites = []
    for path in filter(Path.is_dir, sorted((directory / SUITES).glob("*"))):
        for board in boards(ResultsDirectory(path).records()):
            graded = strengths.strength_tables(board)
            suite_tables = graded or [tables.separability(board)]
            suites.append(SuiteSection(path.name, board, suite_tables, graded=bool(graded)))
    return suites


def sections(entries: Sequence[SubmittedEntry]) -> list[LeaderboardSection]:
    """Sort entries, in any order, into boards of one split digest, protocol and limit each.

    A row is of one entry: further seeds or environments of it from another one are refused, as
    nobody could tell whose numbers its means are.
    """
    owners: dict[object, SubmittedEntry] = {}
    records: list[Record] = []
    for entry in sorted(entries, key=lambda entry: entry.meta.id):
        for record in entry.records:
            if (owner := owners.setdefault(row_of(record), entry)) is not entry:
                raise ResultsError(
                    f"entries {owner.meta.id!r} and {entry.meta.id!r} both hold row "
                    f"{str(record.setting)!r} of split digest {record.split_digest[:12]}, expected "
                    "one: remove the entry that is replaced, or give the detector another name"
                )
            records.append(record)
    by_board = []
    for board in boards(records):
        sources = {r.setting: owners[row_of(r)] for r in board.records}
        rerun = {row for row, entry in sources.items() if entry.trust == "re-run"}
        ranks = ranked(board.records, _primary(board.records, sources, rerun), rerun)
        by_id = {entry.meta.id: entry for entry in sources.values()}
        by_board.append(LeaderboardSection(ranks, [by_id[i] for i in sorted(by_id)], sources))
    return sorted(by_board, key=lambda section: section.order)


def _primary(
    records: Sequence[Record], sources: Mapping[Setting, SubmittedEntry], rerun: Collection[Setting]
) -> set[Setting]:
    """Return the primary row of each detector: what its entry declares, else the usual one.

    A declared row takes the place of another. So the entry has to be the only one with rows of the
    detector, or it would push somebody else's row out of the ranking, and its row has to be whole.
    """
    primary = {row.detector: row for row in primary_settings(records, rerun)}
    expected = expected_cells(records)
    by_row = grouped(records, lambda r: r.setting)
    cells = {row: expected & {r.position for r in rows} for row, rows in by_row.items()}
    declared: dict[str, Setting] = {}
    for row, entry in sources.items():
        if str(row) not in entry.meta.primary:
            continue
        name = f"entry {entry.meta.id!r} declares {str(row)!r} as the primary row of {row.detector}"
        for owner in (sources[r] for r in sources if r.detector == row.detector):
            if owner is not entry:
                raise ResultsError(
                    f"{name}, but entry {owner.meta.id!r} has rows of it, too: only an entry with "
                    "all rows of a detector may choose, so leave the statement out"
                )
        if (before := declared.setdefault(row.detector, row)) != row:
            raise ResultsError(f"{name}, and {str(before)!r}, too: expected one row a detector")
        if lacking := cells[usual := primary[row.detector]] - cells[row]:
            raise ResultsError(
                f"{name}, which lacks {len(lacking)} cells that {str(usual)!r} has: expected a row "
                "with all of them, so run the rest or leave the statement out"
            )
        primary[row.detector] = row
    return set(primary.values())
