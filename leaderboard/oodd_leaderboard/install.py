"""Packages of an entry, installed into a directory that only sandboxes mount.

pip runs as a child process. It takes wheels alone, so that nothing of a stranger runs: first it
tells which files it would install beside those of this environment, then it installs exactly these.
"""

import hashlib
import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

from oodd_eval.data.bounded import read_bytes
from oodd_eval.data.files import temporary_directory
from oodd_eval.errors import PluginError
from oodd_eval.plugins.discovery import printable
from oodd_eval.plugins.installed import normalized
from oodd_leaderboard.entry import ENTRY, Entry
from oodd_leaderboard.sandbox.metadata import check_packages, installed_versions

MOST_WHEEL_BYTES: Final = 10**9  # of a wheel beside its entry
MOST_FILES: Final = 100_000
MOST_BYTES: Final = 8 * 10**9  # of all files; torch with its libraries has about five
SECONDS: Final = 1800.0  # for one call of pip
_REQUIREMENT = re.compile(r"[A-Za-z0-9][\w.-]*(\[[\w., -]*\])? ?== ?[\w.!+]+", re.ASCII)


class InstallError(PluginError):
    """Packages of an entry that are not installed, with the reason."""


class _File(NamedTuple):
    """A wheel that pip would install, and what it requires."""

    distribution: str
    version: str
    sha256: str
    url: str
    requires: list[str]


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
        It is no wheel, or another one than the entry declares; it is installed here, or would
        replace something that is; it needs a file from a URL; it is too large; pip fails, or there
        is none.
    PluginError
        Metadata that `check_packages` refuses.
    """
    if entry.shipped:
        return []
    if find_spec("pip") is None:
        raise InstallError(f"pip is missing: {sys.executable} -m ensurepip installs it")
    installed = installed_versions()
    if (held := installed.get(entry.distribution)) is not None:
        raise InstallError(
            f"{entry.distribution} {held} is installed here already: a season installs it by "
            f"itself, so run `pip uninstall {entry.distribution}` first"
        )
    with temporary_directory(target.parent, target.name) as work:
        requirement = _requirement(entry, directory, work)
        # To learn what a source distribution at a URL requires, pip would run code of it.
        for file in _files(work, "--no-deps", requirement):
            _check_digest(entry, file.sha256)
            if direct := [r for r in file.requires if "@" in r.partition(";")[0]]:
                raise InstallError(f"it requires {direct[0]!r:.200}, expected names of an index")
        files = _files(work, requirement)
        for file in files:
            if (held := installed.get(normalized(file.distribution))) is not None:
                raise InstallError(
                    f"{file.distribution} {file.version} would replace {held}, which is installed "
                    f"here: expected that {entry.distribution} works with that version"
                )
        hashed = (f"{file.url} --hash=sha256:{file.sha256}\n" for file in files)
        (work / "files.txt").write_text("".join(hashed))
        exactly = ("--no-deps", "--require-hashes", "--requirement", "files.txt")
        _pip(work, "download", *exactly, "--dest", "wheels")
        wheels = sorted((work / "wheels").iterdir())
        _check_content(wheels)
        options = ("--no-deps", "--no-index", "--no-compile", "--target", "packages")
        _pip(work, "install", *options, *map(str, wheels))
        check_packages(work / "packages")
        if target.exists():
            target.rename(work / "replaced")
        (work / "packages").rename(target)
    return [
        {"distribution": f.distribution, "version": f.version, "sha256": f.sha256} for f in files
    ]


def _requirement(entry: Entry, directory: Path, work: Path) -> str:
    """Return what pip is asked for; a wheel is copied, compared with its digest and looked into."""
    if not entry.wheel:
        if not _REQUIREMENT.fullmatch(entry.requirement):
            raise InstallError(f"requirement is {entry.requirement!r:.80}, expected NAME==VERSION")
        return entry.requirement
    if Path(entry.wheel).name != entry.wheel or not entry.wheel.endswith(".whl"):
        raise InstallError(f"wheel is {entry.wheel!r:.80}, expected a file NAME.whl")
    path, copy = beside(entry, directory) / entry.wheel, work / entry.wheel
    content = read_bytes(path, MOST_WHEEL_BYTES, InstallError)
    _check_digest(entry, hashlib.sha256(content).hexdigest())
    copy.write_bytes(content)
    _check_content([copy])
    return f"{copy.as_uri()}#sha256={entry.sha256}"


def beside(entry: Entry, directory: Path) -> Path:
    """Return the directory that an entry's file is in: that of the entries, or one in it."""
    inside = directory / entry.name
    return inside if (inside / ENTRY).is_file() else directory


def _check_digest(entry: Entry, digest: str) -> None:
    if digest != entry.sha256:
        raise InstallError(
            f"sha256 of the wheel is {digest}, the entry has {entry.sha256 or None}: write the "
            "digest of this wheel into the entry, or bring the wheel that has the entry's"
        )


def _check_content(wheels: Iterable[Path]) -> None:
    """Raise `InstallError` for wheels that are too large, or have files outside their directory."""
    count = size = 0
    for path in wheels:
        try:
            with zipfile.ZipFile(path) as wheel:
                items = wheel.infolist()
        except Exception as error:  # noqa: BLE001  zipfile raises many kinds for a strange archive
            raise InstallError(f"{path.name} is no wheel: {error}") from None
        for name in (item.filename for item in items):
            if {"..", "/"} & {*PurePosixPath(name).parts} or not name.isprintable() or "\\" in name:
                raise InstallError(f"{path.name} has a file {name!r:.80}, expected one inside")
        count, size = count + len(items), size + sum(item.file_size for item in items)
        if count > MOST_FILES or size > MOST_BYTES:
            most = f"at most {MOST_FILES} of {MOST_BYTES / 1e9:g} GB"
            raise InstallError(f"it has {count} files of {size / 1e9:g} GB, expected {most}")


def _files(work: Path, *arguments: str) -> list[_File]:
    """Return the files that pip would install beside what is installed here."""
    report, files = json.loads(_pip(work, "install", "--dry-run", "--report", "-", *arguments)), []
    for item in report["install"]:
        metadata, source = item["metadata"], item["download_info"]
        archive, url = source.get("archive_info", {}), source["url"]
        # Before version 23.1 pip told one digest, in another form.
        hashes = archive.get("hashes") or dict([archive.get("hash", "=").split("=", 1)])
        if not (digest := hashes.get("sha256")) or not re.fullmatch(r"[!-~]+\.whl", url):
            raise InstallError(f"{metadata['name']} comes from {url!r:.200}, expected a wheel")
        requires = metadata.get("requires_dist", [])
        files.append(_File(metadata["name"], metadata["version"], digest, url, requires))
    return files


def _pip(work: Path, command: str, *arguments: str) -> str:
    """Return what a command of pip prints; `InstallError` with what it says when it fails."""
    call = [sys.executable, "-I", "-m", "pip", command, "--quiet", "--no-input"]
    call += ["--disable-pip-version-check", "--only-binary", ":all:", *arguments]
    try:
        done = subprocess.run(  # noqa: S603  our own interpreter's pip; arguments are checked
            call, cwd=work, input=b"", capture_output=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise InstallError(f"pip {command} is not done after {SECONDS:g} s") from None
    if done.returncode:
        said = (
            " ".join(done.stderr.decode(errors="replace").split()) or f"exit code {done.returncode}"
        )
        raise InstallError(f"pip {command} failed: {printable(said)}")
    return done.stdout.decode(errors="replace")
