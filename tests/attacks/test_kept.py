"""What a run has kept, changed by somebody, cut short, or with no room left to write it."""

import os
import resource
import shutil
import subprocess
import sys
import time
import zipfile

import h5py
import numpy as np
import pytest

from oodd_eval import load_split
from oodd_eval.errors import ResultsError
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.state import PackedState, pack, write_state
from oodd_eval.results import directory as results_directory
from oodd_eval.results.directory import FitStore, ResultsDirectory, ScoreFile
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

LENGTHS = {"calibration": [5, 6], "test/nominal": [7]}


def some_scores(value=1.0):
    parts = {p: [np.full(n, value) for n in sizes] for p, sizes in LENGTHS.items()}
    return ScoreFile(parts, {"seconds_fit": 1.0, "steps_scored": 18.0})


@pytest.fixture
def kept(tmp_path):
    """A results directory with the scores of one unit, and their file."""
    results = ResultsDirectory(tmp_path / "out")
    results.prepare()
    results.write_scores("a-b", some_scores())
    return results, tmp_path / "out" / "scores" / "a-b.h5"


def rewritten(file):
    """Another score in a file that is whole."""
    with h5py.File(file, "a") as stored:
        stored["calibration/scores"][0] = 2.0


def one_bit(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def sparse(file):
    os.truncate(file, 10**13)


def linked(file):
    copy = file.with_name("copy.h5")
    shutil.copy(file, copy)
    rewritten(copy)
    file.unlink()
    file.symlink_to(copy)


CHANGES = (rewritten, one_bit, sparse, linked)


@pytest.mark.parametrize("change", CHANGES)
def test_scores_that_were_changed_are_not_used_and_named(kept, change):
    results, file = kept
    assert results.scores("a-b", LENGTHS)
    change(file)
    assert results.scores("a-b", LENGTHS) is None
    (note,) = results.notes
    assert str(file) in note
    assert "was changed since it was written" in note


def test_changed_scores_of_other_parts_are_not_taken_over(kept):
    results, file = kept
    rewritten(file)
    results.write_scores("a-b", ScoreFile({"test/iid": [np.zeros(4)]}, {}))
    assert results.scores("a-b", LENGTHS) is None
    assert results.scores("a-b", {"test/iid": [4]})


def test_parts_are_added_to_scores_that_are_as_they_were(kept):
    results, _ = kept
    results.write_scores("a-b", ScoreFile({"test/iid": [np.zeros(4)]}, {}))
    assert results.scores("a-b", {**LENGTHS, "test/iid": [4]})
    assert results.notes == []


def test_a_kill_between_digest_and_scores_loses_nothing(kept, monkeypatch):
    results, _ = kept

    def killed(path, content):
        raise KeyboardInterrupt

    monkeypatch.setattr(results_directory.files, "write_bytes", lambda path, content: (
        path.write_bytes(content) if path.suffix == ".sha256" else killed(path, content)
    ))  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        results.write_scores("a-b", ScoreFile({"test/iid": [np.zeros(4)]}, {}))
    assert results.scores("a-b", LENGTHS)
    assert results.notes == []


def test_scores_of_an_earlier_version_have_no_digest_and_are_read(kept):
    results, file = kept
    file.with_suffix(".sha256").unlink()
    assert results.scores("a-b", LENGTHS)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe" * 10, b"0" * 10**6])
def test_a_damaged_digest_is_no_digest_of_anything(kept, content):
    results, file = kept
    file.with_suffix(".sha256").write_bytes(content)
    assert results.scores("a-b", LENGTHS) is None
    results.write_scores("a-b", some_scores())
    assert results.scores("a-b", LENGTHS)


def crafted(file, **datasets):
    """A file without a digest, with datasets of its own in the part of calibration."""
    file.with_suffix(".sha256").unlink()
    with h5py.File(file, "a") as stored:
        for name, settings in datasets.items():
            del stored["calibration"][name]
            stored["calibration"].create_dataset(name, **settings)


ENORMOUS = {"shape": (10**12,), "chunks": (10**5,)}
ODD = {
    "text": {"scores": {"data": [b"a"] * 11}},
    "a scalar": {"scores": {"data": 3.0}},
    "two dimensions": {"scores": {"data": np.zeros((11, 2))}},
    "offsets of floats": {"offsets": {"data": np.array([0.5, 5, 11])}},
    "falling offsets": {"offsets": {"data": np.array([0, 16, 11])}},
    "records": {"scores": {"data": np.zeros(11, [("a", "f8")])}},
    "enormous scores": {"scores": ENORMOUS | {"dtype": "f8"}},
    "enormous offsets": {"offsets": ENORMOUS | {"dtype": "i8"}},
}


@pytest.mark.parametrize("datasets", ODD.values(), ids=ODD)
def test_a_file_without_digest_that_is_no_score_file_is_scored_again(kept, datasets):
    results, file = kept
    crafted(file, **datasets)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert results.scores("a-b", LENGTHS) is None
    results.write_scores("a-b", some_scores())
    assert results.scores("a-b", LENGTHS)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000


@pytest.mark.parametrize("cost", [np.nan, -1.0, "text", [1.0, 2.0]])
def test_costs_that_are_no_amounts_are_not_taken_over(kept, cost):
    results, file = kept
    file.with_suffix(".sha256").unlink()
    with h5py.File(file, "a") as stored:
        stored.attrs["steps_scored"] = cost
    found = results.scores("a-b", LENGTHS)
    assert found is None or "steps_scored" not in found.cost


def test_forgetting_forgets_the_digest(tiny_split, tmp_path):
    run_tiny(tiny_split, tmp_path / "out")
    results = ResultsDirectory(tmp_path / "out")
    results.forget(results.records())
    assert list((tmp_path / "out" / "scores").iterdir()) == []


def run_tiny(tiny_split, output, detectors=("clock",), observer=None, plugins=None, **settings):
    split, plugins = load_split(tiny_split), plugins or discover()
    plan = make_plan(
        plugins, split=split, detectors=list(detectors), environments=["cartpole"],
        anomalies=["iid", "gravity"],
    )  # fmt: skip
    watching = [observer] if observer else []
    results = ResultsDirectory(output)
    settings = RunSettings(jobs=1, **settings)
    return run(plan, split, plugins, settings, results, watching), results


def test_a_plugin_that_rewrites_the_scores_of_another_changes_no_result(tiny_split, tmp_path):
    first, _ = run_tiny(tiny_split, tmp_path / "out")
    (file,) = (tmp_path / "out" / "scores").glob("*.h5")
    with h5py.File(file, "a") as stored:
        stored["test/iid/scores"][:] += 100.0
    again, results = run_tiny(tiny_split, tmp_path / "out")
    assert [r.metrics for r in again.records] == [r.metrics for r in first.records]
    assert len(results.notes) == 1


# Records that were cut short


@pytest.mark.parametrize("missing", [1, 2, "all but one byte"])
def test_records_cut_short_are_made_again_from_kept_scores(
    tiny_split, tmp_path, missing, monkeypatch
):
    first, _ = run_tiny(tiny_split, tmp_path / "out")
    records = tmp_path / "out" / "records.jsonl"
    content = records.read_bytes()
    last = len(content.splitlines()[-1])
    records.write_bytes(content[: -(last if missing == "all but one byte" else missing)])
    results = ResultsDirectory(tmp_path / "out")
    assert len(results.records()) == (2 if missing == 1 else 1)
    assert len(results.notes) == (0 if missing == 1 else 1)
    monkeypatch.setattr("oodd_eval.scoring.unit.run_isolated", None)  # nothing is fitted
    again, _ = run_tiny(tiny_split, tmp_path / "out")
    assert [r.metrics for r in again.records] == [r.metrics for r in first.records]
    assert len(records.read_bytes().splitlines()) == 2


@pytest.mark.parametrize("damage", ["first line", "whole last line", "only line"])
def test_records_that_are_damaged_otherwise_are_refused(tiny_split, tmp_path, damage):
    run_tiny(tiny_split, tmp_path / "out")
    records = tmp_path / "out" / "records.jsonl"
    first, last = records.read_text().splitlines()
    records.write_text({
        "first line": f"{first[:-5]}\n{last}\n", "whole last line": f"{first}\n{last[:-5]}\n",
        "only line": first[:-5],
    }[damage])  # fmt: skip
    with pytest.raises(ResultsError, match="is no record"):
        ResultsDirectory(tmp_path / "out").prepare()


# Kept fits


@pytest.fixture
def fit(tmp_path):
    store = FitStore(tmp_path / "fitted")
    store.keep("key", pack({"weights": np.arange(50.0), "words": ["one", {"two": 2}]}), 2.0)
    assert store.find("key").seconds_fit == 2.0
    return store, tmp_path / "fitted" / "key.npz"


WRAPPINGS = {
    "deep": "[" * 10**5,
    "no seconds": '{"state": {}}',
    "no state": '{"seconds_fit": 2.0}',
    "no number": '{"state": {}, "seconds_fit": NaN}',
    "negative seconds": '{"state": {}, "seconds_fit": -1}',
    "enormous seconds": '{"state": {}, "seconds_fit": 1' + "0" * 400 + "}",
}


@pytest.mark.parametrize("text", WRAPPINGS.values(), ids=WRAPPINGS)
def test_a_kept_fit_with_other_words_is_no_fit(fit, text):
    store, file = fit
    write_state(file, PackedState({"weights": np.zeros(3)}, text))
    assert store.find("key") is None


def a_bomb(file):
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in "abc":
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array_header_1_0(
                    entry, {"descr": "|i1", "fortran_order": False, "shape": (3 * 10**8,)}
                )
                for _ in range(300):
                    entry.write(bytes(10**6))


def many_arrays(file):
    with zipfile.ZipFile(file, "w") as archive:
        for k in range(6000):
            archive.writestr(f"{k}.npy", b"")


def a_directory(file):
    file.unlink()
    file.mkdir()


def a_pipe(file):
    file.unlink()
    os.mkfifo(file)


@pytest.mark.parametrize("change", [sparse, a_bomb, many_arrays, a_directory, a_pipe])
def test_what_is_no_fit_is_neither_read_nor_waited_for(fit, change):
    store, file = fit
    change(file)
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    assert store.find("key") is None
    assert time.monotonic() - start < 60
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 700_000


def test_a_fit_that_cannot_be_kept_is_done_without(tmp_path):
    (tmp_path / "fitted").write_text("a file")
    store = FitStore(tmp_path / "fitted")
    store.keep("key", pack({}), 1.0)
    assert not store.has("key")


# No room


FULL = """
import resource, signal, sys
import numpy as np
from oodd_eval.errors import OutputError
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then writing fails, as on a full disk
results = ResultsDirectory(sys.argv[1])
results.prepare()
results.write_scores("before", ScoreFile({"calibration": [np.ones(3)]}, {}))
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
scores = np.random.default_rng(0).normal(size=10**5)
try:
    results.write_scores("after", ScoreFile({"calibration": [scores]}, {}))
except OutputError as error:
    print(error)
assert results.scores("before", {"calibration": [3]})
assert results.scores("after", {"calibration": [10**5]}) is None
print("went on")
"""


@pytest.mark.parametrize("room", [0, 5_000, 700_000])
def test_scores_without_room_are_an_error_and_no_crash(tmp_path, room):
    done = subprocess.run(
        [sys.executable, "-c", FULL, tmp_path, str(room)], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "cannot be written: [Errno 27]" in done.stdout
    assert "went on" in done.stdout
    assert sorted(p.suffix for p in (tmp_path / "scores").glob("before*")) == [".h5", ".sha256"]
    assert not list((tmp_path / "scores").glob(".*"))


@pytest.mark.parametrize("what", ["out", "out/scores", "out/fitted"])
def test_a_directory_removed_while_running(tiny_split, tmp_path, what):
    """What is removed is made again."""

    class Remover:
        done = False

        @hookimpl
        def oodd_cell_finished(self):
            if not self.done:
                while (tmp_path / what).exists():  # the run may write while it is removed
                    shutil.rmtree(tmp_path / what, ignore_errors=True)
            self.done = True

    detectors = ["clock", "persistence"]
    run_tiny(tiny_split, tmp_path / "out", detectors, Remover())
    found = {r.detector for r in ResultsDirectory(tmp_path / "out").records()}
    assert found == {"clock", "persistence"}
    again, _ = run_tiny(tiny_split, tmp_path / "out", detectors)
    assert [r.status for r in again.records] == ["ok"] * 4
