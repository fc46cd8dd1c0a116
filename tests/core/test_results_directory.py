"""Records are written from time to time, in the plan's order; leftovers of killed runs go away."""

import json
import os
import subprocess
from dataclasses import replace

from oodd_eval.results.directory import RECORDS, RecordWriter, ResultsDirectory
from oodd_eval.results.record import Record


def record(detector, *, seconds=0.0):
    return Record(
        detector=detector, detector_version="", plugin="", parameters={}, environment="ant",
        anomaly="iid", group="sensor", horizon=1, seed=0, split="s", split_digest="", status="ok",
        protocol=1, seconds_fit=seconds,
    )  # fmt: skip


def test_records_written_in_any_order_end_in_the_order_of_the_plan(tmp_path):
    results = ResultsDirectory(tmp_path)
    results.merge_records([record("other")])
    writer = RecordWriter(results)
    for index in (2, 0, 1):
        writer.add(index, [record(f"{index}")])
        writer.write()
    assert [r.detector for r in results.records()] == ["other", "0", "1", "2"]
    again = RecordWriter(results)
    again.add(1, [record("1", seconds=5.0)])
    again.write()
    assert [r.detector for r in results.records()] == ["other", "0", "1", "2"]
    assert results.records()[2].seconds_fit == 5.0


def test_writing_records_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    clock, written = [0.0], []
    monkeypatch.setattr("oodd_eval.results.directory.time.monotonic", lambda: clock[0])

    def merge(records):
        clock[0] += 1.0  # a writing takes a second
        written.append(len(records))

    results = ResultsDirectory(tmp_path)
    monkeypatch.setattr(results, "merge_records", merge)
    writer = RecordWriter(results)
    for index in range(100):
        clock[0] += 1.0
        writer.add(index, [record(str(index))])
    assert written == [1, 21, 41, 61, 81]
    writer.write()
    writer.write()
    assert written[-2:] == [81, 100]


def test_leftovers_of_killed_processes_go_away_and_those_of_living_ones_stay(tmp_path):
    with subprocess.Popen(["true"]) as gone:
        pass
    results = ResultsDirectory(tmp_path)
    results.prepare()
    stale = [
        tmp_path / f".records.jsonl.{gone.pid}",
        tmp_path / "scores" / f".a-b-0123.h5.{gone.pid}",
        tmp_path / "logs" / f".a-b-0123.txt.{gone.pid}",
    ]
    living = tmp_path / "scores" / f".a-b-0123.h5.{os.getppid()}"
    ended = f".mine{gone.pid}.{gone.pid}"  # looks like a temporary name, and is none of ours
    foreign = [tmp_path / ".gitignore", tmp_path / ended, tmp_path / f".python3.{gone.pid}" / "bin"]
    foreign[-1].parent.mkdir()
    for file in (*stale, living, *foreign):
        file.write_text("x")
    fits = [tmp_path / "fitted" / f".abc.{pid}" for pid in (gone.pid, os.getppid())]
    for fit in fits:
        fit.mkdir(parents=True)
        (fit / "weights").write_text("x")
    results.prepare()
    assert not [file for file in stale if file.exists()]
    assert living.exists()
    assert all(file.exists() for file in foreign)
    assert [fit.exists() for fit in fits] == [False, True]


def test_a_line_of_records_ends_at_a_new_line_alone(tmp_path):
    """JSON may hold other ends of lines, such as U+2028, as they are."""
    strange = replace(record("mine"), status="error", reason="a\u2028b\x85c")
    line = json.dumps(json.loads(strange.to_json()), ensure_ascii=False)
    (tmp_path / RECORDS).write_text(line + "\n")
    (read,) = ResultsDirectory(tmp_path).records()
    assert read.reason == strange.reason
