"""Boards of seasons: page, published file, ``build``, ``show`` and ``place``."""

import csv
import io
import math
import re
from dataclasses import replace

import helpers_site
import pytest
from helpers_docs import ROOT
from oodd_leaderboard import published, seasons
from oodd_leaderboard.pages import CELLS, Leaderboard, cells, first_rows, page
from oodd_leaderboard.published import PUBLISHED, published_bytes, read_published
from oodd_leaderboard.season_files import write_row, write_season
from oodd_leaderboard.seasons import read_season_board

from oodd_eval.cli.main import main
from oodd_eval.data.files import decompress
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.ranking import PairedDifference
from oodd_eval.results.directory import ResultsDirectory


def write(directory, board, *, without=()):
    """Write a season's directory, some rows of which lack an environment."""
    directory.mkdir(parents=True)
    write_season(board.season, directory)
    for row in board.ranks.standings:
        name = row.entry.detector
        records = [r for r in row.records if name not in without or r.environment != "hopper"]
        write_row(directory, name, records)
    return directory


@pytest.fixture
def leaderboard(tmp_path, season, monkeypatch):
    """A leaderboard's directory with a season, which has all environments that there are."""
    monkeypatch.setattr(seasons, "ENVIRONMENTS", season.season.environments)
    monkeypatch.setattr(seasons, "WORLDS", ())
    write(tmp_path / "seasons" / season.season.name, season)
    return tmp_path


def test_a_page_says_who_is_first_when_and_by_whom(season, reported):
    text = page(Leaderboard([season], reported))
    head, _, rest = text.partition("## Season 2026-11, 2026-11-27")
    assert "No season" not in head
    board, _, below = rest.partition("## Reported rows")
    about = season.season
    assert f"Bits {about.bits}, split {about.split.name}, digest {about.split.digest}" in board
    assert "60 training and 80 calibration trajectories, and 12\ntest seeds" in board
    assert re.search(r"\| cartpole +\| iid, drift +\| gravity, components +\|", board)
    assert "Best: riqn by Danesh, Fern (2021), matched AUC" in board
    assert "It is told from the second, mine: the difference is" in board
    assert "others, 2026" in board
    assert "Benchmarks \\<b\\>" in board
    assert "not done after 5 s" in board
    assert "Not ranked: broken (timeout in 2 of 8 cells)" in board
    header = re.search(r"\| rank +\| row +\| whose .*", board)[0]
    assert [cell.strip() for cell in header.split("|")[4:-1]] == [
        "matched AUC", "worst environment", "found within 20", "missed", "false episodes"
    ]  # fmt: skip
    assert "## Reported on mini, protocol 1" in below
    assert "| rank" not in below
    assert "](javascript:" not in text
    assert "[docs/submitting.md](../docs/submitting.md)" in head
    assert "docs/leaderboard.md)" not in page(Leaderboard([season]), "")
    assert "(../../../docs/leaderboard.md)" in page(Leaderboard([season]), "../../../")


def test_bold_are_the_best_of_ranked_rows_but_for_trivial_ones():
    # The row clock misses fewest episodes here.
    text = page(Leaderboard([helpers_site.season(rows=("rf", "clock"))]))
    of_row = {name: re.search(rf"\| \d .*\| {name} .*", text)[0] for name in ("rf", "clock")}
    assert "**" not in of_row["clock"]
    assert of_row["rf"].count("**") == 2 * 5


def test_rows_that_are_not_told_apart_share_the_first_rank():
    close = helpers_site.season(rows=("rf", "mine", "clock"))
    assert [row.rank for row in close.ranks.standings] == [1, 1, 3]
    (sentence,) = first_rows(helpers_site.season(rows=("rf",)).ranks)
    assert sentence.endswith("There is no second ranked row.")
    (sentence,) = first_rows(close.ranks)
    assert re.search(r"It is not told from the second, \w+: the difference is .*\]\.$", sentence)


def test_a_difference_has_digits_that_tell_it_from_nothing():
    test = PairedDifference("a", "b", 0.0011, 0.0002, 0.002, 0.01)
    assert published.difference_text(test) == "0.11 points [0.02, 0.20]"
    test = replace(test, low=math.nan, high=math.nan)
    assert published.difference_text(test) == "0.1 points (no interval: too few test episodes)"


def test_build_writes_a_season_and_refuses_an_incomplete_one(leaderboard, season, capsys):
    assert main(["leaderboard", "build", str(leaderboard)]) == 0
    assert (leaderboard / "site" / "index.html").is_file()
    assert "site/data" not in capsys.readouterr().out
    assert main(["leaderboard", "build", str(leaderboard), "--check"]) == 0
    (leaderboard / "README.md").write_text("")
    assert main(["leaderboard", "build", str(leaderboard), "--check"]) == 1
    assert "README.md: differs" in capsys.readouterr().out
    write(leaderboard / "seasons" / "second", season, without=("mine", "rf"))
    assert main(["leaderboard", "build", str(leaderboard)]) == 4
    said = capsys.readouterr().err
    assert re.search(r"mine: .*hopper", said)
    assert re.search(r"rf: .*hopper", said)
    assert "riqn:" not in said


def test_a_season_that_has_not_ended_is_no_board_yet(leaderboard, season):
    begun = leaderboard / "seasons" / "2026-12"
    write(begun, season, without=("rf",))
    write_season(replace(season.season, name="2026-12", date=""), begun)
    (begun / "rows" / "mine.jsonl.xz").unlink()
    assert main(["leaderboard", "build", str(leaderboard), "-q"]) == 0
    text = (leaderboard / "README.md").read_text()
    total = len(season.season.entries)
    assert f"Season 2026-12 is under way: {total - 1} of {total} rows have been run." in text
    assert "## Season 2026-12" not in text
    assert "## Season 2026-11" in text


def test_an_oracle_has_the_cells_whose_equations_it_has(tmp_path, season):
    directory = write(tmp_path / "season", season)
    (oracle,) = (row for row in season.ranks.standings if row.training == "oracle")
    lacking = {"status": "incompatible", "metrics": {}, "per_trajectory": {}}
    records = [
        replace(r, training="oracle", **(lacking if r.environment == "hopper" else {}))
        for r in oracle.records
    ]
    write_row(directory, "oracle", records)
    board = read_season_board(directory)
    (row,) = (row for row in board.ranks.standings if row.training == "oracle")
    assert row.state == "oracle, 4 of 8 cells missing"
    text = page(Leaderboard([board]))
    assert re.search(r"\| –.* oracle +\| oracle +\| +\d\d\.\d .*\\\* \|", text)  # noqa: RUF001
    assert "incompatible" not in text


def test_a_trial_is_built_where_it_lies_and_says_that_it_is_none(tmp_path):
    trial = helpers_site.season(trial=True)
    directory = write(tmp_path / "trial", trial)
    assert main(["leaderboard", "build", str(directory), "-q"]) == 0
    text = (directory / "README.md").read_text()
    assert "## Trial 2026-11, 2026-11-27: no board\n\nThis trial lacks environments acrobot" in text
    assert not (directory / PUBLISHED).exists()
    assert read_published_of(tmp_path, [trial]) == []


def test_without_anything_nothing_is_written(tmp_path, capsys):
    assert main(["leaderboard", "build", str(tmp_path)]) == 5
    assert not [*tmp_path.iterdir()]
    assert "no season" in capsys.readouterr().err


def read_published_of(directory, seasons, reported=()):
    file = directory / PUBLISHED
    file.write_bytes(published_bytes(reported, seasons, helpers_site.ENTRIES.values()))
    return read_published(file)


@pytest.fixture
def shipped(tmp_path, monkeypatch, season, reported):
    """The published file of a season and of reported rows, as an installation has it."""
    old = helpers_site.season(name="2026-05", date="2026-05-02")
    boards = read_published_of(tmp_path, [season, old], reported)
    monkeypatch.setattr(published, "published_file", lambda: tmp_path / PUBLISHED)
    return boards


def test_the_file_has_the_last_season_and_reported_rows_in_their_order(shipped, season, reported):
    assert [board.season and board.season.name for board in shipped] == ["2026-11", None, None]
    for board, ranks in zip(shipped, [season.ranks, *(s.ranks for s in reported)], strict=True):
        again = board.ranks()
        assert [(s.entry, s.printed_rank, s.origin) for s in again.standings] == [
            (s.entry, s.printed_rank, s.origin) for s in ranks.standings
        ]
        assert again.first == ranks.first


def test_an_installation_without_a_board_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(published, "__file__", str(tmp_path / "a" / "b" / "published.py"))
    assert main(["leaderboard", "show"]) == 4
    assert "has no published board" in capsys.readouterr().err


def test_show_prints_the_last_season_or_a_table_of_reported_rows(shipped, capsys, monkeypatch):
    assert main(["leaderboard", "show"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("the paper, 2021" in line for line in lines)  # a column that goes first
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["leaderboard", "show"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("Season 2026-11, 2026-11-27 Best: riqn by Danesh")
    assert "the paper, 2021" in text
    assert "Reported" not in text
    assert main(["leaderboard", "show", "--split", "mini", "--csv"]) == 0
    assert "variant" in capsys.readouterr().out.splitlines()[0]
    assert main(["leaderboard", "show", "--split", "minni"]) == 4
    assert "mini" in capsys.readouterr().err


def run_of(directory, board, change=lambda record: record):
    """A results directory with a row of the season under another name."""
    row = next(row for row in board.ranks.standings if row.entry.detector == "rf")
    records = [change(replace(r, detector="own", split="season-x")) for r in row.records]
    ResultsDirectory(directory).merge_records(filter(None, records))
    return str(directory)


def test_place_says_where_a_run_stands_and_what_it_is_told_from(shipped, season, tmp_path, capsys):
    run = run_of(tmp_path / "run", season)
    assert main(["leaderboard", "place", run]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert re.search(r"own stands at place \d of 7 by mean matched AUC, rank \d\.", text)
    assert re.search(r"It is (not )?told from \w+, the row above it: .* points \[", text)
    assert "> own" in text
    assert main(["leaderboard", "place", run, "--csv"]) == 0
    assert "own" in capsys.readouterr().out


def test_a_run_of_few_cells_is_placed_over_these(shipped, season, tmp_path, capsys):
    run = run_of(tmp_path / "run", season, lambda r: r if r.environment == "hopper" else None)
    assert main(["leaderboard", "place", run]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "over the 4 cells that your rows have, of 8, and so not the board's" in text


@pytest.mark.parametrize("change", [{"split_digest": "9" * 64}, {"limit": 3}, {"protocol": 2}])
def test_what_cannot_be_compared_is_refused(shipped, season, tmp_path, capsys, change):
    run = run_of(tmp_path / "run", season, lambda r: replace(r, **change))
    assert main(["leaderboard", "place", run]) == 4
    assert "cannot be compared with the board" in capsys.readouterr().err


def test_a_row_of_the_board_is_known_again(shipped, season, tmp_path, capsys):
    records = [r for r in season.ranks.board.records if r.detector in ("riqn", "mine")]
    changed = [
        replace(r, per_trajectory={n: t * [[0.5], [1.0]] for n, t in r.per_trajectory.items()})
        if r.detector == "mine" else r
        for r in records
    ]  # fmt: skip
    ResultsDirectory(tmp_path / "run").merge_records(changed)
    assert main(["leaderboard", "place", str(tmp_path / "run")]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "The board has that row with the same numbers." in text
    assert "It stands instead of the board's row of that name, which differs." in text


# Cells for machines


def test_every_column_of_the_table_of_cells_is_described(season, reported):
    text = decompress(cells(Leaderboard([season], reported))).decode()
    lines = [*csv.DictReader(io.StringIO(text))]
    assert {line["board"] for line in lines} == {"season-2026-11", *(s.name for s in reported)}
    board = (ROOT / "docs" / "board-data.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?) \|", board, re.MULTILINE)
    listed = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    own = [c for c in lines[0] if re.sub(r"_(low|high)$", "", c) not in catalogue.NAMES]
    assert sorted(own) == sorted(name for name in listed if not name.startswith("_"))
    assert len(own) < len(lines[0])


def test_the_documents_program_reads_the_table(tmp_path, monkeypatch, capsys, reported):
    pytest.importorskip("pandas")
    board = (ROOT / "docs" / "board-data.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", board, re.DOTALL)
    file = tmp_path / "leaderboard" / CELLS
    file.parent.mkdir(parents=True)
    file.write_bytes(cells(Leaderboard((), reported)))
    monkeypatch.chdir(tmp_path)
    exec(program, {})  # noqa: S102  the document's own
    assert re.search(r"^riqn +0\.\d+$", capsys.readouterr().out, re.MULTILINE)
