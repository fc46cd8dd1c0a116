"""A split may be much larger than memory: it is built, verified, fitted on and scored in pieces."""

import contextlib
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import h5py
import numpy as np
import pytest
from helpers_plugins import install
from helpers_processes import environment
from helpers_split import make_group, make_split

from oodd_eval.data.facts import ENVIRONMENTS, SplitDefinition
from oodd_eval.data.layout import (
    Blocks,
    content_digest,
    environment_digest,
    write_environment,
    write_manifest,
)
from oodd_eval.data.split import load_split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.isolation.worker import TrajectoryFile
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.slow

MEGABYTE = 10**6
ALLOWED = 8 * MEGABYTE
"""What reading may cost beside the program itself, with smaller blocks than usual."""

TRAJECTORIES, LENGTH = 110, 10_000


def write_large_split(directory):
    """Write a split whose training part is all zeros, larger than what reading may cost."""
    make_split(directory, ("hopper",))
    steps = TRAJECTORIES * LENGTH
    with h5py.File(directory / "hopper.h5", "r+") as file:
        train, size = file["train"], 0
        for name, rows in (
            ("observations", steps + TRAJECTORIES), ("actions", steps), ("rewards", steps)
        ):  # fmt: skip
            columns = train[name].shape[1:]
            del train[name]
            size += train.create_dataset(
                name, data=np.zeros((rows, *columns), "<f4"), chunks=(5000, *columns)
            ).nbytes
        for name, array in (
            ("offsets", np.arange(TRAJECTORIES + 1) * LENGTH),
            ("seeds", np.arange(TRAJECTORIES)),
            ("terminated", np.zeros(TRAJECTORIES, np.uint8)),
        ):
            del train[name]
            train[name] = array
        facts = {
            "sha256": content_digest(train), "trajectories": TRAJECTORIES, "transitions": steps
        }  # fmt: skip
    entry = json.loads((directory / "manifest.json").read_text())["environments"]["hopper"]
    entry["groups"]["train"] = facts
    entry["digest"] = environment_digest(entry)
    definition = SplitDefinition("large", TRAJECTORIES, 4, 3, None, 9)
    write_manifest(directory, definition, {"hopper": entry}, generator=1, versions={})
    return directory, size


MEASURE = """
import sys
from oodd_eval.cli.main import main
from oodd_eval.data import layout, parts
from oodd_eval.plugins.isolation.worker import peak_rss_mb

layout._BLOCK >>= 3
parts._KEPT >>= 3
code = main(sys.argv[1:])
print("peak", peak_rss_mb())
sys.exit(code)
"""

STREAMING = """
class Streaming(Good):
    def fit(self, nominal):
        self.steps = sum(x.transitions for x in nominal)

@hookimpl
def oodd_detectors(): return offer(streaming=Streaming)
"""


def evaluate(split, plugin, output, *more):
    """Run the command line on a split; return the peaks of harness and worker in bytes."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, "run", "--detector", "streaming", "--env", "hopper",
         "--split", str(split), "--output", str(output), *more],
        env=environment(plugin, output), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    record = ResultsDirectory(output).records()[0]
    harness = float(done.stdout.split("peak ")[1])
    return np.array([harness, record.peak_rss_mb]) * MEGABYTE


@pytest.mark.skipif(sys.platform != "linux", reason="reads peaks of memory from /proc")
def test_a_split_ten_times_larger_than_memory_is_evaluated(tmp_path, monkeypatch):
    install(monkeypatch, tmp_path / "plugin", "streaming", STREAMING)
    small = make_split(tmp_path / "small", ("hopper",))
    large, size = write_large_split(tmp_path / "large")
    assert size > 10 * ALLOWED
    program = evaluate(small, tmp_path / "plugin", tmp_path / "out-small")
    limit = int(program[1] + ALLOWED)
    peaks = evaluate(large, tmp_path / "plugin", tmp_path / "out-large", "--memory", f"{limit}B")
    assert (peaks - program < ALLOWED).all(), (peaks, program)


@pytest.mark.parametrize("kept", [0, 10**9])
@pytest.mark.parametrize("rows", [1, 150, 10**6])
def test_iterating_reads_in_blocks_what_an_index_reads_alone(tiny_split, monkeypatch, rows, kept):
    monkeypatch.setattr("oodd_eval.data.parts._ROWS", rows)
    monkeypatch.setattr("oodd_eval.data.parts._KEPT", kept)
    data = load_split(tiny_split).environment("cartpole")
    with contextlib.closing(data):
        for part in (data.train, data.twins, data.anomalous("iid")):
            one_by_one = [part[i] for i in range(len(part))]
            found = list(part)
            assert [x.transitions for x in found] == part.lengths.tolist()
            assert all(map(same, found, one_by_one))


# Trajectories in a temporary file


def trajectories(n=5):
    rng = np.random.default_rng(3)
    return [
        Trajectory(rng.normal(size=(t + 1, 3)), rng.normal(size=(t, 2))) for t in range(1, n + 1)
    ]


@pytest.fixture
def in_file():
    """Make trajectory files that are closed in the end."""
    with contextlib.ExitStack() as stack:
        yield lambda given: stack.enter_context(contextlib.closing(TrajectoryFile(given)))


def same(one, two):
    return np.array_equal(one.observations, two.observations) and np.array_equal(
        one.actions, two.actions
    )


def test_a_trajectory_file_is_the_sequence_that_it_was_made_from(in_file):
    episodes = [*trajectories(), Trajectory([[1.0, 2.0, 3.0]], np.zeros((0, 2)))]
    file = in_file(iter(episodes))
    assert len(file) == 6
    assert all(map(same, file, episodes))
    assert all(map(same, file[1:4:2], episodes[1:4:2]))
    assert all(map(same, reversed(file), reversed(episodes)))
    with pytest.raises(IndexError):
        file[6]
    assert list(in_file([])) == []
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(file.__getitem__, [i % 6 for i in range(400)]))
    assert all(same(read[i], episodes[i % 6]) for i in range(400))


def test_a_trajectory_file_that_was_cut_short_is_an_error(in_file):
    file = in_file(trajectories())
    file._file.truncate(10)
    with pytest.raises(TrajectoryError, match="cut short"):
        file[4]


# Writing in blocks


def test_a_dataset_in_blocks_is_the_same_file(tmp_path):
    train = make_group("hopper", range(9), 700)
    info = ENVIRONMENTS["hopper"]
    names = {"sensors": info.sensors, "actions": info.actions}
    whole = write_environment(tmp_path / "whole.h5", [("train", train)], "", **names)
    for parts in (1, 2, 50):
        blocks = {
            name: Blocks(array.shape, lambda a=array, n=parts: np.array_split(a, n))
            for name, array in train.items()
        }
        found = write_environment(tmp_path / "blocks.h5", [("train", blocks)], "", **names)
        assert found == whole | {"file": "blocks.h5"}
        assert (tmp_path / "blocks.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()
