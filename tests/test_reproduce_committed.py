"""The committed reproduction is what the committed records give, byte for byte."""

import shutil
from pathlib import Path

import pytest

from oodd_eval.cli import main

ROOT = Path(__file__).parents[1]
COMMITTED = ROOT / "leaderboard" / "reproduction"
RESULTS = ROOT / "leaderboard" / "results"

pytestmark = pytest.mark.skipif(
    not (COMMITTED / "reproduction.json").exists(), reason="no reproduction is committed"
)


@pytest.fixture(scope="module")
def again(tmp_path_factory):
    """The page and its tables from the records of the entries; the figures are copied."""
    directory = tmp_path_factory.mktemp("again") / "reproduction"
    directory.mkdir()
    for name in ("reproduction.json", "returns.json"):
        shutil.copy(COMMITTED / name, directory / name)
    shutil.copytree(COMMITTED / "figures", directory / "figures")
    command = ["reproduce", "--render-only", "--records", str(RESULTS), "--output", str(directory)]
    assert main([*command, "--no-figures", "-q"]) in (0, 1)
    return directory


def texts(directory):
    """Everything that is rendered from records but figures, by name."""
    found = [directory / "README.md", directory / "claims.csv", *(directory / "tables").iterdir()]
    return {str(path.relative_to(directory)): path.read_text() for path in found}


def test_page_tables_and_claims_are_those_of_the_committed_records(again):
    assert texts(COMMITTED) == texts(again)


def test_the_page_is_of_a_finished_run_and_shows_every_figure():
    page = (COMMITTED / "README.md").read_text()
    assert "**Unfinished**" not in page
    figures = {path.stem for path in (COMMITTED / "figures").iterdir()}
    assert figures == {path.stem for path in (COMMITTED / "figures").glob("*.svg")}
    assert all(f"](figures/{name}.png)" in page for name in figures)


def test_what_is_committed_stays_small():
    assert sum(path.stat().st_size for path in COMMITTED.rglob("*") if path.is_file()) < 6e6
