"""Layout of a split on disk: one HDF5 file per environment, a manifest, content digests.

A file holds one group per part, and the names and units of its columns in the group ``names``. A
part stores its trajectories as flat rows and offsets, counted in transitions: trajectory i owns
transitions ``offsets[i]:offsets[i+1]`` and observation rows ``offsets[i]+i : offsets[i+1]+i+1``. No
dataset holds objects: parameters, and names with units, are JSON in UTF-8 bytes.
The digest of a group covers names, dtypes, shapes and little-endian bytes of its datasets, and
nothing of chunks or compression.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import MANIFEST_BYTES, read_bytes
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    GROUPS,
    LICENCE,
    NAME_PATTERN,
    SPLITS,
    Group,
    LogFacts,
    Quantity,
    Role,
    SplitDefinition,
    roles_of,
)
from oodd_eval.data.files import Unfailing, replacing, write_text
from oodd_eval.data.parts import CALIBRATION, FAILURES, NAMES, NOMINAL, TRAIN, TWINS, conditions_in
from oodd_eval.errors import SplitError

SCHEMA: Final = 2
LOGS_SCHEMA: Final = 3
"""Of a manifest with facts of logs, which versions that know no others would misread."""
MANIFEST: Final = "manifest.json"

IMPORTED: Final = "imported"
"""Word that a manifest has in place of the recipe and of the policy's digest."""

NOMINAL_DTYPES: Final = {
    **dict.fromkeys(("observations", "actions", "rewards"), "<f4"),
    **dict.fromkeys(("offsets", "seeds"), "<i8"),
    "terminated": "|u1",
}
ANOMALOUS_DTYPES: Final = NOMINAL_DTYPES | {
    **dict.fromkeys(("onsets", "effects", "redraws"), "<i8"),
    "parameters": "|S",
}
UNPAIRED_DTYPES: Final = NOMINAL_DTYPES | {"names": "|S", "tasks": "|S"}
LABELLED_DTYPES: Final = UNPAIRED_DTYPES | {"interval_offsets": "<i8", "intervals": "<i8"}
"""Datasets of a group and their types; ``parameters`` are JSON texts of any width.

Without twins, episode i of an anomaly is anomalous in the rows [start, stop) that
``intervals[interval_offsets[i] : interval_offsets[i + 1]]`` name.
"""

_BLOCK: Final = 1 << 21  # bytes that are held at once while content is digested
_LONGEST: Final = 1 << 26  # bytes of one block where chunks are longer


@dataclasses.dataclass(frozen=True, slots=True)
class Blocks:
    """A dataset that may be larger than memory: `blocks` gives its rows in order."""

    shape: tuple[int, ...]
    blocks: Callable[[], Iterable[NDArray[Any]]]


Arrays = Mapping[str, NDArray[Any] | Blocks]


@dataclasses.dataclass(frozen=True, slots=True)
class GroupCheck:
    """The digests of one group of one file: the manifest's, and the content's."""

    file: str
    group: str
    expected: str
    actual: str

    @property
    def ok(self) -> bool:
        """True when the content is what the manifest names."""
        return self.expected == self.actual


def dtypes_of(group: str, *, paired: bool = True) -> dict[str, str]:
    """Return names and dtypes of the datasets a group must have."""
    if paired:
        return dict(NOMINAL_DTYPES if group in NOMINAL else ANOMALOUS_DTYPES)
    return dict(UNPAIRED_DTYPES if group in (*NOMINAL, FAILURES) else LABELLED_DTYPES)


def check_layout(file: str, name: str, group: Mapping[str, Any], *, paired: bool = True) -> None:
    """Raise `SplitError` unless a group has the datasets, dtypes and lengths it must have."""
    source, dtypes = f"{file}, group {name}", dtypes_of(name, paired=paired)
    if unknown := sorted({*group} - {*dtypes}):
        raise SplitError(f"{source} holds {unknown[0]!r}, expected {', '.join(dtypes)} alone")
    for dataset, dtype in dtypes.items():
        if dataset not in group:
            raise SplitError(f"{source} lacks the dataset {dataset!r}: build or fetch it again")
        actual, shape = group[dataset].dtype, group[dataset].shape
        if actual.hasobject or not actual.str.startswith(dtype):
            raise SplitError(f"{source}, {dataset} has dtype {actual.str}, expected {dtype}")
        dimensions = 2 if dataset in {"observations", "actions", "intervals"} else 1
        if len(shape) != dimensions:
            raise SplitError(f"{source}, {dataset} has shape {shape}, expected {dimensions} axes")
    offsets = group["offsets"][:]
    n = len(offsets) - 1
    # Differences of numbers from 0 on do not overflow.
    if n < 0 or offsets[0] != 0 or (offsets < 0).any() or (np.diff(offsets) < 1).any():
        raise SplitError(f"{source}: offsets must start at 0 and rise by at least 1 per trajectory")
    total = int(offsets[-1])
    lengths = dict.fromkeys(dtypes, n)
    lengths |= {"observations": total + n, "actions": total, "rewards": total, "offsets": n + 1}
    if "intervals" in lengths:
        lengths |= {"interval_offsets": n + 1, "intervals": len(group["intervals"])}
    for dataset, expected in lengths.items():
        if len(group[dataset]) != expected:
            raise SplitError(
                f"{source}, {dataset} has {len(group[dataset])} rows, expected {expected} "
                f"for {n} trajectories with {total} transitions"
            )
    if "intervals" in lengths:
        _check_intervals(source, group, np.diff(offsets) + 1)
    if "effects" in lengths:
        onsets, effects = group["onsets"][:], group["effects"][:]
        wrong = (onsets < 0) | (effects < onsets) | (effects > np.diff(offsets))
        for i in np.flatnonzero(wrong):
            raise SplitError(
                f"{source}: trajectory {i} has its onset at row {onsets[i]} and its effect at row "
                f"{effects[i]}, expected 0 <= onset <= effect <= {offsets[i + 1] - offsets[i]}, "
                "the last row"
            )


def _check_intervals(source: str, group: Mapping[str, Any], rows: NDArray[np.int64]) -> None:
    """Raise `SplitError` unless each episode has its intervals in order and inside its rows."""
    offsets, intervals = group["interval_offsets"][:], group["intervals"][:]
    if intervals.shape[1:] != (2,) or offsets[0] != 0 or offsets[-1] != len(intervals):
        raise SplitError(
            f"{source}: intervals have shape {intervals.shape} and offsets from {offsets[0]} to "
            f"{offsets[-1]}, expected (k, 2) and offsets from 0 to k"
        )
    if (np.diff(offsets) < 0).any():
        raise SplitError(f"{source}: offsets of intervals fall, expected them to rise")
    for i, (first, last) in enumerate(itertools.pairwise(offsets.tolist())):
        end = 0
        for start, stop in intervals[first:last].tolist():
            if not (max(start, 0) >= end and max(start, 0) < stop <= rows[i] and start >= -1):
                raise SplitError(
                    f"{source}: trajectory {i} is anomalous in rows [{start}, {stop}), expected "
                    f"intervals in order within its {rows[i]} rows, or a start of -1"
                )
            end = stop


def check_names(file: str, parts: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise `SplitError` unless a file names each column of its observations and actions."""
    for kind, columns in (("sensors", "observations"), ("actions", "actions")):
        if kind not in parts[NAMES]:
            raise SplitError(f"{file} lacks the names of its {kind}: build or fetch it again")
        names = parts[NAMES][kind]
        if names.dtype.kind != "S" or len(names.shape) != 1:
            raise SplitError(
                f"{file}, {NAMES}/{kind} has dtype {names.dtype.str} and shape {names.shape}, "
                "expected a column of |S"
            )
        for part in (part for part in parts if part != NAMES):
            shape = parts[part][columns].shape
            if shape[1:] != names.shape:
                raise SplitError(
                    f"{file}, group {part}: {columns} have shape {shape}, expected "
                    f"{len(names)} columns, since {NAMES} has as many {kind}"
                )


def content_digest(group: Mapping[str, Any]) -> str:
    """Return the SHA-256 of datasets by name, HDF5 or arrays, read in blocks of bounded size."""
    sha = hashlib.sha256()
    for name in sorted(group):
        data = group[name]
        little = data.dtype.newbyteorder("<")
        sha.update(f"{name}|{little.str}|{data.shape}|".encode())
        # In whole chunks, so that each is decompressed once, unless they are very long.
        row = max(1, int(np.prod(data.shape[1:], dtype=np.int64)) * data.dtype.itemsize)
        chunk = (getattr(data, "chunks", None) or (1,))[0]
        step = min(chunk * max(1, _BLOCK // (row * chunk)), max(1, _LONGEST // row))
        for start in range(0, len(data), step):
            block = np.asarray(data[start : start + step]).astype(little, copy=False)
            sha.update(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)
    return sha.hexdigest()


def environment_digest(entry: Mapping[str, Any]) -> str:
    """Return the digest of an environment from its manifest entry: that of all its groups.

    What is said of an environment or of anomalies of one's own counts, too.
    """
    digests = {name: group["sha256"] for name, group in entry["groups"].items()}
    custom = {key: entry[key] for key in ("own", "logs") if key in entry}
    return _canonical_digest(digests | {NAMES: names_digest(entry)} | custom)


def own_facts(
    environment: str,
    *,
    discrete: bool,
    groups: Mapping[str, Group],
    sensors: Sequence[Quantity] = (),
) -> dict[str, Any]:
    """Return what a manifest entry says of what is not among the benchmark's facts, if anything.

    `groups` are those of all anomalies in the environment's file, `sensors` its sensors, whose
    roles are no part of digests.
    """
    kinds = {kind: group for kind, group in groups.items() if kind not in ANOMALIES}
    if environment in ENVIRONMENTS and not kinds:
        return {}
    described = {"own": {"discrete": discrete, "anomalies": kinds}}
    roles = [] if environment in ENVIRONMENTS else [*roles_of(sensors)]
    return described | ({"roles": roles} if roles else {})


def roles_in(environment: str, entry: Mapping[str, Any]) -> tuple[Role, ...]:
    """Return the roles of an environment's sensors from its manifest entry, see `roles_of`.

    Of an environment of the benchmark they are those of its facts, where it has their sensors.
    Raises `SplitError` where there are not as many as sensors.
    """
    sensors = tuple(map(Quantity.read, entry["sensors"]))
    roles: tuple[Role, ...] = tuple(entry.get("roles", ()))
    if roles and len(roles) != len(sensors):
        raise SplitError(
            f"the manifest has {len(roles)} roles of {environment}'s sensors, expected "
            f"{len(sensors)}: build or import it again"
        )
    if not roles and environment in ENVIRONMENTS:
        facts = ENVIRONMENTS[environment].sensors
        roles = roles_of(facts) if [q.name for q in facts] == [q.name for q in sensors] else ()
    return roles or roles_of(sensors)


def discrete_actions(environment: str, entry: Mapping[str, Any]) -> bool:
    """Tell from a manifest entry whether an environment's actions are one-hot rows."""
    return bool(entry["own"]["discrete"] if "own" in entry else ENVIRONMENTS[environment].discrete)


def groups_of(entry: Mapping[str, Any]) -> dict[str, Group]:
    """Return the groups of the anomalies of a manifest entry, by kind."""
    custom = entry["own"]["anomalies"] if "own" in entry else {}
    kinds = (condition.anomaly for condition in conditions_in(entry["groups"]))
    return {kind: ANOMALIES[kind].group if kind in ANOMALIES else custom[kind] for kind in kinds}


def log_facts(entry: Mapping[str, Any]) -> LogFacts | None:
    """Return the facts of logs in a manifest entry; None for an environment of a simulator."""
    if "logs" not in entry:
        return LogFacts() if entry["policy"] == IMPORTED else None
    facts = entry["logs"] | {"offsets": tuple(entry["logs"]["offsets"])}
    return LogFacts(**facts)


def is_paired(entry: Mapping[str, Any]) -> bool:
    """Tell whether each anomalous episode of an environment has a nominal twin."""
    return "logs" not in entry or bool(entry["logs"]["paired"])


def names_digest(entry: Mapping[str, Any]) -> str:
    """Return the digest of an environment's group of names from its manifest entry."""
    return content_digest({kind: pack_parameters(entry[kind]) for kind in ("sensors", "actions")})


def split_digest(environments: Mapping[str, Any], definition: Mapping[str, Any]) -> str:
    """Return the digest of a split from its manifest's environments and recipe."""
    digests = {name: environment_digest(entry) for name, entry in environments.items()}
    return _canonical_digest({"environments": digests, "definition": dict(definition)})


def _canonical_digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def pack_parameters(parameters: Sequence[Mapping[str, Any]]) -> NDArray[np.bytes_]:
    """Return parameters as fixed-width JSON texts, keys sorted."""
    texts = [json.dumps(p, sort_keys=True, separators=(",", ":")).encode() for p in parameters]
    return np.array(texts, dtype=f"S{max(map(len, texts), default=1)}")


def write_environment(
    path: Path,
    groups: Iterable[tuple[str, Arrays]],
    policy: str,
    *,
    sensors: Sequence[Quantity],
    actions: Sequence[Quantity],
    custom: Mapping[str, Any] | None = None,
    logs: LogFacts | None = None,
    recordings: Mapping[str, Sequence[int]] | None = None,
) -> dict[str, Any]:
    """Write an environment's groups, one at a time, in one step; return its manifest entry.

    `custom` is what `own_facts` returns. `logs` are the facts of an imported environment, and
    `recordings` numbers of the recordings that its episodes are windows of, by part.
    """
    described = {"logs": dataclasses.asdict(logs)} if logs else {}
    paired = is_paired(described)
    names = {
        "sensors": [quantity.row for quantity in sensors],
        "actions": [quantity.row for quantity in actions],
    }
    entries: dict[str, dict[str, Any]] = {}
    with (
        replacing(path) as partial,
        Unfailing(partial) as disk,
        h5py.File(disk, "w", libver="v110") as file,
    ):
        file.attrs["schema"] = SCHEMA
        written = {NAMES: file.create_group(NAMES)}
        for kind, quantities in names.items():
            _write(written[NAMES], kind, pack_parameters(quantities), "|S")
        for name, arrays in groups:
            group = file.create_group(name)
            for dataset, dtype in dtypes_of(name, paired=paired).items():
                _write(group, dataset, arrays[dataset], dtype)
            written[name] = group
            check_layout(path.name, name, group, paired=paired)
            n, total = len(group["seeds"]), int(group["offsets"][-1])
            digest = content_digest(group)
            entries[name] = {"sha256": digest, "trajectories": n, "transitions": total}
        check_names(path.name, written)
    entry = {"groups": entries, **names, **(custom or {}), **described}
    # No part of the digest: it is of the episodes.
    texts = {part: packed_recordings(numbers) for part, numbers in (recordings or {}).items()}
    windows = {"recordings": texts} if texts else {}
    digest = environment_digest(entry)
    return {"file": path.name, "policy": policy, "digest": digest, **entry, **windows}


def packed_recordings(numbers: Iterable[int]) -> str:
    """Return the numbers of recordings, one an episode, as a manifest has them.

    >>> packed_recordings([0, 0, 0, 1, 0])
    '0x3 1x1 0x1'
    """
    runs = ((number, len([*run])) for number, run in itertools.groupby(numbers))
    return " ".join(f"{number}x{n}" for number, n in runs)


def recordings_of(entry: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return numbers of recordings, one an episode, by part; `SplitError` for other numbers."""
    recordings = {}
    for part, text in entry.get("recordings", {}).items():
        runs = [(number, int(n)) for number, n in (run.split("x") for run in text.split())]
        expected = entry["groups"][part]["trajectories"] if part in entry["groups"] else "no"
        if sum(n for _, n in runs) != expected:
            raise SplitError(
                f"{entry['file']}: the recordings of {part} are not those of {expected} episodes: "
                "import it again"
            )
        recordings[part] = tuple(number for number, n in runs for _ in range(n))
    return recordings


def _write(group: h5py.Group, name: str, content: NDArray[Any] | Blocks, dtype: str) -> None:
    if not isinstance(content, Blocks):
        array = np.asarray(content)
        dtype = array.dtype.str if dtype == "|S" else dtype  # texts keep their width
        content = Blocks(array.shape, lambda: [array])
    row = int(np.prod(content.shape[1:], dtype=np.int64)) * np.dtype(dtype).itemsize
    gzip = {"shuffle": True, "compression": "gzip", "compression_opts": 9}
    packing = gzip if content.shape[0] * row > 512 else {}  # tiny datasets grow
    dataset = group.create_dataset(name, content.shape, dtype, track_times=False, **packing)
    start = 0
    for block in content.blocks():
        dataset[start : start + len(block)] = block.astype(dtype, copy=False)
        start += len(block)


@functools.cache
def _manifest_schema() -> Any:
    # The core of pydantic: its models would take longer to import than a split to open.
    from pydantic_core import SchemaValidator, core_schema  # noqa: PLC0415  slow to import

    def record(**fields: core_schema.CoreSchema) -> core_schema.TypedDictSchema:
        typed = {name: core_schema.typed_dict_field(field) for name, field in fields.items()}
        return core_schema.typed_dict_schema(typed, extra_behavior="allow")

    # What is printed may not steer a terminal.
    text = core_schema.str_schema(pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$")
    by_name = core_schema.dict_schema
    name = core_schema.str_schema(pattern=f"^{NAME_PATTERN}$")
    parts = core_schema.str_schema(
        pattern=f"^(train|calibration|failures|test/{NAME_PATTERN}(@[a-z0-9.-]{{1,32}})?)$"
    )
    # Others trust these numbers with memory and disk.
    count = core_schema.int_schema(ge=0, le=10**10)
    group = record(sha256=text, trajectories=count, transitions=count)
    names = core_schema.list_schema(record(name=text, unit=text))
    kinds = by_name(name, core_schema.literal_schema([*GROUPS]))
    custom = record(discrete=core_schema.bool_schema(), anomalies=kinds)
    environment = record(
        file=text,
        policy=text,
        digest=text,
        groups=by_name(parts, group),
        sensors=names,
        actions=names,
    )
    strengths = by_name(text, core_schema.float_schema(ge=0, allow_inf_nan=False))
    units = by_name(text, text)
    number = core_schema.float_schema(allow_inf_nan=False)
    flag = core_schema.bool_schema()
    logs = record(
        paired=flag,
        clock=flag,
        baseline=count,
        rate=core_schema.nullable_schema(number),
        order=core_schema.literal_schema(["recorded", "shuffled"]),
        offsets=core_schema.list_schema(number),
        source=text,
        licence=text,
        citation=text,
    )
    logs["extra_behavior"] = "forbid"
    roles = core_schema.list_schema(core_schema.literal_schema([*get_args(Role)]))
    runs = core_schema.str_schema(pattern=r"^([0-9]{1,9}x[0-9]{1,9}( [0-9]{1,9}x[0-9]{1,9})*)?$")
    optional_fields = {
        "own": custom,
        "roles": roles,
        "strengths": strengths,
        "units": units,
        "logs": logs,
        "recordings": by_name(parts, runs),
        "ledger": core_schema.list_schema(text),  # what became of logs, a line each
        "plugins": by_name(text, text),  # by kind of anomaly, and the environment's under ""
    }
    for key, optional in optional_fields.items():
        environment["fields"][key] = core_schema.typed_dict_field(optional, required=False)
    schema = core_schema.literal_schema([SCHEMA, LOGS_SCHEMA])
    environments = by_name(name, environment)
    recipe = record()
    by_environment = by_name(name, record())
    for key, optional in (("strengths", strengths), ("by_environment", by_environment)):
        recipe["fields"][key] = core_schema.typed_dict_field(optional, required=False)
    named = {"name": text, "definition": recipe, "generator": core_schema.int_schema()}
    manifest = record(schema=schema, **named, environments=environments, digest=text)
    manifest["fields"]["licence"] = core_schema.typed_dict_field(text, required=False)
    return SchemaValidator(manifest, core_schema.CoreConfig(strict=True))


def part_sizes(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return numbers of trajectories, such as ``"40"`` or ``"12..40"`` of several environments."""
    counts = {}
    for name, group in (("train", TRAIN), ("calibration", CALIBRATION), ("test", TWINS)):
        parts = (entry["groups"].get(group) for entry in manifest["environments"].values())
        sizes = {part["trajectories"] if part else 0 for part in parts} or {0}
        counts[name] = "..".join(map(str, sorted({min(sizes), max(sizes)})))
    return counts


def write_manifest(
    directory: Path,
    definition: SplitDefinition | Mapping[str, Any],
    environments: Mapping[str, Any],
    generator: int,
    versions: Mapping[str, str],
) -> None:
    """Write ``manifest.json`` in one step from the entries of environments, in their order.

    A split that was not recorded has no definition, but a mapping with its name. That of
    a published split has the licence, which older ones lack, as it is no part of the digest.
    """
    recipe = definition.recipe if isinstance(definition, SplitDefinition) else dict(definition)
    imported = any("logs" in entry for entry in environments.values())
    published = definition in SPLITS.values()
    manifest = {
        "schema": LOGS_SCHEMA if imported else SCHEMA,
        "name": recipe["name"],
        "definition": recipe,
        "generator": generator,
        "environments": environments,
        "digest": split_digest(environments, recipe),
        **({"licence": LICENCE} if published else {}),
        "versions": versions,
    }
    write_text(directory / MANIFEST, json.dumps(manifest, indent=1) + "\n")


def read_manifest(directory: Path) -> dict[str, Any]:
    """Read a manifest; `SplitError` when it is unreadable, edited, or a field is not as it must."""
    from pydantic_core import ValidationError  # noqa: PLC0415  slow to import

    file = directory / MANIFEST
    try:
        content = read_bytes(file, MANIFEST_BYTES, SplitError)
        manifest: dict[str, Any] = _manifest_schema().validate_json(content)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        schema = next((p["input"] for p in problems if p["loc"] == ("schema",)), None)
        if isinstance(schema, int):
            raise SplitError(
                f"{file} is of a split with layout schema {schema}, expected {SCHEMA}: it was "
                "written by another version of oodd-eval; remove it, then build or fetch it again"
            ) from None
        problem = "; ".join(
            f"{'.'.join(map(str, p['loc'])) or 'content'}: {p['msg']}"
            + (f", got {p['input']!r}"[:100] if p["type"] != "missing" else "")
            for p in problems
        )
        raise SplitError(f"{file} is not a split's manifest: {problem}") from None
    for problem in _problems(manifest["environments"]):
        raise SplitError(f"{file} has {problem}: build, fetch or import it again")
    try:
        expected = split_digest(manifest["environments"], manifest["definition"])
    except (ValueError, RecursionError) as error:
        raise SplitError(
            f"{file} has no digest, as its entries are no plain JSON ({error}): "
            "build or fetch it again"
        ) from None
    if manifest["digest"] != expected:
        raise SplitError(
            f"{file} names the digest {manifest['digest']}, but its entries make {expected}: "
            "it was edited; build or fetch the split again"
        )
    return manifest


def _problems(environments: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is missing in the entries of environments."""
    for environment, entry in environments.items():
        if environment not in ENVIRONMENTS and "own" not in entry:
            yield f"an unknown environment {environment!r} without a description"
        for part in (part for part in NOMINAL if part not in entry["groups"]):
            yield f"no group {part!r} of {environment}"
        described = entry["own"]["anomalies"] if "own" in entry else {}
        kinds = {condition.anomaly for condition in conditions_in(entry["groups"])}
        for kind in sorted(kinds - {*ANOMALIES, *described}):
            yield f"an unknown anomaly {kind!r} in {environment} without a description"
