"""Numbers of the page on what was found are those of what is committed under leaderboard/."""

import importlib.util
import re
from collections import Counter
from pathlib import Path

import pytest

from oodd_eval.cli.main import main

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "figures" / "tables.py")
tables = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(tables)
claims = tables.claims

BOARD = ROOT / "leaderboard"
PAGE, README = ((ROOT / name).read_text() for name in ("docs/results.md", "README.md"))
TEXT = " ".join(PAGE.split())


def test_tables_are_those_of_what_is_committed():
    """README and the page of results; `tables.py` without ``--check`` writes them."""
    assert all(f"<!-- table: {name} -->\n|" in PAGE + README for name in tables.TABLES)
    assert tables.main(["--check"]) == 0


def test_a_wrong_number_in_a_table_is_put_right():
    (row,) = re.findall(r"(?m)^\| `pe-step-a` \|.*63\.2.*$", PAGE)
    assert tables.filled(PAGE.replace(row, row.replace("63.2", "36.2"))) == PAGE


@pytest.mark.parametrize("suite", ["ladder", "noisy-1", "noisy-5", "horizons"])
def test_the_page_of_a_suite_is_printed_from_its_records(suite, capsys):
    directory = BOARD / "suites" / suite
    assert main(["show", str(directory), "--stored", "--markdown"]) == 0
    advice = f"run `oodd-eval show leaderboard/suites/{suite} --stored --markdown`"
    assert capsys.readouterr().out == (directory / "README.md").read_text(encoding="utf-8"), advice


def test_verdicts_are_counted():
    counts = Counter(r["verdict"] for (_, kind), r in claims("mini").items() if kind == "paper")
    assert f"Of {sum(counts.values())} claims" in TEXT
    for verdict, many in counts.items():
        assert re.search(rf"\b{many}( are)? {verdict}", TEXT), verdict
