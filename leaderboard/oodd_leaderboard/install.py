"""Packages of an entry, installed into a directory that only sandboxes mount.

pip runs as a child process. It takes wheels alone, so that nothing of a stranger runs: first it
tells which files it would install beside those of this environment, then it installs exactly these.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any, Final

from oodd_eval.data.bounded import open_plain
from oodd_eval.data.files import temporary_directory
from oodd_eval.errors import PluginError
from oodd_eval.plugins.discovery import printable
from oodd_eval.plugins.installed import normalized
from oodd_leaderboard.entry import ENTRY, Entry
from oodd_leaderboard.sandbox.metadata import check_packages, installed_versions

MOST_FILES: Final = 100_000
MOST_BYTES: Final = 8 * 10**9  # of all files; torch with its libraries has about five
SECONDS: Final = 1800.0  # for one call of pip
_MEMORY: Final = 4 * 10**9  # bytes of its addresses
_REQUIREMENT = re.compile(r"[A-Za-z0-9][\w.-]*(\[[\w., -]*\])? ?== ?[\w.!+]+", re.ASCII)


class InstallError(PluginError):
    """Packages of an entry that are not installed, with the reason."""


@dataclass(frozen=True, slots=True)
class _File:
    """A wheel that pip would install."""

    distribution: str
    version: str
    url: str
    sha256: str
    requires: Sequence[str]


def install(entry: Entry, directory: Path, target: Path) -> list[dict[str, str]]:
    """Install an entry's distribution and what it lacks here into a directory of their own.

    Parameters
    ----------
    entry
        What to install; nothing for a row that oodd-eval ships.
    directory
        That of the entries.
    target
        Where to; what is there is replaced once all is installed.

    Returns
    -------
    list of dict
        ``distribution``, ``version`` and ``sha256`` of every file that was installed.

    Raises
    ------
    InstallError
        It is no wheel, or another one than the entry declares; it would replace something that is
        installed here; it needs a file from a URL; it is too large; pip fails, or there is none.
    """
    if entry.shipped:
        return []
    if find_spec("pip") is None:
        raise InstallError(f"pip is not installed for {sys.executable}: python -m ensurepip")
    if not re.fullmatch("[0-9a-f]{64}", entry.sha256):
        raise InstallError(f"sha256 of the wheel is {entry.sha256!r:.80}, expected 64 hex digits")
    with temporary_directory(target.parent, target.name) as work:
        requirement = _requirement(entry, directory, work)
        _check_declared(entry, _files(work, "--no-deps", requirement))
        files = _files(work, requirement)
        _check_replaces_nothing(entry, files)
        lines = (f"{file.url} --hash=sha256:{file.sha256}\n" for file in files)
        (work / "files.txt").write_text("".join(lines))
        wheels = ("--no-deps", "--require-hashes", "--requirement", "files.txt")
        _pip(work, "download", *wheels, "--dest", "wheels")
        paths = sorted((work / "wheels").iterdir())
        _check_size(paths)
        _pip(work, "install", "--no-deps", "--no-index", "--no-compile", "--target", "installed",
             *map(str, paths))  # fmt: skip
        check_packages(work / "installed")
        if target.exists():
            target.rename(work / "replaced")
        (work / "installed").rename(target)
    return [
        {"distribution": f.distribution, "version": f.version, "sha256": f.sha256} for f in files
    ]


def _requirement(entry: Entry, directory: Path, work: Path) -> str:
    """Return what pip is asked for; a wheel is copied, compared with its digest and looked into."""
    if not entry.wheel:
        if not _REQUIREMENT.fullmatch(entry.requirement):
            raise InstallError(f"requirement {entry.requirement!r:.80}, expected NAME==VERSION")
        return entry.requirement
    if Path(entry.wheel).name != entry.wheel or not entry.wheel.endswith(".whl"):
        raise InstallError(f"wheel {entry.wheel!r:.80}, expected a file NAME.whl beside the entry")
    place = directory / entry.name
    path = (place if (place / ENTRY).is_file() else directory) / entry.wheel
    try:
        with open_plain(path) as file:
            if os.fstat(file.fileno()).st_size > MOST_BYTES:
                raise InstallError(f"wheel {entry.wheel} has more than {MOST_BYTES} bytes")
            copy = work / entry.wheel
            with copy.open("wb") as copied:
                shutil.copyfileobj(file, copied)
        with copy.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InstallError(f"wheel {str(path)!r} cannot be read: {error.strerror}") from None
    _check_digest(entry, digest)
    _check_size([copy])
    return str(copy)


def _files(work: Path, *arguments: str) -> list[_File]:
    """Return the files that pip would install beside what is installed here."""
    report = _pip(work, "install", "--dry-run", "--report", "-", *arguments)
    try:
        return [_file(item) for item in json.loads(report)["install"]]
    except (LookupError, TypeError, ValueError) as error:
        raise InstallError(f"pip's report has another form than expected: {error!r:.200}") from None


def _file(item: Mapping[str, Any]) -> _File:
    metadata, source = item["metadata"], item["download_info"]
    file = _File(
        metadata["name"],
        metadata["version"],
        source["url"],
        source["archive_info"]["hashes"]["sha256"],
        metadata.get("requires_dist", ()),
    )
    if not file.url.endswith(".whl") or not file.url.isprintable() or " " in file.url:
        raise ValueError(f"{file.url!r} is no wheel")
    return file


def _check_declared(entry: Entry, files: Sequence[_File]) -> None:
    """Raise `InstallError` where the entry's own file is not as declared, or needs one of a URL."""
    if not files:
        raise InstallError(f"{entry.distribution} is installed in this environment: uninstall it")
    (file,) = files
    if normalized(file.distribution) != entry.distribution:
        raise InstallError(f"it is {file.distribution}, expected {entry.distribution}")
    _check_digest(entry, file.sha256)
    # To learn what a source distribution needs, pip runs code of it. Indexes refuse such wheels.
    for requirement in file.requires:
        if "@" in requirement.partition(";")[0]:
            raise InstallError(f"it needs {requirement!r:.200}: expected names of an index alone")


def _check_digest(entry: Entry, digest: str) -> None:
    if digest != entry.sha256:
        raise InstallError(f"sha256 of the wheel is {digest}, the entry declares {entry.sha256}")


def _check_replaces_nothing(entry: Entry, files: Sequence[_File]) -> None:
    """Raise `InstallError` for a file of something that is installed here in another version."""
    installed = installed_versions()
    for file in files:
        if (held := installed.get(normalized(file.distribution))) is not None:
            raise InstallError(
                f"{file.distribution} {file.version} would replace {held}, which is installed "
                f"here: expected that {entry.distribution} works with that version"
            )


def _check_size(wheels: Sequence[Path]) -> None:
    """Raise `InstallError` for wheels that are too large, or have files outside their directory."""
    count = size = 0
    for path in wheels:
        try:
            with zipfile.ZipFile(path) as wheel:
                items = wheel.infolist()
        except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError) as error:
            raise InstallError(f"{path.name} is no wheel: {error}") from None
        for item in items:
            parts = PurePosixPath(item.filename).parts
            if {"..", "/"} & {*parts} or not item.filename.isprintable() or "\\" in item.filename:
                raise InstallError(f"{path.name} has a file {item.filename!r:.80}")
        count, size = count + len(items), size + sum(item.file_size for item in items)
        if count > MOST_FILES or size > MOST_BYTES:
            limits = f"at most {MOST_FILES} of {MOST_BYTES / 1e9:g} GB"
            raise InstallError(f"it has {count} files of {size / 1e9:g} GB, expected {limits}")


def _pip(work: Path, command: str, *arguments: str) -> str:
    """Return what a command of pip prints; `InstallError` with what it says when it fails."""
    call = [sys.executable, "-I", "-m", "pip", command, "--quiet", "--no-input"]
    call += ["--disable-pip-version-check", "--only-binary", ":all:", *arguments]
    if limits := shutil.which("prlimit"):
        call = [limits, f"--as={_MEMORY}", f"--fsize={MOST_BYTES}", *call]
    try:
        done = subprocess.run(  # noqa: S603  our own interpreter's pip; arguments are checked
            call, cwd=work, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8",
            errors="replace", timeout=SECONDS, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise InstallError(f"pip {command} is not done after {SECONDS:.0f} s") from None
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise InstallError(f"pip {command} failed: {printable(said)}")
    return done.stdout
