"""A season from nothing to its records: complete, resumable, and the same for the same bits."""

import dataclasses
import importlib.util
import shutil
from pathlib import Path

import h5py
import pytest
from helpers_processes import Cluster, environment, oodd_eval, wait_until
from oodd_leaderboard.season_files import read_season, row_path, write_season

from oodd_eval import load_split
from oodd_eval.cli.main import main

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap"),
]
pytest.importorskip("gymnasium")

BITS = "7e0c5a4df6db7db56e4a2ab8c1e4c9a1"
SMALL = ("--env", "cartpole,tank", "--train", 4, "--calibration", 20, "--test", 4, "--cap", 80)
ROWS = ("mewma", "oracle-gym", "random")
VOLATILE = {"seconds_fit": 0.0, "seconds_score": 0.0, "peak_rss_mb": 0.0, "provenance": {}}


def season(directory, *arguments, entries=None):
    """Run a small season in this process; return its exit code."""
    named = () if entries is None else ("--entries", entries)
    words = ("leaderboard", "season", *named, "--output", directory, *SMALL, *arguments)
    return main([*map(str, words)])


def steady(directory):
    """Return the records of a season without what differs from run to run."""
    records = read_season(directory).records(directory)
    return [dataclasses.replace(record, **VOLATILE) for record in records]


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    directory = tmp_path_factory.mktemp("entries")
    for name in ROWS:
        (directory / f"{name}.toml").write_text('authors = "A test"\n')
    (directory / "short.toml").write_text('detector = "mewma"\nparameters = {clip = 2.0}\n')
    return directory


@pytest.fixture(scope="module")
def whole(tmp_path_factory, entries):
    """A season that nothing has ended; `oracle-gym` has no equations of the tank."""
    directory = tmp_path_factory.mktemp("seasons") / "whole"
    assert season(directory, "--bits", BITS, entries=entries) == 1
    return directory


def test_a_season_is_whole_when_every_row_has_every_cell(whole, entries):
    read = read_season(whole)
    assert (read.bits, read.seeds, read.trial, read.name) == (BITS, [0, 1, 2], True, "whole")
    assert read.date
    assert read.split.digest == load_split(whole / "split").digest
    assert {*read.entries} == {*ROWS, "short"}
    records = read.records(whole)
    assert read.missing(records) == []
    assert {r.position for r in records} == read.expected
    assert {(r.detector, r.seed) for r in records} == {
        ("mewma", 0), ("short", 0), ("oracle-gym", 0),
        ("random", 0), ("random", 1), ("random", 2),
    }  # fmt: skip


def test_a_whole_season_has_a_page_and_a_site(whole):
    page = (whole / "README.md").read_text()
    assert "no board" in page  # a trial
    assert all(name in page for name in (*ROWS, "short", BITS))
    assert (whole / "site" / "index.html").is_file()


def test_columns_computed_from_score_files_are_those_of_the_board(whole, tmp_path):
    path = Path(__file__).parents[2] / "benchmarks/season_columns.py"
    spec = importlib.util.spec_from_file_location("season_columns", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    # At 10 % the calibration is enough for each row.
    assert script.main([str(whole), "--level", "10"]) == 0
    assert script.main([str(whole), "random"]) == 0
    changed = shutil.copytree(whole, tmp_path / "changed")
    for file in (changed / "work/random/scores").glob("*.h5"):
        with h5py.File(file, "r+") as scores:
            part = scores["test/nominal/scores"]
            part[:] = part[:] + 1e-3
    assert script.main([str(changed), "mewma"]) == 0
    assert script.main([str(changed), "random"]) == 1


def test_what_fails_is_the_reason_of_a_row(whole):
    by_environment = {r.environment: r for r in steady(whole) if r.detector == "oracle-gym"}
    assert by_environment["tank"].status == "incompatible"
    assert by_environment["tank"].reason
    assert by_environment["cartpole"].ok


def test_killed_at_three_moments_it_goes_on_to_the_same_records(whole, entries, tmp_path):
    directory = tmp_path / "killed"
    words = ("leaderboard", "season", "--entries", entries, "--output", directory, *SMALL)

    def recorded():
        return [*(directory / "split" / ".building").glob("*.npz")]

    def scored():
        return [*(directory / "work" / "mewma" / "scores").glob("*.h5")]

    def written():
        return row_path(directory, "mewma").is_file()

    for moment in (recorded, scored, written):
        process = oodd_eval(*words, "--bits", BITS, "--jobs", 1, env=environment("", tmp_path))
        assert wait_until(lambda moment=moment, process=process: moment() or process.poll())
        assert process.poll() is None, process.stdout.read()
        process.kill()
        process.communicate()
    assert not row_path(directory, "short").is_file()
    assert season(directory, entries=entries) == 1
    assert steady(directory) == steady(whole)
    assert load_split(directory / "split").digest == load_split(whole / "split").digest


def test_a_cluster_gives_the_same_records(whole, entries, tmp_path):
    pytest.importorskip("distributed")
    cluster = Cluster(tmp_path, environment("", tmp_path), workers=2)
    try:
        executor = cluster.address.replace("tcp://", "dask://")
        words = ("--bits", BITS, "--executor", executor)
        assert season(tmp_path / "there", *words, entries=entries) == 1
    finally:
        cluster.close()
    assert steady(tmp_path / "there") == steady(whole)


def test_anybody_records_the_split_of_published_bits_again(whole, tmp_path):
    assert season(tmp_path / "again", "--bits", BITS) == 0
    assert read_season(tmp_path / "again").split == read_season(whole).split
    shutil.copytree(whole, tmp_path / "published", ignore=lambda *_: ["split", "work", "packages"])
    assert season(tmp_path / "published") == 0
    assert read_season(tmp_path / "published") == read_season(whole)
    assert steady(tmp_path / "published") == steady(whole)


def test_other_bits_sizes_or_entries_are_refused(whole, entries, tmp_path, capsys):
    other = BITS[::-1]
    assert season(whole, "--bits", other, entries=entries) == 4
    said = capsys.readouterr().err
    assert BITS in said
    assert other in said
    assert season(whole, "--test", 5, entries=entries) == 4
    assert "expected 5" in capsys.readouterr().err
    (tmp_path / "late.toml").write_text('detector = "clock"\n')
    assert season(whole, entries=tmp_path) == 4
    assert "late" in capsys.readouterr().err


def test_a_changed_row_is_run_again_before_a_season_is_whole(whole, entries, tmp_path, capsys):
    directory, changed = tmp_path / "season", tmp_path / "entries"
    shutil.copytree(whole, directory)
    shutil.copytree(entries, changed)
    write_season(dataclasses.replace(read_season(directory), date=""), directory)
    kept = row_path(directory, "mewma").stat().st_mtime_ns
    (changed / "short.toml").write_text('detector = "mewma"\nparameters = {clip = 4.0}\n')
    (changed / "random.toml").unlink()
    assert season(directory, entries=changed) == 1
    assert "is whole, with 5 failed results: page" in capsys.readouterr().out
    assert row_path(directory, "mewma").stat().st_mtime_ns == kept
    read = read_season(directory)
    assert {r.overrides["clip"] for r in read.records(directory) if r.detector == "short"} == {4.0}
    assert not row_path(directory, "random").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('detector = "mewmo"\n', "entry 'mewma': unknown detector 'mewmo'"),
        ('author = "Lovelace"\n', "unknown field of entries 'author': did you mean 'authors'?"),
        ("parameters = {klip = 2.0}\n", "klip"),
        ('parameters = {clip = "no"}\n', "clip"),
        ('wheel = "mine-1-py3-none-any.whl"\nsha256 = "' + "0" * 64 + '"\n', "no such file as"),
    ],
)
def test_errors_of_entries_are_told_before_anything_starts(tmp_path, content, message, capsys):
    (tmp_path / "mewma.toml").write_text(content)
    assert season(tmp_path / "season", entries=tmp_path) == 4
    assert message in capsys.readouterr().err
    assert not (tmp_path / "season").exists()


def test_without_bubblewrap_nothing_starts(entries, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert season(tmp_path / "season", entries=entries) == 4
    assert "bubblewrap" in capsys.readouterr().err
    assert not (tmp_path / "season").exists()
