"""``leaderboard submit``: an entry from a run, read back before it is there."""

import hashlib
from dataclasses import replace

import pytest
from helpers_records import make_record
from helpers_split import make_split
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.entry import Entry, read_entries, read_entry
from oodd_leaderboard.reported import read_reported

from oodd_eval import evaluate
from oodd_eval.cli.main import main
from oodd_eval.results.directory import ResultsDirectory

MINE = {"plugin": "oodd-mine:mine", "detector_version": "1.2+numpy.2", "training": "simulation"}
WHEEL = "oodd_mine-1.2-py3-none-any.whl"


def run(directory, *rows, **changes):
    """A results directory with rows of a stranger's plug-in, by their parameters."""
    records = [
        replace(make_record("mine", anomaly=anomaly, overrides=overrides), **MINE | changes)
        for overrides in rows or ({},)
        for anomaly in ("iid", "gravity")
    ]
    ResultsDirectory(directory).merge_records(records)
    return str(directory)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / WHEEL).write_bytes(b"a wheel")
    return tmp_path


def submit(*options):
    return main(["leaderboard", "submit", *map(str, options)])


def test_an_entry_has_wheel_digest_parameters_and_records(home, capsys):
    results = run(home / "run", {"window": 3, "scales": [0.1, 1e-5], "fast": True})
    facts = {"authors": "A. Author", "paper": "A_title, *venue*", "licence": "MIT"}
    options = [text for name, value in facts.items() for text in (f"--{name}", value)]
    assert submit(results, "--detector", "mine", "--wheel", WHEEL, "--year", 2026, *options) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "next: pip uninstall oodd-mine oodd-eval leaderboard season --entries" in out
    (entry,) = read_entries(home / "leaderboard" / "entries")
    assert read_entries(home / "leaderboard" / "entries" / "mine") == [entry]
    assert entry == Entry(
        "mine", wheel=WHEEL, sha256=hashlib.sha256(b"a wheel").hexdigest(), detector="mine",
        parameters={"window": 3, "scales": [0.1, 1e-5], "fast": True}, training="simulation",
        year=2026, **facts,
    )  # fmt: skip
    assert (home / "leaderboard/entries/mine" / WHEEL).read_bytes() == b"a wheel"
    (reported,) = read_reported(home / "leaderboard")
    assert reported.records == ResultsDirectory(results).records()


def test_a_requirement_is_the_version_of_the_run(home):
    assert submit(run(home / "run"), "--detector", "mine", "--sha256", "0" * 64) == 0
    entry = read_entry(home / "leaderboard/entries/mine/entry.toml")
    assert entry.requirement == "oodd-mine==1.2"


def test_a_row_is_named_where_a_detector_has_several(home, capsys):
    results = run(home / "run", {"window": 2}, {"window": 3})
    digest = ("--sha256", "0" * 64)
    assert submit(results, "--detector", "mine", *digest) == 4
    assert "mine[window=3]" in capsys.readouterr().err
    options = ("--name", "mine-3", "--variant", *digest)
    assert submit(results, "--detector", "mine[window=3]", *options) == 0
    assert read_entry(home / "leaderboard/entries/mine-3/entry.toml").variant


def test_a_row_that_is_shipped_needs_no_wheel_and_has_curves_of_its_scores(home):
    split = make_split(home / "split", ("cartpole",), calibration=20)
    evaluate("persistence", split, output=home / "run")
    assert submit("run", "--detector", "persistence") == 0
    (reported,) = read_reported(home / "leaderboard")
    assert {unit["anomaly"] for unit in read_curves(reported.curves)["units"]} == {
        record.anomaly for record in reported.records
    }
    assert read_entry(reported.path / "entry.toml").shipped


@pytest.mark.parametrize(
    ("changes", "options", "said"),
    [
        ({}, [], "--wheel"),
        ({"limit": 3}, ["--wheel", WHEEL], "--limit"),
        ({"plugin": "mine"}, ["--wheel", WHEEL], "no installed plug-in"),
        ({"plugin": "oodd-other:mine"}, ["--wheel", WHEEL], "is not of oodd-other"),
        ({}, ["--wheel", WHEEL, "--name", "../x"], "--name is"),
        ({}, ["--wheel", WHEEL, "--paper", "<b>"], "paper is"),
        ({}, ["--sha256", "1"], "sha256 is"),
        ({"overrides": {"a": None}}, ["--wheel", WHEEL], "parameter 'a'"),
    ],
)
def test_what_makes_no_entry_writes_nothing(home, capsys, changes, options, said):
    assert submit(run(home / "run", **changes), "--detector", "mine", *options) == 4
    assert said in capsys.readouterr().err
    left = home / "leaderboard" / "entries"
    assert not left.exists() or not [*left.iterdir()]


def test_an_entry_is_not_overwritten(home, capsys):
    options = (run(home / "run"), "--detector", "mine", "--wheel", WHEEL)
    assert submit(*options) == 0
    assert submit(*options) == 4
    assert "is there already" in capsys.readouterr().err


def test_reasons_become_plain_text(home):
    reason = "\x1b[31m<b>boom</b>](x)"
    failed = {"status": "error", "reason": reason, "metrics": {}, "per_trajectory": {}}
    assert submit(run(home / "run", **failed), "--detector", "mine", "--wheel", WHEEL) == 0
    (reported,) = read_reported(home / "leaderboard")
    assert {record.reason for record in reported.records} == {" [31m(b)boom(/b)] (x)"}
