"""Build a split: all cores, resumable, the same bytes for any number of workers.

Work is divided into chunks, consecutive seeds of one part. A finished chunk is an npz file in a
work folder, named by everything its content depends on: a killed build loses the chunks in
progress. The chunks of an environment are joined into its HDF5 file.
"""

import contextlib
import dataclasses
import functools
import hashlib
import multiprocessing
import os
import platform
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info

from oodd_eval.data import layout
from oodd_eval.data.condition import Condition, conditions_of, ladder_of
from oodd_eval.data.facts import ENVIRONMENTS, PART_OFFSETS, SplitDefinition, in_order
from oodd_eval.data.files import only_writer, remove_abandoned, replacing
from oodd_eval.data.layout import Blocks
from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS, EnvironmentData
from oodd_eval.data.registry import (
    Spec,
    anomaly_spec,
    environment_spec,
    long_name,
    register,
    registered,
)
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import MissingExtraError, SimulationError, SplitError, UsageError
from oodd_eval.names import check_known
from oodd_eval.scoring.cores import available_cores
from oodd_recording.closed_loop import (
    GENERATOR_VERSION,
    RecordedEpisode,
    TwinTooShortError,
    measure,
    record_seed,
)
from oodd_recording.policies import load_policy
from oodd_recording.registered import (
    MEASURED,
    Measured,
    code_digest,
    info_of,
    kinds_of,
    packages_of,
)
from oodd_recording.simulator import how_to_install
from oodd_recording.values import bound_of, unit_of

CHUNK: Final = {"train": 25, "calibration": 25, "test": 5}
"""Seeds of a chunk; a test seed is nine episodes, or hundreds."""
WORK: Final = ".building"  # the work folder, gone when the split is whole
MOST_CANDIDATES: Final = 10  # seeds looked at per test trajectory for twins that are long enough

PACKAGES: Final = ("oodd-eval", "numpy", "gymnasium")
"""Distributions whose versions a manifest has, besides those of the simulators."""

Progress = Callable[[int, int, str], object]
"""Called with chunks done, chunks in all, and the environment and part of the last one."""


@dataclasses.dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive seeds of one part of one environment."""

    environment: str
    part: str
    first_seed: int
    count: int
    episode_cap: int | None
    noise: float
    conditions: tuple[tuple[Condition, float | None], ...]
    bits: int | None
    policy_digest: str
    policy: str

    @property
    def numbers(self) -> range:
        """The numbers of its episodes, which are their seeds unless these are drawn."""
        return range(self.first_seed, self.first_seed + self.count)

    @property
    def file_name(self) -> str:
        """Everything the content depends on, as a name: the policy by its digest."""
        text = repr((GENERATOR_VERSION, dataclasses.astuple(self)[:-1]))
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        return f"{self.environment}-{self.part}-{self.first_seed}-{key}.npz"


def digest_of_bits(bits: int) -> str:
    """Return the SHA-256 of 128 bits, by which a split's definition names them."""
    return hashlib.sha256(bits.to_bytes(16, "big")).hexdigest()


def seed_of(number: int, bits: int | None) -> int:
    """Return the seed of an episode: its number, or 128 bits of its own made from drawn ones."""
    if bits is None:
        return number
    words = np.random.SeedSequence(bits, spawn_key=(number,)).generate_state(4).astype("<u4")
    return int.from_bytes(words.tobytes(), "little")


def build_split(
    definition: SplitDefinition,
    directory: Path,
    *,
    bits: int | None = None,
    environments: Iterable[str] | None = None,
    policies: Mapping[str, Path] | None = None,
    jobs: int | None = None,
    progress: Progress = lambda _done, _total, _what: None,
) -> Path:
    """Build a split into a directory and return the directory; resume an earlier build.

    Complete environments there are kept. By default there are all seven, with their own policies,
    and one worker process per core. `policies` are files of others, `bits` those of a definition
    whose seeds are drawn.
    `UsageError` for a wrong size, or another split in the directory.
    """
    names = in_order(ENVIRONMENTS if environments is None else environments, ENVIRONMENTS)
    for name in names:
        _check_sizes(definition.of(name))
    if definition.drawn != ("" if bits is None else digest_of_bits(bits)):
        raise UsageError(
            f"seeds of split {definition.name!r} come from bits with SHA-256 "
            f"{definition.drawn or '(none)'}: expected these bits"
        )
    for name in names:
        _check_strengths(definition, name)
    paths = {e: str((policies or {}).get(e, "")) for e in names}
    digests = {e: _acting(definition, e, paths[e]) for e in names}
    with only_writer(directory):
        entries = _kept(definition, directory, digests)
        work = directory / WORK
        work.mkdir(parents=True, exist_ok=True)
        remove_abandoned(work)
        todo = {
            e: _chunks(definition, e, paths[e], digests[e], bits) for e in names if e not in entries
        }
        versions = _versions(todo)
        further: dict[str, list[Chunk]] = todo
        while any(further.values()):
            chunks = [c for planned in todo.values() for c in planned]
            missing = [c for c in chunks if not (work / c.file_name).exists()]
            done = len(chunks) - len(missing)
            for chunk in _run(missing, work, jobs):
                done += 1
                progress(done, len(chunks), f"{chunk.environment} {chunk.part}")
            further = {e: _further(definition, planned, work) for e, planned in todo.items()}
            todo = {e: planned + further[e] for e, planned in todo.items()}
        for environment, chunks in todo.items():
            entries[environment] = _write(definition, chunks, work, directory)
        ordered = {e: entries[e] for e in in_order(entries, ENVIRONMENTS)}
        if len(ordered) > len(todo):  # an earlier call may have had other packages
            versions = layout.read_manifest(directory)["versions"] | versions
        layout.write_manifest(directory, definition, ordered, GENERATOR_VERSION, versions)
        shutil.rmtree(work)
    return directory


def _versions(environments: Iterable[str]) -> dict[str, str]:
    """Return the versions of what records some environments; none where there are none."""
    names = list(environments)
    packages = [*PACKAGES, *packages_of(names)] if names else []
    try:
        versions = {package: version(package) for package in packages}
    except PackageNotFoundError as error:
        needing = [e for e in names if error.name in packages_of([e])] or names
        extra = "bullet" if str(error.name).startswith("pybullet") else "sim"
        ours = set(needing) <= set(ENVIRONMENTS)
        raise MissingExtraError(
            f"{error.name} is not installed, which is to record {', '.join(needing)}: "
            f"{how_to_install(extra)}{'' if ours else ', or what the plug-in names in `packages`'}"
        ) from error
    return versions | ({"python": platform.python_version()} if names else {})


def _write(
    definition: SplitDefinition, chunks: Sequence[Chunk], work: Path, directory: Path
) -> dict[str, Any]:
    """Join the chunks of an environment into its file; return its manifest entry."""
    environment, policy = chunks[-1].environment, chunks[-1].policy_digest
    conditions = [condition for condition, _ in chunks[-1].conditions]
    info = info_of(environment)
    kinds = {c.anomaly: anomaly_spec(c.anomaly).group for c in conditions}
    specs = {"": environment_spec(environment)} | {kind: anomaly_spec(kind) for kind in kinds}
    plugins = {name: spec.plugin for name, spec in specs.items() if spec.plugin}
    files = {p: [work / c.file_name for c in chunks if c.part == p] for p in PART_OFFSETS}
    with contextlib.ExitStack() as stack:
        taken: dict[str, layout.Arrays] = {}
        if definition.base:
            base = stack.enter_context(_base(definition.base, environment, policy))
            taken = {part: base.arrays(part) for part in (TRAIN, CALIBRATION)}
        # A file may hold hundreds of parts: to open it for each of them takes minutes.
        held = {
            file: stack.enter_context(np.load(file, allow_pickle=False)) for file in files["test"]
        }
        groups = (
            (part, taken.get(part) or _joined(part, files[part.split("/")[0]], held))
            for part in (TRAIN, CALIBRATION, TWINS, *(c.part for c in conditions))
        )
        return layout.write_environment(
            directory / f"{environment}.h5",
            groups,
            policy,
            sensors=info.sensors,
            actions=info.actions,
            custom=layout.own_facts(
                environment, discrete=info.discrete, groups=kinds, sensors=info.sensors
            )
            | ({"plugins": plugins} if plugins else {}),
        ) | _strengths(definition, environment)


def _check_sizes(definition: SplitDefinition) -> None:
    for part in PART_OFFSETS:
        size = getattr(definition, part)
        if not 1 <= size <= 200_000:
            raise UsageError(f"{part} must have 1 to 200000 trajectories, got {size}")
    if definition.episode_cap is not None and definition.episode_cap < 60:
        raise UsageError(f"the episode cap must be at least 60, got {definition.episode_cap}")
    if not 0 <= definition.noise <= 1:
        raise UsageError(f"the noise must be 0 to 1 of the spread, got {definition.noise}")
    if definition.seed_base < 0:
        raise UsageError(f"the seed base must not be negative, got {definition.seed_base}")


def _check_strengths(definition: SplitDefinition, environment: str) -> None:
    """Raise `UsageError` for kinds that an environment cannot have, and beyond their bounds."""
    definition = definition.of(environment)
    calibrated = definition.suite == "ladder" and ladder_of(environment)
    if not definition.strengths and environment not in ENVIRONMENTS and not calibrated:
        raise UsageError(
            f"no strengths of anomalies are given for {environment!r}, an environment of one's own:"
            f" expected --strength KIND=NUMBER with one of {', '.join(kinds_of(environment))}, or "
            "--suite ladder where its plug-in has one"
        )
    for condition, strength in definition.strengths.items():
        kind = Condition.parse(condition).anomaly
        check_known(f"anomaly that {environment} can have", kinds_of(environment), kind)
        if not 0 <= strength <= bound_of(environment, kind):
            most, unit = bound_of(environment, kind), unit_of(environment, kind)
            raise UsageError(
                f"the strength of {kind} is {strength:g}, expected 0 to {most:g} in {environment} "
                f"(1 is: {unit})"
            )


def _acting(definition: SplitDefinition, environment: str, path: str) -> str:
    """Return the digest of what acts in an environment: policy, and code of one's own."""
    policy = load_policy(environment, path or None)
    measure(environment, policy)
    kinds = dict.fromkeys(c.anomaly for c in _conditions(definition, environment))
    code = code_digest(environment, kinds)
    return hashlib.sha256(f"{policy.digest} {code}".encode()).hexdigest() if code else policy.digest


def _kept(definition: SplitDefinition, directory: Path, digests: dict[str, str]) -> dict[str, Any]:
    """Return the manifest entries of environments that are already complete and current."""
    if not (directory / layout.MANIFEST).exists():
        return {}
    split = Split(directory)
    manifest, recipe, kept = split.manifest, definition.recipe, {}
    if manifest["definition"] != recipe:
        raise UsageError(
            f"{directory} holds the split {manifest['definition']}, expected {recipe}: "
            "choose another name or remove it"
        )
    kinds = {c.anomaly for e in digests for c in _conditions(definition, e)}
    for environment in split.environments:
        entry, same = manifest["environments"][environment], True
        held = kinds & layout.groups_of(entry).keys()
        specs: list[tuple[str, Spec]] = [(kind, anomaly_spec(kind)) for kind in held]
        if environment in digests:
            specs += [("", environment_spec(environment))]
            numbers = _strengths(definition, environment).get("strengths")
            same = numbers is None or entry.get("strengths", numbers) == numbers
            same = same and digests[environment] == entry["policy"]
        for kind, spec in specs:
            name = split.long_name(environment, kind)
            if "/" in name and long_name(spec) not in {name, spec.name}:
                raise UsageError(
                    f"{directory} holds {name}, and {long_name(spec)} has the same short name, by "
                    "which a split knows it: choose another name for the split"
                )
        if manifest["generator"] == GENERATOR_VERSION and same:
            with contextlib.suppress(SplitError):  # a damaged file is built again
                split.environment(environment).close()
                kept[environment] = entry
    return kept


def _conditions(definition: SplitDefinition, environment: str) -> dict[Condition, float | None]:
    """Return the strength of each condition to record; None stands for the values of Table 1."""
    definition = definition.of(environment)
    if definition.strengths:
        return {Condition.parse(name): number for name, number in definition.strengths.items()}
    return conditions_of(definition.suite, environment, definition.episode_cap)


def _strengths(definition: SplitDefinition, environment: str) -> dict[str, Any]:
    """Return the strength of each condition, and the unit of each kind, for the manifest."""
    conditions = _conditions(definition, environment)
    if None in conditions.values():  # the values of Table 1
        return {}
    units = {c.anomaly: unit_of(environment, c.anomaly) for c in conditions}
    numbers = {str(condition): number for condition, number in conditions.items()}
    return {"strengths": numbers, "units": units}


def _base(
    name: str, environment: str, policy: str
) -> contextlib.AbstractContextManager[EnvironmentData]:
    """Open the environment of the split whose training part is taken."""
    split = load_split(name)
    acted = split.manifest["environments"].get(environment, {}).get("policy", policy)
    if acted != policy:
        raise UsageError(
            f"split {name!r} has episodes of another policy of {environment}: expected the digest "
            f"{policy[:12]}, got {acted[:12]}; build on a split of the same policy"
        )
    return contextlib.closing(split.environment(environment))


def _chunks(
    definition: SplitDefinition, environment: str, path: str, digest: str, bits: int | None
) -> list[Chunk]:
    of, conditions = definition.of(environment), tuple(_conditions(definition, environment).items())

    def chunk(part: str, first: int, count: int) -> Chunk:
        recipe = of.episode_cap, of.noise, conditions if part == "test" else ()
        return Chunk(environment, part, first, count, *recipe, bits, digest, path)

    if definition.base:  # its test seeds have twins that are long enough
        with _base(definition.base, environment, digest) as base:
            return [chunk("test", int(seed), 1) for seed in base.twins.seeds]
    chunks = []
    for part, offset in PART_OFFSETS.items():
        first, size = definition.seed_base * 10**6 + offset, getattr(definition, part)
        starts = range(0, size, CHUNK[part])
        chunks += [chunk(part, first + i, min(CHUNK[part], size - i)) for i in starts]
    return chunks


def _further(definition: SplitDefinition, planned: list[Chunk], work: Path) -> list[Chunk]:
    """Return chunks of one further seed for each test seed whose twin was too short."""
    tests = [c for c in planned if c.part == "test"]
    looked_at = sum(c.count for c in tests)
    short = definition.test
    for chunk in tests:
        with np.load(work / chunk.file_name, allow_pickle=False) as stored:
            short -= len(stored[f"{TWINS}:seeds"]) if stored.files else 0
    if looked_at + short > MOST_CANDIDATES * definition.test:
        raise SimulationError(
            f"{tests[0].environment}: of {looked_at} test seeds only {definition.test - short} had "
            f"nominal episodes of 50 transitions, expected {definition.test}: train the policy more"
        )
    last = tests[-1]
    seeds = range(last.first_seed + last.count, last.first_seed + last.count + short)
    return [dataclasses.replace(last, first_seed=seed, count=1) for seed in seeds]


def _run(chunks: list[Chunk], work: Path, jobs: int | None) -> Iterator[Chunk]:
    """Record chunks in worker processes, yielding each when its file is there."""
    with workers(jobs) as pool:
        running = {pool.submit(record_chunk, chunk, work): chunk for chunk in chunks}
        for future in as_completed(running):
            future.result()
            yield running[future]


_AVX512: Final = {"SkylakeX", "Cooperlake", "SapphireRapids"}
"""Kernels of OpenBLAS for processors with AVX-512: rewards differ by them in their last bit."""


@contextlib.contextmanager
def workers(jobs: int | None) -> Iterator[ProcessPoolExecutor]:
    """Start worker processes for recording, by default one per core; they end with this one."""
    context, count = multiprocessing.get_context("spawn"), jobs or available_cores()
    # Sums depend on the number of threads of matrix libraries and on the registers that these use,
    # both of which they read when they load, before any code of ours runs in a child.
    alike = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    if any(library.get("architecture") in _AVX512 for library in threadpool_info()):
        alike["OPENBLAS_CORETYPE"] = "Haswell"  # AMD's processors with AVX2 have the same kernels.
    with (
        patch.dict(os.environ, alike),
        ProcessPoolExecutor(count, context, _begin, (registered(), dict(MEASURED))) as pool,
    ):
        try:
            yield pool
        except BaseException:  # an interrupt, too, does not wait for what is running now
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _begin(specs: Sequence[Spec], measured: Mapping[str, Measured]) -> None:
    """Make known what the build knows, and end this worker when the build is killed."""
    # It would wait for work forever.
    register(specs)
    MEASURED.update(measured)

    def wait_for_parent() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def record_chunk(chunk: Chunk, work: Path) -> None:
    """Record the episodes of a chunk and store them under the chunk's name, all or nothing."""
    policy = load_policy(chunk.environment, chunk.policy or None)
    conditions = dict(chunk.conditions)
    environment, cap = chunk.environment, chunk.episode_cap
    recorded: list[dict[Condition | None, RecordedEpisode]] = []
    for number in chunk.numbers:
        seed = seed_of(number, chunk.bits)
        # A test seed whose twin is too short gives way to a later one, see `_further`.
        with contextlib.suppress(TwinTooShortError):
            episodes = record_seed(
                environment, seed, conditions, policy=policy, episode_cap=cap, noise=chunk.noise
            )
            recorded.append({c: dataclasses.replace(e, seed=number) for c, e in episodes.items()})
    arrays: dict[str, NDArray[Any]] = {}
    for condition in [None, *conditions] if recorded else []:
        nominal = TWINS if chunk.part == "test" else chunk.part
        group = condition.part if condition else nominal
        for name, array in _stack([by_condition[condition] for by_condition in recorded]).items():
            arrays[f"{group}:{name}"] = array
    with replacing(work / chunk.file_name) as partial, partial.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)


def _stack(episodes: list[RecordedEpisode]) -> dict[str, NDArray[Any]]:
    """Return the datasets of a part as a chunk holds them: with lengths instead of offsets."""
    arrays: dict[str, NDArray[Any]] = {
        "observations": np.concatenate([e.trajectory.observations for e in episodes]),
        "actions": np.concatenate([e.trajectory.actions for e in episodes]),
        "rewards": np.concatenate([e.rewards for e in episodes]),
        "lengths": np.array([e.trajectory.transitions for e in episodes], dtype=np.int64),
        "seeds": np.array([e.seed for e in episodes], dtype=np.int64),
        "terminated": np.array([e.terminated for e in episodes], dtype=np.uint8),
    }
    if episodes[0].onset is not None:
        arrays["onsets"] = np.array([e.onset for e in episodes], dtype=np.int64)
        arrays["effects"] = np.array([e.effect for e in episodes], dtype=np.int64)
        arrays["redraws"] = np.array([e.redraws for e in episodes], dtype=np.int64)
        arrays["parameters"] = layout.pack_parameters([e.parameters for e in episodes])
    return arrays


def _joined(part: str, files: Sequence[Path], held: Mapping[Path, Any]) -> layout.Arrays:
    """Return a part from its chunks, `held` open or not; rows in blocks: they may exceed memory."""

    def stored(name: str) -> Iterator[NDArray[Any]]:
        for file in files:
            npz = held.get(file)
            with contextlib.nullcontext(npz) if npz else np.load(file, allow_pickle=False) as chunk:
                if f"{part}:{name}" in chunk:
                    yield chunk[f"{part}:{name}"]

    lengths = np.concatenate(list(stored("lengths")))
    total = int(lengths.sum())
    joined: dict[str, NDArray[Any] | Blocks] = {"offsets": np.append(0, np.cumsum(lengths))}
    rows = {"observations": total + len(lengths), "actions": total, "rewards": total}
    for name, count in rows.items():
        columns = next(stored(name)).shape[1:]
        joined[name] = Blocks((count, *columns), functools.partial(stored, name))
    for name in layout.dtypes_of(part).keys() - joined.keys():
        joined[name] = np.concatenate(list(stored(name)))
    return joined
