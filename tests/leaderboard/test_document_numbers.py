"""What ``docs/figures/tables.py --check`` sees, the check of documents' numbers in ``.ci/run``."""

import re
import sys

import helpers_site
import pytest
from helpers_docs import ROOT
from oodd_leaderboard.pages import Leaderboard

sys.path.insert(0, str(ROOT / "docs" / "figures"))
import committed
import sentences
import tables


def test_a_wrong_number_in_a_table_is_put_right():
    page = (ROOT / "docs" / "results" / "ladder.md").read_text(encoding="utf-8")
    ladder = re.search(r"<!-- table: ladder -->\n(\|.*\n)+\n\*.*\n", page)[0]
    assert tables.filled(ladder.replace(".", ".9")) == ladder


def test_a_table_of_the_season_has_its_first_rows_and_the_first_of_the_paper(monkeypatch, season):
    lines = "| a | b |\n|---|---|\n| x | y |\n| x | y |\n\nText\n"
    page = f"<!-- table: {tables.SEASON_TABLE} -->\n{lines}"
    trial = helpers_site.season(trial=True, date="2027-01-01")
    last = helpers_site.season(rows=("mine", "rf", "clock"), date="2026-05-01")
    monkeypatch.setattr(committed, "leaderboard", lambda: Leaderboard([last, season, trial]))
    _, head, _, *rows, _, text = tables.filled(page).splitlines()
    assert head.startswith("| rank, season 2026-11 | row | whose | matched AUC |")
    assert [row.split(" | ")[1:3] for row in rows] == [["`rf`", "ours"], ["`mine`", "others, 2026"]]
    assert text == "Text"
    monkeypatch.setattr(committed, "leaderboard", lambda: Leaderboard([season, last]))
    filled = tables.filled(page)
    *_, first, second, _, _ = filled.splitlines()
    assert first.startswith("| 1 | `riqn` | the paper, 2021 | ")
    assert second.split(" | ")[0] == "| 2"
    assert tables.filled(filled) == filled


@pytest.fixture
def one_sentence(monkeypatch):
    monkeypatch.setattr(sentences, "stated", lambda: ["It is 3 points above `knn`."])
    monkeypatch.setattr(sentences, "ORDERS", [])


@pytest.mark.usefixtures("one_sentence")
def test_a_sentence_with_another_number_and_a_number_without_a_source_are_seen():
    table = "<!-- table: season -->\n| row | AUC |\n|---|---|\n| `pe` | 96.3 |\n\n"
    page = f"## Of rows\n\n{table}It has 96.3 %, about 96.\nIt is 3 points above `knn`.\n"
    assert [*sentences.problems([page])] == []
    missing, number = sentences.problems([page.replace("is 3 points", "is 4 points")])
    assert missing.endswith("It is 3 points above `knn`.")
    assert "It is 4 points above" in number
    (number,) = sentences.problems([page.replace("It has 96.3", "It has 96.4")])
    assert number.startswith("Of rows: ")
    assert "It has 96.4 %" in number


def test_numbers_of_a_sentence_are_put_right_and_its_words_stay(monkeypatch):
    phrases = [("by {} [{}, {}] points, in {}.", lambda: ["1.5", "-0.3", "2.0", 4])]
    monkeypatch.setattr(sentences, "SENTENCES", phrases)
    page = "It is above\nby 7.25 [1.0,\n  3.0] points, in 12. It has 12.\n"
    after = "It is above\nby 1.5 [-0.3,\n  2.0] points, in 4. It has 12.\n"
    assert sentences.filled(page) == after


def test_an_order_that_the_results_do_not_have_is_seen(monkeypatch):
    monkeypatch.setattr(sentences, "stated", list)
    monkeypatch.setattr(sentences, "ORDERS", [("`a` is above `b`.", lambda: False)])
    (problem,) = sentences.problems(["`a` is\nabove `b`."])
    assert problem.startswith("the results are not so: `a`")
    (problem,) = sentences.problems(["`b` is above `a`."])
    assert problem.startswith("no page has the phrase")


def test_lines_with_records_of_an_earlier_release_are_marked(monkeypatch):
    of_line = {"`a`": {"0.2.0", "0.3.0"}, "`b`, new": {"0.3.0"}}
    monkeypatch.setattr(tables, "releases", lambda _, label: of_line[label])
    monkeypatch.setitem(tables.TABLES, "worlds", lambda name: f"of {name}")
    page = (
        "<!-- table: worlds -->\n| row | x |\n|---|---|\n| `a` | 1 |\n| `b`, new | 2 |\n\nText.\n"
    )
    after = tables.filled(page)
    assert "| `a` † | of a |\n| `b`, new | of b |\n\n*Records of release 0.3.0; " in after
    assert after.endswith("marked † have some of 0.2.0.*\n\nText.\n")
    assert tables.filled(after) == after


def test_another_output_of_the_readmes_command_is_seen(monkeypatch):
    readme = tables.README.read_text(encoding="utf-8")
    command = readme.partition("<!-- command: main -->")[2]
    shown = command.partition("```text\n")[2].partition("```")[0]
    monkeypatch.setattr(tables, "read_records", lambda _: [])
    monkeypatch.setattr(tables, "printed", lambda *_: f"{shown}further tables")
    assert [*tables.in_output(readme)] == []
    monkeypatch.setattr(tables, "printed", lambda *_: shown.replace("1", "2", 1))
    assert len([*tables.in_output(readme)]) == 1


@pytest.mark.parametrize(
    ("fresh", "committed", "same"),
    [
        ("a,0.123456", "a,0.123457", True),
        ("a,0.123456", "a,0.123458", False),
        ("a,0.123456,1", "a,0.123456,2", False),
        ("| 85.3 \\[83.0, 87.0] |", "|  85.4 \\[83.0, 87.1] |", True),
        ("a,1e-07", "a,3e-07", False),
        ("riqn,1", "npn,1", False),
        ("a,,1", "a,1,1", False),
        ("digest 12ab", "digest 13ab", False),
        ("one\ntwo", "one", False),
    ],
)
def test_rounding_alone_is_no_difference(fresh, committed, same):
    assert ([*tables.unlike(fresh, committed)] == []) is same
