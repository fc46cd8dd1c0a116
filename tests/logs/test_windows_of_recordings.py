"""Imports and scans know which episodes are windows of one recording."""

import dataclasses

import numpy as np
import pytest
from helpers_logs import write_table
from oodd_logs.episodes import Episode
from oodd_logs.importing import import_frames, import_recipe
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.outliers import Tail, rank_p, rank_threshold
from oodd_logs.scanning.scan import scan_episodes

from oodd_eval.data.layout import environment_digest
from oodd_eval.scoring.promises import promises_of

NOMINAL = ("train", "calibration", "test/nominal")


def recipe(**keys):
    content = {"split": "pump", "sensors": ["a", "b"], "window": 20, "time": "t", "rate": 10}
    content |= {"nominal": {"files": "*.csv", "parts": [0.5, 0.3, 0.2]}}
    return Recipe.parse(content | keys)


def write_logs(folder, *lengths, gap=None):
    for k, rows in enumerate(lengths):
        rng = np.random.default_rng(k)
        stamps = np.arange(rows) / 10
        if gap is not None:
            stamps[gap:] += 60
        write_table(
            folder / f"log{k}.csv",
            {"t": stamps, "a": rng.normal(size=rows), "b": rng.normal(size=rows)},
        )
    return folder


def recordings(split, environment="pump"):
    data = split.environment(environment)
    found = [data.recordings(part) for part in NOMINAL]
    data.close()
    return found


@pytest.mark.parametrize("order", ["recorded", "shuffled"])
def test_windows_keep_the_recording_that_they_are_cut_from(tmp_path, order):
    folder = write_logs(tmp_path / "logs", 100, 60, 40)
    split = import_recipe(recipe(order=order), folder, tmp_path / "split")
    every = [number for part in recordings(split) for number in part]
    expected = [*"0000011122"]
    if order == "shuffled":
        permuted = np.random.default_rng(recipe().seed).permutation(10)
        expected = [expected[i] for i in permuted]
    assert every == expected
    entry = split.manifest["environments"]["pump"]
    assert entry["digest"] == environment_digest({**entry, "recordings": {}})


def test_a_file_that_is_cut_at_a_gap_is_one_recording(tmp_path):
    folder = write_logs(tmp_path / "logs", 100, 100, gap=50)
    split = import_recipe(recipe(gap=10), folder, tmp_path / "split")
    assert [n for part in recordings(split) for n in part] == ["0"] * 4 + ["1"] * 4


def test_episodes_that_are_recordings_need_no_word(tmp_path):
    rows = np.random.default_rng(0).normal(size=(40, 30, 2))
    keys = {"output": tmp_path / "split", "report": len}
    split = import_frames("arm", train=rows[:20], calibration=rows[20:], **keys)
    assert recordings(split, "arm") == [None] * 3
    cut = import_frames(
        "arm", train=rows[:20], calibration=rows[20:], window=15, replace=True, **keys
    )
    assert recordings(cut, "arm")[1] == tuple(str(20 + i // 2) for i in range(40))
    data = cut.environment("arm")
    assert str(promises_of(data)[0]) == (
        "40 windows of 20 recordings: no promise at 5 %; 38 recordings would for a CUSUM of the "
        "scores"
    )


def test_windows_of_a_recording_count_as_one_in_ranks_and_tails():
    others = np.random.default_rng(1).exponential(size=40)
    windows, weights = np.repeat(others, 3), np.full(120, 1 / 3)
    for x in (0.1, 1.0, 9.0, others[3]):
        assert rank_p(x, windows, weights) == pytest.approx(rank_p(x, others))
    for p in (0.05, 0.3):
        assert rank_threshold(p, windows, weights) == rank_threshold(p, others)
    tail, weighted = Tail.fit(others), Tail.fit(windows, weights)
    assert (weighted.start, weighted.share) == pytest.approx((tail.start, tail.share))
    assert np.allclose(weighted.estimates, tail.estimates)


def test_a_scan_compares_windows_with_those_of_other_recordings():
    rng = np.random.default_rng(5)
    files = [rng.normal(size=(300, 2)) for _ in range(12)]
    scan = scan_episodes(files, window=60, detector="mahalanobis")
    least = min(one.rank_p for one in scan.episodes)
    assert len(scan.episodes) == 60
    assert least >= 1 / 12  # of 12 recordings, and not of 60 windows
    few = scan_episodes(files[:3], window=60, detector="mahalanobis")
    assert min(one.rank_p for one in few.episodes) == pytest.approx(1 / 15)
    assert any("15 windows of 3 recordings" in note for note in few.notes)
    cut = [
        Episode(f"w{i}", "log.csv", rows, np.empty((99, 0)), None, recording=i // 3)
        for i, rows in enumerate(np.concatenate(files).reshape(-1, 100, 2))
    ]
    assert min(s.rank_p for s in scan_episodes(cut, detector="mahalanobis").episodes) >= 1 / 12
    own = [dataclasses.replace(episode, recording=None) for episode in cut]
    assert min(s.rank_p for s in scan_episodes(own, detector="mahalanobis").episodes) < 1 / 12
