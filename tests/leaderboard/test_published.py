"""The published file, and a run placed among its rows: the ranks are those of the board."""

import dataclasses
import json
import lzma
import re

import numpy as np
import pytest
from helpers_records import make_record
from helpers_site import submitted
from oodd_leaderboard import published
from oodd_leaderboard.commands import published_board as board_command
from oodd_leaderboard.published import (
    board_of,
    neighbours,
    neighbours_notes,
    placement,
    published_bytes,
    rankings,
    read_published,
)
from oodd_leaderboard.reported import REPORTED, SuiteSection, sections

from oodd_eval.cli.main import main
from oodd_eval.data.files import decompress
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.prose import Table
from oodd_eval.results.board import Board
from oodd_eval.results.identity import Setting

TEST = 10  # test seeds
PLACES = [(e, a) for e in ("ant", "hopper") for a in ("iid", "gravity")]
MEANS = {"good": 0.9, "fair": 0.8, "poor": 0.6}


def row(detector, mean, *, seeds=(0, 1, 2), places=PLACES, **more):
    """Records of a row: the higher its mean, the shorter its delays."""
    made = []
    for seed in seeds:
        rng = np.random.default_rng([seed, *detector.encode()])
        for environment, anomaly in places:
            matched = np.clip(mean + 0.02 * rng.normal(size=TEST), 0, 1)
            values = {"auc_matched": list(matched), "auc": [0.5] * TEST}
            one = make_record(
                detector, environment, anomaly, seed=seed, values=values, deterministic=False,
                **more,
            )  # fmt: skip
            terms = one.per_trajectory | {
                "delay_censored_at_5pct": np.array([60 * (1 - matched), np.ones(TEST)]),
                "false_episodes_at_5pct": np.array([np.zeros(TEST), np.ones(TEST)]),
            }
            metrics = one.metrics | dict.fromkeys(terms, one.metrics["auc"])
            counts = {"train": 40, "calibration": 40, "test": TEST}
            made.append(
                dataclasses.replace(one, per_trajectory=terms, metrics=metrics, counts=counts)
            )
    return made


def entries():
    rows = [r for name, mean in MEANS.items() for r in row(name, mean)]
    return [
        submitted("first", [*rows, *row("fair", 0.85, horizon=5)], primary=["fair[h=5]"]),
        submitted("second", row("other", 0.5)),
    ]


@pytest.fixture(scope="module")
def board():
    (found,) = sections(entries())
    return found


@pytest.fixture(scope="module")
def file(board, tmp_path_factory):
    file = tmp_path_factory.mktemp("published") / published.PUBLISHED
    file.write_bytes(published_bytes([board]))
    return file


@pytest.fixture
def shipped(file, monkeypatch):
    """The board that an installation has."""
    monkeypatch.setattr(published, "published_file", lambda: file)
    (found,) = read_published().boards
    return found


def places(ranks):
    return {str(s.entry): (s.rank, s.alarm_rank, s.ties, s.primary) for s in ranks.standings}


def run_of(records, directory):
    directory.mkdir(exist_ok=True)
    text = "".join(r.to_json() + "\n" for r in records)
    (directory / "records.jsonl").write_text(text)
    return str(directory)


# The file


def suite_of(records):
    table = Table("Detection thresholds", ["detector", "threshold"], [[records[0].detector, "0.9"]])
    return SuiteSection("graded", Board(records), [table], graded=True)


def test_show_prints_further_suites_unless_one_board_is_asked_for(
    board, tmp_path, monkeypatch, capsys
):
    rung = row("graded-one", 0.9, strength="kept99")
    place = tmp_path / published.PUBLISHED
    place.write_bytes(published_bytes([board], [suite_of(rung)]))
    monkeypatch.setattr(published, "published_file", lambda: place)
    assert main(["leaderboard", "show"]) == 0
    boards, suite = capsys.readouterr().out.split("Suite graded, digest")
    assert "graded-one" in suite
    assert "graded-one" not in boards
    assert main(["leaderboard", "show", "--split", "mini"]) == 0
    assert "graded" not in capsys.readouterr().out


def test_the_rankings_of_the_file_are_those_of_the_board(board, shipped):
    assert places(shipped.ranks()) == places(board.ranks)
    assert places(board.ranks)["fair[h=5]"][3]  # as its entry declares
    assert {str(r): e for r, e in shipped.entries.items()} == {
        "other": "second", "fair": "first", "fair[h=5]": "first", "good": "first", "poor": "first"
    }  # fmt: skip


def test_the_file_has_the_terms_of_the_rankings_and_no_others(file):
    lines = [json.loads(line) for line in decompress(file.read_bytes()).splitlines()]
    assert {name for line in lines for name in line["per_trajectory"]} == {
        "auc_matched", "delay_censored_at_5pct", "false_episodes_at_5pct"
    }  # fmt: skip
    assert not any(line["parameters"] or line["scores"] or line["plugin_source"] for line in lines)


def test_an_installation_without_a_board_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(published, "__file__", str(tmp_path / "a" / "b" / "published.py"))
    with pytest.raises(ResultsError, match=r"has no published board: .*from its wheel"):
        published.published_file()


# Placing


@pytest.mark.parametrize("name", ["first", "second"])
def test_an_entrys_own_records_have_the_places_of_the_board(name, board, shipped):
    (own,) = [e for e in entries() if e.meta.id == name]
    placed = placement(own.records, shipped, own.meta.primary)
    assert places(placed.ranks) == places(board.ranks)
    assert placed.published == placed.rows == {r.setting for r in own.records}
    assert not placed.lacking


def test_a_new_row_has_the_rank_that_the_board_would_give_it(shipped):
    mine = row("mine", 0.7)
    placed = placement(mine, shipped)
    (would,) = sections([*entries(), submitted("mine", mine)])
    assert places(placed.ranks) == places(would.ranks)
    assert places(placed.ranks)["mine"][:2] == (3, 3)
    assert not placed.published
    assert not placed.lacking


def test_a_row_of_a_published_name_with_other_numbers_takes_its_place(shipped):
    placed = placement(row("good", 0.65), shipped)
    assert placed.replaced == {Setting("good")}
    assert places(placed.ranks)["good"][:2] == (2, 2)
    assert places(placed.ranks)["fair[h=5]"][0] == 1


def test_rows_with_few_cells_are_compared_on_these_and_what_they_lack_is_named(shipped):
    placed = placement(row("mine", 0.7, places=PLACES[:3], seeds=(0, 1)), shipped)
    assert placed.cells == set(PLACES[:3])
    assert {r.position for r in placed.ranks.board.records} == set(PLACES[:3])
    assert placed.lacking == {
        Setting("mine"): "1 of 4 cells with seed 0 (hopper/gravity) and 1 of 4 cells with seed 1 "
        "(hopper/gravity) and 1 of 3 detector seeds"
    }
    whole = placement(row("mine", 0.7, places=PLACES[:2], seeds=(0,)), shipped)
    assert "2 of 4 cells (hopper)" in whole.lacking[Setting("mine")]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"split_digest": "cd" * 32}, "digest cdcdcdcdcdcd, .*run on a published split"),
        ({"protocol": 7}, "protocol 7, .*run again with this version"),
        ({"limit": 2}, "limit 2, .*without --limit"),
    ],
)
def test_what_cannot_be_compared_is_refused(shipped, change, said, tmp_path, capsys):
    other = [dataclasses.replace(r, **change) for r in row("mine", 0.7)]
    with pytest.raises(UsageError, match=said):
        board_of(other, [shipped])
    assert main(["leaderboard", "place", run_of(other, tmp_path / "out")]) == 4
    assert "published is split mini" in capsys.readouterr().err


# Tables and commands


def test_neighbours_are_the_primary_rows_next_to_a_row(shipped):
    placed = placement(row("mine", 0.7), shipped)
    table = neighbours(placed.ranks, Setting("mine"))
    assert [[*line[:3], line[4]] for line in table.rows] == [
        ["matched AUC", "fair[h=5]", "2", "worse"],
        ["matched AUC", "poor", "4", "better"],
        ["delay", "fair[h=5]", "2", "worse"],
        ["delay", "poor", "4", "better"],
    ]
    # As the rows were made: .7 against .85 and .6, and sixty times that in steps.
    first, second, third, fourth = (float(line[3].split()[0]) for line in table.rows)
    assert first == pytest.approx(-15, abs=1.5)
    assert second == pytest.approx(10, abs=1.5)
    assert third == pytest.approx(9, abs=1)
    assert fourth == pytest.approx(-6, abs=1)
    for line in table.rows:
        low, high = map(float, line[3].partition("[")[2].strip("]").split(", "))
        assert low < float(line[3].split()[0]) < high


def test_rankings_mark_own_rows_and_have_an_order_of_their_own(shipped):
    # As good as the best at separating, and slow to alarm.
    slow = [
        dataclasses.replace(
            r, per_trajectory=r.per_trajectory | {
                "delay_censored_at_5pct": np.repeat([[59.0], [1.0]], TEST, axis=1)
            },
        )
        for r in row("slow", 0.9)
    ]  # fmt: skip
    placed = placement(slow, shipped)
    first, second = rankings(placed.ranks, placed.rows)
    assert {line[1]: line[0] for line in first.rows}["> slow"] == "1 a"
    assert second.rows[-1][:2] == ["5", "> slow"]


def test_show_prints_both_rankings(shipped, capsys):
    assert main(["leaderboard", "show"]) == 0
    printed = capsys.readouterr().out
    first, second = printed.split("Ranking by guaranteed alarms at 5 %")
    assert "Ranking by separability" in first
    assert "Entry second: other." in second
    assert printed.count(REPORTED) == 1
    assert main(["leaderboard", "show", "--csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("rank,ties,alarm_rank,state,detector,")
    assert len(lines) == 6
    assert main(["leaderboard", "show", "--split", "mini", "--markdown"]) == 0
    assert "### Ranking by separability" in capsys.readouterr().out
    assert main(["leaderboard", "show", "--split", "minni"]) == 4
    assert "did you mean 'mini'" in capsys.readouterr().err


def test_place_says_where_a_run_stands(shipped, tmp_path, capsys):
    directory = run_of([*row("mine", 0.7), *row("good", 0.9)], tmp_path / "out")
    assert main(["leaderboard", "place", directory]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[1].startswith("good: rank 1 by separability, rank 1 by guaranteed")
    printed = " ".join(text.split())
    assert "mine: rank 3 by separability, rank 3 by guaranteed alarms." in printed
    assert "good: rank 1 by separability, rank 1 by guaranteed alarms. It has the" in printed
    assert re.search(r" 3 > mine \d", printed)
    assert "mine and the rows next to it" in printed
    assert "good and the rows" not in printed
    assert main(["leaderboard", "place", directory, "--detector", "good", "--csv"]) == 0
    assert "mine" not in capsys.readouterr().out
    assert main(["leaderboard", "place", directory, "-q"]) == 0
    assert "Ranking" not in capsys.readouterr().out


def test_a_place_over_few_cells_says_how_many_rows_share_it(shipped):
    mine = row("mine", 0.85, places=PLACES[:1])
    (first, *_) = board_command._sentences(placement(mine, shipped), {})
    assert first.startswith("mine, over 1 of 4 cells: rank 2 (shared by 3 rows) by separability, ")
    clock = row("clock", 0.85, plugin="oodd-eval:trivial")
    beside = dataclasses.replace(
        shipped, records=[*shipped.records, *clock], primary=shipped.primary | {Setting("clock")}
    )
    (first, *_) = board_command._sentences(placement(mine, beside), {})
    assert "rank 2 (shared by 4 rows, 1 of them trivial: it says nothing) by separability" in first
    (whole, *_) = board_command._sentences(placement(row("mine", 0.85), beside), {})
    assert whole.startswith("mine: rank 2 by separability, rank ")


def test_notes_of_a_place_stand_once(shipped, tmp_path, capsys):
    directory = run_of([*row("mine", 0.7), *row("another", 0.65)], tmp_path / "out")
    assert main(["leaderboard", "place", directory]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert text.count("Paired differences over the same test episodes") == 1
    assert "Rank is 1 + the number of primary rows that are significantly better" in text


def test_a_tie_whose_interval_leaves_out_zero_has_its_reason(shipped):
    placed = placement(row("mine", 0.7), shipped)
    tests = [dataclasses.replace(test, p_holm=0.2) for test in placed.ranks.ranking.comparisons]
    ranking = dataclasses.replace(placed.ranks.ranking, comparisons=tests)
    table = neighbours(placed.ranks._replace(ranking=ranking), Setting("mine"))
    assert [line[-1] for line in table.rows] == ["tie (Holm)", "tie (Holm)", "worse", "better"]
    assert "Holm's correction for all pairs" in neighbours_notes([table])[1]
    assert len(neighbours_notes([neighbours(placed.ranks, Setting("mine"))])) == 1
    assert neighbours_notes([]) == []


def test_place_prints_the_rows_nearby_unless_all_are_asked_for(
    shipped, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(board_command, "NEARBY", 1)
    directory = run_of(row("mine", 0.7), tmp_path / "out")
    assert main(["leaderboard", "place", directory]) == 0
    first = capsys.readouterr().out.split("Ranking by guaranteed alarms")[0]
    rows = [" ".join(line.split()) for line in first.splitlines()]
    start = next(i for i, line in enumerate(rows) if line.startswith("-"))
    above, better, mine, worse, below, blank, *_ = rows[start + 1 :]
    assert (above, below, blank) == ("(2 more rows)", "(1 more row)", "")
    assert [" fair" in better, " > mine " in mine, " poor " in worse] == [True, True, True]
    assert main(["leaderboard", "place", directory, "--all"]) == 0
    assert "more row" not in capsys.readouterr().out
    assert main(["leaderboard", "place", directory, "--all", "--csv"]) == 4
    assert "--all is for the tables" in capsys.readouterr().err
    assert main(["leaderboard", "show", "--markdown", "--csv"]) == 4
    assert "leave out one" in capsys.readouterr().err


def test_the_file_is_read_from_a_compressed_copy_alone(shipped, tmp_path, monkeypatch):
    broken = tmp_path / published.PUBLISHED
    broken.write_bytes(lzma.compress(b'{"schema": 1}\n'))
    monkeypatch.setattr(published, "published_file", lambda: broken)
    with pytest.raises(ResultsError, match="has schema 1, expected 3"):
        read_published()
