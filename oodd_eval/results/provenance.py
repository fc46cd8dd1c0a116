"""The origin of results: versions, machine, commit and time. Nothing of it decides identity."""

import platform
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from oodd_eval._version import __version__

PACKAGES: Final = ("h5py", "numpy", "scikit-learn", "scipy", "torch")  # scores depend on them

_HOME: Final = Path(__file__).parents[1]


def gather(command: str = "") -> dict[str, Any]:
    """Return the provenance of results computed now, on this machine."""
    return {
        "oodd_eval": __version__,
        **_commit(),
        "command": command,
        "python": platform.python_version(),
        "packages": packages(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def packages() -> dict[str, str]:
    """Return the installed versions of `PACKAGES`."""
    versions = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def _commit() -> dict[str, Any]:
    """Return commit and dirty flag when the harness runs from a checkout of its own."""
    try:
        _git("ls-files", "--error-unmatch", "__init__.py")
        return {"git_commit": _git("rev-parse", "HEAD"), "git_dirty": bool(_git("status", "-s"))}
    except (OSError, subprocess.SubprocessError):
        return {"git_commit": None, "git_dirty": None}


def _git(*arguments: str) -> str:
    # Whichever git is on the path. Killed while it holds the index, it would leave a lock behind.
    command = ["git", "--no-optional-locks", *arguments]
    text = subprocess.check_output(  # noqa: S603  fixed arguments
        command, cwd=_HOME, stderr=subprocess.DEVNULL, text=True, timeout=10
    )
    return text.strip()


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()
