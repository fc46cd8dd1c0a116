"""Files that are whole or absent: atomic replacement, a lock per directory, bounded compression."""

import contextlib
import glob
import gzip
import hashlib
import io
import lzma
import os
import re
import secrets
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Final

import psutil

from oodd_eval.data.bounded import read_bytes
from oodd_eval.errors import OutputError, ResultsError, UsageError

GZIP: Final = ".gz"
XZ: Final = ".xz"
PACKED: Final = (XZ, GZIP)
"""Endings of compressed files. New ones are by xz, which takes half of the room; both are read."""

COMPRESSED_FROM: Final = 10**5  # bytes; smaller files stay readable in a pull request
MAX_BYTES: Final = 64 * 10**6  # most bytes that a compressed file may decompress to
MAX_TEXT: Final = 2**30  # most bytes of a file of text
_MEMORY: Final = 128 * 2**20  # bytes that decompressing may need: twice what xz -9 asks for


UNFINISHED: Final = re.compile(r"\..+\.(\d{1,9})", re.ASCII)
"""Names of files and directories that are being written, ``.NAME.PID`` with the process."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path that is moved to `path` when the block ends without an error.

    What killed processes have left of the same file is removed.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent, path.name)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
    finally:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            temporary.unlink()


@contextlib.contextmanager
def temporary_directory(parent: Path | None = None, name: str = "oodd-eval") -> Iterator[Path]:
    """Give an empty directory, which is removed afterwards unless it was moved.

    What killed processes have left under the same name is removed, too. Without a `parent` it is
    private, and lies where temporary files do.
    """
    directory = parent or Path(tempfile.gettempdir())
    path = directory / f".{name}.{secrets.token_hex(4)}.{os.getpid()}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        remove_abandoned(directory, name)
        path.mkdir(0o777 if parent else 0o700)
    except OSError as error:
        raise OutputError(f"{str(directory)!r} cannot be written to: {error}") from error
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


class Unfailing(io.FileIO):
    """A file that drops what a full disk does not take, and tells the first error when closed.

    HDF5 cannot bear an error: it raises at every later call, or ends the process.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._error: OSError | None = None

    def write(self, content: Any, /) -> int:
        """Write all of some bytes."""
        left = memoryview(content).cast("B")
        try:
            while left and self._error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self._error = error
        return memoryview(content).nbytes

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size of the file."""
        try:
            return super().truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def close(self) -> None:
        """Close the file; `OSError` where it lacks something that was written."""
        super().close()
        error, self._error = self._error, None
        if error is not None:
            raise error


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file in one step, see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with line feeds in one step, see `replacing`."""
    write_bytes(path, text.encode())


def refuse_inputs(output: Path, inputs: Iterable[Path], option: str = "output") -> None:
    """Raise `UsageError` when writing an output would overwrite an input, under any of its names.

    No output replaces a file of a directory that is read. A directory to write in may hold such
    directories, and TOML files, which no command writes there, but no other input.
    """
    written = _file_id(output)
    for path in inputs if written else ():
        if written == _file_id(path):
            overwritten = f"the input {str(path)!r}"
        elif (
            output.is_dir() and path.is_file() and path.suffix != ".toml" and lies_in(path, output)
        ):
            overwritten = f"the input {str(path)!r} in it"
        elif output.is_file() and path.is_dir() and _has_file(path, output):
            overwritten = f"a file of the input {str(path)!r}"
        else:
            continue
        raise UsageError(
            f"{option} {str(output)!r} would overwrite {overwritten}, and nothing was written: "
            "expected a path that is not read, choose another name"
        )


def lies_in(path: Path, directory: Path) -> bool:
    """Tell whether a path, or what it links to, is a directory or below it."""
    names = (path.resolve(), path.parent.resolve() / path.name)
    above = {_file_id(folder) for name in names for folder in (name, *name.parents)}
    return _file_id(directory) in above - {None}


def _has_file(directory: Path, path: Path) -> bool:
    """Tell whether a file is in a directory, by its own path or as the target of a link there."""
    return lies_in(path, directory) or _file_id(path) in map(_file_id, directory.rglob("*"))


def _file_id(path: Path) -> tuple[int, int] | None:
    """Return device and inode of what a path leads to; None where there is nothing."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def remove_abandoned(directory: Path, name: str = "*") -> None:
    """Remove what has an `UNFINISHED` name of an ended process.

    Where others may keep files, too, `name` says which of them this program writes.
    """
    for path in directory.glob(f".{name if name == '*' else glob.escape(name)}.*"):
        process = UNFINISHED.fullmatch(path.name)
        if process and not psutil.pid_exists(int(process[1])):
            shutil.rmtree(path, ignore_errors=True)
            with contextlib.suppress(OSError):  # a directory, or another user's
                path.unlink()


def digests(directory: Path) -> dict[str, str]:
    """Return the SHA-256 of files below a directory by relative name."""
    return {
        path.relative_to(directory).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


@contextlib.contextmanager
def only_writer(directory: Path) -> Iterator[None]:
    """Let no other process write into a directory meanwhile; `OutputError` while one does."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{str(directory)!r} cannot be written to: {error}") from None
    with lock(directory, wait=False) as held:
        if not held:
            raise OutputError(
                f"{str(directory)!r} is being written by another process: wait for its end"
            )
        yield


@contextlib.contextmanager
def lock(directory: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold an exclusive lock on a directory; without `wait`, give False while another has it.

    A file system without locks counts as held: two writers at a time are not supported there.
    """
    import fcntl  # noqa: PLC0415  POSIX only

    descriptor, held = os.open(directory, os.O_RDONLY), True
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            held = not isinstance(error, BlockingIOError)
        yield held
    finally:
        os.close(descriptor)


def flush_streams() -> None:
    """Write what was printed; foreign code may have closed a stream, or put None in its place."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(ValueError, OSError, AttributeError):
            stream.flush()


@contextlib.contextmanager
def redirected(file: IO[Any]) -> Iterator[None]:
    """Send descriptors 1 and 2 into a file, as far as this process has them, then put them back."""
    flush_streams()
    with contextlib.ExitStack() as back:
        with contextlib.suppress(OSError):
            for descriptor in (1, 2):
                copy = os.dup(descriptor)
                back.callback(os.close, copy)
                back.callback(os.dup2, copy, descriptor)
                os.dup2(file.fileno(), descriptor)
        yield


def compress(content: bytes) -> bytes:
    """Compress with gzip: the same bytes for the same content, without name and time."""
    return gzip.compress(content, 7, mtime=0)  # Level 9 takes four times as long and saves 5 %.


def packed(path: Path, content: bytes) -> bytes:
    """Return content as a file of this name holds it: compressed where the name says so."""
    if path.suffix == XZ:
        return lzma.compress(content, preset=9 | lzma.PRESET_EXTREME)
    return compress(content) if path.suffix == GZIP else content


def decompress(content: bytes, most: int = MAX_BYTES) -> bytes:
    """Undo gzip or xz, never holding more than `most` bytes; anything else is a `ResultsError`."""
    by_xz = content.startswith(b"\xfd7zXZ\0")
    decompressor = (
        lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MEMORY)
        if by_xz
        else zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    )
    try:
        plain = decompressor.decompress(content, most + 1)
    except (zlib.error, lzma.LZMAError) as error:
        raise ResultsError(f"is damaged or not compressed by gzip or xz: {error}") from None
    if len(plain) > most:
        raise ResultsError(f"decompresses to more than {most} bytes")
    if not decompressor.eof:
        raise ResultsError("is compressed, but cut off")
    if decompressor.unused_data:
        raise ResultsError("has something behind its compressed content")
    return plain


def compress_large(path: Path) -> Path:
    """Compress a large file into ``NAME.xz`` and return the path that the content has then."""
    if path.stat().st_size <= COMPRESSED_FROM:
        return path
    target = path.with_name(path.name + XZ)
    write_bytes(target, packed(target, path.read_bytes()))
    path.unlink()
    return target


def forms(name: str) -> tuple[str, ...]:
    """Return the names that a file may have: plain, and compressed.

    >>> forms("curves.json")
    ('curves.json', 'curves.json.xz', 'curves.json.gz')
    """
    return name, *(name + ending for ending in PACKED)


def find_file(path: Path) -> Path | None:
    """Return the file or its compressed form, whichever exists."""
    return next((p for p in map(path.with_name, forms(path.name)) if p.is_file()), None)


def read_text(path: Path) -> str:
    """Read UTF-8 text, decompressed if the name ends in ``.xz`` or ``.gz``."""
    content = read_bytes(path, MAX_TEXT, ResultsError)
    try:
        return (decompress(content) if path.suffix in PACKED else content).decode()
    except (UnicodeDecodeError, ResultsError) as error:
        raise ResultsError(f"{str(path)!r} cannot be read: {error}") from None
