"""Entries of the leaderboard, one directory of plain data each, and the boards that they make.

::

    entry.json       what it is, who submits it, and the digest of every other file
    records.jsonl    one record a line, as in a results directory
    curves.json      illustrations computed from the scores (optional)

Records or curves of more than a megabyte are compressed: ``records.jsonl.xz``, ``curves.json.xz``.

Entries are read here after they were verified (`oodd_leaderboard.verify`): the shape of
``entry.json`` and of each record is checked, their truth is not.
"""

import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.bounded import MANIFEST_BYTES, read_bytes
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.data.files import find_file
from oodd_eval.errors import ResultsError
from oodd_eval.prose import Table
from oodd_eval.results.board import Board, boards, expected_cells, grouped
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.standings import RankedBoard, primary_settings, ranked
from oodd_eval.results.strengths import StrengthTables
from oodd_eval.results.tables import Tables

SCHEMA: Final = 3  # version of the layout of an entry; a reader refuses others

ENTRY: Final = "entry.json"
CURVES: Final = "curves.json"

REPORTED: Final = "Every row is reported by its author: the numbers are not verified."
"""Stands at the head of every board."""


@dataclass(frozen=True, slots=True)
class EntryInfo:
    """The content of ``entry.json``.

    Title, submitter, citation, url and caption (a note above the tables) are plain text for people;
    all but the title may be empty. Detectors, sorted, split and protocol are those of the records.
    `plugins` have ``distribution``, ``plugin``, ``version`` and ``source_digest``, the
    `environment` ``python``, ``platform`` and ``packages``; `primary` are the rows that are ranked
    for their detectors, as `Setting` writes them. `files` has ``sha256`` and ``bytes`` of all other
    files by relative name.
    """

    id: str
    title: str
    detectors: list[str]
    submitter: str
    citation: str
    url: str
    split: str
    split_digest: str
    protocol: int
    plugins: list[dict[str, str]]
    environment: dict[str, Any]
    created: str
    caption: str
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    primary: list[str] = field(default_factory=list)
    schema: int = SCHEMA

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    def to_json(self) -> str:
        """Return the text of ``entry.json``, keys sorted."""
        return json.dumps(asdict(self), indent=1, sort_keys=True, ensure_ascii=False) + "\n"


@dataclass(frozen=True, slots=True)
class SubmittedEntry:
    """An entry that was read: `meta` is ``entry.json``, `path` its directory."""

    path: Path
    meta: EntryInfo
    records: list[Record]

    @property
    def commands(self) -> list[str]:
        """The commands that give its cells: derived from the records, as anybody may run them."""
        return commands_of(self.records)

    @property
    def curves(self) -> Path | None:
        """The file of curves; None when the entry has none."""
        return find_file(self.path / CURVES)


def commands_of(records: Sequence[Record]) -> list[str]:
    """Return ``oodd-eval run`` commands that give the cells of records, and few others.

    Detectors share a command when their environments, anomalies, seeds and parameters are the same.
    """
    rows: dict[Setting, tuple[set[str], set[int], set[str]]] = {}
    for record in records:
        environments, seeds, anomalies = rows.setdefault(record.setting, (set(), set(), set()))
        environments.add(record.environment)
        seeds.add(record.seed)
        anomalies.add(str(record.condition))
    alike: dict[tuple[str, ...], list[str]] = {}
    for setting, (environments, seeds, anomalies) in sorted(rows.items(), key=_in_order):
        all_environments = environments == set(ENVIRONMENTS)
        options = ["--env", "all" if all_environments else ",".join(sorted(environments))]
        if anomalies != set(TABLE1):
            options += ["--anomaly", ",".join(sorted(anomalies))]
        options += ["--split", records[0].split.partition("@")[0]]
        options += ["--seed", ",".join(map(str, sorted(seeds)))]
        if setting.horizon != 1:
            options += ["--horizon", str(setting.horizon)]
        for name, value in setting.overrides.items():
            options += ["--param", f"{name}={json.dumps(value)}"]
        alike.setdefault(tuple(options), []).append(setting.detector)
    commands = (
        shlex.join(["oodd-eval", "run", "--detector", ",".join(names), *options])
        for options, names in alike.items()
    )
    return [" ".join(command.split()) for command in commands]  # one line, whatever names hold


def _in_order(item: tuple[Setting, object]) -> tuple[bool, int, str]:
    """Plain settings first, and those that may share a command one after the other."""
    setting = item[0]
    more = bool(setting.overrides)
    return more, setting.horizon, json.dumps([setting.overrides, setting.detector])


def read_entry(path: Path | str) -> SubmittedEntry:
    """Read the entry in a directory; ResultsError when it cannot be read."""
    file = Path(path) / ENTRY
    meta = _read_info(file)
    if meta.schema != SCHEMA:
        raise ResultsError(
            f"{str(file)!r}: schema is {meta.schema}, expected {SCHEMA}: it was written by another "
            "version of oodd-eval"
        )
    return SubmittedEntry(file.parent, meta, ResultsDirectory(path).records())


def _read_info(file: Path) -> EntryInfo:
    """Read ``entry.json``; `ResultsError` says which of its fields is wrong."""
    try:
        return TypeAdapter(EntryInfo).validate_json(read_bytes(file, MANIFEST_BYTES, ResultsError))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    raise ResultsError(f"{str(file)!r} is no entry: {why}")


def read_entries(root: Path | str) -> list[SubmittedEntry]:
    """Read the entries below a directory in the order of their names, or the one that it is."""
    root = Path(root)
    if not root.is_dir():
        raise ResultsError(f"no directory of entries at {str(root)!r}")
    if (root / ENTRY).exists():
        return [read_entry(root)]
    # A name with a leading dot is an entry that is being written.
    paths = sorted(p.parent for p in root.glob(f"*/{ENTRY}") if not p.parent.name.startswith("."))
    return [read_entry(path) for path in paths]


def row_of(record: Record) -> tuple[Setting, str, int, int | None]:
    """Return the row of the leaderboard that a record is of, which only one entry may have."""
    return record.setting, record.split_digest, record.protocol, record.limit


def recorded_versions(records: Iterable[Record]) -> dict[str, str]:
    """Return the versions that made records, by package and for ``python``, joined by ``+``."""
    by_package: dict[str, set[str]] = {}
    for record in records:
        origin = record.provenance
        named = {"python": origin.get("python", ""), "oodd-eval": origin.get("oodd_eval", "")}
        # Records without a list of packages name the version of one.
        named |= origin.get("packages", {"numpy": origin.get("numpy", "")})
        for name, version in named.items():
            by_package.setdefault(name, set()).add(str(version))
    return {name: "+".join(sorted(versions)) for name, versions in sorted(by_package.items())}


def recorded_plugins(records: Iterable[Record]) -> list[dict[str, str]]:
    """Return the plug-ins that made records, as ``entry.json`` lists them."""
    names = ("distribution", "plugin", "version", "source_digest")
    used = sorted({(r.plugin, r.detector_version, r.plugin_source) for r in records})
    return [dict(zip(names, (*p.split(":", 1), *source), strict=True)) for p, *source in used]


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
    def name(self) -> str:
        """Name in file names, such as ``mini-8fb95f205861-protocol1``."""
        board = self.ranks.board
        split = re.sub(r"[^A-Za-z0-9-]+", "-", board.split.partition("@")[0])
        limit = f"-limit{board.limit}" if board.limit is not None else ""
        twins = "" if board.paired else "-unpaired"
        return f"{split}-{board.digest[:12]}-protocol{board.protocol}{limit}{twins}"

    def file(self, kind: str) -> str:
        """Return the relative name of the section's CSV file of a kind."""
        return f"{TABLES}/{self.name}-{kind}.csv"

    @property
    def order(self) -> tuple[int, str, int, int, str]:
        """Order of the boards, see `sections`."""
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
            suite_tables = graded or [Tables(board).separability()]
            suite_tables = suite_tables if board.paired else Tables(board).of_logs()
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
        ranks = ranked(board.records, _primary(board.records, sources))
        by_id = {entry.meta.id: entry for entry in sources.values()}
        by_board.append(LeaderboardSection(ranks, [by_id[i] for i in sorted(by_id)], sources))
    return sorted(by_board, key=lambda section: section.order)


def _primary(records: Sequence[Record], sources: Mapping[Setting, SubmittedEntry]) -> set[Setting]:
    """Return the primary row of each detector: what its entry declares, else the usual one."""
    # A declared row takes the place of another. So the entry has to be the only one with rows of
    # the detector, or it would push somebody else's row out of the ranking, and its row has to be
    # whole.
    primary = {row.detector: row for row in primary_settings(records)}
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
