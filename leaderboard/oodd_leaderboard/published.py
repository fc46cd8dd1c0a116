"""The published boards as one small file, and a run of one's own among their rows.

``leaderboard build`` writes the file, the wheel ships it: the last season's rows and the reported
ones, reduced to what the front columns need. Its first line has entries and season, the others
are records.
"""

import json
import lzma
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.files import read_text
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.metrics.catalogue import FOUND_WITHIN, RANKING, UNDEFINED
from oodd_eval.metrics.ranking import PairedDifference, Position
from oodd_eval.prose import Table
from oodd_eval.results.board import Conditions, boards, expected_cells, grouped, level_of, ranked_by
from oodd_eval.results.directory import read_records
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Metric, Record, same_terms
from oodd_eval.results.standings import with_interval
from oodd_eval.results.tables import Tables
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.reported import LeaderboardSection, by_detector
from oodd_leaderboard.season_files import Season
from oodd_leaderboard.seasons import SeasonBoard
from oodd_leaderboard.standings import OrderedBoard, Standing, ordered

PUBLISHED: Final = "published.jsonl.xz"

_BESIDE: Final = (f"found_within_{FOUND_WITHIN[0]}", "missed", "false_episodes")


def kept_metrics(records: Sequence[Record]) -> tuple[str, ...]:
    """Return the metrics that the file has of a board: those of its front columns."""
    return *ranked_by(records), *(f"{name}_{level_of(records)}" for name in _BESIDE)


@dataclass(frozen=True, slots=True)
class PublishedBoard:
    """One board: its records, the entries of its rows by detector, and of a season also that."""

    records: list[Record]
    entries: Mapping[str, Entry]
    season: Season | None = None

    @property
    def expected(self) -> Collection[Position]:
        """Environments and conditions that a whole row has."""
        return self.season.expected if self.season else expected_cells(self.records)

    def ranks(self) -> OrderedBoard:
        """Return the board in order, as the page has it."""
        return self.with_rows(self.records, self.expected)

    def with_rows(self, records: Sequence[Record], cells: Collection[Position]) -> OrderedBoard:
        """Return other rows on this board, over some of its cells."""
        return ordered(records, self.entries, expected=cells, ranked=self.season is not None)

    @property
    def title(self) -> str:
        """Its name, with the date of a season or as reported rows."""
        if self.season:
            return f"Season {self.season.name}, {self.season.date}"
        return f"Reported rows, {Conditions.of(self.records[0])}"


def published_bytes(
    sections: Iterable[LeaderboardSection],
    seasons: Sequence[SeasonBoard] = (),
    entries: Iterable[Entry] = (),
) -> bytes:
    """Return the bytes of the file: the same ones for the same boards."""
    seasons = [board for board in seasons if not board.season.trial][:1]
    head = {
        "entries": {entry.name: asdict(entry) for entry in entries},
        "season": asdict(seasons[0].season) if seasons else None,
    }
    lines = [json.dumps(head, sort_keys=True)]
    for ranks in [board.ranks for board in seasons] + [section.ranks for section in sections]:
        kept = kept_metrics(ranks.board.records)
        lines += [slim(r, kept).to_json() for row in ranks.standings for r in row.records]
    return lzma.compress("".join(line + "\n" for line in lines).encode())


def published_file() -> Path:
    """Return the file's place: in the wheel beside this module, in a checkout with the board.

    `ResultsError`: there is none.
    """
    here = Path(__file__)
    candidates = here.with_name(PUBLISHED), here.parents[1] / PUBLISHED
    for path in candidates:
        if path.is_file():
            return path
    raise ResultsError(
        f"this installation has no published board: expected {str(candidates[0])!r}; install "
        "oodd-eval from its wheel, or run leaderboard build in its checkout"
    )


@dataclass(frozen=True, slots=True)
class _Head:
    """The first line of the file."""

    entries: dict[str, Entry]
    season: Season | None


def read_published(file: Path | None = None) -> list[PublishedBoard]:
    """Read the boards of the file, by default the one of this installation; a season is first."""
    file = file or published_file()
    try:
        head = TypeAdapter(_Head).validate_json(read_text(file).partition("\n")[0])
    except ValidationError:
        raise ResultsError(
            f"{str(file)!r} was written by another version of oodd-eval: run leaderboard build"
        ) from None
    reported = by_detector(head.entries.values())
    published = []
    for board in boards(read_records(file, matches=lambda line: not line.startswith('{"entries"'))):
        season = head.season
        if season is not None and board.digest == season.split.digest:
            published.append(PublishedBoard(board.records, season.entries, season))
        else:
            published.append(PublishedBoard(board.records, reported, None))
    return sorted(published, key=lambda board: board.season is None)


def board_of(records: Sequence[Record], among: Iterable[PublishedBoard]) -> PublishedBoard:
    """Return the board that some records of one split can be compared with.

    `UsageError`: there is none with their split digest, protocol and limit.
    """
    by_conditions = {Conditions.of(board.records[0]): board for board in among}
    conditions = Conditions.of(records[0])
    if conditions in by_conditions:
        return by_conditions[conditions]
    listed = "; ".join(map(str, by_conditions)) or "none"
    if any(candidate.split_digest == conditions.split_digest for candidate in by_conditions):
        advice = "run again with this version, without --limit, into another directory"
    else:
        advice = "run on a published split, such as --split mini, or compare rows with one another"
    raise UsageError(
        f"these results cannot be compared with the board: they are of {conditions}, and "
        f"published is {listed}; {advice}"
    )


def slim(record: Record, metrics: Iterable[str]) -> Record:
    """Return a record with the terms of some metrics alone, from which their values follow."""
    terms = {name: record.per_trajectory[name] for name in metrics if name in record.per_trajectory}
    return replace(
        record,
        parameters={},
        plugin_source="",
        scores="",
        provenance={},
        reason="",
        per_trajectory=terms,
        calibration_draws=record.calibration_draws.only(terms),
        metrics={name: Metric(NAN) for name in terms},
        seconds_fit=NAN,
        seconds_score=NAN,
        peak_rss_mb=NAN,
        steps_scored=None,
    )


MARK: Final = "> "
"""Stands before the rows of one's own."""


class Placement(NamedTuple):
    """A run among the rows of a published board.

    `rows` are its rows, of which the board has those in `published` with the same numbers, and
    others of the same name in `replaced`. `cells` are compared: all that the board `expected`, or
    fewer where no new row of the run has them all.
    """

    ranks: OrderedBoard
    rows: set[Setting]
    published: set[Setting]
    replaced: set[Setting]
    cells: Collection[Position]
    expected: Collection[Position]


def placement(records: Sequence[Record], board: PublishedBoard) -> Placement:
    """Place the rows of a run among those of a board.

    A row of the board's name takes the place of the board's. `UsageError`: the rows of the run
    have no cell in common.
    """
    kept = kept_metrics(board.records)
    by_row = grouped((slim(r, kept) for r in records), lambda r: r.setting)
    on_board = grouped(board.records, lambda r: r.setting)
    same = {r for r, records in by_row.items() if r in on_board and _within(records, on_board[r])}
    new = {row: records for row, records in by_row.items() if row not in same}
    expected = set(board.expected)
    has = [{r.position for r in records if r.ok} & expected for records in new.values()]
    cells = set.intersection(*has) if has and expected not in has else expected
    if not cells:
        raise UsageError(
            "the rows of these results have no cell of the board in common: name some of them with "
            "--detector"
        )
    used = [r for rows in (on_board | new).values() for r in rows if r.position in cells]
    replaced = set(new.keys() & on_board.keys())
    return Placement(board.with_rows(used, cells), set(by_row), same, replaced, cells, expected)


def _within(records: Sequence[Record], other_records: Sequence[Record]) -> bool:
    """Tell whether all numbers of a row are among those of another."""
    terms = {(r.position, r.seed, r.status): r.per_trajectory for r in other_records}
    keys = [(r.position, r.seed, r.status) for r in records]
    return all(
        key in terms and same_terms(terms[key], r.per_trajectory)
        for key, r in zip(keys, records, strict=True)
    )


ORIGINS: Final = {
    "paper": "the paper",
    "others": "others",
    "project": "ours",
    "trivial": "trivial",
    "oracle": "oracle",
    "": UNDEFINED,
}
"""Whose rows are, as tables say it."""


def board_table(ranks: OrderedBoard, marked: Collection[Setting] = ()) -> Table | None:
    """Return the front columns of a board's rows with place, origin and year, some `marked`.

    None: no record has any of them.
    """
    placed = any(row.rank for row in ranks.standings)
    header = ("rank", "row", "whose") if placed else ("row", "whose")
    labels = {}
    for row in ranks.standings:
        named = [printed_name(row, marked), _whose(row)]
        labels[row.entry] = [row.printed_rank, *named] if placed else named
    table = Tables(ranks.board, labels=labels, label_names=header).headline()
    if table is None:
        return None
    short = table.narrower[-1] if table.narrower else table
    columns = [i for i, name in enumerate(short.header) if name != header[-1]]
    without = replace(short.columns(columns), labels=len(header) - 1)
    return replace(table, narrower=[*table.narrower, without])


def printed_name(row: Standing, marked: Collection[Setting] = ()) -> str:
    """Return the name of a row as boards print it, of those `marked` with `MARK`."""
    marks = row.marks.replace(f" ({row.origin})", "")  # which stands in a column of its own
    return f"{MARK * (row.entry in marked)}{row.entry}{marks}"


def _whose(row: Standing) -> str:
    year = "" if row.origin in {"trivial", "oracle"} else str(row.year or "")
    return ", ".join(filter(None, [ORIGINS[row.origin], year]))


def difference_text(test: PairedDifference) -> str:
    """Return a difference in points with its interval, of as many digits as tell it from 0."""
    return with_interval(test.difference, test.low, test.high, RANKING)
