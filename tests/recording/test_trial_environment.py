"""The trial of a newcomer: from the how-to alone to a board of an environment of one's own."""

import re

import pytest
from helpers_docs import ROOT, Session, commands

pytestmark = pytest.mark.slow

pytest.importorskip("gymnasium", reason="needs the extra gym")
PAGE = (ROOT / "docs" / "how-to" / "own-environment.md").read_text()


def block(language):
    return re.search(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[1]


@pytest.fixture
def session(tmp_path, monkeypatch):
    (tmp_path / "oodd_pendulum.py").write_text(block("python"))
    (tmp_path / "pyproject.toml").write_text(block("toml"))
    session = Session(tmp_path, monkeypatch)
    yield session
    session.forget()


def test_the_page_leads_to_a_board_of_ones_own(session, capsys):
    for command in commands(PAGE):
        assert session.run(command) == 0, command
    told = capsys.readouterr().out
    board = told[told.index("Matched AUC") :]
    assert re.search(r"mewma +[│|]? *\d", board)
    assert "pendulum" in board
    assert "8 ok" in told
