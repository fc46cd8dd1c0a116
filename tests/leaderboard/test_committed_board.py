"""The committed leaderboard: valid entries, and no number that the records do not give.

Numbers are compared to their last printed digit:
sums may be rounded otherwise on another processor. `leaderboard build --check` compares bytes.
"""

import re
from itertools import zip_longest
from pathlib import Path

import pytest
from oodd_leaderboard import build as leaderboard_build
from oodd_leaderboard.entry import read_entries, sections, suite_sections
from oodd_leaderboard.published import PUBLISHED, board_of, placement, read_published
from oodd_leaderboard.verify import verify

from oodd_eval.data.files import read_text

BOARD = Path(__file__).parents[2] / "leaderboard"

NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")


def rendered(board):
    """Return the names of all committed files of a board that are made from its entries."""
    files = [board / "README.md", board / PUBLISHED, *(board / "tables").glob("*.csv")]
    return {f.relative_to(board).as_posix() for f in files if f.is_file()}


def digit(text):
    """Return what one unit of a number's last printed digit is worth; nothing for whole numbers."""
    if text.lstrip("-").isdigit():
        return 0.0
    mantissa, _, exponent = text.partition("e")
    if len(exponent) > 3:
        return 0.0  # the beginning of a digest
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def unlike(fresh, committed):
    """Return a line for each line of two texts that differs by more than rounding."""
    found = []
    pairs = zip_longest(fresh.splitlines(), committed.splitlines(), fillvalue="")
    for i, (new, old) in enumerate(pairs, start=1):
        if new == old:
            continue
        words = [NUMBER.sub("#", re.sub(r" +|-{3,}", " ", text)) for text in (new, old)]
        numbers = zip(NUMBER.findall(new), NUMBER.findall(old), strict=False)
        near = all(abs(float(a) - float(b)) <= 1.001 * digit(b) for a, b in numbers)
        if words[0] != words[1] or not near:
            found.append(f"line {i}: {old[:200]!r} is committed, the records give {new[:200]!r}")
    return found


def check_board(board, scratch, entries):
    """Return what is wrong with a board: a line for every file or line of one."""
    leaderboard_build.build(entries, scratch, suite_sections(board))
    new, old = rendered(scratch), rendered(board)
    lines = [f"{name} is missing or of no entry" for name in sorted(new ^ old)]
    for name in sorted(new & old):
        texts = (read_text(path / name) for path in (scratch, board))
        lines += [f"{name}: {line}" for line in unlike(*texts)]
    return lines


@pytest.fixture(scope="module")
def entries():
    return read_entries(BOARD / "results")


@pytest.fixture(scope="module")
def committed(entries):
    """The committed entries, sorted into sections with their rankings."""
    return sections(entries)


@pytest.mark.artefacts
def test_every_number_of_the_committed_board_comes_from_its_records(
    tmp_path, monkeypatch, entries, committed
):
    # The site is not committed; test_docs builds it.
    monkeypatch.setattr(leaderboard_build.site, "files", lambda *_, **__: {})
    monkeypatch.setattr(leaderboard_build, "sections", lambda _: committed)
    assert check_board(BOARD, tmp_path, entries) == []


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
        return {s.entry: (s.rank, s.alarm_rank, s.ties, s.below) for s in ranks.standings}

    for section in committed:
        for one in section.entries:
            placed = placement(one.records, board_of(one.records, published), one.meta.primary)
            assert places(placed.ranks) == places(section.ranks), one.meta.id
            assert placed.published == placed.rows


# The comparison itself


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
    assert (unlike(fresh, committed) == []) is same
