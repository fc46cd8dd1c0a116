"""Entries of many setups, as a reproduction leaves them: what is kept, left out, packed, drawn."""

import json
import shutil
from dataclasses import replace

import pytest
from helpers_split import make_split
from oodd_leaderboard.reported import read_entries
from oodd_leaderboard.submit import with_curves

from oodd_eval.api import evaluate
from oodd_eval.cli import main as cli
from oodd_eval.data import files as packed
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.slow

# Its results are made once, not once a worker.


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Results of several horizons, seeds and parameters; one seed lacks an environment."""
    home = tmp_path_factory.mktemp("many")
    split = make_split(home / "split", ("cartpole", "hopper"), calibration=20, name="many")
    out = home / "results"
    for detector, more in (
        ("random", {"seed": 0}),
        ("random", {"seed": 1}),
        ("random", {"seed": 2, "environments": "cartpole"}),
        ("persistence", {"horizon": 3}),
        ("mewma", {"parameters": {"order": 2}}),
        ("mewma", {}),
    ):
        evaluate(detector, split, output=out, **more)
    return split, out


def submit(many, root, *options):
    """Submit; without curves, which take their time, unless they are asked for."""
    split, out = many
    if "--curves" not in options:
        options = (*options, "--curves", "none")
    return cli.main(
        ["leaderboard", "submit", str(out), "--results", str(root), "--split", str(split),
         "--id", "all", *options]
    )  # fmt: skip


def labels(entry):
    return {record.cell.label for record in entry.records}


ALL = {
    "mewma[h=1,seed=0]", "mewma[h=1,seed=0,order=2]", "persistence[h=3,seed=0]",
    "random[h=1,seed=0]", "random[h=1,seed=1]",
}  # fmt: skip


def test_seeds_that_lack_cells_are_left_out_and_named(many, tmp_path, capsys):
    assert submit(many, tmp_path, "--complete") == 0
    out = capsys.readouterr().out
    assert "left out: random[h=1,seed=2], which has 8 of 16 cells" in out
    (entry,) = read_entries(tmp_path)
    assert labels(entry) == ALL
    assert entry.meta.detectors == ["mewma", "persistence", "random"]


def test_without_being_asked_nothing_is_left_out_and_what_is_partial_is_said(
    many, tmp_path, capsys
):
    assert submit(many, tmp_path) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "random[h=1,seed=2] is partial: 1 of 2 environments (without hopper)" in out
    (entry,) = read_entries(tmp_path)
    assert labels(entry) == ALL | {"random[h=1,seed=2]"}


def test_cells_are_selected_by_expression(many, tmp_path, capsys):
    assert submit(many, tmp_path, "-k", "random or order=2", "--complete") == 0
    (entry,) = read_entries(tmp_path)
    assert labels(entry) == {
        "mewma[h=1,seed=0,order=2]", "random[h=1,seed=0]", "random[h=1,seed=1]"
    }  # fmt: skip
    assert submit(many, tmp_path / "b", "-k", "nowhere") == 4
    assert "-k 'nowhere' selects none of the 88 records" in capsys.readouterr().err


def test_where_no_row_is_complete_this_is_said(many, tmp_path, capsys):
    lacking = "(random and cartpole and seed=2) or (mewma and hopper)"
    assert submit(many, tmp_path, "--complete", "-k", lacking) == 4
    assert "no row of these results has all 16 cells" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_row_without_some_anomalies_is_refused_or_left_out(many, tmp_path, capsys):
    some = "random or (mewma and not order and not iid)"
    assert submit(many, tmp_path, "-k", some) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "cartpole lacks iid" in out
    assert "run them, or leave out what is not complete" in out
    assert submit(many, tmp_path, "-k", some, "--complete") == 0
    assert "left out: mewma[h=1,seed=0], which has 14 of 16 cells" in capsys.readouterr().out


# Size


def test_large_files_are_packed_and_read_like_plain_ones(many, tmp_path, monkeypatch, capsys):
    options = ("-k", "random and seed=0", "--curves", "rows")
    assert submit(many, tmp_path / "plain", *options) == 0
    monkeypatch.setattr(packed, "COMPRESSED_FROM", 10_000)
    assert submit(many, tmp_path / "packed", *options) == 0
    ((plain,), (small,)) = (read_entries(tmp_path / name) for name in ("plain", "packed"))
    assert {p.name for p in small.path.iterdir()} == {
        "entry.json", "records.jsonl.xz", "curves.json.xz"
    }  # fmt: skip
    assert small.meta.files.keys() == {"records.jsonl.xz", "curves.json.xz"}
    assert [r.to_json() for r in small.records] == [r.to_json() for r in plain.records]
    assert packed.read_text(small.curves) == plain.curves.read_text()
    boards = [tmp_path / f"board-{name}" for name in ("plain", "packed")]
    for entry, board in zip((plain, small), boards, strict=True):
        root = str(entry.path.parent)
        assert cli.main(["leaderboard", "build", root, "--output", str(board), "-q"]) == 0
    one, other = (
        {p.relative_to(b): p.read_bytes() for b in [board] for p in b.rglob("*") if p.is_file()}
        for board in boards
    )
    assert one == other


def test_packing_gives_the_same_bytes_and_no_name_or_time():
    content = b"a record\n" * 1000
    once = packed.compress(content)
    assert once == packed.compress(content)
    # RFC 1952: no flags, no time.
    assert once[3:8] == bytes(5)
    assert packed.decompress(once) == content


def test_an_entry_says_how_large_it_is(many, tmp_path, monkeypatch, capsys):
    from oodd_leaderboard import submit as submission

    monkeypatch.setattr(submission, "LARGE", 1000)
    assert submit(many, tmp_path, "--complete") == 0
    out = capsys.readouterr().out
    assert "MB; next:" in out
    assert "burden to the repository" in " ".join(out.split())


# Curves


@pytest.mark.parametrize(
    ("extent", "expected"),
    [
        ("rows", ALL - {"random[h=1,seed=1]"}),
        ("detectors", {"mewma[h=1,seed=0]", "persistence[h=3,seed=0]", "random[h=1,seed=0]"}),
        ("none", set()),
    ],
)
def test_curves_are_of_first_seeds_and_of_as_many_rows_as_asked_for(many, extent, expected):
    records = ResultsDirectory(many[1]).records()
    drawn = with_curves(records, extent)
    assert {r.cell.label for r in drawn} == expected
    assert len(drawn) == 16 * len(expected)


def test_a_first_seed_that_failed_gives_way_to_the_next(many):
    records = [
        replace(r, status="error", reason="no") if (r.detector, r.seed) == ("random", 0) else r
        for r in ResultsDirectory(many[1]).records()
    ]
    drawn = with_curves(records, "detectors")
    assert {r.seed for r in drawn if r.detector == "random"} == {1}


def test_curves_of_some_rows_pass_and_none_leave_no_file(many, tmp_path, capsys):
    assert submit(many, tmp_path / "a", "--complete", "--curves", "detectors") == 0
    (entry,) = read_entries(tmp_path / "a")
    assert len(json.loads(entry.curves.read_text())["units"]) == 48
    assert submit(many, tmp_path / "b", "--complete", "--curves", "none") == 0
    (entry,) = read_entries(tmp_path / "b")
    assert entry.curves is None


def test_scores_that_are_missing_are_named_with_what_to_do(many, tmp_path, capsys):
    bare = tmp_path / "bare"
    bare.mkdir()
    shutil.copy(many[1] / "records.jsonl", bare)
    arguments = ["--results", str(tmp_path / "entries"), "--split", str(many[0]), "-k", "random",
                 "--complete"]  # fmt: skip
    assert cli.main(["leaderboard", "submit", str(bare), *arguments]) == 4
    said = capsys.readouterr().err
    assert "scores are not there in" in said
    assert "--curves none" in said


def test_records_of_a_packed_entry_serve_where_results_do(many, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(packed, "COMPRESSED_FROM", 10_000)
    assert submit(many, tmp_path / "entries", "--complete") == 0
    entry = tmp_path / "entries" / "all"
    assert cli.main(["compare", str(many[1]), "--against", str(entry)]) == 0
    shutil.rmtree(entry)
