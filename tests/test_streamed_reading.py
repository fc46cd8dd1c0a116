"""A split may be much larger than memory: it is built, verified, fitted on and scored in pieces."""

import contextlib
import dataclasses
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_plugins import install
from helpers_processes import environment
from helpers_split import make_group

from oodd_eval.data.facts import ANOMALIES, SplitDefinition
from oodd_eval.data.layout import (
    SCHEMA,
    TWINS,
    Blocks,
    environment_digest,
    split_digest,
    write_environment,
    write_manifest,
)
from oodd_eval.data.split import load_split
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.isolation.trajectory_file import Spool
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.runner import _as_they_finish

MEGABYTE = 10**6
ALLOWED = 32 * MEGABYTE
"""What reading may cost beside the program itself; it does cost about 18 MB."""

TRAJECTORIES, LENGTH = 425, 10_000


def large_training_part(dimension, action_dimension):
    """A training part ten times as large as what is allowed; one trajectory is held at a time."""
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.normal(size=(20, dimension)).astype("f4"), LENGTH // 20, axis=0)
    rows = np.concatenate([rows, rows[:1]])
    actions = np.zeros((LENGTH, action_dimension), "f4")
    steps = TRAJECTORIES * LENGTH
    arrays = {
        "observations": Blocks((steps + TRAJECTORIES, dimension), lambda: [rows] * TRAJECTORIES),
        "actions": Blocks((steps, action_dimension), lambda: [actions] * TRAJECTORIES),
        "rewards": Blocks((steps,), lambda: [actions[:, 0]] * TRAJECTORIES),
        "offsets": np.arange(TRAJECTORIES + 1) * LENGTH,
        "seeds": np.arange(TRAJECTORIES),
        "terminated": np.zeros(TRAJECTORIES, np.uint8),
    }
    return arrays, 4 * steps * (dimension + action_dimension + 1)


def write_split(directory, train):
    groups = {"train": train, "calibration": make_group("hopper", range(300, 304), 60)}
    groups[TWINS] = make_group("hopper", range(600, 603), 60)
    for anomaly in ANOMALIES:
        groups[f"test/{anomaly}"] = make_group("hopper", range(600, 603), 60, anomaly)
    directory.mkdir()
    facts = write_environment(directory / "hopper.h5", groups)
    recipe = dataclasses.asdict(SplitDefinition("large", TRAJECTORIES, 4, 3, None, 9))
    digest = environment_digest({g: f["sha256"] for g, f in facts.items()})
    entry = {"file": "hopper.h5", "policy": "", "digest": digest, "groups": facts}
    write_manifest(
        directory,
        {
            "schema": SCHEMA, "name": "large", "definition": recipe, "generator": 1,
            "environments": {"hopper": entry}, "versions": {},
            "digest": split_digest({"hopper": digest}, recipe),
        },
    )  # fmt: skip
    return directory


MEASURE = """
import sys
from oodd_eval.cli.main import main
from oodd_eval.plugins.isolation.worker import peak_rss_mb

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
    train, size = large_training_part(15, 3)
    assert size > 10 * ALLOWED
    small = write_split(tmp_path / "small", make_group("hopper", range(4), 60))
    large = write_split(tmp_path / "large", train)
    program = evaluate(small, tmp_path / "plugin", tmp_path / "out-small")
    limit = int(program[1] + ALLOWED)
    peaks = evaluate(large, tmp_path / "plugin", tmp_path / "out-large", "--memory", f"{limit}B")
    assert (peaks - program < ALLOWED).all(), (peaks, program)


@pytest.mark.parametrize("rows", [1, 60, 150, 10**6])
def test_iterating_reads_in_blocks_what_an_index_reads_alone(tiny_split, monkeypatch, rows):
    monkeypatch.setattr("oodd_eval.data.split._ROWS", rows)
    data = load_split(tiny_split).environment("cartpole")
    with contextlib.closing(data):
        for part in (data.train, data.twins, data.anomalous("iid")):
            one_by_one = [part[i] for i in range(len(part))]
            found = list(part)
            assert [x.transitions for x in found] == part.lengths.tolist()
            assert all(map(same, found, one_by_one))


def test_scores_of_a_few_units_are_in_memory_at_a_time():
    begun, taken, most = 0, 0, 0
    guard = threading.Lock()

    def score(_job):
        nonlocal begun, most
        with guard:
            begun += 1
            most = max(most, begun - taken)
        return object()

    executor = SimpleNamespace(jobs=2, stop=lambda: None, fit_of=lambda _job: "")
    jobs = [SimpleNamespace(offer=SimpleNamespace(plugin="x")) for _ in range(50)]
    for _ in _as_they_finish(jobs, score, executor):
        taken += 1
        time.sleep(0.002)
    assert taken == 50
    assert most <= 2 * executor.jobs + 1  # the one that the caller has in its hands


def test_jobs_go_on_while_the_caller_is_busy():
    executor = SimpleNamespace(jobs=1, stop=lambda: None, fit_of=lambda _job: "")
    jobs = [SimpleNamespace(offer=SimpleNamespace(plugin="x")) for _ in range(2)]
    second = threading.Event()

    def score(job):
        if job is jobs[1]:
            second.set()

    outcomes = _as_they_finish(jobs, score, executor)
    next(outcomes)
    assert second.wait(10)
    outcomes.close()


# The spool


def trajectories(n=5):
    rng = np.random.default_rng(3)
    return [
        Trajectory(rng.normal(size=(t + 1, 3)), rng.normal(size=(t, 2))) for t in range(1, n + 1)
    ]


@pytest.fixture
def spooled():
    """Make spools that are closed in the end."""
    with contextlib.ExitStack() as stack:
        yield lambda given: stack.enter_context(contextlib.closing(Spool(given)))


def same(one, two):
    return np.array_equal(one.observations, two.observations) and np.array_equal(
        one.actions, two.actions
    )


def test_a_spool_is_the_sequence_that_it_was_made_from(spooled):
    given = trajectories()
    spool = spooled(iter(given))
    assert len(spool) == 5
    assert all(map(same, spool, given))
    assert all(map(same, spool[1:4:2], given[1:4:2]))
    assert same(spool[-1], given[-1])
    assert all(map(same, reversed(spool), reversed(given)))
    with pytest.raises(IndexError):
        spool[5]


def test_an_empty_spool_is_empty(spooled):
    assert len(spooled([])) == 0
    assert list(spooled([])) == []


def test_a_trajectory_of_one_observation_comes_back(spooled):
    spool = spooled([Trajectory([[1.0, 2.0]], np.zeros((0, 1)))])
    assert spool[0].observations.tolist() == [[1.0, 2.0]]
    assert spool[0].actions.shape == (0, 1)


def test_threads_read_a_spool_at_the_same_time(spooled):
    given = trajectories(20)
    spool = spooled(given)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(spool.__getitem__, [i % 20 for i in range(400)]))
    assert all(same(found[i], given[i % 20]) for i in range(400))


def test_a_spool_that_was_cut_short_is_an_error(spooled):
    spool = spooled(trajectories())
    spool._file.truncate(10)
    with pytest.raises(TrajectoryError, match="cut short"):
        spool[4]


# Writing in blocks


def test_a_dataset_in_blocks_is_the_same_file(tmp_path):
    groups = {"train": make_group("hopper", range(9), 700)}
    whole = write_environment(tmp_path / "whole.h5", groups)
    for parts in (1, 2, 50):
        blocks = {
            name: Blocks(array.shape, lambda a=array, n=parts: np.array_split(a, n))
            for name, array in groups["train"].items()
        }
        assert write_environment(tmp_path / "blocks.h5", {"train": blocks}) == whole
        assert (tmp_path / "blocks.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_blocks_of_any_length_come_in_one_length():
    array = np.arange(20).reshape(10, 2)
    blocks = Blocks(array.shape, lambda: [array[:1], array[1:1], array[1:9], array[9:]])
    assert [len(block) for block in blocks.of_length(4)] == [4, 4, 2]
    assert np.concatenate(list(blocks.of_length(3))).tolist() == array.tolist()
    assert list(Blocks((0,), list).of_length(2)) == []
