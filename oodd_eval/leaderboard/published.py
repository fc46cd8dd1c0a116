"""The published board as one small file, which ``leaderboard build`` writes and the wheel ships.

It holds the records of all entries without what no ranking needs, as lines of JSON, compressed.
Each record's provenance says which entry it is from, at which level of trust, and whether its row
is primary; or of which further test suite it is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from oodd_eval.data.files import compress
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.leaderboard.sections import LeaderboardSection, SuiteSection
from oodd_eval.metrics.catalogue import ALARM_RANKING, FOUND_WITHIN, HEADLINE, RANKING
from oodd_eval.results.board import Board, Conditions, boards, grouped
from oodd_eval.results.directory import read_records
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Metric, Record
from oodd_eval.results.standings import RankedBoard, ranked
from oodd_eval.results.strengths import DETECTION

PUBLISHED: Final = "published.jsonl.gz"

ALARMS: Final = tuple(
    f"{name}_{HEADLINE}" for name in (f"found_within_{FOUND_WITHIN[0]}", "missed", "false_episodes")
)
"""Metrics of guaranteed alarms that stand beside the one that ranks."""

RANKED_BY: Final = (RANKING, ALARM_RANKING, *ALARMS)
"""Metrics that the file has: those of the rankings, and those beside them."""

_OF_SUITE: Final = '"provenance": {"suite": '  # in the line of a record of a further suite


@dataclass(frozen=True, slots=True)
class PublishedBoard:
    """One board: its records, and by row the entry's id and trust; `primary` are primary rows."""

    records: list[Record]
    entries: dict[Setting, str]
    trust: dict[Setting, str]
    primary: set[Setting]

    def ranks(self) -> RankedBoard:
        """Return the board's rankings, those of the page."""
        return ranked(self.records, self.primary, self.rerun)

    @property
    def rerun(self) -> set[Setting]:
        """The rows that were run again, which alone are ranked where there are any."""
        return {row for row, trust in self.trust.items() if trust == "re-run"}

    @property
    def conditions(self) -> Conditions:
        """The conditions that all records have."""
        return Conditions.of(self.records[0])

    def __str__(self) -> str:
        """Return what tells boards apart, such as ``mini, digest 7041bd7c9c2b, protocol 2``."""
        return str(self.conditions)


class Published(NamedTuple):
    """All published boards, and the file that they are from."""

    boards: list[PublishedBoard]
    file: Path

    @property
    def suites(self) -> dict[str, Board]:
        """The boards of further suites with several strengths, by name; reading them takes long."""
        records = read_records(self.file, matches=lambda line: _OF_SUITE in line)
        by_suite = grouped(records, lambda r: str(r.provenance["suite"]))
        return {name: Board(records) for name, records in by_suite.items()}


def published_bytes(
    sections: Iterable[LeaderboardSection], suites: Iterable[SuiteSection] = ()
) -> bytes:
    """Return the bytes of the file: the same ones for the same boards and suites."""
    records = [
        slim(
            record,
            RANKED_BY,
            entry=section.sources[row.entry].meta.id,
            trust=section.trust[row.entry],
            primary=row.primary,
        )
        for section in sections
        for row in section.ranks.standings
        for record in row.records
    ]
    records += [
        slim(record, (DETECTION,), suite=suite.name)
        for suite in suites
        if suite.graded
        for record in suite.board.records
    ]
    return compress("".join(record.to_json() + "\n" for record in records).encode())


def published_file() -> Path:
    """Return the file's place: in the wheel beside this module, in a checkout with the board.

    `ResultsError`: there is none.
    """
    here = Path(__file__)
    candidates = here.with_name(PUBLISHED), here.parents[2] / "leaderboard" / PUBLISHED
    for path in candidates:
        if path.is_file():
            return path
    raise ResultsError(
        f"this installation has no published board: expected {str(candidates[0])!r}; install "
        "oodd-eval from its wheel, or run leaderboard build in its checkout"
    )


def read_published(file: Path | None = None) -> Published:
    """Read the boards of the file, by default the one of this installation."""
    file = file or published_file()
    published = []
    for board in boards(read_records(file, matches=lambda line: _OF_SUITE not in line)):
        origin = {r.setting: r.provenance for r in board.records}
        entries, trust = (
            {row: about[k] for row, about in origin.items()} for k in ("entry", "trust")
        )
        primary = {row for row, about in origin.items() if about["primary"]}
        published.append(PublishedBoard(board.records, entries, trust, primary))
    return Published(published, file)


def board_of(records: Sequence[Record], among: Iterable[PublishedBoard]) -> PublishedBoard:
    """Return the board that some records of one split can be compared with.

    `UsageError`: there is none with their split digest, protocol and limit.
    """
    by_conditions = {board.conditions: board for board in among}
    conditions = Conditions.of(records[0])
    if conditions in by_conditions:
        return by_conditions[conditions]
    listed = "; ".join(map(str, by_conditions)) or "none"
    if any(known.split_digest == conditions.split_digest for known in by_conditions):
        advice = "run again with this version, without --limit, into another directory"
    else:
        name = conditions.split.partition("@")[0]
        advice = "run on a published split, such as --split mini"
        if any(known.split == name for known in by_conditions):
            advice += f"; a split {name} that was built otherwise is another one"
    raise UsageError(
        f"these results cannot be compared with the board: they are of {conditions}, and "
        f"published is {listed}; {advice}"
    )


def slim(record: Record, metrics: Iterable[str] = RANKED_BY, **provenance: object) -> Record:
    """Return a record with the terms of some metrics alone, from which their values follow."""
    terms = {name: record.per_trajectory[name] for name in metrics if name in record.per_trajectory}
    return replace(
        record,
        parameters={},
        plugin_source="",
        scores="",
        provenance=provenance,
        reason="",
        per_trajectory=terms,
        metrics={name: Metric(NAN) for name in terms},
        seconds_fit=NAN,
        seconds_score=NAN,
        peak_rss_mb=NAN,
        steps_scored=None,
    )
