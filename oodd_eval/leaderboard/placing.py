"""A run of one's own among the rows of the published board, and the tables that show both.

The ranks are made by the code that ranks the board itself.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.published import ALARMS, PublishedBoard, slim
from oodd_eval.metrics.catalogue import ALARM_RANKING, FOUND_WITHIN, RANKING, UNDEFINED, metric_info
from oodd_eval.metrics.ranking import PairTest, Ranking
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record, same_terms
from oodd_eval.results.tables.board import (
    SEEDS,
    RankedBoard,
    Standing,
    grouped,
    has_few_seeds,
    primary_settings,
    ranked,
)
from oodd_eval.results.tables.layout import Table, show_value

OWN: Final = "> "  # stands before the rows of one's own


class Placement(NamedTuple):
    """A run among the rows of a published board.

    `own` are its rows, of which the board has those in `published` with the same numbers, and
    others of the same name in `replaced`. `cells` are compared: all that the board `expected`, or
    fewer where no new row of the run has them all. `lacking` says by row what a ranked one needs.
    """

    ranks: RankedBoard
    own: set[Setting]
    published: set[Setting]
    replaced: set[Setting]
    cells: set[tuple[str, str]]
    expected: set[tuple[str, str]]
    lacking: dict[Setting, str]


def place(
    records: Sequence[Record], board: PublishedBoard, primary: Collection[str] = ()
) -> Placement:
    """Place the rows of a run among those of a board, as if they had been run again.

    A row that the board has with the same numbers keeps its place and its trust. Another row of
    the same name takes the place of the board's. `primary` are the rows that an entry declares
    for its detectors. `UsageError`: the rows of the run have no cell in common.
    """
    by_row = grouped(map(slim, records), lambda r: r.setting)
    theirs = grouped(board.records, lambda r: r.setting)
    same = {row for row, own in by_row.items() if row in theirs and _within(own, theirs[row])}
    new = {row: own for row, own in by_row.items() if row not in same}
    replaced = new.keys() & theirs.keys()
    expected = {r.position for r in board.records}
    has = [{r.position for r in own if r.ok} & expected for own in new.values()]
    cells = set.intersection(*has) if has and expected not in has else expected
    if not cells:
        raise UsageError(
            "the rows of these results have no cell of the board in common: name some of them with "
            "--detector"
        )
    first = board.primary - replaced
    taken = {row.detector for row in first}
    free = [r for own in new.values() for r in own if r.setting.detector not in taken]
    chosen = {row.detector: row for row in primary_settings(free)}
    chosen |= {row.detector: row for row in new if str(row) in primary and row.detector in chosen}
    # With too few seeds a primary row has no rank. A variant has the one that it would have.
    first = first | {row for row in chosen.values() if not has_few_seeds(new[row])}
    used = [r for own in (theirs | new).values() for r in own if r.position in cells]
    found = {row: _lacking(own, expected) for row, own in new.items()}
    return Placement(
        ranks=ranked(used, first, board.rerun and board.rerun | new.keys()),
        own=set(by_row),
        published=same,
        replaced=set(replaced),
        cells=cells,
        expected=expected,
        lacking={row: text for row, text in found.items() if text},
    )


def _within(own: Sequence[Record], others: Sequence[Record]) -> bool:
    """Tell whether all numbers of a row are among those of another."""
    known = {(r.position, r.seed, r.status): r.per_trajectory for r in others}
    keys = [(r.position, r.seed, r.status) for r in own]
    return all(
        key in known and same_terms(known[key], r.per_trajectory)
        for key, r in zip(keys, own, strict=True)
    )


def _lacking(records: Sequence[Record], expected: set[tuple[str, str]]) -> str:
    """Return what a row has to have besides for a rank on the board; empty if nothing."""
    found = grouped(records, lambda r: r.seed)
    sizes = grouped(expected, lambda cell: cell[0])
    parts = []
    for seed, own in sorted(found.items()):
        missing = grouped(
            sorted(expected - {r.position for r in own if r.ok}), lambda cell: cell[0]
        )
        named = [
            e if len(cells) == len(sizes[e]) else ", ".join(map("/".join, cells))
            for e, cells in missing.items()
        ]
        if named:
            count = sum(map(len, missing.values()))
            of = f" with seed {seed}" if len(found) > 1 else ""
            parts.append(f"{count} of {len(expected)} cells{of} ({', '.join(named)})")
    if has_few_seeds(records):
        parts.append(f"{SEEDS - len(found)} of {SEEDS} detector seeds")
    return " and ".join(parts)


def rankings(
    ranks: RankedBoard, trust: Mapping[Setting, str], own: Collection[Setting] = ()
) -> list[Table]:
    """Return the ranking by separability and that by guaranteed alarms, `own` rows marked.

    Trust is by row; a row without is of no entry. Letters of tie groups stand behind a rank.
    """
    board = ranks.board
    over = board.environments, board.anomalies

    def texts(one: Standing, names: Sequence[str]) -> list[str]:
        values = [board.mean(one.entry, *over, n, intervals=n == names[0]) for n in names]
        return [show_value(v, n) for v, n in zip(values, names, strict=True)]

    def labels(one: Standing, rank: int | None, ranking: Ranking) -> list[str]:
        place = UNDEFINED if rank is None else f"({rank})" if one.below else str(rank)
        marks = " (trivial)" * one.trivial + " (variant)" * (not one.primary)
        ties = ranking.letters(str(one.entry))
        return [f"{place} {ties}".rstrip(), f"{OWN * (one.entry in own)}{one.entry}{marks}"]

    first = [
        [
            *labels(one, one.rank, ranks.ranking),
            *texts(one, [RANKING]),
            trust.get(one.entry, UNDEFINED),
        ]
        for one in ranks.standings
    ]
    names = [ALARM_RANKING, *ALARMS]
    order = {row: i for i, row in enumerate(ranks.alarms.ranks)}
    by_alarms = sorted(ranks.standings, key=lambda one: order.get(str(one.entry), len(order)))
    by_alarms = [*(s for s in by_alarms if not s.below), *(s for s in by_alarms if s.below)]
    second = [[*labels(one, one.alarm_rank, ranks.alarms), *texts(one, names)] for one in by_alarms]
    level = metric_info(ALARM_RANKING).level
    return [
        Table(
            "Ranking by separability: matched AUC (%), higher is better",
            ["rank", "row", "matched AUC", "trust"],
            first,
            labels=2,
        ),
        Table(
            f"Ranking by guaranteed alarms at {level}: censored delay (steps), lower is better",
            ["rank", "row", "delay", f"found in {FOUND_WITHIN[0]}", "missed", "false"],
            second,
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
    for name, ranking, metric in (
        ("matched AUC", ranks.ranking, RANKING),
        ("delay", ranks.alarms, ALARM_RANKING),
    ):
        own = (c for c in ranking.comparisons if c.first == str(row) and c.second in near)
        tests = {c.second: c for c in own}
        worse = {c.first for c in ranking.comparisons if c.second == str(row) and c.better}
        order = list(ranking.ranks)
        here = order.index(str(row)) if str(row) in order else len(order)
        above = [other for other in order[:here] if other in tests][-1:]
        below = [other for other in order[here:] if other in tests][:1]
        for other in (*above, *below):
            better = "better" if tests[other].better else "tie"
            verdict = "worse" if other in worse else better
            difference = _difference(tests[other], metric)
            lines.append([name, other, str(ranking.ranks[other]), difference, verdict])
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
