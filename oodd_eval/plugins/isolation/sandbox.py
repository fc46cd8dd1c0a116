"""A sandbox for one worker, by bubblewrap: what it may read, where it may write, and nothing else.

The worker sees the system's programs and libraries, the interpreter and what can be imported, all
read-only. Its home is ``/tmp``: an empty directory, which is removed when the worker ends. It has
no network, sees no process but its own, and has no capabilities.
"""

import importlib.machinery
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval.errors import UsageError

SCRATCH: Final = Path("/tmp")  # noqa: S108  of the sandbox, not of the system

_READ_ONLY: Final = (
    "/usr",
    "/bin",
    "/sbin",
    "/lib",
    "/lib32",
    "/lib64",
    "/libx32",
    "/sys/devices/system/cpu",
    "/etc/alternatives",
    "/etc/fonts",
    "/etc/group",
    "/etc/ld.so.cache",
    "/etc/localtime",
    "/etc/nsswitch.conf",
    "/etc/passwd",
    "/etc/timezone",
)
_KEPT: Final = ("LANG", "LANGUAGE", "PATH", "TZ")  # of the user's environment
_SUFFIXES: Final = (
    *importlib.machinery.all_suffixes(),
    ".dist-info",
    ".egg-info",
    ".egg",
    ".zip",
    ".pth",
)


class Sandbox:
    """The place of one worker; to be closed.

    `hidden` are paths that it must not see, wherever they lie. A fit is saved in the sandbox and
    loaded from there: its own directory would tell the user's paths.
    """

    def __init__(self, hidden: Iterable[str | Path]) -> None:
        self._outside = Path(tempfile.mkdtemp(prefix="oodd-eval-"))
        self._hidden = [Path(os.path.realpath(path)) for path in hidden]

    def close(self) -> None:
        """Remove what the worker has written."""
        shutil.rmtree(self._outside, ignore_errors=True)

    def taken(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return a request for a worker in here: a kept fit is brought, a place to save is made."""
        inside = dict(request)
        if request["load"]:
            _copy_plain(Path(request["load"]), self._outside / "load")
            inside["load"] = str(SCRATCH / "load")
        if request["save"]:
            (self._outside / "save").mkdir()
            inside["save"] = str(SCRATCH / "save")
        return inside

    def give(self, request: Mapping[str, Any]) -> None:
        """Copy what the worker has saved to where the request wants it; links are left out."""
        if request["save"]:
            _copy_plain(self._outside / "save", Path(request["save"]))

    def command(self, command: Sequence[str]) -> tuple[list[str], int]:
        """Return the command that runs another one in here, and a descriptor that it reads."""
        # Not on the command line, which every process in the sandbox can read.
        arguments = tempfile.TemporaryFile()  # noqa: SIM115  its descriptor is for the caller
        arguments.write(b"\0".join(map(os.fsencode, self._arguments())))
        arguments.seek(0)
        descriptor = os.dup(arguments.fileno())
        arguments.close()
        return [_program(), "--args", str(descriptor), *command], descriptor

    def environment(self) -> dict[str, str]:
        """Return the variables of a worker: few of the user's, and an empty directory as home."""
        kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
        return kept | dict.fromkeys(("HOME", "TMPDIR", "XDG_CACHE_HOME"), str(SCRATCH))

    def _arguments(self) -> Iterator[str]:
        yield from ("--unshare-all", "--unshare-user", "--disable-userns", "--die-with-parent")
        yield from ("--cap-drop", "ALL", "--hostname", "sandbox")
        yield from ("--proc", "/proc", "--dev", "/dev", "--bind", str(self._outside), str(SCRATCH))
        targets: dict[Path, Path] = {}  # real paths by those in the sandbox
        for path in _readable():
            if any(path.is_relative_to(other) for other in targets):
                continue
            if path.is_symlink() and path.parent == Path("/"):  # such as /lib
                yield from ("--symlink", str(path.readlink()), str(path))
                continue
            targets[path] = Path(os.path.realpath(path))
            yield from ("--ro-bind", str(path), str(path))
        for hidden in self._hidden:
            for path, target in targets.items():
                if hidden.exists() and hidden.is_relative_to(target):
                    mask = ("--tmpfs",) if hidden.is_dir() else ("--ro-bind", os.devnull)
                    yield from (*mask, str(path / hidden.relative_to(target)))
        yield from ("--remount-ro", "/", "--chdir", str(SCRATCH))


def require_sandbox() -> None:
    """Raise `UsageError` if bubblewrap is not installed, or may not make a sandbox here."""
    box = Sandbox(())
    try:
        command, descriptor = box.command([sys.executable, "-I", "-c", ""])
        done = subprocess.run(  # noqa: S603  bubblewrap and our own interpreter
            command,
            pass_fds=[descriptor],
            env=box.environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        os.close(descriptor)
    finally:
        box.close()
    if done.returncode:
        raise UsageError(
            f"--sandbox: bubblewrap cannot make a sandbox here: {done.stderr.strip()[-300:]}; "
            "user namespaces have to be allowed"
        )


def _program() -> str:
    if not (program := shutil.which("bwrap")):
        raise UsageError("--sandbox needs bubblewrap, the program bwrap (on Linux): install it")
    return program


def _readable() -> Iterator[Path]:
    """Yield what a worker may read: the system, the interpreter, and what can be imported."""
    yield from (Path(path) for path in _READ_ONLY if os.path.lexists(path))
    for prefix in (sys.base_prefix, sys.prefix, os.path.realpath(sys.base_prefix)):
        yield Path(prefix)
    yield Path(os.path.realpath(sys.executable)).parent
    # A checkout on the import path also holds results and splits: only its modules are shown.
    for entry in map(Path, dict.fromkeys(sys.path)):
        if entry.is_file() or entry.name in {"site-packages", "dist-packages"}:
            yield entry.absolute()
        elif entry.is_dir():
            yield from (path.absolute() for path in sorted(entry.iterdir()) if _importable(path))
    # Editable installs may find modules elsewhere.
    for name, module in sorted(sys.modules.items()):
        if "." not in name:
            for path in (*getattr(module, "__path__", ()), getattr(module, "__file__", None)):
                if path and Path(path).exists():
                    yield Path(path).absolute()


def _importable(path: Path) -> bool:
    if path.name.endswith(_SUFFIXES):
        return True
    return path.is_dir() and path.name.isidentifier() and any(path.glob("*.py"))


def _copy_plain(source: Path, target: Path) -> None:
    """Copy a directory's files and directories: a link or pipe in it could name another file."""
    target.mkdir(parents=True, exist_ok=True)
    for entry in os.scandir(source):
        if entry.is_dir(follow_symlinks=False):
            _copy_plain(Path(entry.path), target / entry.name)
        elif entry.is_file(follow_symlinks=False):
            shutil.copy2(entry.path, target / entry.name)
