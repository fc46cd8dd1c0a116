"""Reported rows: strangers' files are read within bounds, and tables of them rank nothing."""

import json
import lzma
import re
from dataclasses import replace

import pytest
from helpers_records import example, make_record
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.formats import check_record
from oodd_leaderboard.pages import build, differences, page, read_leaderboard
from oodd_leaderboard.reported import (
    MOST_PACKED,
    by_detector,
    read_reported,
    read_strange_records,
    sections,
)

from oodd_eval.errors import ResultsError
from oodd_eval.results.comparison import write_reference

RECORDS = [record for record in example() if record.detector != "rf"]


@pytest.fixture
def leaderboard(tmp_path):
    """A leaderboard's directory with reported rows of the project and of an entry's author."""
    for name, rows in (("results/simple", ("persistence", "clock")), ("entries/mine", ("riqn",))):
        (tmp_path / name).mkdir(parents=True)
        lines = [r.to_json() + "\n" for r in RECORDS if r.detector in rows]
        (tmp_path / name / "records.jsonl").write_text("".join(lines))
    entry = 'detector = "riqn"\npaper = "Forecasts_of <x>"\nyear = 2026\n'.replace("<x>", "*all*")
    (tmp_path / "entries/mine/entry.toml").write_text(entry)
    return tmp_path


def changed(path, value):
    """A line of a record, one field of which is another."""
    plain = json.loads(RECORDS[0].to_json())
    *parents, last = path.split(".")
    inner = plain
    for name in parents:
        inner = inner[name]
    inner[last] = value
    return json.dumps(plain) + "\n"


WRONG = {
    "markup": ("reason", "<script>alert(1)</script>"),
    "path": ("detector", "../../etc/passwd"),
    "escape": ("note", "\x1b[2Jgone"),
    "letters": ("environment", "Ünlaut"),
    "plugin": ("plugin", "nothing"),
    "digest": ("split_digest", "ab"),
    "number": ("seed", -1),
    "provenance": ("provenance", {"command": "<b>"}),
    "deep": ("parameters", {"a": [[[[[[[[[1]]]]]]]]]}),
    "terms": ("per_trajectory.auc_matched", [[0.5], [1.0]]),
    "ratio": ("per_trajectory.auc_matched", [[0.5, 0.5], [0.0, 1.0]]),
    "metric": ("metrics.made_up", {"value": 1.0, "low": 1.0, "high": 1.0, "n": 1}),
    "recordings": ("recordings", {"test": [-1]}),
    "field": ("trust", "re-run"),
    "type": ("horizon", "1"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_record_is_refused_with_file_line_and_field(tmp_path, case):
    path, value = WRONG[case]
    text = RECORDS[1].to_json() + "\n" + changed(path, value)
    (tmp_path / "records.jsonl").write_text(text)
    with pytest.raises(ResultsError) as error:
        read_strange_records(tmp_path)
    said = str(error.value)
    assert "records.jsonl:2" in said
    assert path.rpartition(".")[0].partition(".")[0] in said
    assert said.isprintable()


def test_recordings_of_other_episodes_are_refused():
    record = RECORDS[0]
    counts = {"nominal": 0, "test": len(record.per_trajectory["auc_matched"][0])}
    alone = replace(record, paired=False, counts=counts)
    check_record(replace(alone, recordings={"test": (0,) * counts["test"]}), "line")
    with pytest.raises(ResultsError, match="recordings: are of 1 episodes"):
        check_record(replace(alone, recordings={"test": (0,)}), "line")


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\n",
        b"",
        b"{}\n",
        b"[" * 100_000 + b"\n",
        RECORDS[0].to_json().encode(),
        b"0" * (MOST_PACKED + 1),
    ],
    ids=["no text", "nothing", "no record", "deep", "cut off", "large"],
)
def test_a_file_that_holds_no_records_is_refused(tmp_path, content):
    (tmp_path / "records.jsonl").write_bytes(content)
    with pytest.raises(ResultsError, match=r"records\.jsonl"):
        read_strange_records(tmp_path)


def test_a_bomb_and_a_link_are_refused(tmp_path):
    bomb = tmp_path / "records.jsonl.xz"
    bomb.write_bytes(lzma.compress(bytes(10**8)))
    with pytest.raises(ResultsError, match="decompresses to more"):
        read_strange_records(tmp_path)
    bomb.unlink()
    (tmp_path / "records.jsonl").symlink_to("/dev/zero")
    with pytest.raises(ResultsError, match="is a link"):
        read_strange_records(tmp_path)


def test_rows_stand_by_mean_without_ranks_and_have_their_entries(leaderboard):
    (table,) = read_leaderboard(leaderboard).reported
    assert [str(row.entry) for row in table.ranks.standings] == ["riqn", "persistence", "clock"]
    assert {row.rank for row in table.ranks.standings} == {None}
    assert not table.ranks.above
    assert table.ranks.standings[0].year == 2026


def test_the_entry_of_a_detector_is_that_of_its_ranked_row():
    variant, ranked = Entry("a", detector="mine", variant=True), Entry("b", detector="mine")
    assert by_detector([ranked, variant]) == by_detector([variant, ranked]) == {"mine": ranked}


def test_a_record_is_of_the_variant_whose_parameters_it_was_made_with(leaderboard):
    path = leaderboard / "entries/mine/records.jsonl"
    plain = [json.loads(line) for line in path.read_text().splitlines()]
    made = [p | {"parameters": {"members": 5, "samples": 8}, "overrides": {}} for p in plain]
    path.write_text("".join(json.dumps(p) + "\n" for p in made))
    entry = 'detector = "riqn"\nvariant = true\nparameters = {members = 5}\n'
    (leaderboard / "entries/riqn-5.toml").write_text(entry)
    (table,) = read_leaderboard(leaderboard).reported
    assert str(table.ranks.standings[0].entry) == "riqn[members=5]"
    (leaderboard / "entries/riqn-5.toml").write_text(entry.replace("5", "3"))
    (table,) = read_leaderboard(leaderboard).reported
    assert str(table.ranks.standings[0].entry) == "riqn"


def test_a_row_is_of_one_directory(leaderboard):
    other = leaderboard / "results" / "other"
    other.mkdir()
    (other / "records.jsonl").write_text(make_record("riqn", "ant", seed=7).to_json() + "\n")
    with pytest.raises(ResultsError, match="both hold row 'riqn'"):
        sections(read_reported(leaderboard))


def test_a_row_that_is_run_again_takes_the_place_of_the_older_one(leaderboard):
    path = leaderboard / "entries/mine/records.jsonl"
    older = path.read_text()
    fresh = [json.loads(line) for line in older.splitlines()]
    for record in fresh:
        record |= {"detector_version": "9.9", "provenance": {"time": "2027-01-02T03:04:05+00:00"}}
    again = "".join(json.dumps(record) + "\n" for record in fresh)
    path.write_text(older + again)
    with pytest.raises(ResultsError, match="twice, expected one record: remove the older"):
        read_leaderboard(leaderboard)
    path.write_text(again)
    board = read_leaderboard(leaderboard)
    assert [str(row.entry) for row in board.reported[0].ranks.standings].count("riqn") == 1
    (line,) = re.findall(r"\| riqn .*\| 9\.9 .*", page(board))
    assert [cell.strip() for cell in line.split("|")][7:9] == ["9.9", "2027-01-02"]


def test_no_table_mixes_digests_protocols_or_limits(leaderboard):
    others = [{"digest": "cd" * 32}, {"limit": 3}]
    for i, changes in enumerate(others):
        directory = leaderboard / "results" / f"other-{i}"
        directory.mkdir()
        write_reference([make_record(**changes)], directory / "records.jsonl", keep=["auc_matched"])
    found = sections(read_reported(leaderboard))
    assert len({section.name for section in found}) == 3
    for section in found:
        conditions = {(r.split_digest, r.protocol, r.limit) for r in section.ranks.board.records}
        assert len(conditions) == 1


def test_the_same_records_give_the_same_files(leaderboard, tmp_path):
    read = read_leaderboard(leaderboard)
    names = build(read, tmp_path / "one")
    build(read, tmp_path / "two")
    assert not differences(tmp_path / "one", tmp_path / "two")
    page = (tmp_path / "one" / names[0]).read_text()
    assert "No season has ended" in page
    assert "Forecasts\\_of \\*all\\*" in page
    table = next(name for name in names if name.startswith("tables/"))
    (tmp_path / "two" / table).write_text("rank\n")
    (tmp_path / "two" / "tables" / "old.csv").write_text("rank\n")
    assert differences(tmp_path / "one", tmp_path / "two") == sorted(
        [f"{table}: differs", "tables/old.csv: no part of the leaderboard any more"]
    )
