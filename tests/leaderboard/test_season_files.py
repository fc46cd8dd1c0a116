"""The files of a season: what is written is read back, and what is wrong in them is told."""

import dataclasses
import json
from pathlib import Path

import pytest
from helpers_records import make_record
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.season_files import (
    SEASON,
    Installed,
    Season,
    SeasonSplit,
    read_season,
    row_path,
    write_row,
    write_season,
)

from oodd_eval.errors import ResultsError

DIGEST = "ab" * 32
SEASON_OF_TWO = Season(
    "2026-11",
    "0" * 31 + "7",
    1,
    "0.2.0",
    SeasonSplit("season-1", DIGEST, {"train": 60}),
    [0, 1, 2],
    ["ant", "hopper"],
    {"ant": ["iid"], "hopper": ["iid", "gravity"]},
    entries={"rf": Entry("rf", detector="rf"), "mine": Entry("mine", wheel="mine-1.whl")},
    installed={"mine": [Installed("oodd-mine", "1.0", "0" * 64)]},
)


def row(name, *, seeds=(0, 1, 2), deterministic=False):
    return [
        make_record(name, environment, kind, seed=seed, deterministic=deterministic)
        for environment, kinds in SEASON_OF_TWO.conditions.items()
        for kind in kinds
        for seed in seeds
    ]


@pytest.fixture
def directory(tmp_path):
    write_season(SEASON_OF_TWO, tmp_path)
    return tmp_path


def test_what_is_written_is_read(directory):
    assert read_season(directory) == SEASON_OF_TWO
    assert read_season(directory).records(directory) == []
    write_row(directory, "rf", row("rf"))
    assert read_season(directory).records(directory) == row("rf")


def test_a_whole_season_lacks_nothing():
    records = row("rf") + row("mine", seeds=[0], deterministic=True)
    assert SEASON_OF_TWO.missing(records) == []
    assert {record.position for record in records} == SEASON_OF_TWO.expected


def test_rows_and_environments_that_lack_are_named():
    records = [
        r for r in row("rf") if (r.environment, r.anomaly, r.seed) != ("hopper", "gravity", 2)
    ]
    first, second = SEASON_OF_TWO.missing(records)
    assert first.startswith("rf: ")
    assert "hopper" in first
    assert "ant" not in first
    assert second == "mine: not run"


@pytest.mark.parametrize(
    "change", [{"detector": "other"}, {"split_digest": "cd" * 32}, {"protocol": 2}]
)
def test_records_of_another_row_or_split_are_refused(directory, change):
    write_row(directory, "rf", [dataclasses.replace(r, **change) for r in row("rf")])
    with pytest.raises(ResultsError, match=str(row_path(directory, "rf"))):
        read_season(directory).records(directory)


@pytest.mark.parametrize(
    ("field", "value"), [("schema", 2), ("bits", 7), ("more", 1), ("entries", {"a": {"year": "x"}})]
)
def test_what_is_no_season_is_refused(directory, field, value):
    file = directory / SEASON
    file.write_text(json.dumps(json.loads(file.read_text()) | {field: value}))
    with pytest.raises(ResultsError, match=field):
        read_season(directory)


def test_a_directory_without_a_season_is_named(tmp_path: Path):
    with pytest.raises(ResultsError, match=SEASON):
        read_season(tmp_path)
