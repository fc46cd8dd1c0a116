"""Reported results: records that authors hand in, shown in tables by mean and never ranked.

::

    results/NAME/    the project's, on the shipped splits
    entries/NAME/    those of an entry's author, beside ``entry.toml``

    records.jsonl    one record a line, as in a results directory
    curves.json      illustrations computed from the scores (optional)

Records or curves of more than 100 kB are compressed: ``records.jsonl.xz``, ``curves.json.xz``.
They are strangers' files: read within bounds and held to the rules of `oodd_leaderboard.formats`.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

from oodd_eval.data.bounded import read_bytes
from oodd_eval.data.files import PACKED, decompress, find_file
from oodd_eval.errors import ResultsError
from oodd_eval.prose import Table
from oodd_eval.results.board import Board, boards
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.evaluate import early_difference
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.strengths import StrengthTables
from oodd_eval.results.tables import Tables
from oodd_leaderboard.entry import ENTRY, Entry, read_entries
from oodd_leaderboard.formats import check_record
from oodd_leaderboard.standings import OrderedBoard, ordered

CURVES: Final = "curves.json"
RESULTS: Final = "results"
ENTRIES: Final = "entries"

MOST_PACKED: Final = 8 * 10**6  # bytes of a file as it lies in the repository
MOST_RECORDS: Final = 20_000

REPORTED: Final = "Every row is reported by its author: the numbers are not verified, nor ranked."
"""Stands at the head of every table of reported rows."""


@dataclass(frozen=True, slots=True)
class Reported:
    """Records of one directory; `curves` is the file of curves, None without one."""

    path: Path
    records: list[Record]

    @property
    def name(self) -> str:
        """Name of its directory."""
        return self.path.name

    @property
    def curves(self) -> Path | None:
        """The file of curves; None without one."""
        return find_file(self.path / CURVES)


def read_reported(leaderboard: Path) -> list[Reported]:
    """Read all reported records of a leaderboard's directory, the project's first.

    `ResultsError` names the file, line and field that is wrong.
    """
    paths = [p for name in (RESULTS, ENTRIES) for p in sorted((leaderboard / name).glob("*/"))]
    # A name with a leading dot is of an entry that is being written.
    paths = [p for p in paths if not p.name.startswith(".") and find_file(p / RECORDS)]
    variants = [entry for entry in entries_of(leaderboard) if entry.variant]
    return [
        Reported(path, [_as_run(record, variants) for record in read_strange_records(path)])
        for path in paths
    ]


def _as_run(record: Record, variants: Iterable[Entry]) -> Record:
    """Return a record as that of the variant whose parameters it was made with, if there is one.

    They were the defaults, perhaps, when it was made.
    """
    for entry in variants:
        parameters = dict(entry.parameters)
        same = {name: record.parameters.get(name) for name in parameters} == parameters
        if parameters and same and entry.detector == record.detector:
            return replace(record, overrides=parameters | record.overrides)
    return record


def read_strange_records(directory: Path) -> list[Record]:
    """Read the records of a stranger's directory, each held to the rules of `formats`."""
    path = find_file(directory / RECORDS) or directory / RECORDS
    if path.is_symlink() or directory.is_symlink():
        raise ResultsError(f"{path} is a link, expected a plain file")
    content = read_bytes(path, MOST_PACKED, ResultsError)
    try:
        text = (decompress(content) if path.suffix in PACKED else content).decode()
    except (ResultsError, UnicodeDecodeError) as error:
        raise ResultsError(f"{path}: {error}") from None
    lines = text.removesuffix("\n").split("\n")
    if len(lines) > MOST_RECORDS or not text.endswith("\n"):
        raise ResultsError(f"{path}: expected at most {MOST_RECORDS} whole lines, got {len(lines)}")
    records = []
    for number, line in enumerate(lines, start=1):
        record = Record.from_json(line, f"{path}:{number}")
        check_record(record, f"{path}:{number}")
        equal_before = record.paired and "auc_before" not in record.metrics
        if equal_before and (problem := early_difference(record)):
            raise ResultsError(f"{path}:{number}: {problem}")
        records.append(record)
    return records


def entries_of(leaderboard: Path) -> list[Entry]:
    """Read the entries of a leaderboard's directory; none where it has no directory of them."""
    directory = leaderboard / ENTRIES
    has_entries = any(directory.glob("*.toml")) or any(directory.glob(f"*/{ENTRY}"))
    return read_entries(directory) if has_entries else []


def by_detector(entries: Iterable[Entry]) -> dict[str, Entry]:
    """Return entries by the name that records of their authors have."""
    # Where a detector has several rows, the ranked one comes last and stands for it.
    in_order = sorted(entries, key=lambda entry: not entry.variant)
    return {entry.detector or entry.name: entry for entry in in_order}


def day_of(records: Iterable[Record]) -> str:
    """Return the day of the latest of some records; empty where none says it."""
    times = (str(r.provenance.get("time", ""))[:10] for r in records)
    return max(filter(re.compile(r"\d{4}-\d\d-\d\d").fullmatch, times), default="")


TABLES: Final = "tables"  # directory of the CSV files
SUITES: Final = "suites"  # directory of results on further test suites, one directory a split

_SPLITS_FIRST: Final = ("standard", "paper", "reduced", "mini")
"""Order of the tables: the largest split of the benchmark first."""


@dataclass(frozen=True, slots=True)
class LeaderboardSection:
    """One table of reported rows, by row where it is from, and entries by detector."""

    ranks: OrderedBoard
    sources: dict[Setting, Reported]
    entries: Mapping[str, Entry]

    @property
    def name(self) -> str:
        """Name in file names, such as ``mini-8fb95f205861-protocol1``."""
        board = self.ranks.board
        split = re.sub(r"[^A-Za-z0-9-]+", "-", board.split.partition("@")[0])
        limit = f"-limit{board.limit}" if board.limit is not None else ""
        twins = "" if board.paired else "-unpaired"
        return f"{split}-{board.digest[:12]}-protocol{board.protocol}{limit}{twins}"

    @property
    def date(self) -> str:
        """The day of its latest record; empty where none says it."""
        return day_of(self.ranks.board.records)

    @property
    def order(self) -> tuple[int, str, int, int, str]:
        """Order of the tables, see `sections`."""
        board = self.ranks.board
        name = board.split.partition("@")[0]
        position = _SPLITS_FIRST.index(name) if name in _SPLITS_FIRST else len(_SPLITS_FIRST)
        # Whole splits before limited ones, the newest protocol first.
        limit = -1 if board.limit is None else int(board.limit)
        return position, name, limit, -board.protocol, board.digest


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
            graded = StrengthTables(board).overview() if board.paired else []
            suite_tables = graded or [t for t in [Tables(board).headline()] if t]
            suites.append(SuiteSection(path.name, board, suite_tables, graded=bool(graded)))
    return suites


def sections(
    reported: Sequence[Reported], entries: Mapping[str, Entry] = MappingProxyType({})
) -> list[LeaderboardSection]:
    """Sort reported records into tables of one split digest, protocol and limit each.

    A row is of one directory, as nobody could tell whose numbers its means are, and has each cell
    once: `ResultsError` names two that have it, or the cell. `entries` are by detector.
    """
    owners: dict[object, Reported] = {}
    cells: set[object] = set()
    records: list[Record] = []
    for report in reported:
        for record in report.records:
            row = record.setting, record.split_digest, record.protocol, record.limit
            if (owner := owners.setdefault(row, report)) is not report:
                raise ResultsError(
                    f"{owner.path} and {report.path} both hold row {str(record.setting)!r} of "
                    f"split digest {record.split_digest[:12]}, expected one: remove one of them"
                )
            if (cell := (row, record.cell)) in cells:
                raise ResultsError(
                    f"{report.path} holds {str(record.cell)!r} twice, expected one record: remove "
                    "the older"
                )
            cells.add(cell)
            records.append(record)
    by_board = []
    for board in boards(records):
        ranks = ordered(board.records, entries, ranked=False)
        of_board = board.digest, board.protocol, board.limit
        sources = {row.entry: owners[row.entry, *of_board] for row in ranks.standings}
        by_board.append(LeaderboardSection(ranks, sources, entries))
    return sorted(by_board, key=lambda section: section.order)
