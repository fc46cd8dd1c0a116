"""Forget what was read: memory that sandboxes would otherwise share.

Sandboxes read the same files, and what one of them has read lies in the system's memory: the next
one reads it sooner, and is told so by the blocks that it has read. So a detector could note in one
group what it finds in another.
"""

import ctypes
import math
import os
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice
from pathlib import Path
from typing import Final

_OPENED, _OVERFLOW, _DIRECTORY = 0x20, 0x4000, 0x40000000  # IN_OPEN, IN_Q_OVERFLOW, IN_ISDIR
_EVENT: Final = struct.Struct("iIII")  # watch, what happened, cookie, bytes of the name

_PAUSE: Final = 0.05
_AT_ONCE: Final = 1000
"""Seconds between looks at what was opened, and files that are forgotten between them.

The system keeps some 16 000 openings for a look, and others may open many files meanwhile.
"""


class Reads:
    """The files below some paths that were opened since it was made, by whomever.

    Where the system cannot tell, as there are too many directories, these are all files.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        roots = {Path(os.path.realpath(path)) for path in paths}
        self._roots = [root for root in roots if roots.isdisjoint(root.parents)]
        self._opened: dict[str, float] = {}  # and when it was noted
        self._begun: list[float] = []
        self._lock = threading.Lock()
        self._watched: dict[int, str] = {}
        self._blind = False  # to some directories
        self._closed = threading.Event()
        system = ctypes.CDLL(None, use_errno=True)
        self._descriptor = system.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        for path in self._watches():
            watch = system.inotify_add_watch(self._descriptor, os.fsencode(path), _OPENED)
            self._blind = self._blind or watch < 0
            self._watched[watch] = path
        self._missed = False  # what was opened meanwhile is of no group
        threading.Thread(target=self._look, daemon=True).start()

    def close(self) -> None:
        """Stop looking."""
        with self._lock:
            self._closed.set()
            if self._descriptor >= 0:
                os.close(self._descriptor)

    @contextmanager
    def forgotten(self) -> Iterator[None]:
        """Have the system drop from memory, at the end, what was read of these files meanwhile."""
        begun = time.monotonic()
        with self._lock:
            self._begun.append(begun)
        try:
            yield
        finally:
            with self._lock:
                self._forget()
                self._begun.remove(begun)
                # What others may still have open, they may read again.
                since = min(self._begun, default=math.inf)
                self._opened = {path: t for path, t in self._opened.items() if t >= since}

    def _forget(self) -> None:
        self._note(self._news())
        paths = iter(tuple(self._opened))
        if self._blind or self._missed:
            paths = chain(paths, (f"{d}/{f}" for d, files in self._tree() for f in files))
            self._missed = False
        while some := [*islice(paths, _AT_ONCE)]:
            ours, news = Counter(filter(_forget, some)), Counter(self._news())
            self._note(news - ours)

    def _look(self) -> None:
        while not self._closed.wait(_PAUSE):
            with self._lock:
                if not self._closed.is_set():
                    self._note(self._news())

    def _note(self, paths: Iterable[str]) -> None:
        self._opened.update(dict.fromkeys(paths, time.monotonic()))

    def _tree(self) -> Iterator[tuple[str, list[str]]]:
        for root in self._roots:
            if root.is_file():
                yield str(root.parent), [root.name]
            for directory, _, files in os.walk(root):
                yield directory, files

    def _watches(self) -> Iterator[str]:
        yield from (str(root) for root in self._roots if root.is_file())
        yield from dict.fromkeys(d for root in self._roots for d, *_ in os.walk(root))

    def _news(self) -> Iterator[str]:
        with suppress(BlockingIOError, OSError):
            while content := os.read(self._descriptor, 1 << 20):
                at = 0
                while at < len(content):
                    watch, event, _, size = _EVENT.unpack_from(content, at)
                    at += _EVENT.size + size
                    name = content[at - size : at].rstrip(b"\0")
                    self._missed = self._missed or bool(event & _OVERFLOW)
                    if event & _OPENED and not event & _DIRECTORY:
                        yield f"{self._watched[watch]}/{os.fsdecode(name)}".rstrip("/")


def _forget(path: str) -> bool:
    """Drop a file from memory; return whether it could be opened."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        try:
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)
        return True
    return False
