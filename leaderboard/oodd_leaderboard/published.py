"""The published board as one small file, and a run of one's own among its rows.

``leaderboard build`` writes the file, the wheel ships it. It holds each entry's records, reduced to
what ranking needs, as lines of JSON, compressed. Each record's provenance says which
entry it is from, and whether its row is primary. A run is placed by the code that ranks the board
itself. Of further test suites with several strengths it has the table of detection thresholds.
"""

import json
import lzma
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.metrics.catalogue import FOUND_WITHIN, metric_info
from oodd_eval.metrics.ranking import PairTest, Ranking
from oodd_eval.names import counted
from oodd_eval.prose import Table
from oodd_eval.results.board import (
    Column,
    Conditions,
    boards,
    expected_cells,
    grouped,
    level_of,
    ranked_by,
)
from oodd_eval.results.directory import read_records
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Metric, Record, same_terms
from oodd_eval.results.standings import (
    SEEDS,
    RankedBoard,
    Standing,
    has_few_seeds,
    primary_settings,
    ranked,
)
from oodd_eval.results.tables import printed_rank, texts
from oodd_leaderboard.reported import LeaderboardSection, SuiteSection

PUBLISHED: Final = "published.jsonl.xz"

_SOON: Final = f"found_within_{FOUND_WITHIN[0]}"

_BESIDE: Final = {
    _SOON: f"found in {FOUND_WITHIN[0]}",
    "missed": "missed",
    "false_episodes": "false",
}
"""Metrics of guaranteed alarms that stand beside the one that ranks, and their headings."""


def kept_metrics(records: Sequence[Record]) -> tuple[str, ...]:
    """Return the metrics that the file has of a board: those of its rankings, and those beside."""
    return *ranked_by(records), *(f"{name}_{level_of(records)}" for name in _BESIDE)


_OF_SUITE: Final = '{"suite": '  # begins the line of a further suite


@dataclass(frozen=True, slots=True)
class PublishedBoard:
    """One board: its records, and by row the entry's id; `primary` are primary rows."""

    records: list[Record]
    entries: dict[Setting, str]
    primary: set[Setting]

    def ranks(self) -> RankedBoard:
        """Return the board's rankings, those of the page."""
        return ranked(self.records, self.primary)

    @property
    def conditions(self) -> Conditions:
        """The conditions that all records have."""
        return Conditions.of(self.records[0])

    def __str__(self) -> str:
        """Return what tells boards apart, such as ``mini, digest 7041bd7c9c2b, protocol 2``."""
        return str(self.conditions)


class PublishedSuite(NamedTuple):
    """A further test suite with several strengths: its name, its split's digest, thresholds."""

    name: str
    digest: str
    thresholds: Table


class Published(NamedTuple):
    """All published boards, and further suites."""

    boards: list[PublishedBoard]
    suites: list[PublishedSuite]


def published_bytes(
    sections: Iterable[LeaderboardSection], suites: Iterable[SuiteSection] = ()
) -> bytes:
    """Return the bytes of the file: the same ones for the same boards and suites."""
    records = [
        slim(
            record,
            kept_metrics(section.ranks.board.records),
            entry=section.sources[row.entry].meta.id,
            primary=row.primary,
        )
        for section in sections
        for row in section.ranks.standings
        for record in row.records
    ]
    lines = [record.to_json() for record in records]
    for suite in suites:
        if suite.graded:
            first = {k: getattr(suite.tables[0], k) for k in ("title", "header", "rows", "note")}
            lines.append(
                json.dumps({"suite": suite.name, "digest": suite.board.digest, "table": first})
            )
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


def read_published(file: Path | None = None) -> Published:
    """Read the boards of the file, by default the one of this installation."""
    file = file or published_file()
    suites: list[PublishedSuite] = []

    def is_record(line: str) -> bool:
        if of_suite := line.startswith(_OF_SUITE):
            about = json.loads(line)
            suites.append(PublishedSuite(about["suite"], about["digest"], Table(**about["table"])))
        return not of_suite

    published = []
    for board in boards(read_records(file, matches=is_record)):
        origin = {r.setting: r.provenance for r in board.records}
        entries = {row: about["entry"] for row, about in origin.items()}
        primary = {row for row, about in origin.items() if about["primary"]}
        published.append(PublishedBoard(board.records, entries, primary))
    return Published(published, suites)


def board_of(records: Sequence[Record], among: Iterable[PublishedBoard]) -> PublishedBoard:
    """Return the board that some records of one split can be compared with.

    `UsageError`: there is none with their split digest, protocol and limit.
    """
    by_conditions = {board.conditions: board for board in among}
    conditions = Conditions.of(records[0])
    if conditions in by_conditions:
        return by_conditions[conditions]
    listed = "; ".join(map(str, by_conditions)) or "none"
    if any(candidate.split_digest == conditions.split_digest for candidate in by_conditions):
        advice = "run again with this version, without --limit, into another directory"
    elif not conditions.paired and all(candidate.paired for candidate in by_conditions):
        advice = (
            "logs of your own have no board there: `oodd-eval compare` tells which of your rows is "
            "better"
        )
    else:
        name = conditions.split.partition("@")[0]
        advice = "run on a published split, such as --split mini"
        if any(candidate.split == name for candidate in by_conditions):
            advice += f"; a split {name} that was built otherwise is another one"
    raise UsageError(
        f"these results cannot be compared with the board: they are of {conditions}, and "
        f"published is {listed}; {advice}"
    )


def slim(record: Record, metrics: Iterable[str], **provenance: object) -> Record:
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
    fewer where no new row of the run has them all. `lacking` says by row what a ranked one needs.
    """

    ranks: RankedBoard
    rows: set[Setting]
    published: set[Setting]
    replaced: set[Setting]
    cells: set[tuple[str, str]]
    expected: set[tuple[str, str]]
    lacking: dict[Setting, str]


def placement(
    records: Sequence[Record], board: PublishedBoard, primary: Collection[str] = ()
) -> Placement:
    """Place the rows of a run among those of a board.

    A row that the board has with the same numbers keeps its place. Another row of the same
    name takes the place of the board's. `primary` are the rows that an entry declares for its
    detectors. `UsageError`: the rows of the run have no cell in common.
    """
    kept = kept_metrics(board.records)
    by_row = grouped((slim(r, kept) for r in records), lambda r: r.setting)
    on_board = grouped(board.records, lambda r: r.setting)
    same = {r for r, records in by_row.items() if r in on_board and _within(records, on_board[r])}
    new = {row: records for row, records in by_row.items() if row not in same}
    replaced = new.keys() & on_board.keys()
    expected = expected_cells(board.records)
    has = [{r.position for r in records if r.ok} & expected for records in new.values()]
    cells = set.intersection(*has) if has and expected not in has else expected
    if not cells:
        raise UsageError(
            "the rows of these results have no cell of the board in common: name some of them with "
            "--detector"
        )
    first = board.primary - replaced
    taken = {row.detector for row in first}
    free = [r for rows in new.values() for r in rows if r.setting.detector not in taken]
    primary_rows = {row.detector: row for row in primary_settings(free)}
    primary_rows |= {
        row.detector: row for row in new if str(row) in primary and row.detector in primary_rows
    }
    # With too few seeds a primary row has no rank. A variant has the one that it would have.
    first = first | {row for row in primary_rows.values() if not has_few_seeds(new[row])}
    used = [r for rows in (on_board | new).values() for r in rows if r.position in cells]
    lacking = {row: _lacking(rows, expected) for row, rows in new.items()}
    return Placement(
        ranks=ranked(used, first, expected=cells),
        rows=set(by_row),
        published=same,
        replaced=set(replaced),
        cells=cells,
        expected=expected,
        lacking={row: text for row, text in lacking.items() if text},
    )


def _within(records: Sequence[Record], other_records: Sequence[Record]) -> bool:
    """Tell whether all numbers of a row are among those of another."""
    terms = {(r.position, r.seed, r.status): r.per_trajectory for r in other_records}
    keys = [(r.position, r.seed, r.status) for r in records]
    return all(
        key in terms and same_terms(terms[key], r.per_trajectory)
        for key, r in zip(keys, records, strict=True)
    )


def _lacking(records: Sequence[Record], expected: set[tuple[str, str]]) -> str:
    """Return what a row has to have besides for a rank on the board; empty if nothing."""
    seeds = grouped(records, lambda r: r.seed)
    sizes = grouped(expected, lambda cell: cell[0])
    parts = []
    for seed, of_seed in sorted(seeds.items()):
        missing = grouped(sorted(expected - {r.position for r in of_seed if r.ok}), lambda c: c[0])
        named = [
            e if len(cells) == len(sizes[e]) else ", ".join(map("/".join, cells))
            for e, cells in missing.items()
        ]
        if named:
            count = sum(map(len, missing.values()))
            of = f" with seed {seed}" if len(seeds) > 1 else ""
            parts.append(f"{count} of {counted(len(expected), 'cell(s)')}{of} ({', '.join(named)})")
    if has_few_seeds(records):
        parts.append(f"{SEEDS - len(seeds)} of {SEEDS} detector seeds")
    return " and ".join(parts)


def printed_name(row: Standing, marked: Collection[Setting] = ()) -> str:
    """Return the name of a row as rankings print it, of those `marked` with `MARK`."""
    return f"{MARK * (row.entry in marked)}{row.entry}{row.marks}"


def rankings(ranks: RankedBoard, marked: Collection[Setting] = ()) -> list[Table]:
    """Return the ranking by separability and that by guaranteed alarms, some rows `marked`.

    Letters of tie groups stand behind a rank.
    """
    by_scores, by_alarms = (
        metric_info(n) for n in (ranks.board.ranking, ranks.board.alarm_ranking)
    )

    def rows(standings: Iterable[Standing], ranking: Ranking, *metrics: str) -> list[list[str]]:
        columns = [Column(name, intervals=name == metrics[0]) for name in metrics]
        lines = []
        for row in standings:
            label = str(row.entry)
            letters = ranking.letters(label)
            rank = f"{printed_rank(ranking.ranks.get(label))} {letters}".rstrip()
            labels = [rank, printed_name(row, marked)]
            lines.append([*labels, *texts(ranks.board, row.entry, columns)])
        return lines

    by_separability = rows(ranks.standings, ranks.ranking, by_scores.name)
    order = {row: i for i, row in enumerate(ranks.alarms.ranks)}
    standings = sorted(ranks.standings, key=lambda row: order.get(str(row.entry), len(order)))
    level, suffix = f"at {by_alarms.level}", ranks.board.level
    names = [f"{name}_{suffix}" for name in _BESIDE]
    if not ranks.board.paired:
        names = ranks.board.present(names)
    lines = rows(standings, ranks.alarms, by_alarms.name, *names)
    censored = by_alarms.unit == "steps"
    title = f"{by_alarms.noun} (steps)" if censored else f"{by_alarms.title.removesuffix(level)}(%)"
    header = [
        by_alarms.noun if censored else "found",
        *(_BESIDE[n.removesuffix(f"_{suffix}")] for n in names),
    ]
    return [
        Table(
            f"Ranking by separability: {by_scores.title} (%), higher is better",
            ["rank", "row", by_scores.title],
            by_separability,
            labels=2,
        ),
        Table(
            f"Ranking by guaranteed alarms {level}: {title}, {by_alarms.better} is better",
            ["rank", "row", *header],
            lines,
            labels=2,
            note=_DELAYS if censored else "",
        ),
    ]


_DELAYS: Final = (
    "The delay counts a miss as the rest of its episode. The shares (%) are of episodes found "
    "within so many steps, of those missed, and of nominal episodes with an alarm."
)


def neighbours(ranks: RankedBoard, row: Setting) -> Table | None:
    """Return how a row differs from the primary rows next above and below it, in both rankings.

    Differences are paired, with 95 % intervals, in the metric's own unit. None: it has no rank.
    """
    lines = []
    near = {str(s.entry) for s in ranks.standings if s.primary}
    label = str(row)
    by_scores, by_alarms = (
        metric_info(n) for n in (ranks.board.ranking, ranks.board.alarm_ranking)
    )
    for title, ranking, metric in (
        (by_scores.title, ranks.ranking, by_scores.name),
        ("delay" if by_alarms.unit == "steps" else "found", ranks.alarms, by_alarms.name),
    ):
        pairs = (c for c in ranking.comparisons if c.first == label and c.second in near)
        tests = {c.second: c for c in pairs}
        worse = {c.first for c in ranking.comparisons if c.second == label and c.better}
        order = list(ranking.ranks)
        here = order.index(label) if label in order else len(order)
        above = [name for name in order[:here] if name in tests][-1:]
        below = [name for name in order[here:] if name in tests][:1]
        for neighbour in (*above, *below):
            test = tests[neighbour]
            tie = HOLM if test.low > 0 or test.high < 0 else "tie"
            verdict = "worse" if neighbour in worse else "better" if test.better else tie
            difference = _difference(test, metric)
            lines.append([title, neighbour, str(ranking.ranks[neighbour]), difference, verdict])
    header = ["metric", "against", "rank", "difference", "verdict"]
    title = f"{row} and the rows next to it"
    return Table(title, header, lines, labels=2) if lines else None


HOLM: Final = "tie (Holm)"
"""A verdict: the interval leaves out 0, but the corrected p-value is too large."""


def neighbours_notes(compared: Iterable[Table]) -> list[str]:
    """Return what has to stand once below tables of `neighbours`."""
    verdicts = [line[-1] for table in compared for line in table.rows]
    notes = ["Paired differences over the same test episodes, this row minus the other."]
    if HOLM in verdicts:
        notes.append(
            f"{HOLM}: the interval leaves out 0, but after Holm's correction for all pairs of rows "
            "the difference is not significant."
        )
    return notes if verdicts else []


def _difference(test: PairTest, metric: str) -> str:
    """Return a difference with its interval in the metric's unit and direction."""
    info = metric_info(metric)
    ends = test.difference, test.low, test.high
    if info.better == "lower":  # rankings turn the sign
        ends = -test.difference, -test.high, -test.low
    value, low, high = map(info.text, ends)
    return f"{'+' * (ends[0] > 0)}{value} [{low}, {high}]"
