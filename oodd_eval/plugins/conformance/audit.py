"""What Python code does to files and the network, by audit events.

An audit hook sees every file that Python opens and every address it connects to, from whatever
library, and cannot be removed again: one is installed at the first use and is idle in between.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

_NETWORK: Final = frozenset(
    {
        "socket.connect",
        "socket.getaddrinfo",
        "socket.gethostbyaddr",
        "socket.gethostbyname",
        "socket.sendmsg",
        "socket.sendto",
    }
)

_CHANGES: Final = {
    "os.link": (1,),
    "os.mkdir": (0,),
    "os.remove": (0,),
    "os.rename": (0, 1),
    "os.rmdir": (0,),
    "os.symlink": (1,),
    "os.truncate": (0,),
    "shutil.rmtree": (0,),
    "sqlite3.connect": (0,),
}
"""Events that change what is on disk, and which of their arguments are the paths that change."""

_RELATIVE: Final = {"os.remove": 1, "os.rmdir": 1, "shutil.rmtree": 1}
"""Where an argument tells that a path is relative to an open directory.

Emptying a directory removes what is in it in this way; it is seen as a whole before.
"""

_WRITING: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(slots=True)
class Events:
    """What was seen: addresses that were asked for, and paths that were written to."""

    network: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)


_current: Events | None = None
_installed = False


@contextlib.contextmanager
def auditing(events: Events) -> Iterator[None]:
    """Record events, of all threads, and refuse connections, until the block is left."""
    global _current, _installed  # noqa: PLW0603  an audit hook is the process's, for ever
    if not _installed:
        sys.addaudithook(_hook)
        _installed = True
    _current, before = events, _current
    try:
        yield
    finally:
        _current = before


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _current is None:
        return
    if event == "open":
        path, _, flags = arguments
        if flags is not None and flags & _WRITING:
            _note(path)
    elif event in _CHANGES:
        relative = _RELATIVE.get(event)
        if relative is None or arguments[relative] in (None, -1):
            for index in _CHANGES[event]:
                _note(arguments[index])
    elif event in _NETWORK and (address := _address(event, arguments)):
        _current.network.append(address)
        raise ConnectionRefusedError(f"no network during a check: {event} {address}")


def _note(path: object) -> None:
    # Descriptors are of files that were opened before, and seen then.
    if _current is not None and isinstance(path, str | bytes | os.PathLike):
        _current.written.append(Path(os.path.abspath(os.fsdecode(path))))  # noqa: PTH100  keeps links


def _address(event: str, arguments: tuple[Any, ...]) -> str:
    """Return where a call wants to go; empty for sockets of this machine's file system."""
    target = arguments[-1] if event in {"socket.connect", "socket.sendto", "socket.sendmsg"} else (
        tuple(arguments[:2]) if event == "socket.getaddrinfo" else (arguments[0],)
    )  # fmt: skip
    if not isinstance(target, tuple):
        return ""
    return ":".join(str(part) for part in target[:2])
