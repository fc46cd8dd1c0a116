"""Records and results directories: what is written is what is read."""

import json
import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.errors import OutputError, ResultsError, UsageError
from oodd_eval.results import record as record_module
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import SCHEMA, STATUSES, Metric, Record, same_terms

NAN = float("nan")


def record(**changes):
    fields = {
        "detector": "rf", "detector_version": "1.0",
        "plugin": "oodd-eval:rf", "parameters": {"trees": 50}, "environment": "hopper",
        "anomaly": "iid", "group": "sensor", "horizon": 1, "seed": 0, "split": "mini",
        "split_digest": "ab" * 32, "status": "ok", "protocol": 1,
        "metrics": {"auc": Metric(0.75, 0.5, 1.0, 2), "delay": Metric(NAN, NAN, NAN, 0)},
        "counts": {"test": 2}, "per_trajectory": {"auc": np.array([[1.0, 0.5], [1.0, 1.0]])},
        "seconds_fit": 1.5, "provenance": {"python": "3.11"},
    }  # fmt: skip
    return Record(**{**fields, **changes})


def same(one, two):
    """Equality that takes NaN as equal to NaN."""
    fields = [repr(replace(r, per_trajectory={})) for r in (one, two)]
    return fields[0] == fields[1] and same_terms(one.per_trajectory, two.per_trajectory)


@given(
    value=st.floats(allow_infinity=False),
    number=st.floats(allow_infinity=False, allow_nan=False),
    reason=st.text(max_size=40),
    parameters=st.dictionaries(
        st.text(max_size=5), st.integers() | st.text(max_size=5), max_size=3
    ),
    status=st.sampled_from(STATUSES),
)
def test_json_round_trip_of_anything(value, number, reason, parameters, status):
    one = record(
        metrics={"auc": Metric(value, value, NAN, 3)}, reason=reason, parameters=parameters,
        status=status, per_trajectory={"auc": np.array([[number], [1.0]]), "far": np.ones((2, 3))},
    )  # fmt: skip
    line = one.to_json()
    assert "\n" not in line
    assert same(Record.from_json(line), one)


def test_undefined_is_null():
    plain = json.loads(record().to_json())
    assert plain["metrics"]["delay"] == {"value": None, "low": None, "high": None, "n": 0}
    assert plain["seconds_score"] is None
    assert "NaN" not in record().to_json()


def changed(**changes):
    return json.dumps({**json.loads(record().to_json()), **changes})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "r:1 is no record: Invalid JSON"),
        ("[]", "r:1 is no record"),
        ("{}", f"has schema None, expected {SCHEMA}"),
        (changed(schema=1), f"has schema 1, expected {SCHEMA}: it was written by another version"),
        (changed(schema=99, more=1), "has schema 99"),
        (changed(more=1), "more: "),
        (json.dumps({"schema": SCHEMA}), "detector: "),
        (changed(status="fine"), "status: .* got 'fine'"),
        (changed(seed="0"), "seed: .* got '0'"),
        (changed(horizon=True), "horizon: .* got True"),
        (changed(metrics={"auc": {"value": "x"}}), "metrics.auc.value: "),
        (changed(per_trajectory={"auc": [[1.0]]}), "per_trajectory.auc.1: "),
        (
            changed(per_trajectory={"far": [[1.0], [1.0]], "auc": [[1.0], [1.0, 1.0]]}),
            "r:1 is no record: per_trajectory.auc: .*1 numerators and 2 denominators",
        ),
        ("[" * 100_000, "r:1 is no record"),
    ],
)
def test_what_is_no_record_is_refused_by_name(line, message):
    with pytest.raises(ResultsError, match=message):
        Record.from_json(line, "r:1")


def test_merging_replaces_the_same_cell_in_its_place(tmp_path):
    results = ResultsDirectory(tmp_path)
    first, other = record(), record(environment="ant")
    results.merge_records([first, other])
    newer = record(status="error", reason="worse", metrics={})
    merged = results.merge_records([newer])
    assert [(r.cell, r.status) for r in merged] == [(first.cell, "error"), (other.cell, "ok")]
    assert all(map(same, results.records(), merged))


@pytest.mark.parametrize(
    "change",
    [
        {"split_digest": "cd" * 32},
        {"protocol": 2},
        {"parameters": {"trees": 60}},
        {"limit": 3},
        {"overrides": {"trees": 60}},
    ],
)
def test_merging_keeps_what_is_not_the_same_cell(tmp_path, change):
    results = ResultsDirectory(tmp_path)
    results.merge_records([record()])
    assert len(results.merge_records([record(**change)])) == 2


def test_a_directory_names_what_it_lacks_and_a_bad_line(tmp_path):
    with pytest.raises(ResultsError, match=r"expected a file records\.jsonl"):
        ResultsDirectory(tmp_path / "nowhere").records()
    (tmp_path / "records.jsonl").write_text(record().to_json() + "\n{\n")
    with pytest.raises(ResultsError, match=r"records\.jsonl:2 is no record"):
        ResultsDirectory(tmp_path).records()


SCORES = ScoreFile(
    {"calibration": [np.array([np.nan, 1.0])], "test/iid": [np.array([0.1]), np.array([2.0, 3.0])]},
    {"seconds_fit": 1.5},
)
LENGTHS = {"calibration": [2], "test/iid": [1, 2]}


@pytest.fixture
def results(tmp_path):
    directory = ResultsDirectory(tmp_path)
    directory.prepare()
    directory.write_scores("key", SCORES)
    return directory


def test_scores_are_read_back_bit_for_bit(results):
    # Further parts are added to earlier ones.
    results.write_scores("key", ScoreFile({"test/drift": [np.array([5.0])]}, SCORES.cost))
    read = results.scores("key", {**LENGTHS, "test/drift": [1]})
    assert read.cost == SCORES.cost
    for part, sequences in SCORES.parts.items():
        for one, two in zip(sequences, read.parts[part], strict=True):
            assert one.tobytes() == two.tobytes()


@pytest.mark.parametrize(
    "lengths",
    [{"test/drift": [1]}, {"test/iid": [1, 3]}, {"test/iid": [1]}, {"calibration": [2, 1]}],
)
def test_scores_that_do_not_fit_are_no_scores(results, lengths):
    assert results.scores("key", lengths) is None
    assert results.scores("nokey", LENGTHS) is None


def test_a_failed_write_leaves_no_file_behind(results, tmp_path):
    (tmp_path / "scores" / "new.h5").mkdir()  # a file cannot take its place
    with pytest.raises(OutputError, match=r"new\.h5"):
        results.write_scores("new", ScoreFile({"x": [np.zeros(3)]}, {}))
    left = {p.name for p in (tmp_path / "scores").iterdir()}
    assert left - {"key.h5", "key.sha256"} == {"new.h5", "new.sha256"}


def test_a_record_knows_its_cell_and_its_row():
    one = record(overrides={"trees": 60, "depth": 2}, horizon=5, seed=2)
    assert str(one.cell) == "mini/hopper/iid::rf[h=5,seed=2,depth=2,trees=60]"
    assert str(one.setting) == "rf[h=5,depth=2,trees=60]"
    # The order of parameters does not count.
    assert one.setting == Setting.of("rf", 5, {"depth": 2, "trees": 60})


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=5,
)  # fmt: skip


@given(
    overrides=st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), VALUES, max_size=3),
    horizon=st.integers(1, 99),
)
def test_a_setting_is_read_back_from_its_text(overrides, horizon):
    overrides = {k: v for k, v in overrides.items() if k != "h"}
    setting = Setting.of("pyod:IForest", horizon, overrides)
    assert Setting.parse(str(setting)) == setting


@pytest.mark.parametrize("text", ["", "rf[h=1", "rf[x]", 'rf[h=1,x="]'])
def test_what_is_no_setting_is_refused(text):
    with pytest.raises(UsageError):
        Setting.parse(text)


def test_the_commit_is_read_without_writing_to_the_checkout(tmp_path, monkeypatch):
    """`git status` writes the index anew where it may; killed there, it leaves a lock behind."""

    def git(*arguments):
        told = ("-c", "user.name=one", "-c", "user.email=one@example.org")
        done = ["git", "-C", tmp_path, *told, *arguments]
        return subprocess.run(done, check=True, capture_output=True, text=True).stdout.strip()

    package, notes = tmp_path / "oodd_eval", tmp_path / "docs" / "notes.md"
    detector = tmp_path / "detectors" / "rf" / "oodd_rf" / "forest.py"
    for file in (notes, detector, package / "__init__.py"):
        file.parent.mkdir(parents=True)
        file.write_text("1\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "one")
    monkeypatch.setattr(record_module, "_HOME", package)
    os.utime(file, (1, 1))  # git has to look whether it is the same
    index = (tmp_path / ".git" / "index").read_bytes()
    found = record_module.gather()
    assert (found["git_commit"], found["git_dirty"]) == (git("rev-parse", "HEAD"), False)
    assert (tmp_path / ".git" / "index").read_bytes() == index
    # Results that nobody has committed, and documents, change no score.
    (tmp_path / "oodd-results").mkdir()
    (tmp_path / "oodd-results" / "records.jsonl").write_text("{}\n")
    (package / "notes.txt").write_text("untracked\n")
    notes.write_text("2\n")
    assert record_module.gather()["git_dirty"] is False
    for changed in (file, detector):
        before = changed.read_text()
        changed.write_text("2\n")
        assert record_module.gather()["git_dirty"] is True
        changed.write_text(before)
        assert record_module.gather()["git_dirty"] is False
