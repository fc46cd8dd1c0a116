"""Fetch a split: bring its files here, verify everything, then put it in its place in one step.

Files on their way are in ``<home>/.fetch/<source>/``, where a fetch that was stopped goes on. They
are compared with the manifest, and the manifest with the digest that the caller expects, if any.
Names inside an archive are only compared, never used as paths.
"""

import contextlib
import functools
import hashlib
import http.client
import io
import lzma
import shutil
import stat
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple, Self
from urllib.parse import quote, urlsplit
from urllib.request import url2pathname

from oodd_eval._version import __version__
from oodd_eval.data.files import lock
from oodd_eval.data.layout import MANIFEST, MOST_MANIFEST, read_manifest
from oodd_eval.data.split import SHIPPED, Split, data_home
from oodd_eval.errors import DigestError, OutputError, SplitError, SplitNotFoundError, UsageError

ARCHIVES: Final = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2", ".zip")
MOST_ARCHIVE: Final = 10**12
MOST_MEMBERS: Final = 10_000  # of an archive: a tar file of 10 MB may have millions
PATIENCE: Final = 60.0
SLOWEST: Final = 4096
"""Seconds in which a download may be slow, and the bytes a second that it must have later."""
_MIB: Final = 2**20
_DAMAGED: Final = (
    EOFError,
    ValueError,
    OverflowError,
    RuntimeError,
    NotImplementedError,
    zlib.error,
    lzma.LZMAError,
    tarfile.TarError,
    zipfile.BadZipFile,
)

Progress = Callable[[str], None]
Source = Callable[[str, Path, int], None]
"""Writes a file of the split, by its plain name, to a path, refusing more than some bytes."""


class Fetched(NamedTuple):
    """A fetched split in its place; `already` is True if it was there before."""

    split: Split
    already: bool = False


def fetch(
    place: str,
    *,
    output: Path | None = None,
    digest: str | None = None,
    progress: Progress = lambda _file: None,
) -> Fetched:
    """Fetch a split and install it in `output`, by default its name below `data_home`.

    One with another digest than a given one is refused. `progress` is called with the name of each
    file when it is verified. `SplitError` when something is missing or not as the manifest says,
    `UsageError` when another split is in the way.
    """
    home = output.parent if output else data_home()
    staging = home / ".fetch" / hashlib.sha256(place.encode()).hexdigest()[:16]
    try:
        staging.mkdir(parents=True, exist_ok=True)
        with lock(staging, wait=False) as held:
            if not held:
                raise OutputError(f"another process is fetching the same into {str(home)!r}; wait")
            try:
                with _open_source(place, staging / "archive") as source:
                    found = _bring(source, staging, output, digest, progress)
                shutil.rmtree(staging, ignore_errors=True)
            finally:
                shutil.rmtree(staging / "doubtful", ignore_errors=True)
                # Files beside the manifest are work that a later fetch goes on from.
                if not any(p.is_file() and p.name != MANIFEST for p in staging.rglob("*")):
                    shutil.rmtree(staging, ignore_errors=True)
    except OSError as error:
        if isinstance(error, SplitError | OutputError):
            raise
        raise OutputError(f"{str(home)!r} cannot be written to: {error}") from error
    finally:
        with contextlib.suppress(OSError):
            staging.parent.rmdir()  # unless there is more on its way
    return found


def _bring(
    source: Source, staging: Path, output: Path | None, digest: str | None, progress: Progress
) -> Fetched:
    fresh, incoming = staging / "split", staging / MANIFEST
    fresh.mkdir(exist_ok=True)
    source(MANIFEST, incoming, MOST_MANIFEST)
    incoming.replace(fresh / MANIFEST)
    split, manifest = Split(fresh), read_manifest(fresh)
    # Names in the manifest become names of files.
    name, environments = manifest["name"], manifest["environments"]
    if not name or not name.isprintable() or set(name) & set("/\\@: ") or name.startswith("."):
        raise SplitError(f"the manifest names the split {name!r}, which is no name")
    for environment, entry in environments.items():
        file, expected = entry["file"], f"{environment}.h5"
        if file != expected:
            raise SplitError(f"it names the file {file!r} for {environment}, expected {expected!r}")
    if digest and manifest["digest"] != digest:
        raise DigestError(f"split {name!r} there has the digest {split.digest}, expected {digest}")
    target = output or data_home() / name
    if there := _installed(name, target, split.digest, by_name=output is None):
        return Fetched(there, already=True)
    for environment, entry in environments.items():
        _bring_file(source, split, environment, entry, staging)
        progress(entry["file"])
    files = {MANIFEST, *(entry["file"] for entry in environments.values())}
    for stray in (path for path in fresh.iterdir() if path.name not in files):
        stray.unlink()
    if target.exists():  # a damaged copy
        shutil.rmtree(staging / "replaced", ignore_errors=True)
        target.rename(staging / "replaced")
    fresh.rename(target)
    return Fetched(Split(target))


def _installed(name: str, target: Path, digest: str, *, by_name: bool) -> Split | None:
    """Return the split if it is in its place already; raise `UsageError` if another one is."""
    shipped = Split(SHIPPED / name)
    if by_name and (shipped.path / MANIFEST).exists():
        if shipped.digest == digest:
            return shipped
        raise UsageError(
            f"split {name!r} comes with the package, and this is another one: choose an --output"
        )
    if not target.exists():
        return None
    there = Split(target)
    with contextlib.suppress(SplitError):
        if there.digest == digest:
            with contextlib.suppress(SplitError):
                return there if all(check.ok for check in there.verify()) else None
            return None  # a damaged copy is replaced
    raise UsageError(
        f"{str(target)!r} exists and is not this split: remove it, or name another with --output"
    )


def _bring_file(
    source: Source, split: Split, environment: str, entry: dict[str, Any], staging: Path
) -> None:
    """Fetch and verify one file; one that an earlier attempt has verified stays."""
    file, part = split.path / entry["file"], staging / f"{entry['file']}.part"
    if file.exists():
        return
    # The most bytes that it may have, if nothing in it were compressed, with some to spare.
    sensors, actions = len(entry["sensors"]), len(entry["actions"])
    row = 4 * (sensors + actions + 1)
    trajectory = 4 * sensors + 6 * 8 + 4096
    sizes = [(g["transitions"], g["trajectories"]) for g in entry["groups"].values()]
    most = 2 * _MIB + sum(_MIB + row * steps + trajectory * n for steps, n in sizes)
    source(file.name, part, most)
    # What ends the check, or this process, leaves nothing that a later fetch would go on from.
    doubtful = staging / "doubtful"
    shutil.rmtree(doubtful, ignore_errors=True)
    doubtful.mkdir()
    shutil.copy(split.path / MANIFEST, doubtful)
    part.replace(doubtful / file.name)
    Split(doubtful).environment(environment).close()
    (doubtful / file.name).replace(file)


@contextlib.contextmanager
def _open_source(place: str, archive: Path) -> Iterator[Source]:
    """Give the files at a place; an archive on the web is downloaded to `archive` first."""
    try:
        parts = urlsplit(place)
    except ValueError as error:
        raise UsageError(
            f"{_plain(place)} is no address ({error}): expected such as "
            "https://example.org/split.tar"
        ) from None
    path = Path(url2pathname(parts.path)) if parts.scheme == "file" else Path(place)
    if parts.scheme in {"http", "https"}:
        address = place.rstrip("/")
        if not parts.path.endswith(ARCHIVES):
            yield lambda name, target, most: _download(f"{address}/{quote(name)}", target, most)
            return
        _download(place, archive, MOST_ARCHIVE)
        path = archive
    elif "://" in place and parts.scheme != "file":
        raise UsageError(f"{place!r} cannot be fetched, expected http://, https:// or file://")
    if path.is_dir():
        yield functools.partial(_copy_from, path)
    elif path.is_file():
        try:
            with _open_archive(path) as source:
                yield source
        except SplitError:
            # A whole download with something wrong in it would be wrong again.
            archive.unlink(missing_ok=True)
            raise
    else:
        raise SplitNotFoundError(f"there is nothing at {place}: expected a directory, file or URL")


def _copy_from(directory: Path, name: str, target: Path, most: int) -> None:
    try:
        with (directory / name).open("rb") as content:
            _copy(content, target, most, str(directory / name))
    except FileNotFoundError:
        raise SplitNotFoundError(f"{directory} holds no {name}") from None


@contextlib.contextmanager
def _open_archive(path: Path) -> Iterator[Source]:
    """Open a tar or zip archive that holds the files of one split, in its root or one folder."""
    with contextlib.ExitStack() as stack:
        try:
            tar = functools.partial(tarfile.open, tarinfo=_TarInfo)
            kind: Any = zipfile.ZipFile if zipfile.is_zipfile(path) else tar
            members = _members(path.name, stack.enter_context(kind(path)))
        except SplitError:
            raise
        except (OSError, *_DAMAGED) as error:
            # tarfile's longest message has a line for every kind that it has tried.
            why = (str(error) or type(error).__name__).splitlines()[0].rstrip(":")
            raise SplitError(
                f"{path.name} cannot be read as a tar or zip archive ({why}): fetch it again"
            ) from error

        def extract(name: str, target: Path, most: int) -> None:
            if name not in members:
                raise SplitNotFoundError(f"{path.name} holds no {name} beside its {MANIFEST}")
            try:
                with members[name]() as content:
                    _copy(content, target, most, f"{name} in {path.name}")
            except SplitError:
                raise
            except _DAMAGED as error:
                raise SplitError(f"{path.name} is damaged at {name}: {error}") from error

        yield extract


class _TarInfo(tarfile.TarInfo):
    """A member whose extended header, which is read into memory, is no longer than 1 MiB."""

    @classmethod
    def frombuf(cls, *given: Any) -> Self:
        found = super().frombuf(*given)
        if not found.isreg() and found.size > _MIB:
            raise tarfile.HeaderError(f"a header of {found.size} bytes, expected at most {_MIB}")
        return found


def _members(file: str, archive: Any) -> dict[str, Callable[[], Any]]:
    """Return what opens the manifest and the files beside it; refuse an archive with tricks."""
    found: list[tuple[PurePosixPath, Callable[[], Any]]] = []
    opened: Callable[[], Any]
    zipped = isinstance(archive, zipfile.ZipFile)
    for number, item in enumerate(archive.infolist() if zipped else archive):
        if number == MOST_MEMBERS:
            raise SplitError(f"{file} holds more than {MOST_MEMBERS} files, expected one split")
        if item.is_dir() if zipped else item.isdir():
            continue
        name = item.filename if zipped else item.name
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\\" in name:
            raise SplitError(f"{file} holds a file with the path {name!r}: refused")
        mode = stat.S_IFMT(item.external_attr >> 16) if zipped else 0
        if mode not in (0, stat.S_IFREG) or not (zipped or item.isreg()):
            raise SplitError(f"{file} holds {name!r}, which is no plain file: refused")
        opened = functools.partial(archive.open if zipped else archive.extractfile, item)
        found.append((path, opened))
    folders = [path.parent for path, _ in found if path.name == MANIFEST]
    if len(folders) != 1:
        raise SplitError(f"{file} holds {len(folders)} files named {MANIFEST}, expected one")
    members: dict[str, Callable[[], Any]] = {}
    for path, opened in found:
        if path.parent == folders[0]:
            if path.name in members:
                raise SplitError(f"{file} holds {str(path)!r} twice: refused")
            members[path.name] = opened
    return members


class _Redirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        old, new = urlsplit(req.full_url).scheme, urlsplit(newurl).scheme
        if new not in {old, "https"}:
            raise SplitError(f"{req.full_url} leads to {_plain(newurl)}, expected {old}: refused")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class _Watched(io.RawIOBase):
    """A server's answer as a raw stream; `TimeoutError` when it stays slower than `SLOWEST`."""

    def __init__(self, raw: Any) -> None:
        self._raw, self._since, self._bytes = raw, time.monotonic(), 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        got: int | None = self._raw.readinto(buffer)
        self._bytes += got or 0
        late = time.monotonic() - self._since - PATIENCE
        if late > 0 and self._bytes < late * SLOWEST:
            raise TimeoutError(f"it gives less than {SLOWEST} bytes a second")
        return got

    def close(self) -> None:
        self._raw.close()
        super().close()


class _Response(http.client.HTTPResponse):
    def __init__(self, sock: Any, *arguments: Any, **settings: Any) -> None:
        super().__init__(sock, *arguments, **settings)
        self.fp.close()
        self.fp = io.BufferedReader(_Watched(sock.makefile("rb", buffering=0)))


class _Watching(urllib.request.AbstractHTTPHandler):
    def do_open(self, http_class: Any, req: Any, **settings: Any) -> Any:
        def connect(*given: Any, **named: Any) -> Any:
            connection = http_class(*given, **named)
            connection.response_class = _Response
            return connection

        return super().do_open(connect, req, **settings)


class _Http(_Watching, urllib.request.HTTPHandler):
    pass


class _Https(_Watching, urllib.request.HTTPSHandler):
    pass


def _plain(text: object) -> str:
    """Return a stranger's text without what steers a terminal."""
    return "".join(c if c.isprintable() else "?" for c in str(text))[:300]


def _download(address: str, target: Path, most: int) -> None:
    """Download a file over http or https, continuing after the bytes that `target` has."""
    have = target.stat().st_size if target.exists() else 0
    again = "run the same command again, it goes on from there"
    headers = {"User-Agent": f"oodd-eval/{__version__}"}
    headers |= {"Range": f"bytes={have}-"} if have else {}
    request = urllib.request.Request(address, headers=headers)  # noqa: S310  http or https
    try:
        # Handlers given here take the place of those that follow a redirect to any scheme.
        opener = urllib.request.build_opener(_Redirects, _Http, _Https)
        response = opener.open(request, timeout=60)
    except urllib.error.HTTPError as error:
        error.close()
        if have and error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            return  # all of it is there
        kind = SplitNotFoundError if error.code in {404, 410} else SplitError
        raise kind(f"{address} answers {error.code} {_plain(error.reason)}") from None
    except SplitError:
        raise
    except (OSError, http.client.HTTPException, ValueError, OverflowError) as error:
        reason = _plain(getattr(error, "reason", error))
        raise SplitError(f"{_plain(address)} cannot be reached: {reason}") from error
    with response:
        if response.status != http.client.PARTIAL_CONTENT:
            have = 0
        length = response.headers.get("Content-Length")
        expected = have + int(length) if length and length.isdigit() else None
        try:
            _copy(response, target, most, address, have=have)
        except (OSError, http.client.HTTPException) as error:
            raise SplitError(f"{address} broke off ({_plain(error)}): {again}") from error
    got = target.stat().st_size
    if expected is not None and got < expected:
        raise SplitError(f"{address} broke off after {got} of {expected} bytes: {again}")


def _copy(content: Any, target: Path, most: int, what: str, *, have: int = 0) -> None:
    """Write behind the first bytes that `target` has, up to a number of bytes in all."""
    with target.open("ab" if have else "wb") as out:
        while block := content.read(_MIB):
            have += len(block)
            if have > most:
                target.unlink()
                raise SplitError(f"{what} has more than the {most} bytes that it may have: refused")
            out.write(block)
