"""Side effects of running code: files, network, threads, processes.

An audit hook sees every file that Python opens and every address that it connects to, from whatever
library. It cannot be removed again: one is installed at the first use and is idle in between.
"""

import contextlib
import functools
import os
import random
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import psutil

from oodd_eval.data.files import temporary_directory

_CALLS: Final = "connect getaddrinfo gethostbyaddr gethostbyname sendmsg sendto"
_NETWORK: Final = frozenset(f"socket.{call}" for call in _CALLS.split())
_WRITING: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(slots=True)
class Events:
    """Addresses that were asked for, and paths that were written to."""

    network: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Effects(Events):
    """The side effects of one piece of work, up to its error; paths are those of `outside`."""

    error: BaseException | None = None
    running: list[str] = field(default_factory=list)  # threads and child processes left


DAEMON: Final = "daemon thread"  # prefix of the daemon threads in `Effects.running`

_install: Final = functools.cache(sys.addaudithook)
_recording: Final[list[Events]] = []  # the audit hook writes to the last one


@contextlib.contextmanager
def auditing(events: Events) -> Iterator[None]:
    """Record events, of all threads, and refuse connections, until the block is left."""
    _install(_hook)
    _recording.append(events)
    try:
        yield
    finally:
        _recording.pop()


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not _recording:
        return
    if event in _NETWORK and (address := _address(event, arguments)):
        _recording[-1].network.append(address)
        raise ConnectionRefusedError(f"no network during a check: {event} {address}")
    # Descriptors are of files that were opened before, and seen then.
    path = arguments[0] if event == "open" and (arguments[2] or 0) & _WRITING else None
    if isinstance(path, str | bytes | os.PathLike):
        absolute = os.path.abspath(os.fsdecode(path))  # noqa: PTH100  keeps links
        _recording[-1].written.append(absolute)


def _address(event: str, arguments: tuple[Any, ...]) -> str:
    """Return where a call wants to go; empty for sockets of this machine's file system."""
    if event.startswith("socket.gethostby"):
        return str(arguments[0])
    target = arguments if event == "socket.getaddrinfo" else arguments[-1]
    return ":".join(str(part) for part in target[:2]) if isinstance(target, tuple) else ""


def watch(work: Callable[[], None]) -> Effects:
    """Return the side effects of work, done in an empty directory; then the process is as before.

    What is global in the process is not watched: a run scores every group in a process of its own.
    """
    seen, running_before = Effects(), _running()
    with temporary_directory() as here, _set_apart(here):
        with auditing(seen):
            try:
                work()
            except (Exception, SystemExit) as error:  # noqa: BLE001  the checks judge it
                seen.error = error
        left = sorted(str(path) for path in here.rglob("*") if path.is_file())
        seen.written = outside([*seen.written, *left], here / "work")
    seen.running = [name for _, name in sorted(_running() - running_before)]
    return seen


def outside(written: Iterable[str], here: Path) -> list[str]:
    """Return the paths that must not be written to, each once, relative to `here` if below it.

    Allowed are the user's cache directory, byte code, devices, and temporary files that are gone.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111
    allowed = cache, Path("/dev"), Path("/proc")
    return [
        str(path.relative_to(here) if path.is_relative_to(here) else path)
        for path in map(Path, dict.fromkeys(written))
        if "__pycache__" not in path.parts
        and not any(path.is_relative_to(directory) for directory in allowed)
        and not (path.is_relative_to(tempfile.gettempdir()) and not path.exists())
    ]


@contextlib.contextmanager
def seeded_generators(seed: int) -> Iterator[None]:
    """Seed the global random generators; put them back as they were when the block is left."""
    with contextlib.ExitStack() as back:
        back.callback(random.setstate, random.getstate())
        back.callback(np.random.set_state, np.random.get_state())  # noqa: NPY002
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  the generator that is watched
        if torch := sys.modules.get("torch"):
            back.callback(torch.set_rng_state, torch.get_rng_state())
            torch.random.manual_seed(seed)
        yield


@contextlib.contextmanager
def _set_apart(here: Path) -> Iterator[None]:
    """Work in empty directories, with generators of the global kind put back in the end."""
    for directory in (work := here / "work", temporary := here / "temporary"):
        directory.mkdir()
    with (
        seeded_generators(0),
        patch.dict(os.environ, TMPDIR=str(temporary)),
        patch.object(tempfile, "tempdir", str(temporary)),
        contextlib.chdir(work),
    ):
        yield


def _running() -> set[tuple[int, str]]:
    """Return the further threads and the children of this process: id and name."""
    running = {
        (thread.ident or 0, f"{DAEMON if thread.daemon else 'thread'} {thread.name}")
        for thread in threading.enumerate()
        if thread is not threading.main_thread()
    }
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.NoSuchProcess):
            if child.status() != psutil.STATUS_ZOMBIE:
                running.add((child.pid, f"process {child.pid} ({child.name()})"))
    return running
