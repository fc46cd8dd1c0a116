"""Fetch a split: bring its files here, verify everything, then put it in its place in one step.

::

    <home>/.fetch/<source>/     files on their way; a fetch that was stopped goes on from here
    <home>/<name>/              the split, whole and verified

What arrives is compared with the manifest (names, sizes, digests of content), and the manifest with
the digest that the caller expects, if any.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit
from urllib.request import url2pathname

import h5py

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.layout import group_names, read_manifest
from oodd_eval.data.sources import (
    ARCHIVES,
    MANIFEST,
    ArchiveSource,
    DirectorySource,
    Source,
    WebSource,
    download,
)
from oodd_eval.data.split import SHIPPED, Split, data_home
from oodd_eval.errors import DigestError, OutputError, SplitError, SplitNotFoundError, UsageError

MOST_MANIFEST: Final = 10**7
MOST_ARCHIVE: Final = 10**12
_SPARE: Final = 2**20
"""Bytes of a file beside its data, and again as much as these for every group."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Fetched:
    """What came of a fetch: the split in its place, and whether it was there before."""

    split: Split
    already: bool = False


def fetch(
    place: str,
    *,
    output: Path | None = None,
    digest: str | None = None,
    progress: Progress = lambda _what: None,
) -> Fetched:
    """Fetch a split and install it where splits are found.

    Parameters
    ----------
    place
        A split's directory, an archive of one, or an address (http, https, file) of either.
    output
        Directory of the split; default its name below `oodd_eval.data.split.data_home`.
    digest
        The split's digest, if it is known; anything else is refused.
    progress
        Called with the name of each file when it is there and verified.

    Raises
    ------
    SplitNotFoundError
        When there is nothing at the place, or a file is missing there.
    SplitError
        When something is not as the manifest says.
    DigestError
        When content has another digest than the manifest says, or the manifest than `digest`.
    UsageError
        When another split is in the way.
    OutputError
        When the split cannot be written.
    """
    home = output.parent if output else data_home()
    staging = home / ".fetch" / hashlib.sha256(place.encode()).hexdigest()[:16]
    try:
        with _alone(staging):
            try:
                source = _source(place, staging)
                try:
                    found = _bring(source, staging, output, digest, progress)
                except SplitError:
                    # A whole archive with something wrong in it would be wrong again.
                    (staging / "archive").unlink(missing_ok=True)
                    raise
                finally:
                    source.close()
                shutil.rmtree(staging, ignore_errors=True)
            finally:
                _tidy(staging)
    except OSError as error:
        if isinstance(error, SplitError | OutputError):
            raise
        raise OutputError(f"{str(home)!r} cannot be written to: {error}") from error
    finally:
        with contextlib.suppress(OSError):
            staging.parent.rmdir()  # unless there is more on its way
    return found


def _tidy(staging: Path) -> None:
    """Remove a staging directory unless it holds work that a later fetch goes on from."""
    if not any(path.is_file() and path.name != MANIFEST for path in staging.rglob("*")):
        shutil.rmtree(staging, ignore_errors=True)


def _bring(
    source: Source, staging: Path, output: Path | None, digest: str | None, progress: Progress
) -> Fetched:
    fresh = staging / "split"
    fresh.mkdir(exist_ok=True)
    incoming = staging / MANIFEST
    incoming.unlink(missing_ok=True)
    source.fetch(MANIFEST, incoming, MOST_MANIFEST)
    incoming.replace(fresh / MANIFEST)
    manifest = read_manifest(fresh)
    _check(manifest)
    name = str(manifest["name"])
    if digest and manifest["digest"] != digest:
        raise DigestError(
            f"split {name!r} there has the digest {manifest['digest']}, expected {digest}"
        )
    target = output or data_home() / name
    if _is_there(name, target, str(manifest["digest"]), by_name=output is None):
        return Fetched(Split(target if target.exists() else SHIPPED / name), already=True)
    split = Split(fresh)
    for environment, entry in manifest["environments"].items():
        _bring_file(source, split, environment, entry, staging)
        progress(str(entry["file"]))
    files = {MANIFEST, *(str(e["file"]) for e in manifest["environments"].values())}
    for stray in (path for path in fresh.iterdir() if path.name not in files):
        stray.unlink()
    _replace(target, fresh, staging / "replaced")
    return Fetched(Split(target))


def _check(manifest: dict[str, Any]) -> None:
    """Raise `SplitError` unless names and numbers of a manifest can be trusted with a disk."""
    name = manifest["name"]
    if not isinstance(name, str) or not name.isprintable() or set(name) & set("/\\@: "):
        raise SplitError(f"the manifest names the split {name!r}, which is no name")
    if name.startswith(".") or not name:
        raise SplitError(f"the manifest names the split {name!r}, which is no name")
    for environment, entry in manifest["environments"].items():
        if environment not in ENVIRONMENTS:
            raise SplitError(f"the manifest has an unknown environment {environment!r}")
        if entry.get("file") != f"{environment}.h5":
            raise SplitError(
                f"the manifest names the file {entry.get('file')!r} for {environment}, expected "
                f"'{environment}.h5'"
            )
        for group, facts in entry["groups"].items():
            for fact in ("trajectories", "transitions"):
                if not isinstance(facts.get(fact), int) or not 0 < facts[fact] <= 10**10:
                    raise SplitError(
                        f"the manifest says {facts.get(fact)!r} {fact} for {environment}, {group}"
                    )


def _is_there(name: str, target: Path, digest: str, *, by_name: bool) -> bool:
    """Whether the split is in its place already; raise `UsageError` if another one is."""
    if by_name and (SHIPPED / name / MANIFEST).exists():
        if Split(SHIPPED / name).digest == digest:
            return True
        raise UsageError(
            f"split {name!r} comes with the package, and this is another one: name a directory "
            "with --output"
        )
    if not target.exists():
        return False
    try:
        there = Split(target)
        if there.digest == digest:
            return all(check.ok for check in there.verify())  # a damaged copy is replaced
    except SplitError:
        if read_digest(target) == digest:
            return False
    raise UsageError(
        f"{str(target)!r} exists and is not this split: remove it, or name another directory with "
        "--output"
    )


def read_digest(directory: Path) -> str | None:
    """Return the digest of the split in a directory; None where its manifest cannot be read."""
    try:
        return str(read_manifest(directory)["digest"])
    except SplitError:
        return None


def _bring_file(
    source: Source, split: Split, environment: str, entry: dict[str, Any], staging: Path
) -> None:
    """Fetch and verify one file; one that an earlier attempt has verified stays."""
    file = split.path / entry["file"]
    if file.exists():
        with contextlib.suppress(SplitError):
            _verify(split, environment, file, entry)
            return
        file.unlink()
    part = staging / f"{file.name}.part"
    source.fetch(file.name, part, _most(environment, entry))
    part.replace(file)
    try:
        _verify(split, environment, file, entry)
    except SplitError:
        file.unlink()
        raise


def _most(environment: str, entry: dict[str, Any]) -> int:
    """Return the bytes that a file may have, if nothing in it were compressed."""
    info = ENVIRONMENTS[environment]
    row = 4 * (info.observation_dim + info.action_dim + 1)
    per_trajectory = 4 * info.observation_dim + 5 * 8 + 4096
    return 2 * _SPARE + sum(
        _SPARE + row * int(facts["transitions"]) + per_trajectory * int(facts["trajectories"])
        for facts in entry["groups"].values()
    )


def _verify(split: Split, environment: str, file: Path, entry: dict[str, Any]) -> None:
    """Raise unless a file is whole in itself, and all in it is what the manifest says."""
    split.environment(environment).close()
    with h5py.File(file, "r") as stored:
        if elsewhere := stored.visititems_links(_leads_away) or stored.visititems(_is_outside):
            raise SplitError(f"{file.name} {elsewhere}: refused")
        groups = group_names(stored)
        if set(groups) != set(entry["groups"]):
            raise SplitError(
                f"{file.name} holds the groups {', '.join(groups)}, expected "
                f"{', '.join(entry['groups'])}"
            )
        for name, facts in entry["groups"].items():
            found = (len(stored[name]["seeds"]), int(stored[name]["offsets"][-1]))
            expected = (facts["trajectories"], facts["transitions"])
            if found != expected:
                raise SplitError(
                    f"{file.name}, {name} has {found[0]} trajectories with {found[1]} transitions, "
                    f"expected {expected[0]} with {expected[1]}"
                )


def _leads_away(name: str, link: object) -> str | None:
    return None if isinstance(link, h5py.HardLink) else f"holds {name}, which points elsewhere"


def _is_outside(name: str, item: h5py.Group | h5py.Dataset) -> str | None:
    outside = isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
    return f"keeps the content of {name} in another file" if outside else None


def _replace(target: Path, fresh: Path, aside: Path) -> None:
    """Put the verified split in its place; a damaged copy of it goes away."""
    if target.exists():
        shutil.rmtree(aside, ignore_errors=True)
        target.rename(aside)
    fresh.rename(target)


def _source(place: str, staging: Path) -> Source:
    """Return what gives the files at a place; an archive on the web is downloaded first."""
    parts = urlsplit(place)
    if parts.scheme in {"http", "https"}:
        if not parts.path.endswith(ARCHIVES):
            return WebSource(place)
        archive = staging / "archive"
        download(place, archive, MOST_ARCHIVE)
        try:
            return ArchiveSource(archive)
        except SplitError:
            archive.unlink(missing_ok=True)
            raise
    if parts.scheme == "file":
        path = Path(url2pathname(parts.path))
    elif "://" in place:
        raise UsageError(f"{place!r} cannot be fetched, expected http://, https:// or file://")
    else:
        path = Path(place)
    if path.is_dir():
        return DirectorySource(path)
    if path.is_file():
        return ArchiveSource(path)
    raise SplitNotFoundError(f"there is nothing at {place}: expected a directory, a file or a URL")


@contextlib.contextmanager
def _alone(staging: Path) -> Iterator[None]:
    """Let one process at a time fetch from a place."""
    staging.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(staging, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"another process is fetching the same into {str(staging.parent.parent)!r}: wait "
                "for it"
            ) from None
        yield
    finally:
        os.close(descriptor)
