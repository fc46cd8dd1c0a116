"""Standard streams from which nothing but text reaches a terminal, whoever has written the text.

Names, summaries, messages and records are of strangers, and a terminal obeys what it is sent:
escape sequences move its cursor and rename its window, marks of direction exchange letters.
"""

import contextlib
import os
import sys
import unicodedata
from collections.abc import Iterator
from typing import IO, Any, Final

_KEPT: Final = {"\n", "\t"}
_OBEYED: Final = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # categories of characters that are not drawn


class _Table(dict[int, int]):
    """A table of `str.translate`, which learns a character when it comes."""

    def __missing__(self, point: int) -> int:
        is_text = chr(point) in _KEPT or unicodedata.category(chr(point)) not in _OBEYED
        return self.setdefault(point, point if is_text else 0xFFFD)


_TABLE: Final = _Table()
_HYPHENS: Final = dict.fromkeys(map(ord, "\N{EN DASH}\N{EM DASH}\N{MINUS SIGN}"), "-")


def plain_text(text: str) -> str:
    r"""Return a text with a replacement character for each one that steers a terminal.

    >>> plain_text("a\x1b[2Jb\n")
    'a�[2Jb\n'
    """
    return text if text.isascii() and text.isprintable() else text.translate(_TABLE)


def encodable(text: str, encoding: str | None) -> str:
    r"""Return a text with what an encoding lacks as a question mark, and dashes as hyphens.

    >>> encodable("Δ ≥ 1 \N{EN DASH} 2", "latin-1")
    '? ? 1 - 2'
    """
    try:
        text.encode(encoding or "utf-8")
    except UnicodeEncodeError:
        hyphens = text.translate(_HYPHENS)
        return hyphens.encode(encoding or "utf-8", "replace").decode(encoding or "utf-8")
    return text


class PlainStream:
    """A stream of text that writes `plain_text` to another one, `raw`, and is like it otherwise.

    Parameters
    ----------
    raw
        The other stream.
    """

    def __init__(self, raw: IO[str]) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        """Write a text; what the encoding of the stream lacks becomes a question mark."""
        self.raw.write(encodable(plain_text(text), getattr(self.raw, "encoding", None)))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


@contextlib.contextmanager
def plain_streams() -> Iterator[None]:
    """Have standard output and standard error be a `PlainStream` each."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_plain(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def open_streams() -> bool:
    """Lead closed standard streams nowhere, and tell whether standard output was closed.

    A file that is opened later would take their places, and what is printed would go there.
    """
    closed = [name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None]
    for name in closed:
        number = os.open(os.devnull, os.O_RDWR)  # the lowest that is free
        os.set_inheritable(number, True)
        setattr(sys, name, os.fdopen(number, "w"))
    return "stdout" in closed


def _plain(stream: Any) -> Any:
    return stream if stream is None or isinstance(stream, PlainStream) else PlainStream(stream)


def raw(stream: Any) -> Any:
    """Return the stream behind a `PlainStream`: for who writes styles of its own to a terminal."""
    return stream.raw if isinstance(stream, PlainStream) else stream
