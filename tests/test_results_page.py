"""Numbers of the page on what was found are those of the committed board."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "results.md").read_text()


def board(split):
    (file,) = (ROOT / "leaderboard" / "tables").glob(f"{split}-*-ranking.csv")
    with file.open() as lines:
        rows = [r for r in csv.DictReader(lines) if (r["horizon"], r["overrides"]) == ("1", "{}")]
    return {r["detector"]: 100 * float(r["auc_matched"]) for r in rows}


def rows_of_the_table():
    return re.findall(r"^\| ([a-z-]+) \| ([\d.]+) \| ([\d.]+) \|$", PAGE, re.MULTILINE)


@pytest.mark.parametrize(("column", "split"), [(1, "mini"), (2, "reduced")])
def test_the_table_is_the_boards(column, split):
    rows, expected = rows_of_the_table(), board(split)
    assert [r[0] for r in rows] == ["mewma", "npn", "rf", "riqn", "persistence"]
    for row in rows:
        assert float(row[column]) == pytest.approx(expected[row[0]], abs=0.051), row[0]
