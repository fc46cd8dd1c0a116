"""Build a split: all cores, resumable, the same bytes for any number of workers.

The unit of work is one chunk of consecutive seeds of one part; a finished chunk is an npz file in
a work folder beside the target, named by everything its content depends on. A killed build loses
the chunks in progress, at most one per worker. When all chunks of an environment are there, they
are joined into its HDF5 file; the work folder goes away when the split is complete.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import multiprocessing
import os
import platform
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, PART_OFFSETS, SplitDefinition
from oodd_eval.data.layout import (
    SCHEMA,
    TWINS,
    content_digest,
    environment_digest,
    pack_parameters,
    read_manifest,
    split_digest,
    write_environment,
    write_manifest,
)
from oodd_eval.data.simulate.joining import Joined
from oodd_eval.data.simulate.policies import load_policy
from oodd_eval.data.simulate.record import (
    GENERATOR_VERSION,
    Episode,
    TwinTooShortError,
    record_seed,
)
from oodd_eval.errors import SimulationError, UnknownNameError, UsageError

CHUNK: Final = {"train": 25, "calibration": 25, "test": 5}
"""Seeds per unit of work; a test seed is nine episodes."""

SEED_STRIDE: Final = 10**6

MOST_CANDIDATES: Final = 10
"""A test part looks at up to this many seeds per trajectory for twins that are long enough."""

Progress = Callable[[int, int, str], None]
"""Called with chunks done, chunks in all, and what was finished."""


@dataclasses.dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive seeds of one part of one environment."""

    environment: str
    part: str
    first_seed: int
    count: int
    episode_cap: int | None
    policy: str
    policy_digest: str

    @property
    def file_name(self) -> str:
        """Everything the content depends on, as a name."""
        text = repr((GENERATOR_VERSION, dataclasses.astuple(self)[:5], self.policy_digest))
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        return f"{self.environment}-{self.part}-{self.first_seed}-{key}.npz"


def build_split(
    definition: SplitDefinition,
    directory: Path,
    *,
    environments: Iterable[str] | None = None,
    policies: Mapping[str, Path] | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Build a split into a directory; resume what an earlier call left there.

    Parameters
    ----------
    definition
        Sizes, cap and seed base.
    directory
        Where manifest and files go. Environments that are complete and intact there
        are kept.
    environments
        Names; default all seven.
    policies
        Policy files instead of the frozen ones, by environment.
    jobs
        Worker processes; default one per core.
    progress
        Observer.

    Returns
    -------
    The directory.

    Raises
    ------
    UnknownNameError, PolicyError
        For unknown environments and missing policies, before any work.
    UsageError
        When the directory holds another split.
    """
    names = list(environments) if environments is not None else list(ENVIRONMENTS)
    for name in names:
        if name not in ENVIRONMENTS:
            raise UnknownNameError("environment", name, ENVIRONMENTS)
    names = [e for e in ENVIRONMENTS if e in names]
    _check_sizes(definition)
    paths = {e: str((policies or {}).get(e, "")) for e in names}
    digests = {e: load_policy(e, paths[e] or None).digest for e in names}
    entries = _kept(definition, directory, digests)
    work = directory / "work"
    work.mkdir(parents=True, exist_ok=True)
    todo = {e: _chunks(definition, e, paths[e], digests[e]) for e in names if e not in entries}
    report = progress or (lambda _done, _total, _what: None)
    while True:
        chunks = [c for planned in todo.values() for c in planned]
        missing = [c for c in chunks if not (work / c.file_name).exists()]
        done = len(chunks) - len(missing)
        for chunk in _run(missing, work, jobs or os.cpu_count() or 1):
            done += 1
            report(done, len(chunks), f"{chunk.environment} {chunk.part}")
        further = {e: _further(definition, planned, work) for e, planned in todo.items()}
        if not any(further.values()):
            break
        todo = {e: planned + further[e] for e, planned in todo.items()}
    for environment, chunks in todo.items():
        entries[environment] = _assemble(environment, chunks, work, directory, digests[environment])
    write_manifest(directory, _manifest(definition, entries))
    shutil.rmtree(work)
    return directory


def _check_sizes(definition: SplitDefinition) -> None:
    for part in PART_OFFSETS:
        size = getattr(definition, part)
        if not 1 <= size <= 200_000:
            raise UsageError(f"{part} must have 1 to 200000 trajectories, got {size}")
    if definition.episode_cap is not None and definition.episode_cap < 60:
        raise UsageError(f"the episode cap must be at least 60, got {definition.episode_cap}")
    if definition.seed_base < 0:
        raise UsageError(f"the seed base must not be negative, got {definition.seed_base}")


def _kept(
    definition: SplitDefinition, directory: Path, digests: Mapping[str, str]
) -> dict[str, Any]:
    """Return the manifest entries of environments that are already complete and current."""
    if not (directory / "manifest.json").exists():
        return {}
    manifest = read_manifest(directory)
    if manifest["definition"] != dataclasses.asdict(definition):
        raise UsageError(
            f"{directory} holds the split {manifest['definition']}, expected "
            f"{dataclasses.asdict(definition)}: choose another name or remove it"
        )
    current = manifest["generator"] == GENERATOR_VERSION
    return {
        e: entry
        for e, entry in manifest["environments"].items()
        if current
        and digests.get(e, entry["policy"]) == entry["policy"]
        and _intact(directory / entry["file"], entry["groups"])
    }


def _intact(file: Path, groups: Mapping[str, Mapping[str, Any]]) -> bool:
    """Return whether a file holds what its manifest names; a damaged one is built again."""
    try:
        with h5py.File(file, "r") as stored:
            return all(content_digest(stored[g]) == f["sha256"] for g, f in groups.items())
    except (OSError, KeyError, RuntimeError):
        return False


def _chunks(definition: SplitDefinition, environment: str, path: str, digest: str) -> list[Chunk]:
    chunks = []
    for part, offset in PART_OFFSETS.items():
        size = getattr(definition, part)
        first = definition.seed_base * SEED_STRIDE + offset
        for start in range(0, size, CHUNK[part]):
            count = min(CHUNK[part], size - start)
            cap = definition.episode_cap
            chunks.append(Chunk(environment, part, first + start, count, cap, path, digest))
    return chunks


def _further(definition: SplitDefinition, planned: list[Chunk], work: Path) -> list[Chunk]:
    """Return chunks of one further seed for each test seed whose twin was too short."""
    tests = [c for c in planned if c.part == "test"]
    looked_at = sum(c.count for c in tests)
    short = definition.test - sum(_recorded(work / c.file_name) for c in tests)
    if looked_at + short > MOST_CANDIDATES * definition.test:
        raise SimulationError(
            f"{tests[0].environment}: of {looked_at} test seeds only {definition.test - short} had "
            f"nominal episodes of at least 50 transitions, expected {definition.test}: the policy "
            "does not hold the environment long enough"
        )
    last = tests[-1]
    following = last.first_seed + last.count
    return [
        dataclasses.replace(last, first_seed=following + i, count=1) for i in range(short)
    ]  # fmt: skip


def _recorded(file: Path) -> int:
    with np.load(file, allow_pickle=False) as stored:
        return len(stored[f"{TWINS}:seeds"]) if stored.files else 0


def _run(chunks: list[Chunk], work: Path, jobs: int) -> Iterator[Chunk]:
    """Record chunks in worker processes, yielding each when its file is there."""
    if not chunks:
        return
    context = multiprocessing.get_context("spawn")
    with (
        _single_threaded_children(),
        ProcessPoolExecutor(jobs, mp_context=context, initializer=_watch_parent) as pool,
    ):
        running: dict[Future[None], Chunk] = {}
        queue = iter(chunks)
        try:
            while True:
                for chunk in queue:
                    running[pool.submit(record_chunk, chunk, work)] = chunk
                    if len(running) >= 2 * jobs:
                        break
                if not running:
                    return
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    chunk = running.pop(future)
                    future.result()
                    yield chunk
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Let child processes start with one thread per matrix library.

    Their threads would fight over the cores, and sums could depend on their number. The libraries
    look at the environment when they are loaded, which is before any code of ours runs in a child.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _watch_parent() -> None:
    """End this worker when the build is killed: it would wait for work forever."""
    parent = multiprocessing.parent_process()

    def wait_for_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def record_chunk(chunk: Chunk, work: Path) -> None:
    """Record the episodes of a chunk and store them under the chunk's name, all or nothing."""
    policy = load_policy(chunk.environment, chunk.policy or None)
    anomalies = list(ANOMALIES) if chunk.part == "test" else []
    recorded: list[dict[str | None, Episode]] = []
    for seed in range(chunk.first_seed, chunk.first_seed + chunk.count):
        # A test seed whose twin is too short gives way to a later one, see `_further`.
        with contextlib.suppress(TwinTooShortError):
            recorded.append(
                record_seed(
                    chunk.environment, seed, anomalies,
                    policy=policy, episode_cap=chunk.episode_cap,
                )
            )  # fmt: skip
    arrays: dict[str, NDArray[Any]] = {}
    for kind in [None, *anomalies] if recorded else []:
        group = chunk.part if chunk.part != "test" else f"test/{kind or 'nominal'}"
        for name, array in _stack([r[kind] for r in recorded]).items():
            arrays[f"{group}:{name}"] = array
    partial = work / f"{chunk.file_name}.{os.getpid()}.partial"
    with partial.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)
    partial.replace(work / chunk.file_name)


def _stack(episodes: list[Episode]) -> dict[str, NDArray[Any]]:
    lengths = [e.trajectory.transitions for e in episodes]
    found: dict[str, NDArray[Any]] = {
        "observations": np.concatenate([e.trajectory.observations for e in episodes]),
        "actions": np.concatenate([e.trajectory.actions for e in episodes]),
        "rewards": np.concatenate([e.rewards for e in episodes]),
        "lengths": np.array(lengths, dtype=np.int64),
        "seeds": np.array([e.seed for e in episodes], dtype=np.int64),
        "terminated": np.array([e.terminated for e in episodes], dtype=np.uint8),
    }
    if episodes[0].onset is not None:
        found["onsets"] = np.array([e.onset for e in episodes], dtype=np.int64)
        found["redraws"] = np.array([e.redraws for e in episodes], dtype=np.int64)
        found["parameters"] = pack_parameters([e.parameters for e in episodes])
    return found


def _assemble(
    environment: str, chunks: list[Chunk], work: Path, directory: Path, policy: str
) -> dict[str, Any]:
    file = f"{environment}.h5"
    files = {p: [work / c.file_name for c in chunks if c.part == p] for p in PART_OFFSETS}
    groups = write_environment(directory / file, Joined(files))
    digest = environment_digest({g: str(f["sha256"]) for g, f in groups.items()})
    return {"file": file, "policy": policy, "digest": digest, "groups": groups}


def _manifest(definition: SplitDefinition, entries: Mapping[str, Any]) -> dict[str, Any]:
    recipe = dataclasses.asdict(definition)
    ordered = {e: entries[e] for e in ENVIRONMENTS if e in entries}
    digests = {e: str(entry["digest"]) for e, entry in ordered.items()}
    return {
        "schema": SCHEMA,
        "name": definition.name,
        "definition": recipe,
        "generator": GENERATOR_VERSION,
        "environments": ordered,
        "digest": split_digest(digests, recipe),
        "versions": {
            name: version(name)
            for name in ("oodd-eval", "numpy", "gymnasium", "pybullet", "pybullet-envs-gymnasium")
        }
        | {"python": platform.python_version()},
    }
