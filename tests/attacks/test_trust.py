"""Entries that say more than they may, or take another's row."""

import secrets
import shutil

import pytest
from helpers_split import make_split
from helpers_submission import Draft
from oodd_leaderboard import verify as verification
from oodd_leaderboard.reported import read_entries, sections
from oodd_leaderboard.submit import Statement, submit
from oodd_leaderboard.verify import verify

from oodd_eval import evaluate
from oodd_eval.errors import ResultsError


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Entries of one honest row each, by detector."""
    home = tmp_path_factory.mktemp("rows")
    split = make_split(home / "split", calibration=20)
    for detector in ("persistence", "random"):
        evaluate(detector, split, output=home / "out")
    return {
        name: submit(home / "out", home / "results", Statement(), detectors=name).path
        for name in ("persistence", "random")
    }


@pytest.fixture
def board(rows, tmp_path):
    """A directory of entries with the row ``persistence``, and room for an attacker's."""
    results = tmp_path / "leaderboard" / "results"
    shutil.copytree(rows["persistence"], results / rows["persistence"].name)
    return results


def another(rows, board, name, of="persistence", **changes):
    """Return an attacker's entry: a copy of an honest one under another name, and changed."""
    draft = Draft(rows[of], board.parent / "drafts")
    draft.entry |= {"id": name} | changes
    shutil.move(draft.path, board / name)
    draft.path = board / name
    return draft


def problems(board):
    return {v.name: [p.text for p in v.findings.problems] for v in verify(board) if not v.ok}


def test_honest_entries_are_valid(rows, board):
    another(rows, board, "other", of="random").write()
    assert problems(board) == {}


# Fields that an entry may not have

CLAIMS = [
    {"trust": "re-run"}, {"verified": True}, {"schema": 1, "trust": "re-run"},
]  # fmt: skip


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda c: "-".join(c) + str(len(str(c))))
def test_an_entry_cannot_say_that_it_was_verified(rows, board, claim):
    another(rows, board, "mine", of="random", **claim).write()
    assert "mine" in problems(board)
    with pytest.raises(ResultsError):
        read_entries(board)


# Another's row


def forged(draft):
    for record in draft.records:
        record |= {"seed": 99, "seconds_fit": 0.001}


def half(draft):
    draft.records = draft.records[:8]


@pytest.mark.parametrize("change", [lambda draft: None, forged, half])
def test_a_row_of_another_entry_is_refused(rows, board, change):
    draft = another(rows, board, "persistence-again")
    change(draft)
    draft.write()
    assert "is of a row of entry" in str(problems(board))
    with pytest.raises(ResultsError, match="both hold row 'persistence'"):
        sections(read_entries(board))


@pytest.mark.parametrize("distribution", ["oodd-eval-x", "other"])
def test_a_name_of_another_distribution_is_refused(rows, board, distribution):
    draft = another(rows, board, "mine")
    for record in draft.records:
        record["plugin"] = f"{distribution}:trivial"
        record["horizon"] = 3
    draft.entry["plugins"][0]["distribution"] = distribution
    draft.write()
    assert "a name stands for one detector" in str(problems(board))


# Verification of a whole directory


@pytest.mark.parametrize("error", [RecursionError, MemoryError])
def test_what_breaks_the_check_of_an_entry_does_not_end_that_of_others(
    rows, board, monkeypatch, error
):
    """Whatever nobody has thought of: the entry is refused, and the next one is checked."""
    another(rows, board, "aaa", of="random").write()
    checked = verification.verify_entry

    def breaks(directory, **known):
        if directory.name == "aaa":
            raise error("\x1b[31mboom")
        return checked(directory, **known)

    monkeypatch.setattr(verification, "verify_entry", breaks)
    found = {verdict.name: verdict for verdict in verify(board)}
    assert [verdict.ok for verdict in found.values()] == [False, True]
    (problem,) = found["aaa"].findings.problems
    assert f"could not be checked ({error.__name__}: " in problem.text
    assert "\x1b" not in problem.text


# Seeds that can be found


def first_row(seed):
    from oodd_recording.environments import make

    simulator = make("cartpole")
    try:
        return simulator.reset(seed).tobytes()
    finally:
        simulator.close()


def test_a_search_among_seed_bases_finds_no_episode_of_drawn_bits():
    """One training row gave away the base, and with it the twin of every test episode."""
    pytest.importorskip("gymnasium")
    from oodd_recording.build import seed_of

    rows = {first_row(seed_of(base * 10**6, None)): base for base in range(900)}
    assert rows[first_row(738 * 10**6)] == 738
    assert first_row(seed_of(0, secrets.randbits(128))) not in rows
