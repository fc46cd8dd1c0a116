"""A run of one's own among the rows of the published board, and the tables that show both.

The ranks are made by the code that ranks the board itself.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.published import ALARMS, PublishedBoard, slim
from oodd_eval.metrics.catalogue import ALARM_RANKING, FOUND_WITHIN, RANKING, UNDEFINED, metric_info
from oodd_eval.metrics.ranking import PairTest, Ranking
from oodd_eval.results.board import expected_cells, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record, same_terms
from oodd_eval.results.standings import (
    SEEDS,
    RankedBoard,
    Standing,
    has_few_seeds,
    primary_settings,
    ranked,
)
from oodd_eval.results.tables import Mean, Table, texts

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
    """Place the rows of a run among those of a board, as if they had been run again.

    A row that the board has with the same numbers keeps its place and its trust. Another row of
    the same name takes the place of the board's. `primary` are the rows that an entry declares
    for its detectors. `UsageError`: the rows of the run have no cell in common.
    """
    by_row = grouped(map(slim, records), lambda r: r.setting)
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
    chosen = {row.detector: row for row in primary_settings(free)}
    chosen |= {row.detector: row for row in new if str(row) in primary and row.detector in chosen}
    # With too few seeds a primary row has no rank. A variant has the one that it would have.
    first = first | {row for row in chosen.values() if not has_few_seeds(new[row])}
    used = [r for rows in (on_board | new).values() for r in rows if r.position in cells]
    lacking = {row: _lacking(rows, expected) for row, rows in new.items()}
    return Placement(
        ranks=ranked(used, first, board.rerun and board.rerun | new.keys(), expected=cells),
        rows=set(by_row),
        published=same,
        replaced=set(replaced),
        cells=cells,
        expected=expected,
        lacking={row: text for row, text in lacking.items() if text},
    )


def _within(records: Sequence[Record], others: Sequence[Record]) -> bool:
    """Tell whether all numbers of a row are among those of another."""
    known = {(r.position, r.seed, r.status): r.per_trajectory for r in others}
    keys = [(r.position, r.seed, r.status) for r in records]
    return all(
        key in known and same_terms(known[key], r.per_trajectory)
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
            parts.append(f"{count} of {len(expected)} cells{of} ({', '.join(named)})")
    if has_few_seeds(records):
        parts.append(f"{SEEDS - len(seeds)} of {SEEDS} detector seeds")
    return " and ".join(parts)


def rankings(
    ranks: RankedBoard, trust: Mapping[Setting, str], marked: Collection[Setting] = ()
) -> list[Table]:
    """Return the ranking by separability and that by guaranteed alarms, some rows `marked`.

    Trust is by row; a row without is of no entry. Letters of tie groups stand behind a rank.
    """
    over = ranks.board.environments, ranks.board.anomalies

    def rows(
        standings: Iterable[Standing], ranking: Ranking, *metrics: str
    ) -> list[tuple[Setting, list[str]]]:
        columns = [Mean(name, name, *over, name == metrics[0]) for name in metrics]
        lines = []
        for row in standings:
            label = str(row.entry)
            rank = f"{row.printed(ranking.ranks.get(label))} {ranking.letters(label)}".rstrip()
            name = f"{MARK * (row.entry in marked)}{label}{row.marks}"
            lines.append((row.entry, [rank, name, *texts(ranks.board, row.entry, columns)]))
        return lines

    by_separability = rows(ranks.standings, ranks.ranking, RANKING)
    order = {row: i for i, row in enumerate(ranks.alarms.ranks)}
    standings = sorted(
        ranks.standings, key=lambda row: (row.below, order.get(str(row.entry), len(order)))
    )
    by_alarms = rows(standings, ranks.alarms, ALARM_RANKING, *ALARMS)
    level = metric_info(ALARM_RANKING).level
    return [
        Table(
            "Ranking by separability: matched AUC (%), higher is better",
            ["rank", "row", "matched AUC", "trust"],
            [[*line, trust.get(entry, UNDEFINED)] for entry, line in by_separability],
            labels=2,
        ),
        Table(
            f"Ranking by guaranteed alarms at {level}: censored delay (steps), lower is better",
            ["rank", "row", "delay", f"found in {FOUND_WITHIN[0]}", "missed", "false"],
            [line for _, line in by_alarms],
            labels=2,
            note="The delay counts a miss as the rest of its episode. The shares (%) are of "
            "episodes found within so many steps, of those missed, and of nominal episodes with "
            "an alarm.",
        ),
    ]


def neighbours(ranks: RankedBoard, row: Setting) -> Table | None:
    """Return how a row differs from the primary rows next above and below it, in both rankings.

    Differences are paired, with 95 % intervals, in the metric's own unit. None: it has no rank.
    """
    lines = []
    near = {str(s.entry) for s in ranks.standings if s.primary and not s.below}
    for ranked_by, ranking, metric in (
        ("matched AUC", ranks.ranking, RANKING),
        ("delay", ranks.alarms, ALARM_RANKING),
    ):
        pairs = (c for c in ranking.comparisons if c.first == str(row) and c.second in near)
        tests = {c.second: c for c in pairs}
        worse = {c.first for c in ranking.comparisons if c.second == str(row) and c.better}
        order = list(ranking.ranks)
        here = order.index(str(row)) if str(row) in order else len(order)
        above = [name for name in order[:here] if name in tests][-1:]
        below = [name for name in order[here:] if name in tests][:1]
        for neighbour in (*above, *below):
            better = "better" if tests[neighbour].better else "tie"
            verdict = "worse" if neighbour in worse else better
            difference = _difference(tests[neighbour], metric)
            lines.append([ranked_by, neighbour, str(ranking.ranks[neighbour]), difference, verdict])
    header = ["metric", "against", "rank", "difference", "verdict"]
    note = "Paired differences over the same test episodes, this row minus the other."
    title = f"{row} and the rows next to it"
    return Table(title, header, lines, labels=2, note=note) if lines else None


def _difference(test: PairTest, metric: str) -> str:
    """Return a difference with its interval in the metric's unit and direction."""
    info = metric_info(metric)
    ends = test.difference, test.low, test.high
    if info.better == "lower":  # rankings turn the sign
        ends = -test.difference, -test.high, -test.low
    value, low, high = map(info.text, ends)
    return f"{'+' * (ends[0] > 0)}{value} [{low}, {high}]"
