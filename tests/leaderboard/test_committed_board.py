"""The committed leaderboard: what it reads as, and nothing that the harness leaks.

Its numbers are among those that ``docs/figures/tables.py --check`` compares.
"""

from pathlib import Path

import pytest
from oodd_leaderboard.pages import read_leaderboard
from oodd_leaderboard.published import PUBLISHED, board_of, placement, read_published

BOARD = Path(__file__).parents[2] / "leaderboard"


@pytest.fixture(scope="module")
def reported():
    """The committed tables of reported rows."""
    return read_leaderboard(BOARD).reported


@pytest.mark.artefacts
def test_nominal_twins_look_alike_to_every_row_in_every_environment(reported):
    """Matched AUC of one twin against another: chance, unless the harness leaks something."""
    for board in (section.ranks.board for section in reported):
        ran = dict.fromkeys((r.setting, r.environment) for r in board.records)
        for row, environment in ran:  # an oracle has some environments alone
            placebo = board.mean(row, [environment], board.anomalies, "auc_placebo", intervals=True)
            assert placebo.low <= 0.5 <= placebo.high, (str(row), environment, placebo)


@pytest.mark.artefacts
def test_every_committed_row_has_an_entry(reported):
    without = [row.entry for s in reported for row in s.ranks.standings if not row.origin]
    assert without == []


@pytest.mark.artefacts
def test_committed_rows_have_their_places_on_the_published_board(reported):
    published = read_published(BOARD / PUBLISHED)
    for section in reported:
        records = section.ranks.board.records
        placed = placement(records, board_of(records, published))
        in_order = [row.entry for row in section.ranks.standings]
        assert [row.entry for row in placed.ranks.standings] == in_order
        assert placed.published == placed.rows == set(in_order)
