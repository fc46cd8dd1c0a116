"""``oodd-eval intervene``: progress, exit codes, going on after an interrupt."""

import pytest
from helpers_studies import episode, study_cell
from oodd_interventions import study

from oodd_eval.cli.main import main

CELLS = [study_cell([episode(s, [100, 20, 80, 100, 30, 90, 95 + s]) for s in range(5)])]
COMMAND = ["intervene", "--detector", "panel", "--env", "hopper"]


@pytest.fixture
def calls(monkeypatch, tmp_path):
    """Calls of a study that ends at once; `calls.outcome` is what comes of it."""

    class Calls(list):
        outcome = (CELLS, {})

    recorded = Calls()

    def intervene(*names, observer, **settings):
        recorded.append((names, settings))
        if isinstance(recorded.outcome, BaseException):
            raise recorded.outcome
        observer(1, 3, "hopper/panel fitted")
        observer(3, 3, "hopper/iid")
        return study.Interventions(tmp_path, *recorded.outcome)

    monkeypatch.setattr(study, "intervene", intervene)
    return recorded


def test_tables_are_printed_and_files_written(calls, tmp_path, capsys):
    options = ["--level", "10", "--act", "mask", "--param", "a=1", "--seeds", "3", "--jobs", "1"]
    assert main([*COMMAND, *options]) == 0
    names, settings = calls[0]
    assert names == ("panel", "hopper")
    assert settings["level"] == pytest.approx(0.1)
    assert (settings["parameters"], settings["acts"], settings["seeds"]) == ({"a": 1}, "mask", 3)
    out = capsys.readouterr().out
    first, *lines = out.splitlines()
    assert first == "1/3  hopper/panel fitted"
    assert lines[0] == "3/3  hopper/iid"
    assert lines[1] == "Acting by mask"
    assert lines[2].startswith("The alarm of panel is worth having")
    assert "Return saved by mask" in out
    assert str(tmp_path) in lines[-1].replace("\n", "")
    assert (tmp_path / "hopper.html").exists()


def test_quiet_is_the_sentence_and_where_the_files_are(calls, capsys):
    assert main([*COMMAND, "-q"]) == 0
    out = capsys.readouterr().out
    assert "The alarm of panel is worth having" in out
    assert "Return saved by" not in out
    assert "3/3" not in out


def test_what_failed_is_said_and_decides_the_exit_code(calls, capsys):
    calls.outcome = CELLS, {"hopper/riqn": "ValueError: no"}
    assert main(COMMAND) == 1
    out = capsys.readouterr().out
    assert "FAILED hopper/riqn: ValueError: no" in out
    assert "Return saved by mask" in out
    calls.outcome = [], {"hopper/riqn": "ValueError: no"}
    assert main(COMMAND) == 1


def test_nothing_that_suits_is_exit_code_5(calls, capsys):
    calls.outcome = [], {}
    assert main(COMMAND) == 5
    assert "no act suits" in capsys.readouterr().err


def test_an_interrupted_study_says_how_it_goes_on(calls, capsys):
    calls.outcome = KeyboardInterrupt()
    assert main([*COMMAND, "--output", "mine"]) == 2
    assert "kept in mine; the same command continues" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--detector", "mewma-b", "did you mean 'mewma-a'"),
        ("--env", "hoper", "did you mean 'hopper'"),
        ("--act", "maks", "did you mean 'mask'"),
        ("--kind", "gravty", "did you mean 'gravity'"),
        ("--split", "minni", "did you mean 'mini'"),
    ],
)
def test_other_names_are_refused_with_a_suggestion(option, value, message, tmp_path, capsys):
    values = {"--detector": "mewma-a", "--env": "cartpole", "--output": str(tmp_path)}
    words = [word for pair in (values | {option: value}).items() for word in pair]
    assert main(["intervene", *words]) == 4
    assert message in capsys.readouterr().err


def test_a_study_of_cartpole_runs_and_goes_on(tmp_path, capsys):
    """The second call finds all cells, and prints the same."""
    names = ["--detector", "mewma-a,persistence", "--env", "cartpole", "--kind", "iid"]
    words = ["intervene", *names, "--act", "mask", "--seeds", "2", "--jobs", "1"]
    words += ["--output", str(tmp_path)]
    assert main(words) == 0
    first = capsys.readouterr().out
    assert "2/2  cartpole" in first
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.json")}
    assert len(before) == 2
    assert main(words) == 0
    assert capsys.readouterr().out == first[first.index("Acting") :]
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.json")} == before
