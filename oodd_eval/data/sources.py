"""Where a split can be fetched from: a directory, an archive, or an address on the web.

A source gives the bytes of files by their plain names. Names inside an archive are only compared,
never used as paths, so that nothing in it decides where something is written.
"""

from __future__ import annotations

import contextlib
import http.client
import stat
import tarfile
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Final, Protocol
from urllib.parse import quote, urlsplit

from oodd_eval._version import __version__
from oodd_eval.errors import SplitError, SplitNotFoundError

ARCHIVES: Final = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2", ".zip")
MANIFEST: Final = "manifest.json"
TIMEOUT: Final = 60.0
_BLOCK: Final = 1 << 20
_NO_ARCHIVE: Final = (tarfile.TarError, zipfile.BadZipFile)
_Entry = tuple[str, bool, zipfile.ZipInfo | tarfile.TarInfo]


class Source(Protocol):
    """Gives the files of one split."""

    def fetch(self, name: str, target: Path, most: int) -> None:
        """Write a file of the split to `target`; what is there of it already may be kept.

        Parameters
        ----------
        name
            ``manifest.json``, or a file that it names.
        target
            Where to.
        most
            Bytes that it may have: a longer one is refused before it fills the disk.

        Raises
        ------
        SplitNotFoundError, SplitError
            When there is no such file, or it cannot be read.
        """
        ...

    def close(self) -> None:
        """Let go of whatever is open."""
        ...


class DirectorySource:
    """A split's directory."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def fetch(self, name: str, target: Path, most: int) -> None:
        """Copy a file."""
        try:
            with (self._path / name).open("rb") as content:
                _copy(content, target, most, f"{self._path / name}")
        except FileNotFoundError:
            raise SplitNotFoundError(f"{self._path} holds no {name}") from None

    def close(self) -> None:
        """Do nothing: no file stays open."""


class ArchiveSource:
    """A tar or zip archive that holds the files of one split, in its root or one folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._members: dict[str, zipfile.ZipInfo | tarfile.TarInfo] = {}
        with contextlib.ExitStack() as stack:
            try:
                self._archive = _open_archive(path)
                stack.callback(self._archive.close)
                self._index()
            except (OSError, EOFError, zlib.error, *_NO_ARCHIVE) as error:
                if isinstance(error, SplitError):
                    raise
                # tarfile's longest message has a line for every kind that it has tried.
                why = (str(error) or type(error).__name__).splitlines()[0].rstrip(":")
                raise SplitError(
                    f"{path.name} cannot be read as a tar or zip archive ({why}): it is truncated "
                    "or something else, fetch it again"
                ) from error
            self._stack = stack.pop_all()

    def _index(self) -> None:
        """Find the manifest and what lies beside it."""
        entries = _entries(self._archive)
        for name, plain, _ in entries:
            path = PurePosixPath(name)
            if path.is_absolute() or ".." in path.parts or "\\" in name:
                raise SplitError(f"{self._path.name} holds a file with the path {name!r}: refused")
            if not plain:
                raise SplitError(
                    f"{self._path.name} holds {name!r}, which is no plain file: refused"
                )
        folders = [
            PurePosixPath(n).parent for n, *_ in entries if PurePosixPath(n).name == MANIFEST
        ]
        if len(folders) != 1:
            raise SplitError(
                f"{self._path.name} holds {len(folders)} files named {MANIFEST}, expected one: an "
                "archive has one split"
            )
        for name, _, member in entries:
            if PurePosixPath(name).parent == folders[0]:
                short = PurePosixPath(name).name
                if short in self._members:
                    raise SplitError(f"{self._path.name} holds {name!r} twice: refused")
                self._members[short] = member

    def fetch(self, name: str, target: Path, most: int) -> None:
        """Extract a file."""
        if name not in self._members:
            raise SplitNotFoundError(f"{self._path.name} holds no {name} beside its {MANIFEST}")
        try:
            with self._open(name) as content:
                _copy(content, target, most, f"{name} in {self._path.name}")
        except (EOFError, zlib.error, *_NO_ARCHIVE) as error:
            raise SplitError(f"{self._path.name} is damaged at {name}: {error}") from error

    def _open(self, name: str) -> IO[bytes]:
        member = self._members[name]
        if isinstance(self._archive, zipfile.ZipFile) and isinstance(member, zipfile.ZipInfo):
            return self._archive.open(member)
        content = None
        if isinstance(self._archive, tarfile.TarFile) and isinstance(member, tarfile.TarInfo):
            content = self._archive.extractfile(member)
        if content is None:
            raise SplitError(f"{self._path.name} holds {name!r}, which is no plain file: refused")
        return content

    def close(self) -> None:
        """Close the archive."""
        self._stack.close()


class WebSource:
    """A directory on a web server; a download that broke off goes on where it was."""

    def __init__(self, address: str) -> None:
        self._address = address.rstrip("/")

    def fetch(self, name: str, target: Path, most: int) -> None:
        """Download a file."""
        download(f"{self._address}/{quote(name)}", target, most)

    def close(self) -> None:
        """Do nothing: no connection stays open."""


def download(address: str, target: Path, most: int) -> None:
    """Download a file over http or https, going on where an earlier attempt broke off.

    Raises
    ------
    SplitNotFoundError
        When the server has no such file.
    SplitError
        When it cannot be reached, the file is too long, or the download breaks off.
    """
    if urlsplit(address).scheme not in {"http", "https"}:
        raise SplitError(f"{address!r} is no address that can be fetched, expected http or https")
    have = target.stat().st_size if target.exists() else 0
    with _response(address, have) as response:
        if response is None:
            return  # all of it is there
        if response.status != http.client.PARTIAL_CONTENT:
            target.unlink(missing_ok=True)
            have = 0
        length = response.headers.get("Content-Length")
        expected = have + int(length) if length and length.isdigit() else None
        try:
            _copy(response, target, most, address, have=have)
        except (OSError, http.client.HTTPException) as error:
            raise SplitError(
                f"{address} broke off ({error}): run the same command again, it goes on from there"
            ) from error
    got = target.stat().st_size
    if expected is not None and got < expected:
        raise SplitError(
            f"{address} broke off after {got} of {expected} bytes: run the same command again, it "
            "goes on from there"
        )


@contextlib.contextmanager
def _response(address: str, have: int) -> Iterator[http.client.HTTPResponse | None]:
    """Ask for a file from a byte on; None when there is nothing beyond it."""
    headers = {"User-Agent": f"oodd-eval/{__version__}"}
    if have:
        headers["Range"] = f"bytes={have}-"
    request = urllib.request.Request(address, headers=headers)  # noqa: S310  checked by the caller
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT)  # noqa: S310
    except urllib.error.HTTPError as error:
        error.close()
        if have and error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            yield None
            return
        kind = SplitNotFoundError if error.code in {404, 410} else SplitError
        raise kind(f"{address} answers {error.code} {error.reason}") from None
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise SplitError(f"{address} cannot be reached: {reason}") from error
    with response:
        yield response


def _open_archive(path: Path) -> zipfile.ZipFile | tarfile.TarFile:
    return zipfile.ZipFile(path) if zipfile.is_zipfile(path) else tarfile.open(path)


def _entries(archive: zipfile.ZipFile | tarfile.TarFile) -> list[_Entry]:
    """Return the files of an archive: name, whether it is a plain file, and what it is there."""
    if isinstance(archive, zipfile.ZipFile):
        return [(i.filename, _zip_file(i), i) for i in archive.infolist() if not i.is_dir()]
    return [(m.name, m.isreg(), m) for m in archive.getmembers() if not m.isdir()]


def _zip_file(entry: zipfile.ZipInfo) -> bool:
    kind = stat.S_IFMT(entry.external_attr >> 16)
    return kind in (0, stat.S_IFREG)


class _Readable(Protocol):
    def read(self, size: int, /) -> bytes: ...


def _copy(content: _Readable, target: Path, most: int, what: str, *, have: int = 0) -> None:
    """Append to what `target` has, up to a number of bytes in all."""
    with target.open("ab" if have else "wb") as out:
        while block := content.read(_BLOCK):
            have += len(block)
            if have > most:
                out.close()
                target.unlink()
                raise SplitError(
                    f"{what} has more than the {most} bytes that the split's sizes allow: refused"
                )
            out.write(block)
