"""Open a frozen split, verify it, and iterate over its trajectories.

Names, onsets and parameters stay on this side; a detector is handed `Trajectory` objects only.
Trajectories are read from the file a few at a time, so that a split may be larger than memory.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, overload

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.data.layout import (
    TWINS,
    GroupCheck,
    check_layout,
    content_digest,
    environment_digest,
    read_manifest,
)
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import DigestError, SplitError, SplitNotFoundError, UnknownNameError

SHIPPED = Path(__file__).with_name("shipped")
"""Splits that come with the package: ``mini``."""

_ROWS: Final = 1 << 14
"""Transitions that are read at once from a file, unless a single trajectory has more."""


def data_home() -> Path:
    """Where built splits lie: ``$OODD_EVAL_DATA``, or the user's data directory."""
    if os.environ.get("OODD_EVAL_DATA"):
        return Path(os.environ["OODD_EVAL_DATA"])
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "oodd-eval" / "splits"


def split_directories() -> dict[str, Path]:
    """Return the splits on this machine: shipped ones first, then built ones."""
    found: dict[str, Path] = {}
    for home in (SHIPPED, data_home()):
        for manifest in sorted(home.glob("*/manifest.json")):
            found.setdefault(manifest.parent.name, manifest.parent)
    return found


def load_split(name: str | Path) -> Split:
    """Open a split by name or by the path of its directory.

    Nothing is read but the manifest; `Split.environment` verifies an environment's content.

    Raises
    ------
    UnknownNameError
        For a name that is neither published nor built here.
    SplitNotFoundError
        For a published split that is not on this machine, with the command that builds it.
    SplitError
        When the manifest is damaged.
    """
    path = Path(name)
    if (path / "manifest.json").is_file() and (isinstance(name, Path) or os.sep in str(name)):
        return Split(path)
    known = split_directories()
    if str(name) in known:
        return Split(known[str(name)])
    if isinstance(name, Path) or os.sep in str(name):
        raise SplitNotFoundError(f"{name} is no split: it has no manifest.json")
    if str(name) in SPLITS:
        raise SplitNotFoundError(
            f"split {str(name)!r} is not on this machine: build it with "
            f"`oodd-eval data build {name}`, or fetch a copy with `oodd-eval data fetch`"
        )
    raise UnknownNameError("split", str(name), {*known, *SPLITS})


class TrajectorySet(Sequence[Trajectory]):
    """The trajectories of one group, read when asked for.

    Attributes
    ----------
    lengths : int64 array of shape (n,)
        Transitions of each trajectory.
    seeds : int64 array of shape (n,)
        Environment seeds.
    """

    def __init__(self, file: h5py.File, group: str) -> None:
        self._data = file[group]
        self.group = group
        self._offsets: NDArray[np.int64] = self._data["offsets"][:]
        self.lengths: NDArray[np.int64] = np.diff(self._offsets)
        self.seeds: NDArray[np.int64] = self._data["seeds"][:]

    def __len__(self) -> int:
        return len(self.lengths)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory]: ...
    def __getitem__(self, index: int | slice) -> Trajectory | list[Trajectory]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = range(len(self))[index]
        return next(self._read(i, i + 1))

    def __iter__(self) -> Iterator[Trajectory]:
        # Several at a time: the file is unpacked in chunks that hold rows of many trajectories.
        start = 0
        while start < len(self):
            most = self._offsets[start] + max(self.lengths[start], _ROWS)
            stop = int(np.searchsorted(self._offsets, most, side="right")) - 1
            yield from self._read(start, stop)
            start = stop

    def _read(self, start: int, stop: int) -> Iterator[Trajectory]:
        """Yield the trajectories of a range, which are read at once."""
        first, last = int(self._offsets[start]), int(self._offsets[stop])
        rows = self._data["observations"][first + start : last + stop]
        actions = self._data["actions"][first:last]
        for i in range(start, stop):
            a, b = self._offsets[i : i + 2] - first
            yield Trajectory(rows[a + i - start : b + i - start + 1], actions[a:b])

    def rewards(self, index: int) -> NDArray[np.float32]:
        """Rewards of one trajectory, of shape (T,)."""
        i = range(len(self))[index]
        found: NDArray[np.float32] = self._data["rewards"][self._offsets[i] : self._offsets[i + 1]]
        return found

    @property
    def returns(self) -> NDArray[np.float64]:
        """Sum of rewards of each trajectory, of shape (n,)."""
        rewards = self._data["rewards"][:].astype(np.float64)
        return np.add.reduceat(rewards, self._offsets[:-1]) if len(self) else np.zeros(0)

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """Whether the simulator, not the cap, ended each episode."""
        return np.asarray(self._data["terminated"][:], dtype=bool)


class AnomalousSet(TrajectorySet):
    """Anomalous trajectories with what is known of them; index i is the twin of test seed i.

    Attributes
    ----------
    onsets, redraws : int64 arrays of shape (n,)
    parameters : list of n dicts
        What the anomaly drew for each trajectory.
    """

    def __init__(self, file: h5py.File, group: str) -> None:
        super().__init__(file, group)
        self.onsets: NDArray[np.int64] = self._data["onsets"][:]
        self.redraws: NDArray[np.int64] = self._data["redraws"][:]
        self.parameters: list[dict[str, Any]] = [json.loads(t) for t in self._data["parameters"][:]]


class EnvironmentData:
    """The verified content of one environment of a split."""

    def __init__(self, environment: str, file: h5py.File, digest: str) -> None:
        self.id, self.digest, self._file = environment, digest, file

    @functools.cached_property
    def train(self) -> TrajectorySet:
        """Nominal trajectories to fit on."""
        return TrajectorySet(self._file, "train")

    @functools.cached_property
    def calibration(self) -> TrajectorySet:
        """Nominal trajectories that standardize scores and calibrate alarms."""
        return TrajectorySet(self._file, "calibration")

    @functools.cached_property
    def twins(self) -> TrajectorySet:
        """Nominal test trajectories, one per test seed."""
        return TrajectorySet(self._file, TWINS)

    def anomalous(self, anomaly: str) -> AnomalousSet:
        """Anomalous test trajectories, in the order of their twins."""
        if anomaly not in ANOMALIES:
            raise UnknownNameError("anomaly", anomaly, ANOMALIES)
        if f"test/{anomaly}" not in self._file:
            raise SplitError(f"{Path(self._file.filename).name} has no group test/{anomaly}")
        return AnomalousSet(self._file, f"test/{anomaly}")

    @property
    def anomalies(self) -> tuple[str, ...]:
        """Names of the anomalies in this split."""
        return tuple(a for a in ANOMALIES if f"test/{a}" in self._file)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


@dataclass(frozen=True, slots=True)
class Split:
    """A frozen split: a directory with a manifest and one file per environment."""

    path: Path

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest, read and checked once per path and modification time."""
        file = self.path / "manifest.json"
        stamp = file.stat().st_mtime_ns if file.exists() else 0
        return _manifest(self.path, stamp)

    @property
    def name(self) -> str:
        """The split's name; with the start of its digest when it is not the published one."""
        name = str(self.manifest["name"])
        published = published_digests().get(name)
        if name not in SPLITS or published == self.digest:
            return name
        return f"{name}@{self.digest[:8]}"

    @property
    def digest(self) -> str:
        """SHA-256 over the content of all environments and the recipe."""
        return str(self.manifest["digest"])

    @property
    def environments(self) -> tuple[str, ...]:
        """Names of the environments, in the benchmark's order."""
        return tuple(e for e in ENVIRONMENTS if e in self.manifest["environments"])

    def environment(self, name: str) -> EnvironmentData:
        """Open one environment after verifying every group's digest.

        Raises
        ------
        UnknownNameError
            When the split has no such environment.
        SplitNotFoundError, SplitError, DigestError
            When the file is missing, damaged, or not what the manifest names.
        """
        if name not in self.environments:
            raise UnknownNameError(f"environment of split {self.name}", name, self.environments)
        file = self._open(name)
        try:
            bad = next((check for check in self._checks(name, file) if not check.ok), None)
        except BaseException:
            file.close()
            raise
        if bad is not None:
            file.close()
            raise DigestError(
                f"{bad.file}, group {bad.group}: content does not match the manifest: expected "
                f"{bad.expected}, found {bad.found}; the file was changed or damaged, build or "
                "fetch it again"
            )
        groups = self.manifest["environments"][name]["groups"]
        digest = environment_digest({g: str(f["sha256"]) for g, f in groups.items()})
        return EnvironmentData(name, file, digest)

    def verify(self) -> Iterator[GroupCheck]:
        """Yield what was found for every group of every environment; damaged files raise."""
        for name in self.environments:
            with self._open(name) as file:
                yield from self._checks(name, file)

    def _open(self, name: str) -> h5py.File:
        path = self.path / str(self.manifest["environments"][name]["file"])
        if path.parent != self.path:
            raise SplitError(f"the manifest names a file outside of the split: {path.name}")
        if not path.exists():
            raise SplitNotFoundError(f"{path} is missing: build or fetch the split again")
        try:
            return h5py.File(path, "r")
        except OSError as error:
            raise SplitError(
                f"{path.name} cannot be read, it is truncated or no HDF5 file ({error}): "
                "build or fetch it again"
            ) from error

    def _checks(self, name: str, file: h5py.File) -> Iterator[GroupCheck]:
        short = Path(file.filename).name
        for group, facts in self.manifest["environments"][name]["groups"].items():
            if group not in file:
                raise SplitError(f"{short} lacks the group {group}: build or fetch it again")
            try:
                check_layout(short, group, file[group])
                found = content_digest(file[group])
            except (OSError, KeyError, RuntimeError) as error:
                raise SplitError(
                    f"{short}, group {group} cannot be read ({error}): build or fetch it again"
                ) from error
            yield GroupCheck(short, group, str(facts["sha256"]), found)


@functools.lru_cache(maxsize=32)
def _manifest(path: Path, _stamp: int) -> dict[str, Any]:
    return read_manifest(path)


def published_digests() -> dict[str, str]:
    """Return the digests under which the published splits are known."""
    file = SHIPPED / "published.json"
    found: dict[str, str] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    return found
