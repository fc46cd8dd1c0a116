"""A committed reproduction is what the committed records give, byte for byte."""

import shutil
from pathlib import Path

import pytest

from oodd_eval.cli.main import main

BOARD = Path(__file__).parents[2] / "leaderboard"
RESULTS = BOARD / "results"
COMMITTED = sorted(header.parent for header in BOARD.rglob("reproduction.json"))
BESIDE = {
    "mini-paper": "mini",
    "standard": "mini",
    "reduced": "standard",
    "reduced-paper": "standard",
}
"""The reproduction whose numbers stand beside those of another."""
OWN = "records.jsonl.*"  # where the records are not those of the board

pytestmark = [
    pytest.mark.artefacts,
    pytest.mark.parametrize("committed", COMMITTED, ids=lambda p: str(p.relative_to(BOARD))),
]
"""Skipped while no reproduction is committed."""


def texts(directory):
    """Everything that is rendered from records but figures, by name."""
    found = [directory / "README.md", directory / "claims.csv", *(directory / "tables").iterdir()]
    return {str(path.relative_to(directory)): path.read_text() for path in found}


def test_page_tables_and_claims_are_those_of_the_committed_records(committed, tmp_path):
    own = [*committed.glob(OWN)]
    for path in (committed / "reproduction.json", committed / "returns.json", *own):
        if path.exists():
            shutil.copy(path, tmp_path / path.name)
    # Which figures there are decides what the page links to.
    if (committed / "figures").exists():
        shutil.copytree(committed / "figures", tmp_path / "figures")
    command = ["reproduce", "--render-only", "--output", str(tmp_path)]
    command += [] if own else ["--records", str(RESULTS)]
    if committed.name in BESIDE:
        command += ["--beside", str(BOARD / "reproduction" / BESIDE[committed.name])]
    assert main([*command, "--no-figures", "-q"]) in (0, 1)
    assert texts(tmp_path) == texts(committed)


def test_the_page_shows_every_figure_that_is_there(committed):
    page = (committed / "README.md").read_text()
    names = {path.stem for path in (committed / "figures").glob("*")}
    assert names == {path.stem for path in (committed / "figures").glob("*.svg")}
    assert all(f"](figures/{name}.png)" in page for name in names)


def test_what_is_committed_stays_small(committed):
    assert sum(path.stat().st_size for path in committed.rglob("*") if path.is_file()) < 6e6
