"""Fetch a split: bring its files here, verify everything, then install it in one step.

Files on their way are in ``<home>/.fetch/<source>/``, where a fetch that was stopped goes on. They
are compared with the manifest, and the manifest with the digest that the caller expects, if any.
Names inside an archive are only compared, never used as paths.
"""

import contextlib
import functools
import hashlib
import http.client
import shutil
import stat
import tarfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple, Self
from urllib.parse import SplitResult, quote, urlsplit
from urllib.request import url2pathname

from oodd_eval._version import __version__
from oodd_eval.data.bounded import MANIFEST_BYTES
from oodd_eval.data.files import lies_in, lock, temporary_directory
from oodd_eval.data.layout import MANIFEST, read_manifest
from oodd_eval.data.split import SHIPPED, Split, data_home
from oodd_eval.errors import DigestError, OutputError, SplitError, SplitNotFoundError, UsageError

ARCHIVES: Final = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2", ".zip")
ARCHIVE_BYTES: Final = 2 * 10**10  # packed, and unpacked: the largest published split has a third
SPARE_BYTES: Final = 10**9  # of the disk, that stay free
MOST_MEMBERS: Final = 10_000  # of an archive: a tar file of 10 MB may have millions
_MIB: Final = 2**20

Progress = Callable[[str], None]
Source = Callable[[str, Path, int], None]
"""Writes a file of the split, by its plain name, to a path, refusing more than some bytes."""


class Fetched(NamedTuple):
    """An installed split; `already` is True if it was there before."""

    split: Split
    already: bool = False


def fetch(
    address: str,
    *,
    output: Path | None = None,
    digest: str | None = None,
    progress: Progress = lambda _file: None,
) -> Fetched:
    """Fetch a split and install it.

    Parameters
    ----------
    address
        A directory with the split's files, or a tar or zip archive of them: a path or a URL.
    output
        Directory of the split, by default its name below `data_home`.
    digest
        The split's digest; one with another digest is refused.
    progress
        Called with the name of each file when it is verified.

    Raises
    ------
    SplitError
        When something is missing or is not as the manifest says.
    UsageError
        When another split is in the way, or the address is none.
    OutputError
        When files cannot be written, or another process is fetching the same.
    """
    home = output.parent if output else data_home()
    staging = home / ".fetch" / hashlib.sha256(address.encode()).hexdigest()[:16]
    try:
        staging.mkdir(parents=True, exist_ok=True)
        with lock(staging, wait=False) as held:
            if not held:
                raise OutputError(f"another process is fetching the same into {str(home)!r}; wait")
            try:
                with _open_source(address, staging / "archive") as source:
                    fetched = _bring(source, staging, output, digest, progress, _parsed(address)[1])
                shutil.rmtree(staging, ignore_errors=True)
            finally:
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
    return fetched


def _bring(
    source: Source,
    staging: Path,
    output: Path | None,
    digest: str | None,
    progress: Progress,
    origin: Path,
) -> Fetched:
    (staging / MANIFEST).unlink(missing_ok=True)
    source(MANIFEST, staging / MANIFEST, MANIFEST_BYTES)
    manifest = read_manifest(staging)
    # Names in the manifest become names of files.
    name, environments = manifest["name"], manifest["environments"]
    if not name or not name.isprintable() or set(name) & set("/\\@: ") or name.startswith("."):
        raise SplitError(f"the manifest names the split {name!r}, which is no name")
    for environment, entry in environments.items():
        file, expected = entry["file"], f"{environment}.h5"
        if file != expected:
            raise SplitError(f"it names the file {file!r} for {environment}, expected {expected!r}")
    actual = manifest["digest"]
    if digest and actual != digest:
        raise DigestError(f"split {name!r} there has the digest {actual}, expected {digest}")
    target = output or data_home() / name
    if present := _installed(name, target, actual, by_name=output is None):
        return Fetched(present, already=True)
    if target.exists() and lies_in(origin, target):
        raise UsageError(
            f"{str(target)!r} is a damaged copy that would be replaced, with {str(origin)!r} in "
            "it: move that elsewhere, and fetch it there"
        )
    fresh = staging / actual
    fresh.mkdir(exist_ok=True)
    shutil.copy(staging / MANIFEST, fresh)
    for environment, entry in environments.items():
        if not (fresh / entry["file"]).exists():  # an earlier attempt has verified what is there
            _bring_file(source, fresh, environment, entry, staging)
        progress(entry["file"])
    if target.exists():  # a damaged copy
        shutil.rmtree(staging / "replaced", ignore_errors=True)
        target.rename(staging / "replaced")
    fresh.rename(target)
    return Fetched(Split(target))


def _installed(name: str, target: Path, digest: str, *, by_name: bool) -> Split | None:
    """Return the split if it is installed already; raise `UsageError` if another one is."""
    shipped = Split(SHIPPED / name)
    if by_name and (shipped.path / MANIFEST).exists():
        if shipped.digest == digest:
            return shipped
        raise UsageError(
            f"split {name!r} comes with the package, and this is another one: choose an --output"
        )
    if not target.exists():
        return None
    present = Split(target)
    try:
        same = present.digest == digest
    except SplitError:
        same = False
    if not same:
        raise UsageError(
            f"{str(target)!r} exists and is not this split: remove it, or name another "
            "with --output"
        )
    with contextlib.suppress(SplitError):
        if all(check.ok for check in present.verify()):
            return present
    return None  # a damaged copy is replaced


def _bring_file(
    source: Source, fresh: Path, environment: str, entry: dict[str, Any], staging: Path
) -> None:
    """Fetch one file and verify it."""
    part = staging / f"{entry['file']}.part"
    # The most bytes that it may have, if nothing in it were compressed, with some to spare.
    sensors, actions = len(entry["sensors"]), len(entry["actions"])
    row = 4 * (sensors + actions + 1)
    trajectory = 4 * sensors + 6 * 8 + 4096
    sizes = [(g["transitions"], g["trajectories"]) for g in entry["groups"].values()]
    most = 2 * _MIB + sum(_MIB + row * steps + trajectory * n for steps, n in sizes)
    source(entry["file"], part, most)
    # What ends the check, or this process, leaves nothing that a later fetch would go on from.
    with temporary_directory(staging, "doubtful") as doubtful:
        shutil.copy(fresh / MANIFEST, doubtful)
        part.replace(doubtful / entry["file"])
        Split(doubtful).environment(environment).close()
        (doubtful / entry["file"]).replace(fresh / entry["file"])


@contextlib.contextmanager
def _open_source(address: str, archive: Path) -> Iterator[Source]:
    """Give the files at an address; an archive on the web is downloaded to `archive` first."""
    parts, path = _parsed(address)
    if parts.scheme in {"http", "https"}:
        if not parts.path.endswith(ARCHIVES):
            folder = address.rstrip("/")
            yield lambda name, target, most: _download(f"{folder}/{quote(name)}", target, most)
            return
        _download(address, archive, ARCHIVE_BYTES)
        path = archive
    elif "://" in address and parts.scheme != "file":
        raise UsageError(f"{address!r} cannot be fetched, expected http://, https:// or file://")
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
        raise SplitNotFoundError(
            f"there is nothing at {address}: expected a directory, file or URL"
        )


def _parsed(address: str) -> tuple[SplitResult, Path]:
    """Return the parts of an address, and its path if it is one of this machine."""
    try:
        parts = urlsplit(address)
    except ValueError as error:
        raise UsageError(
            f"{_plain(address)} is no address ({error}): expected such as "
            "https://example.org/split.tar"
        ) from None
    return parts, Path(url2pathname(parts.path)) if parts.scheme == "file" else Path(address)


def _copy_from(directory: Path, name: str, target: Path, most: int) -> None:
    file = directory / name
    if not file.is_file():
        raise SplitNotFoundError(f"{directory} holds no {name}")
    with file.open("rb") as content:
        _copy(content, target, most, str(file))


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
        except Exception as error:  # zipfile, tarfile and what unpacks raise many kinds for damage
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
            except (SplitError, OSError):
                raise
            except Exception as error:  # zipfile, tarfile and what unpacks raise many kinds
                raise SplitError(f"{path.name} is damaged at {name}: {error}") from error

        yield extract


class _TarInfo(tarfile.TarInfo):
    """A member whose extended header, which is read into memory, is no longer than 1 MiB."""

    @classmethod
    def frombuf(cls, *arguments: Any) -> Self:
        member = super().frombuf(*arguments)
        if not member.isreg() and member.size > _MIB:
            raise tarfile.HeaderError(f"a header of {member.size} bytes, limit {_MIB}")
        return member


def _members(file: str, archive: Any) -> dict[str, Callable[[], Any]]:
    """Return what opens the manifest and the files beside it; refuse an archive with tricks."""
    files: dict[PurePosixPath, Callable[[], Any]] = {}
    zipped, unpacked = isinstance(archive, zipfile.ZipFile), 0
    for number, item in enumerate(archive.infolist() if zipped else archive):
        if number == MOST_MEMBERS:
            raise SplitError(f"{file} holds more than {MOST_MEMBERS} files, expected one split")
        # To get behind a file in a tar archive takes unpacking it.
        unpacked += item.file_size if zipped else item.size
        if unpacked > ARCHIVE_BYTES:
            raise SplitError(f"{file} unpacks to more than {ARCHIVE_BYTES} bytes: refused")
        if item.is_dir() if zipped else item.isdir():
            continue
        name = item.filename if zipped else item.name
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\\" in name:
            raise SplitError(f"{file} holds a file with the path {name!r}: refused")
        kind = stat.S_IFMT(item.external_attr >> 16) if zipped else 0
        if kind not in (0, stat.S_IFREG) or not (zipped or item.isreg()):
            raise SplitError(f"{file} holds {name!r}, which is no plain file: refused")
        if path in files:
            raise SplitError(f"{file} holds {name!r} twice: refused")
        opener = archive.open if zipped else archive.extractfile
        files[path] = functools.partial(opener, item)
    folders = [path.parent for path in files if path.name == MANIFEST]
    if len(folders) != 1:
        raise SplitError(f"{file} holds {len(folders)} files named {MANIFEST}, expected one")
    return {path.name: opener for path, opener in files.items() if path.parent == folders[0]}


class _Redirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        old, new = urlsplit(req.full_url).scheme, urlsplit(newurl).scheme
        if new not in {old, "https"}:
            raise SplitError(f"{req.full_url} leads to {_plain(newurl)}, expected {old}: refused")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


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
        # It takes the place of the one that follows a redirect to any scheme.
        opener = urllib.request.build_opener(_Redirects)
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
        except OutputError:  # of this disk, not of the network
            raise
        except (OSError, http.client.HTTPException) as error:
            raise SplitError(f"{address} broke off ({_plain(error)}): {again}") from error
    got = target.stat().st_size
    if expected is not None and got < expected:
        raise SplitError(f"{address} broke off after {got} of {expected} bytes: {again}")


def _copy(content: Any, target: Path, most: int, name: str, *, have: int = 0) -> None:
    """Write behind the first bytes that `target` has, up to a number of bytes in all."""
    with target.open("ab" if have else "wb") as out:
        while block := content.read(_MIB):
            have += len(block)
            if have > most:
                target.unlink()
                raise SplitError(f"{name} has more than the {most} bytes that it may have: refused")
            if shutil.disk_usage(target.parent).free < len(block) + SPARE_BYTES:
                target.unlink()
                raise OutputError(f"{name} would leave less than {SPARE_BYTES} bytes of disk free")
            out.write(block)
