"""The order of a board: places, equal rows, the first band, what is not ranked, who made a row."""

import csv
import dataclasses
import io
import random

import numpy as np
import pytest
from helpers_records import make_record
from oodd_leaderboard.board_csv import standings_csv
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.standings import ordered

from oodd_eval.errors import ResultsError

UNRANKED = "\N{EN DASH}"
CELLS = [(e, a) for e in ("ant", "hopper") for a in ("iid", "drift")]
NOISE = np.random.default_rng(0).uniform(-0.05, 0.05, size=(8, 12))
NOISE -= NOISE.mean(axis=1)[:, None]


def row(name, mean, noise=0, *, cells=CELLS, seeds=(0,), **facts):
    """Records of a row; noises differ from one another, and rows with the same one are alike."""
    values = (mean + NOISE[noise]).tolist()
    return [
        make_record(name, e, a, seed=seed, values={"auc_matched": values}, **facts)
        for seed in seeds
        for e, a in cells
    ]


def places(board):
    return [(s.printed_rank, s.entry.detector) for s in board.standings]


def test_rows_stand_by_mean_and_the_first_band_shares_the_first_rank():
    records = [*row("b", 0.7, 1), *row("a", 0.701, 2), *row("c", 0.6, 3), *row("d", 0.599, 4)]
    board = ordered(records)
    assert places(board) == [("1", "a"), ("1 =", "b"), ("3", "c"), ("4 =", "d")]
    assert [s.band for s in board.standings] == [True, True, False, False]
    above = {d.second: d.first for d in board.above.values()}
    assert above == {"b": "a", "c": "b", "d": "c"}
    assert {d.first for d in board.first.values()} == {"a"}
    for entry, difference in (*board.above.items(), *board.first.items()):
        assert difference.second == str(entry)
        assert difference.told_apart == (difference.p <= 0.05)
    # The pair of the first two rows has one verdict.
    second = board.standings[1].entry
    assert board.above[second] == board.first[second]
    shuffled = random.Random(0).sample(records, len(records))
    again = ordered(shuffled)
    assert (again.standings, again.above, again.first) == (
        board.standings, board.above, board.first
    )  # fmt: skip


def test_what_is_not_ranked_stands_at_the_place_of_its_mean():
    entries = {
        "tuned": Entry("tuned", variant=True),
        "wise": Entry("wise", training="simulation", authors="W. Ise", paper="Wise", year=2025),
    }
    records = [
        *row("best", 0.8, seeds=(0, 1)), *row("wise", 0.75, 1, seeds=(0, 1)),
        *row("tuned", 0.7, 2, seeds=(0, 1)), *row("last", 0.6, 3, seeds=(0, 1)),
        *row("half", 0.9, 4, cells=CELLS[:2], seeds=(0, 1)),
        *row("once", 0.65, 5, deterministic=False),
        *row("oracle", 0.99, 6, seeds=(0, 1), training="oracle"),
    ]  # fmt: skip
    board = ordered(records, entries)
    assert places(board) == [
        (UNRANKED, "oracle"), ("1", "best"), (UNRANKED, "wise"), (UNRANKED, "tuned"),
        (UNRANKED, "once"), ("2", "last"), (UNRANKED, "half"),
    ]  # fmt: skip
    states = {s.entry.detector: s.state for s in board.standings}
    assert states == {
        "best": "", "last": "", "oracle": "oracle", "wise": "trained on simulation",
        "tuned": "a variant", "once": "4 of 8 cells missing", "half": "4 of 8 cells missing",
    }  # fmt: skip
    wise = next(s for s in board.standings if s.entry.detector == "wise")
    assert (wise.authors, wise.paper, wise.year, wise.origin) == ("W. Ise", "Wise", 2025, "others")
    assert wise.marks == " (trained on simulation)"
    reported = ordered(records, entries, ranked=False)
    assert [name for _, name in places(reported)] == [name for _, name in places(board)]
    assert not (reported.above)
    assert not (reported.first)
    assert {s.rank for s in reported.standings} == {None}


def test_a_copy_with_a_nudge_takes_nothing_from_the_original():
    original, copy = row("mine", 0.7, 1), row("copy", 0.7, 1)
    nudged = [
        dataclasses.replace(r, per_trajectory={"auc_matched": r.per_trajectory["auc_matched"]})
        for r in row("copy", 0.7, 1)
    ]
    for r in nudged:
        r.per_trajectory["auc_matched"] = r.per_trajectory["auc_matched"].copy()
        r.per_trajectory["auc_matched"][0, 0] += 1e-3
    for others in (copy, nudged):
        board = ordered([*original, *others, *row("below", 0.5, 2)])
        assert {s.entry.detector: s.rank for s in board.standings} == {
            "mine": 1, "copy": 1, "below": 3
        }  # fmt: skip


def test_lowest_and_highest_seed_stand_beside_and_rows_need_a_name_of_their_own():
    records = [*row("a", 0.7), *[dataclasses.replace(r, seed=1) for r in row("a", 0.8)]]
    (standing,) = ordered(records).standings
    assert (standing.seeds, standing.seed_low, standing.seed_high) == pytest.approx((2, 0.7, 0.8))
    plain, twin = row("rf", 0.7, overrides={"trees": 9}), row("rf[trees=9]", 0.7)
    with pytest.raises(ResultsError, match="both called"):
        ordered([*plain, *twin])


def test_csv_has_a_line_a_row_with_both_differences():
    board = ordered([*row("a", 0.7), *row("b", 0.5, 1)])
    first, second = csv.DictReader(io.StringIO(standings_csv(board)))
    assert (first["rank"], second["rank"], first["above_difference"]) == ("1", "2", "")
    low = board.first[board.standings[1].entry].low
    assert float(second["first_low"]) == pytest.approx(low, rel=1e-5)
