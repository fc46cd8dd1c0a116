"""How a split lies on disk: one HDF5 file per environment, a manifest, content digests.

A file holds the groups ``train``, ``calibration``, ``test/nominal`` (the twins) and
``test/<anomaly>``. Each group stores its trajectories as ragged arrays: flat rows and offsets.
``offsets`` count transitions, so that trajectory i owns transitions ``offsets[i]:offsets[i+1]`` and
observation rows ``offsets[i]+i : offsets[i+1]+i+1``.

The digest of a group covers names, dtypes, shapes and little-endian bytes of its datasets, and
nothing of chunks or compression. No dataset holds objects: parameters are fixed-width UTF-8 bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.errors import SplitError

SCHEMA: Final = 1
"""Version of this layout."""

TWINS: Final = "test/nominal"

NOMINAL_DTYPES: Final = {
    "observations": "<f4",
    "actions": "<f4",
    "rewards": "<f4",
    "offsets": "<i8",
    "seeds": "<i8",
    "terminated": "|u1",
}
ANOMALOUS_DTYPES: Final = NOMINAL_DTYPES | {"onsets": "<i8", "redraws": "<i8", "parameters": "|S"}
"""Datasets of a group and their types; ``parameters`` are JSON texts of any width."""

_BLOCK: Final = 1 << 21
"""Bytes that are held at once while content is digested or written."""


@dataclass(frozen=True, slots=True)
class Blocks:
    """A dataset that comes in blocks of rows, because it may be larger than memory.

    Attributes
    ----------
    shape
        Of the whole.
    blocks
        Gives its rows from the first to the last, as arrays of any length.
    """

    shape: tuple[int, ...]
    blocks: Callable[[], Iterable[NDArray[Any]]]

    def of_length(self, rows: int) -> Iterator[NDArray[Any]]:
        """Yield the rows in blocks of one length; only the last may be shorter."""
        held: list[NDArray[Any]] = []
        for block in self.blocks():
            held.append(block)
            while sum(map(len, held)) >= rows:
                joined = np.concatenate(held)
                yield joined[:rows]
                held = [joined[rows:]]
        if sum(map(len, held)):
            yield np.concatenate(held)


Groups = Mapping[str, Mapping[str, NDArray[Any] | Blocks]]


@dataclass(frozen=True, slots=True)
class GroupCheck:
    """What verification found for one group of one file."""

    file: str
    group: str
    expected: str
    found: str

    @property
    def ok(self) -> bool:
        """Whether the content is what the manifest names."""
        return self.expected == self.found


def group_names(file: h5py.File) -> list[str]:
    """Return the trajectory groups of a file, in the benchmark's order."""
    names = ["train", "calibration", TWINS, *(f"test/{a}" for a in ANOMALIES)]
    return [name for name in names if name in file]


def dtypes_of(group: str) -> dict[str, str]:
    """Return names and dtypes of the datasets a group must have."""
    nominal = group in {"train", "calibration", TWINS}
    return dict(NOMINAL_DTYPES if nominal else ANOMALOUS_DTYPES)


def check_layout(file: str, name: str, group: h5py.Group) -> None:
    """Raise `SplitError` unless a group has the datasets, dtypes and lengths it must have."""
    where = f"{file}, group {name}"
    for dataset, dtype in dtypes_of(name).items():
        if dataset not in group:
            raise SplitError(f"{where} lacks the dataset {dataset!r}: build or fetch it again")
        found = group[dataset].dtype
        if found.hasobject or not found.str.startswith(dtype):
            raise SplitError(f"{where}, {dataset} has dtype {found.str}, expected {dtype}")
    offsets = group["offsets"][:]
    n = len(offsets) - 1
    if n < 0 or offsets[0] != 0 or (np.diff(offsets) < 1).any():
        raise SplitError(f"{where}: offsets must start at 0 and rise by at least 1 per trajectory")
    total = int(offsets[-1])
    lengths = {
        dataset: {"observations": total + n, "actions": total, "rewards": total, "offsets": n + 1}
        .get(dataset, n)
        for dataset in dtypes_of(name)
    }  # fmt: skip
    for dataset, expected in lengths.items():
        if len(group[dataset]) != expected:
            raise SplitError(
                f"{where}, {dataset} has {len(group[dataset])} rows, expected {expected} "
                f"for {n} trajectories with {total} transitions"
            )


def content_digest(group: Mapping[str, Any]) -> str:
    """SHA-256 of a group's content, read in blocks of bounded size.

    Parameters
    ----------
    group
        Datasets by name: HDF5 datasets or arrays.
    """
    sha = hashlib.sha256()
    for name in sorted(group):
        data = group[name]
        little = data.dtype.newbyteorder("<")
        sha.update(f"{name}|{little.str}|{data.shape}|".encode())
        for block in _blocks(data):
            plain = np.ascontiguousarray(block.astype(little, copy=False))
            sha.update(plain.reshape(-1).view(np.uint8).data)
    return sha.hexdigest()


def _blocks(data: Any) -> Iterator[NDArray[Any]]:
    """Yield all rows in blocks of whole chunks, so that each chunk is unpacked once."""
    row = max(1, int(np.prod(data.shape[1:], dtype=np.int64)) * data.dtype.itemsize)
    chunk = (getattr(data, "chunks", None) or (1,))[0]
    step = chunk * max(1, _BLOCK // (row * chunk))
    for start in range(0, len(data), step):
        yield np.asarray(data[start : start + step])


def environment_digest(groups: Mapping[str, str]) -> str:
    """Digest of an environment from the digests of its groups."""
    return canonical_digest(dict(groups))


def canonical_digest(value: Any) -> str:
    """SHA-256 of a JSON value with sorted keys and no white space."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def split_digest(environments: Mapping[str, str], definition: Mapping[str, Any]) -> str:
    """Digest of a split from those of its environments and its recipe."""
    return canonical_digest({"environments": dict(environments), "definition": dict(definition)})


def pack_parameters(parameters: list[dict[str, Any]]) -> NDArray[np.bytes_]:
    """Return parameters as fixed-width JSON texts, keys sorted."""
    texts = [json.dumps(p, sort_keys=True, separators=(",", ":")).encode() for p in parameters]
    return np.array(texts, dtype=f"S{max(map(len, texts), default=1)}")


def write_environment(path: Path, groups: Groups) -> dict[str, dict[str, Any]]:
    """Write the groups of one environment; return what the manifest says of each.

    The file appears under its name only when it is complete.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    facts: dict[str, dict[str, Any]] = {}
    with h5py.File(partial, "w", libver="v110") as file:
        file.attrs["schema"] = SCHEMA
        for name, arrays in groups.items():
            group = file.create_group(name)
            for dataset, dtype in dtypes_of(name).items():
                _write(group, dataset, arrays[dataset], dtype)
            check_layout(path.name, name, group)
            facts[name] = {
                "sha256": content_digest(group),
                "trajectories": len(group["seeds"]),
                "transitions": int(group["offsets"][-1]),
            }
    partial.replace(path)
    return facts


def _write(group: h5py.Group, name: str, content: NDArray[Any] | Blocks, dtype: str) -> None:
    if not isinstance(content, Blocks):
        array = np.asarray(content)
        # Texts keep their width.
        dtype = array.dtype.str if name == "parameters" else dtype
        content = Blocks(array.shape, lambda: [array])
    row = int(np.prod(content.shape[1:], dtype=np.int64)) * np.dtype(dtype).itemsize
    # Tiny datasets grow when compressed.
    packed = content.shape[0] * row > 512
    dataset = group.create_dataset(
        name, content.shape, dtype, track_times=False,
        **({"shuffle": True, "compression": "gzip", "compression_opts": 9} if packed else {}),
    )  # fmt: skip
    # Whole chunks, so that each is compressed once.
    step = dataset.chunks[0] if dataset.chunks else 1
    start = 0
    for block in content.of_length(step * max(1, _BLOCK // (row * step))):
        dataset[start : start + len(block)] = block.astype(dtype, copy=False)
        start += len(block)


def write_manifest(directory: Path, manifest: Mapping[str, Any]) -> None:
    """Write ``manifest.json``, replacing an older one only when complete."""
    partial = directory / "manifest.json.partial"
    partial.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    partial.replace(directory / "manifest.json")


def read_manifest(directory: Path) -> dict[str, Any]:
    """Read and check the manifest of a split directory.

    Raises
    ------
    SplitError
        When it cannot be read, has another schema, or lacks a field.
    """
    file = directory / "manifest.json"
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SplitError(f"{file} cannot be read as a split's manifest: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        found = manifest.get("schema") if isinstance(manifest, dict) else type(manifest).__name__
        raise SplitError(f"{file} has schema {found!r}, expected {SCHEMA}")
    missing = {"name", "definition", "generator", "environments", "digest"} - set(manifest)
    if missing:
        raise SplitError(f"{file} lacks {', '.join(sorted(missing))}")
    for field in ("environments", "definition"):
        if not isinstance(manifest[field], dict):
            found = type(manifest[field]).__name__
            raise SplitError(f"{file}: {field} must be an object, got {found}")
    digests = {
        e: environment_digest(_hashes(file, e, m)) for e, m in manifest["environments"].items()
    }
    expected = split_digest(digests, manifest["definition"])
    if manifest["digest"] != expected:
        raise SplitError(
            f"{file} names the digest {manifest['digest']}, but its entries make {expected}: "
            "it was edited; build or fetch the split again"
        )
    return manifest


def _hashes(file: Path, environment: str, entry: Any) -> dict[str, str]:
    try:
        return {name: str(facts["sha256"]) for name, facts in entry["groups"].items()}
    except (TypeError, KeyError, AttributeError) as error:
        raise SplitError(f"{file}: the entry of {environment} is incomplete ({error})") from None
