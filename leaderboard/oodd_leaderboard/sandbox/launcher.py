"""A launcher of workers, each in a sandbox of its own, which bubblewrap makes.

The worker sees the system's programs and libraries, the interpreter, what can be imported, and the
packages that only sandboxes get, all read-only. Its home is ``/tmp``: memory of limited size, which
is gone when the worker ends. It has no network, sees no process but its own, has no rights, and is
nobody. No directory of the system is its to write, and none outlives it.
"""

import functools
import importlib.machinery
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from oodd_eval.errors import UsageError

Paths = Iterable[str | Path]

SCRATCH: Final = "/tmp"  # noqa: S108  of the sandbox, not of the system
SCRATCH_BYTES: Final = 2 * 10**9  # of /tmp, beside --memory: the training episodes lie there
SHARED_BYTES: Final = 256 * 10**6  # of /dev/shm
NOBODY: Final = "65534"
ELSEWHERE: Final = "oodd_leaderboard.sandbox.describe:sandboxed_plugins"
PACKAGES: Final = Path("/packages")  # Numbers below it: paths of this machine may tell something.

_ROOT: Final = ("usr", "bin", "sbin", "lib", "lib32", "lib64", "libx32")
_ETC: Final = ("alternatives", "fonts", "group", "ld.so.cache", "localtime", "nsswitch.conf")
_CPU: Final = ("online", "possible", "present")
_BELOW: Final = {"/": _ROOT, "/etc": (*_ETC, "passwd", "timezone"), "/sys/devices/system/cpu": _CPU}
_READ_ONLY: Final = [Path(parent, name) for parent, names in _BELOW.items() for name in names]
_FROZEN: Final = ("cpuinfo", "filesystems", "meminfo", "stat", "version")
"""Files of /proc that libraries read: they are as they were when the command first looked.

Of the others, which tell what all processes of the system do, none is to be seen.
"""

_KEPT: Final = ("LANG", "LANGUAGE", "PATH", "TZ")  # of the user's environment
_METADATA: Final = (".dist-info", ".egg-info", ".egg", ".zip", ".pth")
_SUFFIXES: Final = (*importlib.machinery.all_suffixes(), *_METADATA)


class Sandbox:
    """Launcher of workers, each of which has a sandbox of its own.

    `hidden` are paths that they must not see, wherever they lie, and `packages` directories of
    packages that no other process imports.
    """

    processes = 256

    def __init__(self, hidden: Paths = (), packages: Paths = ()) -> None:
        self._hidden = [Path(os.path.realpath(path)) for path in hidden]
        targets = (Path(os.path.realpath(path)) for path in packages)
        self._packages = {PACKAGES / str(i): target for i, target in enumerate(targets)}
        self.packages = [*map(str, self._packages)]
        self._mounts: dict[tuple[Path, ...], tuple[list[str], bool]] = {}

    def wrap(self, command: Sequence[str]) -> tuple[list[str], list[int]]:
        """Return the command that runs another one in here, and descriptors that it reads."""
        # Directories of results are made after the first sandboxes.
        existing = tuple(path for path in self._hidden if path.exists())
        if existing not in self._mounts:
            readable = {path: path for path in _readable()} | self._packages
            nobody = _may_be_nobody(tuple(readable.items()))
            self._mounts[existing] = [*_mounts(readable, existing)], nobody
        mounts, nobody = self._mounts[existing]
        return _bubblewrap(mounts, command, nobody=nobody)

    @property
    def elsewhere(self) -> dict[str, Any]:
        """What another machine with the same file system makes an equal one of."""
        paths = {"hidden": self._hidden, "packages": self._packages.values()}
        return {"maker": ELSEWHERE} | {name: [*map(str, of)] for name, of in paths.items()}

    def environment(self) -> dict[str, str]:
        """Return the variables of a worker: few of the user's, and an empty directory as home."""
        kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
        return kept | dict.fromkeys(("HOME", "TMPDIR", "XDG_CACHE_HOME"), SCRATCH)


def make_sandbox(hidden: Iterable[str | Path] = (), packages: Iterable[str | Path] = ()) -> Sandbox:
    """Return a launcher, once a process has run in a sandbox.

    Raises `UsageError` if bubblewrap is not installed, or may not make a sandbox here.
    """
    sandbox = Sandbox(hidden, packages)
    command, descriptors = sandbox.wrap([sys.executable, "-I", "-c", "import oodd_eval"])
    code, error = _run(command, descriptors, sandbox.environment())
    if code:
        raise UsageError(
            f"bubblewrap cannot make a sandbox here: {error.strip()[-300:]}; "
            "user namespaces have to be allowed, and oodd-eval has to be installed"
        )
    return sandbox


def _run(
    command: Sequence[str], descriptors: Sequence[int], environment: dict[str, str]
) -> tuple[int, str]:
    """Run a command that reads descriptors, which are closed; return its exit code and errors."""
    done = subprocess.run(  # noqa: S603  bubblewrap and our own interpreter
        command, pass_fds=descriptors, env=environment, input=b"", capture_output=True, check=False
    )
    for descriptor in descriptors:
        os.close(descriptor)
    return done.returncode, done.stderr.decode(errors="replace")


@functools.cache
def _may_be_nobody(readable: tuple[tuple[Path, Path], ...]) -> bool:
    """Tell whether the superuser's workers can be nobody, who has to be able to read the files."""
    # Otherwise, as for other users, a worker has the user's number outside, and nobody's inside.
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        return False
    looks = ["/bin/sh", "-c", 'for path; do [ -r "$path" ] || exit 1; done', "sh"]
    looks += [str(path) for path, _ in readable if not path.is_symlink()]
    return _run(*_bubblewrap([*_mounts(dict(readable), [])], looks, nobody=True), {})[0] == 0


def _bubblewrap(
    mounts: Sequence[str], command: Sequence[str], *, nobody: bool
) -> tuple[list[str], list[int]]:
    """Return the command that runs another one in a sandbox, and descriptors that it reads."""
    descriptors: list[int] = []
    arguments = ["--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts"]
    arguments += ["--unshare-cgroup-try", "--die-with-parent", "--hostname", "sandbox"]
    arguments += ["--cap-drop", "ALL"]
    if shutil.which("prlimit"):
        # One byte: with none, the system would still hand a dump to a program of its own.
        command = ["prlimit", "--core=1:1", *command]
    if nobody:
        for right in ("SETUID", "SETGID", "SETPCAP"):  # gone once they are used
            arguments += ["--cap-add", f"CAP_{right}"]
        become = ["setpriv", "--reuid", NOBODY, "--regid", NOBODY, "--clear-groups"]
        become += ["--inh-caps=-all", "--ambient-caps=-all", "--bounding-set=-all"]
        command = [*become, *command]
    else:
        arguments += ["--unshare-user", "--disable-userns", "--uid", NOBODY, "--gid", NOBODY]
    arguments += mounts
    for name, content in _frozen().items():
        descriptors.append(_readable_file(content))
        arguments += ["--perms", "0444", "--ro-bind-data", str(descriptors[-1]), f"/proc/{name}"]
    arguments += ["--remount-ro", "/proc", "--remount-ro", "/dev", "--remount-ro", "/"]
    # Not on the command line, which every process in the sandbox can read.
    descriptors.append(_readable_file(b"\0".join(map(os.fsencode, arguments))))
    return [_program(), "--args", str(descriptors[-1]), *command], descriptors


def _readable_file(content: bytes) -> int:
    """Return the descriptor of a file with some content, which has no name."""
    with tempfile.TemporaryFile() as file:
        file.write(content)
        file.seek(0)
        return os.dup(file.fileno())


@functools.cache
def _frozen() -> dict[str, bytes]:
    frozen = {}
    for name in _FROZEN:
        with suppress(OSError):
            frozen[name] = Path("/proc", name).read_bytes()
    return frozen


def _mounts(readable: Mapping[Path, Path], hidden: Sequence[Path]) -> Iterator[str]:
    """Yield the arguments that mount what a worker sees, as some paths here by those there."""
    yield from ("--proc", "/proc", "--dev", "/dev", "--chdir", SCRATCH)
    for writable, size in ((SCRATCH, SCRATCH_BYTES), ("/dev/shm", SHARED_BYTES)):  # noqa: S108
        yield from ("--perms", "1777", "--size", str(size), "--tmpfs", writable)
    for entry in os.scandir("/proc"):
        if not entry.name.isdigit() and entry.name not in _FROZEN and not entry.is_symlink():
            yield from _masked(entry.path, directory=entry.is_dir())
    # Bubblewrap makes directories above what it mounts, but for their owner alone.
    for directory in dict.fromkeys(d for path in readable for d in reversed(path.parents)):
        yield from ("--perms", "0755", "--dir", str(directory))
    targets: dict[Path, Path] = {}  # real paths by those in the sandbox
    for path, source in readable.items():
        if any(path.is_relative_to(other) for other in targets):
            continue
        if path.is_symlink() and path.parent == Path("/"):  # such as /lib
            yield from ("--symlink", str(path.readlink()), str(path))
            continue
        targets[path] = Path(os.path.realpath(source))
        yield from ("--ro-bind", str(source), str(path))
    for secret in hidden:
        for path, target in targets.items():
            if secret.is_relative_to(target):
                inside = path / secret.relative_to(target)
                yield from _masked(str(inside), directory=secret.is_dir())


def _masked(path: str, *, directory: bool) -> tuple[str, ...]:
    """Return the arguments that put an empty directory, or file, in place of one."""
    if directory:
        return ("--size", "4096", "--tmpfs", path, "--remount-ro", path)
    return ("--ro-bind", os.devnull, path)


def _program() -> str:
    if not (program := shutil.which("bwrap")):
        raise UsageError(
            "a sandbox needs bubblewrap, the program bwrap (on Linux): PATH has none, install it"
        )
    return program


def _readable() -> Iterator[Path]:
    """Yield what a worker may read: the system, the interpreter, and what can be imported."""
    yield from filter(os.path.lexists, _READ_ONLY)
    for prefix in (sys.base_prefix, sys.prefix, os.path.realpath(sys.base_prefix)):
        yield Path(prefix)
    yield Path(os.path.realpath(sys.executable)).parent
    # A checkout on the import path also holds results and splits: only its modules are shown.
    for entry in map(Path, _import_path()):
        if entry.is_file() or entry.name in {"site-packages", "dist-packages"}:
            yield entry.absolute()
        elif entry.is_dir():
            yield from (path.absolute() for path in sorted(entry.iterdir()) if _importable(path))
    # Editable installs may find modules elsewhere, and those of plug-ins are not imported here.
    points = (p for g in ("oodd_eval", "oodd_eval.observers") for p in entry_points(group=g))
    for name in sorted({n.partition(".")[0] for n in (*sys.modules, *(p.module for p in points))}):
        with suppress(ImportError, ValueError, AttributeError):
            if spec := find_spec(name):
                for path in (*(spec.submodule_search_locations or ()), spec.origin):
                    if path and Path(path).exists():
                        yield Path(path).absolute()


@functools.cache
def _import_path() -> list[str]:
    """Return the import path of the environment, which is a worker's: without that of variables."""
    ask = [sys.executable, "-I", "-c", r"import sys; print(*sys.path, sep='\0', end='')"]
    return subprocess.run(ask, capture_output=True, text=True, check=True).stdout.split("\0")  # noqa: S603  our own interpreter


def _importable(path: Path) -> bool:
    if path.name.endswith(_SUFFIXES):
        return True
    return path.is_dir() and path.name.isidentifier() and any(path.glob("*.py"))
