"""What a detector does to the process around it: one run, watched from all sides."""

from __future__ import annotations

import contextlib
import io
import locale
import os
import random
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.plugins.conformance.audit import Events, auditing

THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)

_SENTINEL: Final = 3
"""Threads that are asked for while a detector is watched: whoever sets another number is seen."""

_SAMPLE_SECONDS: Final = 0.005


@dataclass(slots=True)
class Watched:
    """What was seen of a run.

    Attributes
    ----------
    error
        What it raised; then the rest is what was seen up to there.
    seconds
        Wall-clock time.
    megabytes
        Growth of the resident memory, at its largest.
    printed
        Standard output and error, of Python and of libraries beneath it.
    warnings
        ``Category: message`` of each.
    network
        Addresses asked for; connections were refused.
    written
        Paths written to outside the places that are allowed; see `outside`.
    random
        Global generators whose state changed: ``"random"``, ``"numpy.random"``, ``"torch"``.
    threads
        Thread settings that changed, ``"name: before -> after"``.
    settings
        Other settings of the process that changed, likewise.
    running
        Threads and child processes left running.
    """

    error: BaseException | None = None
    seconds: float = 0.0
    megabytes: float = 0.0
    printed: str = ""
    warnings: list[str] = field(default_factory=list)
    network: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    random: list[str] = field(default_factory=list)
    threads: list[str] = field(default_factory=list)
    settings: list[str] = field(default_factory=list)
    running: list[str] = field(default_factory=list)


def watch(work: Callable[[], None], settings_before: dict[str, str]) -> Watched:
    """Do some work and see what it does beside.

    It is done in an empty working directory and with a temporary directory of its own. Afterwards
    the process is put back into the state before.

    Parameters
    ----------
    work
        What to do; the second time of its kind, so that what importing libraries does is not seen.
    settings_before
        Settings of the process (see `settings`) before anything of the kind was done.
    """
    seen = Watched()
    running_before = _running()
    with contextlib.ExitStack() as stack:
        here = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="oodd-check-")))
        stack.enter_context(_places(here))
        generators = stack.enter_context(_fresh_generators())
        threads = stack.enter_context(_sentinel_threads())
        printed = stack.enter_context(_captured())
        caught = stack.enter_context(warnings.catch_warnings(record=True))
        warnings.simplefilter("always")
        memory = _Memory()
        start = time.perf_counter()
        events = Events()
        with auditing(events):
            try:
                work()
            except (Exception, SystemExit) as error:  # noqa: BLE001  the checks judge it
                seen.error = error
        seen.seconds = time.perf_counter() - start
        seen.megabytes = memory.stop()
        seen.random = [name for name, state in generators.items() if _state(name) != state]
        seen.threads = _changes(threads, _thread_settings())
        seen.settings = _changes({**settings_before, "working directory": str(here / "work")},
                                 {**settings(), "working directory": str(_cwd())})  # fmt: skip
        seen.warnings = [f"{w.category.__name__}: {' '.join(str(w.message).split())}"
                         for w in caught or []]  # fmt: skip
        seen.network = events.network
        seen.written = outside([*events.written, *_left(here)], here / "work")
        seen.printed = printed()
    seen.running = [name for _, name in sorted(_running() - running_before)]
    return seen


def settings() -> dict[str, str]:
    """Return settings of the process that a detector has no business to change, as text.

    A library that is not imported yet has its defaults.
    """
    torch = sys.modules.get("torch")
    handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)}
    found: dict[str, object] = {
        "numpy error handling": np.geterr(),
        "numpy print options": np.get_printoptions(),
        "recursion limit": sys.getrecursionlimit(),
        "locale": locale.setlocale(locale.LC_ALL),
        "signal handlers": {s.name: repr(h) for s, h in handlers.items()},
        "umask": _umask(),
        "torch default dtype": torch.get_default_dtype() if torch else "torch.float32",
        "torch gradients enabled": torch.is_grad_enabled() if torch else True,
        "torch deterministic algorithms":
            torch.are_deterministic_algorithms_enabled() if torch else False,
    }  # fmt: skip
    return {name: str(value) for name, value in found.items()}


def _umask() -> int:
    """Return the mask of new files, which can only be read by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _cwd() -> Path | str:
    try:
        return Path.cwd()
    except FileNotFoundError:
        return "removed"


def _changes(before: dict[str, str], after: dict[str, str]) -> list[str]:
    return [
        f"{name}: {before.get(name, 'unset')} -> {after.get(name, 'unset')}"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    ]


@contextlib.contextmanager
def _places(here: Path) -> Iterator[None]:
    """Work in an empty directory, with another one for temporary files."""
    work, temporary = here / "work", here / "temporary"
    work.mkdir()
    temporary.mkdir()
    before, tempdir = _cwd(), tempfile.tempdir
    environment = dict(os.environ)
    os.environ["TMPDIR"] = str(temporary)
    tempfile.tempdir = str(temporary)
    os.chdir(work)
    try:
        yield
    finally:
        os.chdir(before)
        tempfile.tempdir = tempdir
        os.environ.clear()
        os.environ.update(environment)


@contextlib.contextmanager
def _fresh_generators() -> Iterator[dict[str, object]]:
    """Put the global generators into states of their own, yield these, and put them back."""
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002  what is watched
    torch = sys.modules.get("torch")
    kept_torch = torch.get_rng_state() if torch else None
    # Not those a detector would seed: seeding again with the same number would not be seen.
    random.seed(0x0DD)
    np.random.seed(0x0DD)  # noqa: NPY002
    if torch:
        torch.random.manual_seed(0x0DD)
    names = ["random", "numpy.random", *(["torch"] if torch else [])]
    try:
        yield {name: _state(name) for name in names}
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002
        if torch:
            torch.set_rng_state(kept_torch)


def _state(name: str) -> object:
    match name:
        case "random":
            return random.getstate()
        case "numpy.random":
            kind, words, *rest = np.random.get_state()  # noqa: NPY002
            return kind, np.asarray(words).tobytes(), rest
        case _:
            return sys.modules["torch"].get_rng_state().numpy().tobytes()


@contextlib.contextmanager
def _sentinel_threads() -> Iterator[dict[str, str]]:
    """Ask for an unusual number of threads, yield the settings, and put them back."""
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch else None
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(_SENTINEL)))
    if torch:
        torch.set_num_threads(_SENTINEL)
    try:
        yield _thread_settings()
    finally:
        if torch:
            torch.set_num_threads(threads)
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _thread_settings() -> dict[str, str]:
    torch = sys.modules.get("torch")
    found: dict[str, Any] = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    if torch:
        found["torch.get_num_threads()"] = torch.get_num_threads()
    return {name: str(value) for name, value in found.items()}


@contextlib.contextmanager
def _captured() -> Iterator[Callable[[], str]]:
    """Catch what is printed, by Python and by libraries beneath it; yield how to read it."""
    text = io.StringIO()
    with tempfile.TemporaryFile() as file, contextlib.ExitStack() as stack:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
        stack.enter_context(contextlib.redirect_stdout(text))
        stack.enter_context(contextlib.redirect_stderr(text))
        for descriptor in (1, 2):
            copy = os.dup(descriptor)
            stack.callback(os.close, copy)
            stack.callback(os.dup2, copy, descriptor)
            os.dup2(file.fileno(), descriptor)

        def read() -> str:
            file.seek(0)
            return text.getvalue() + file.read().decode(errors="replace")

        yield read


class _Memory:
    """Growth of this process's resident memory, sampled until stopped."""

    def __init__(self) -> None:
        self._start = self._peak = _resident_mb()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._end.wait(_SAMPLE_SECONDS):
            self._peak = max(self._peak, _resident_mb())

    def stop(self) -> float:
        self._end.set()
        self._thread.join()
        return max(self._peak, _resident_mb()) - self._start


def _resident_mb() -> float:
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _left(place: Path) -> list[Path]:
    return [path for path in sorted(place.rglob("*")) if path.is_file()]


def outside(written: Iterable[Path], here: Path) -> list[str]:
    """Return the paths that must not be written to, each once, relative to `here` if below it.

    Allowed are the user's cache directory, byte code, devices, and temporary files that are gone.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    temporary = Path(tempfile.gettempdir())
    found = [
        path
        for path in written
        if "__pycache__" not in path.parts
        and not path.is_relative_to(cache)
        and path.parts[:2] not in {("/", "dev"), ("/", "proc")}
        and not (path.is_relative_to(temporary) and not path.exists())
    ]
    names = [str(p.relative_to(here) if p.is_relative_to(here) else p) for p in found]
    return list(dict.fromkeys(names))


def _running() -> set[tuple[int, str]]:
    """Return the threads that keep a process alive, and the children of this one: id and name."""
    threads = {
        (t.ident or 0, f"thread {t.name}") for t in threading.enumerate()
        if not t.daemon and t is not threading.main_thread()
    }  # fmt: skip
    return threads | {(pid, f"process {pid} ({name})") for pid, name in _children()}


def _children() -> Iterator[tuple[int, str]]:
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            name, _, rest = (place / "stat").read_text(errors="replace").rpartition(")")
            state, parent = rest.split()[:2]
            if int(parent) == os.getpid() and state != "Z":
                yield int(place.name), name.partition("(")[2]
