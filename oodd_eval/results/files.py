"""Text files that are kept compressed where they are large: ``NAME`` plain, or ``NAME.gz``.

The records of a whole reproduction are some 15 MB of text, of which gzip leaves a fifth. What is
read may be somebody else's, so that the size it unpacks to is bounded while it is unpacked.
"""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import Final

from oodd_eval.errors import ResultsError

ENDING: Final = ".gz"

LARGE: Final = 10**6
"""Bytes beyond which a file is kept compressed: smaller ones stay readable in a pull request."""

MOST: Final = 64 * 10**6
"""Bytes that a file may unpack to where nothing else is said."""


def pack(content: bytes) -> bytes:
    """Compress; the same bytes for the same content, with no name and no time in them."""
    return gzip.compress(content, 9, mtime=0)


def unpack(content: bytes, most: int = MOST) -> bytes:
    """Undo `pack`.

    Parameters
    ----------
    content
        One gzip member and nothing behind it.
    most
        Bytes that may come of it; no more than that is ever held.

    Raises
    ------
    ResultsError
        When it is something else, or more.

    Examples
    --------
    >>> unpack(pack(b"one record"))
    b'one record'
    """
    unpacker = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        plain = unpacker.decompress(content, most + 1)
    except zlib.error as error:
        raise ResultsError(f"is damaged or not packed by gzip: {error}") from None
    if len(plain) > most:
        raise ResultsError(f"unpacks to more than {most} bytes")
    if not unpacker.eof:
        raise ResultsError("is packed by gzip, but cut off")
    if unpacker.unused_data:
        raise ResultsError("has something behind what is packed in it")
    return plain


def shrink(path: Path) -> Path:
    """Pack a file that is large, under the name ``NAME.gz``; return the path that it has then."""
    if path.stat().st_size <= LARGE:
        return path
    target = path.with_name(path.name + ENDING)
    target.write_bytes(pack(path.read_bytes()))
    path.unlink()
    return target


def find(path: Path) -> Path | None:
    """Return the file, or its packed form, whichever there is."""
    packed = path.with_name(path.name + ENDING)
    return next((p for p in (path, packed) if p.is_file()), None)


def read_text(path: Path, most: int = MOST) -> str:
    """Read a file, unpacked if its name says that it is packed.

    Raises
    ------
    OSError, UnicodeDecodeError
        As for a plain file.
    ResultsError
        When it cannot be unpacked.
    """
    if path.suffix != ENDING:
        return path.read_text(encoding="utf-8")
    try:
        return unpack(path.read_bytes(), most).decode("utf-8")
    except ResultsError as error:
        raise ResultsError(f"{str(path)!r} {error}") from None
