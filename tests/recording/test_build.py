"""Building: the same bytes however the work is divided, and no work lost to a killed process."""

import dataclasses
import platform
import subprocess

import numpy as np
import pytest
from threadpoolctl import threadpool_info

pytest.importorskip("gymnasium")
from oodd_recording import build
from oodd_recording.benchmark import FROZEN
from oodd_recording.build import Chunk, build_split, digest_of_bits, seed_of
from oodd_recording.closed_loop import TwinTooShortError, record_seed
from oodd_recording.policies import load_policy
from oodd_recording.train.freeze import freeze_policy

from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ENVIRONMENTS, SplitDefinition
from oodd_eval.data.split import load_split
from oodd_eval.errors import SimulationError, UnknownNameError, UsageError

SMALL = SplitDefinition("small", 4, 2, 2, 60, 950)
FEW = {"environments": ["cartpole"]}


def digest(directory):
    return load_split(directory).digest


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_split(SMALL, tmp_path_factory.mktemp("build") / "small", jobs=1, **FEW)


@pytest.fixture
def in_process(monkeypatch):
    """Record in this process, so that a test can replace what a worker calls."""

    def run(chunks, work, _jobs):
        for chunk in chunks:
            build.record_chunk(chunk, work)
            yield chunk

    monkeypatch.setattr(build, "_run", run)


def test_two_workers_and_smaller_chunks_give_the_same_bytes(built, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "CHUNK", {"train": 1, "calibration": 2, "test": 1})
    build_split(SMALL, tmp_path / "again", jobs=2, **FEW)
    assert digest(tmp_path / "again") == digest(built)
    # The work folder is gone; a complete split is kept, and no other recipe takes its place.
    assert sorted(p.name for p in built.iterdir()) == ["cartpole.h5", "manifest.json"]
    before = (built / "cartpole.h5").stat().st_mtime_ns
    reports = []
    build_split(SMALL, built, jobs=1, progress=lambda *a: reports.append(a), **FEW)
    assert reports == []
    with pytest.raises(UsageError, match="choose another name or remove it"):
        build_split(dataclasses.replace(SMALL, train=5), built, **FEW)
    assert (built / "cartpole.h5").stat().st_mtime_ns == before


def test_every_x86_processor_with_avx2_records_with_the_same_kernels():
    """In the worker, whose environment is set before NumPy is imported there."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("not a processor of x86")
    with build.workers(1) as pool:
        (library,) = pool.submit(threadpool_info).result()
    assert library["architecture"] in ("Haswell", "Zen"), library
    assert library["num_threads"] == 1


def test_a_built_split_holds_what_recording_gives(built):
    data = load_split(built).environment("cartpole")
    assert data.train.seeds.tolist() == [950_000_000 + i for i in range(4)]
    assert data.calibration.seeds.tolist() == [950_300_000, 950_300_001]
    assert data.twins.seeds.tolist() == [950_600_000, 950_600_001]
    gravity = Condition("gravity")
    episode = record_seed(
        "cartpole", 950_600_001, [gravity], policy=load_policy("cartpole"), episode_cap=60
    )[gravity]
    stored = data.anomalous("gravity")
    np.testing.assert_array_equal(stored[1].observations, episode.trajectory.observations)
    np.testing.assert_array_equal(stored[1].actions, episode.trajectory.actions)
    assert (stored.onsets[1], stored.redraws[1]) == (episode.onset, episode.redraws)
    assert stored.effects[1] == episode.effect
    assert data.sensors == ENVIRONMENTS["cartpole"].sensors
    assert stored.parameters[1] == episode.parameters
    assert stored.returns[1] == episode.rewards.sum()


BITS = 0x0123456789ABCDEF_FEDCBA9876543210
DRAWN = dataclasses.replace(SMALL, seed_base=0, drawn=digest_of_bits(BITS))


def test_drawn_bits_decide_all_episodes_and_are_nowhere_in_the_split(tmp_path):
    built = build_split(DRAWN, tmp_path / "drawn", bits=BITS, jobs=1, **FEW)
    split = load_split(built)
    assert all(check.ok for check in split.verify())
    assert split.manifest["definition"]["drawn"] == digest_of_bits(BITS)
    data = split.environment("cartpole")
    assert data.train.seeds.tolist() == [0, 1, 2, 3]
    assert data.twins.seeds.tolist() == data.anomalous("gravity").seeds.tolist()
    gravity = Condition("gravity")
    seed = seed_of(int(data.twins.seeds[1]), BITS)
    assert seed.bit_length() > 100
    options = {"policy": load_policy("cartpole"), "episode_cap": 60}
    episode = record_seed("cartpole", seed, [gravity], **options)[gravity]
    stored = data.anomalous("gravity")
    np.testing.assert_array_equal(stored[1].observations, episode.trajectory.observations)
    assert stored.parameters[1] == episode.parameters
    for file in built.iterdir():
        content = file.read_bytes()
        for secret in (BITS, seed):
            texts = (b"%d" % secret, b"%x" % secret, secret.to_bytes(16, "big"))
            assert not any(text in content or text[::-1] in content for text in texts)
    other = dataclasses.replace(DRAWN, drawn=digest_of_bits(BITS + 1))
    build_split(other, tmp_path / "other", bits=BITS + 1, jobs=1, **FEW)
    first = load_split(tmp_path / "other").environment("cartpole").train[0].observations
    assert not np.array_equal(first[0], data.train[0].observations[0])


def test_seeds_that_are_drawn_need_their_bits(tmp_path):
    for bits in (None, 1):
        with pytest.raises(UsageError, match="expected these bits"):
            build_split(DRAWN, tmp_path / "drawn", bits=bits, **FEW)
    with pytest.raises(UsageError, match=r"\(none\)"):
        build_split(SMALL, tmp_path / "small", bits=1, **FEW)
    numbers = [*range(50), *range(300_000, 300_050), *range(600_000, 600_050)]
    assert len({seed_of(number, BITS) for number in numbers}) == len(numbers)
    assert seed_of(7, BITS) == 0xC0BCBF75_1500C421_01149DB8_3C32A991
    assert seed_of(950_600_001, None) == 950_600_001


def test_a_damaged_file_is_built_again_and_what_others_keep_there_stays(built, tmp_path):
    expected = digest(built)
    with subprocess.Popen(["true"]) as gone:
        pass
    copy = tmp_path / "small"
    copy.mkdir()
    for file in built.iterdir():
        content = file.read_bytes()
        (copy / file.name).write_bytes(content[:-200] if file.suffix == ".h5" else content)
    stale = copy / f".cartpole.h5.{gone.pid}"
    foreign = [copy / "work" / "mine", copy / f".python3.{gone.pid}" / "bin"]
    for file in (stale, *foreign):
        file.parent.mkdir(exist_ok=True)
        file.write_text("x")
    build_split(SMALL, copy, jobs=1, **FEW)
    assert not stale.exists()
    assert all(file.exists() for file in foreign)
    assert digest(copy) == expected


def test_chunks_that_are_there_are_not_recorded_again(built, in_process, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "CHUNK", {"train": 1, "calibration": 1, "test": 1})

    def stop(done, *_):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_split(SMALL, tmp_path / "small", progress=stop, **FEW)
    finished = len(list((tmp_path / "small" / build.WORK).glob("*.npz")))
    assert finished >= 3
    reports = []
    build_split(SMALL, tmp_path / "small", progress=lambda *a: reports.append(a), **FEW)
    assert len(reports) == 8 - finished
    assert digest(tmp_path / "small") == digest(built)


def test_a_chunk_is_named_by_everything_its_content_depends_on(monkeypatch):
    chunk = Chunk("cartpole", "train", 7, 5, 60, 0.0, (), None, "a" * 64, "")
    changes = [
        {"environment": "ant"}, {"part": "test"}, {"first_seed": 8}, {"count": 6},
        {"episode_cap": None}, {"policy_digest": "b" * 64}, {"noise": 0.01}, {"bits": 1},
        {"conditions": (("iid@kept99", 0.1),)}, {"conditions": (("iid@kept99", 0.2),)},
    ]  # fmt: skip
    names = {dataclasses.replace(chunk, **change).file_name for change in [{}, *changes]}
    assert len(names) == 11
    assert dataclasses.replace(chunk, policy="elsewhere.npz").file_name == chunk.file_name
    monkeypatch.setattr(build, "GENERATOR_VERSION", 999)
    assert chunk.file_name not in names


def test_a_seed_with_a_short_twin_gives_way_to_the_next(in_process, tmp_path, monkeypatch):
    def record(environment, seed, anomalies, **options):
        if seed in {950_600_000, 950_600_002}:
            raise TwinTooShortError(str(seed))
        return record_seed(environment, seed, anomalies, **options)

    monkeypatch.setattr(build, "record_seed", record)
    split = load_split(build_split(SMALL, tmp_path / "small", **FEW))
    data = split.environment("cartpole")
    assert data.twins.seeds.tolist() == [950_600_001, 950_600_003]
    assert data.anomalous("iid").seeds.tolist() == [950_600_001, 950_600_003]


def test_a_policy_that_never_lasts_is_an_error(in_process, tmp_path):
    with np.load(FROZEN / "cartpole.npz") as stored:
        arrays = {k: stored[k] if k == "quantiles" else 0 * stored[k] for k in stored.files}
    freeze_policy("cartpole", arrays, {}, tmp_path)
    with pytest.raises(SimulationError, match="cartpole: of 20 test seeds only 0 had nominal"):
        build_split(
            SMALL, tmp_path / "small", policies={"cartpole": tmp_path / "cartpole.npz"}, **FEW
        )


def test_wrong_requests_fail_before_any_work(tmp_path):
    target = tmp_path / "none"
    with pytest.raises(UnknownNameError, match="did you mean 'hopper'"):
        build_split(SMALL, target, environments=["hoper"])
    for change, message in [
        ({"test": 0}, "test must have 1 to 200000"),
        ({"episode_cap": 59}, "cap must be at least 60, got 59"),
        ({"seed_base": -1}, "must not be negative"),
    ]:
        with pytest.raises(UsageError, match=message):
            build_split(dataclasses.replace(SMALL, **change), target, **FEW)
    assert not target.exists()
