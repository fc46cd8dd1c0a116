"""Side effects of running code: files, network, output, settings, threads, processes, memory.

An audit hook sees every file that Python opens and every address that it connects to, from whatever
library. It cannot be removed again: one is installed at the first use and is idle in between.
"""

import contextlib
import functools
import locale
import os
import random
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final
from unittest.mock import patch

import numpy as np
import psutil

from oodd_eval.data.files import redirected

_THREAD_VARIABLES: Final = tuple(f"{x}_NUM_THREADS" for x in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"))

# Set before code is watched, so that setting the usual value is seen as well.
_UNUSUAL_THREADS: Final = 3
_UNUSUAL_SEED: Final = 0x0DD

_CALLS: Final = "connect getaddrinfo gethostbyaddr gethostbyname sendmsg sendto"
_NETWORK: Final = frozenset(f"socket.{call}" for call in _CALLS.split())
_WRITING: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(slots=True)
class Events:
    """Addresses that were asked for, paths that were written to, and names that were unpickled."""

    network: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    unpickled: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Effects(Events):
    """The side effects of one piece of work, up to its error; paths are those of `outside`."""

    error: BaseException | None = None
    printed: str = ""  # by Python and by libraries beneath it
    warnings: list[str] = field(default_factory=list)  # "Category: message"
    random: list[str] = field(default_factory=list)  # global generators whose state changed
    settings: list[str] = field(default_factory=list)  # "setting: before -> after"
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
    if event == "pickle.find_class":
        _recording[-1].unpickled.append(".".join(map(str, arguments)))
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


def watch(work: Callable[[], None], settings_before: dict[str, str]) -> Effects:
    """Return the side effects of work, done in an empty directory; then the process is as before.

    `settings_before` are those before libraries were imported, which is not seen otherwise.
    """
    seen, running_before = Effects(), _running()
    with contextlib.ExitStack() as stack:
        here = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="oodd-check-")))
        stack.enter_context(_set_apart(here))
        generators, before = _generators(), settings_before | _set_here()
        printed = stack.enter_context(_captured())
        caught = stack.enter_context(warnings.catch_warnings(record=True, action="always"))
        with auditing(seen):
            try:
                work()
            except (Exception, SystemExit) as error:  # noqa: BLE001  the checks judge it
                seen.error = error
        seen.random = [name for name, state in _generators().items() if generators[name] != state]
        after = settings() | _set_here()
        pairs = [(n, before.get(n, "unset"), after[n]) for n in sorted(after)]
        seen.settings = [f"{name}: {old} -> {new}" for name, old, new in pairs if old != new]
        seen.warnings = [
            f"{w.category.__name__}: {' '.join(str(w.message).split())}" for w in caught or []
        ]
        left = sorted(str(path) for path in here.rglob("*") if path.is_file())
        seen.written = outside([*seen.written, *left], here / "work")
        printed.flush()
        printed.seek(0)
        seen.printed = printed.read()
    seen.running = [name for _, name in sorted(_running() - running_before)]
    return seen


def settings() -> dict[str, str]:
    """Return settings of the process that are the user's; a missing library has its defaults."""
    torch = sys.modules.get("torch")
    values: dict[str, object] = {
        "numpy error handling": np.geterr(),
        "recursion limit": sys.getrecursionlimit(),
        "locale": locale.setlocale(locale.LC_ALL),
        "interrupts": signal.getsignal(signal.SIGINT),
        "torch default dtype": torch.get_default_dtype() if torch else "torch.float32",
        "torch gradients enabled": torch.is_grad_enabled() if torch else True,
        "torch deterministic": bool(torch and torch.are_deterministic_algorithms_enabled()),
    }
    return {name: str(value) for name, value in values.items()}


def _set_here() -> dict[str, str]:
    """Return the settings that are set to unusual values before code is watched."""
    values = {name: str(os.environ.get(name)) for name in _THREAD_VARIABLES}
    if torch := sys.modules.get("torch"):
        values["torch.get_num_threads()"] = str(torch.get_num_threads())
    return {**values, "working directory": os.path.realpath(os.curdir)}


def outside(written: Iterable[str], here: Path) -> list[str]:
    """Return the paths that must not be written to, each once, relative to `here` if below it.

    Allowed are the user's cache directory, byte code, devices, and temporary files that are gone.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
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
    """Work in empty directories, with unusual generators and thread settings; then put all back."""
    for directory in (work := here / "work", temporary := here / "temporary"):
        directory.mkdir()
    variables = dict.fromkeys(_THREAD_VARIABLES, str(_UNUSUAL_THREADS))
    with (
        seeded_generators(_UNUSUAL_SEED),
        patch.dict(os.environ, variables, TMPDIR=str(temporary)),
        patch.object(tempfile, "tempdir", str(temporary)),
        contextlib.chdir(work),
        contextlib.ExitStack() as back,
    ):
        if torch := sys.modules.get("torch"):
            back.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(_UNUSUAL_THREADS)
        yield


def _generators() -> dict[str, object]:
    kind, words, *rest = np.random.get_state()  # noqa: NPY002
    numpy_state = kind, np.asarray(words).tobytes(), rest
    states: dict[str, object] = {"random": random.getstate(), "numpy.random": numpy_state}
    if torch := sys.modules.get("torch"):
        states["torch"] = torch.get_rng_state().numpy().tobytes()
    return states


@contextlib.contextmanager
def _captured() -> Iterator[IO[str]]:
    """Send what is printed, by Python and by libraries beneath it, into a file."""
    with (
        tempfile.TemporaryFile("w+", errors="replace") as file,
        redirected(file),
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
    ):
        yield file


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
