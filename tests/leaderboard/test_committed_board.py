"""The committed leaderboard: valid entries, their places, and nothing that the harness leaks.

Its numbers are among those that ``docs/figures/tables.py --check`` compares.
"""

from pathlib import Path

import pytest
from oodd_leaderboard.published import PUBLISHED, board_of, placement, read_published
from oodd_leaderboard.reported import read_entries, sections
from oodd_leaderboard.verify import verify

BOARD = Path(__file__).parents[2] / "leaderboard"


@pytest.fixture(scope="module")
def entries():
    return read_entries(BOARD / "results")


@pytest.fixture(scope="module")
def committed(entries):
    """The committed entries, sorted into sections with their rankings."""
    return sections(entries)


@pytest.mark.artefacts
def test_nominal_twins_look_alike_to_every_row_in_every_environment(committed):
    """Matched AUC of one twin against another: chance, unless the harness leaks something."""
    for board in (section.ranks.board for section in committed):
        ran = dict.fromkeys((r.setting, r.environment) for r in board.records)
        for row, environment in ran:  # an oracle has some environments alone
            placebo = board.mean(row, [environment], board.anomalies, "auc_placebo", intervals=True)
            assert placebo.low <= 0.5 <= placebo.high, (str(row), environment, placebo)


@pytest.mark.artefacts
def test_every_committed_entry_is_valid():
    assert [p.text for v in verify(BOARD / "results") for p in v.findings.problems] == []


@pytest.mark.artefacts
def test_committed_entries_have_their_committed_places_on_the_published_board(committed):
    published = read_published(BOARD / PUBLISHED).boards

    def places(ranks):
        return {s.entry: (s.rank, s.alarm_rank, s.ties) for s in ranks.standings}

    for section in committed:
        for one in section.entries:
            placed = placement(one.records, board_of(one.records, published), one.meta.primary)
            assert places(placed.ranks) == places(section.ranks), one.meta.id
            assert placed.published == placed.rows
