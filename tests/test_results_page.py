"""Numbers of the page on what was found are those of the committed board."""

import csv
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "results.md").read_text()


def table(split, name):
    (file,) = (ROOT / "leaderboard" / "tables").glob(f"{split}-*-{name}.csv")
    with file.open() as lines:
        return list(csv.DictReader(lines))


def board(split, overrides="{}"):
    rows = [
        r for r in table(split, "ranking") if (r["horizon"], r["overrides"]) == ("1", overrides)
    ]
    return {r["detector"]: 100 * float(r["auc_matched"]) for r in rows}


def rows_of_the_table():
    return re.findall(r"^\| ([a-z-]+) \| ([\d.]+) \| ([\d.]+) \|$", PAGE, re.MULTILINE)


@pytest.mark.parametrize(("column", "split"), [(1, "mini"), (2, "reduced")])
def test_the_table_is_the_boards(column, split):
    rows, expected = rows_of_the_table(), board(split)
    assert [r[0] for r in rows] == ["mewma", "npn", "rf", "riqn", "persistence"]
    for row in rows:
        assert float(row[column]) == pytest.approx(expected[row[0]], abs=0.051), row[0]


def test_what_longer_training_gives_is_the_boards():
    number = r"(-?[\d.]+)"
    rows = re.findall(
        rf"^\| `(\w+)` \| (\w+) \| {number} \| {number} \| {number} \[{number}, {number}\] \|$",
        PAGE,
        re.MULTILINE,
    )
    assert [row[:2] for row in rows] == [("riqn", "mini"), ("riqn", "reduced"), ("npn", "mini")]
    for name, split, *numbers in rows:
        (pair,) = (
            r
            for r in table(split, "comparisons")
            if (r["first"], r["second"]) == (f"{name}[updates=2400]", "rf")
        )
        expected = [
            board(split)[name],
            board(split, '{"updates": 2400}')[name],
            *(100 * float(pair[f"difference{end}"]) for end in ("", "_low", "_high")),
        ]
        assert [float(n) for n in numbers] == pytest.approx(expected, abs=0.051), (name, split)


def test_papers_auc_of_riqn_and_rf_on_reduced():
    rows = {
        (r["detector"], r["overrides"]): 100 * float(r["auc"])
        for r in table("reduced", "ranking")
        if r["horizon"] == "1"
    }
    pairs = re.findall(r"\(([\d.]+)\s+against\s+([\d.]+)\b", PAGE)
    shorter, longer = rows["riqn", "{}"], rows["riqn", '{"updates": 2400}']
    expected = [(rows["rf", "{}"], shorter), (longer, rows["rf", "{}"])]
    for found, numbers in zip(pairs, expected, strict=True):
        assert [float(n) for n in found] == pytest.approx(numbers, abs=0.051)


def claims():
    with (ROOT / "leaderboard/reproduction/reduced/claims.csv").open() as lines:
        return list(csv.DictReader(lines))


def test_verdicts_are_those_of_the_reproduction():
    verdicts = {(r["text"], r["kind"]): r["verdict"] for r in claims()}
    rows = re.findall(r"^\| ([^|]+) \| (\w+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
    found = [(text, paper, fair) for text, paper, fair in rows if (text, "paper") in verdicts]
    assert len(found) == 15
    for text, paper, fair in found:
        assert (paper, fair) == (
            verdicts[text, "paper"],
            verdicts.get((text, "fair"), "\N{EN DASH}"),
        ), text


def test_verdicts_are_counted_rightly():
    counted = Counter(r["verdict"] for r in claims() if r["kind"] == "paper")
    text = " ".join(PAGE.split())
    assert f"Of {sum(counted.values())} claims" in text
    for verdict, many in counted.items():
        assert re.search(rf"\b{many}( are)? {verdict}", text), verdict
