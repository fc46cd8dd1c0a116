"""Where a result is from: versions, machine, commit, and digests of the code that made it."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import platform
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval._version import __version__

_HOME: Final = Path(__file__).parents[1]
_SCORING_MODULES: Final = ("plugins.contract", "data.trajectory", "plugins.isolation.worker")
"""Modules of the harness that every score passes through, beside those that a plug-in imports."""


def gather() -> dict[str, Any]:
    """Return the provenance of results computed now, on this machine."""
    return {
        "oodd_eval": __version__,
        **_commit(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "platform": platform.platform(),
        "cpu": _cpu(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@functools.cache
def source_digest(module: str) -> str:
    """Return the SHA-256 of the code that decides a plug-in's scores.

    That is all files of the plug-in's own package (or its one file), of packages named ``oodd_*``
    that it imports, of the harness's modules that it imports, and of those through which every
    score passes. Third-party libraries are not included; their versions are part of an environment,
    not of a plug-in.
    """
    content = hashlib.sha256()
    for name, path in sorted(_sources(module).items()):
        content.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\0".encode())
    return content.hexdigest()


def _sources(module: str) -> dict[str, Path]:
    """Return the files that a plug-in's scores depend on, by names free of installation paths."""
    files: dict[str, Path] = {}
    pending = [module, *(f"oodd_eval.{name}" for name in _SCORING_MODULES)]
    seen: set[str] = set()
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        for label, path in _files(name):
            files[label] = path
            if path.suffix == ".py":
                pending += [i for i in _imports(path) if i.startswith("oodd_") and i != "oodd_eval"]
    return files


def _files(name: str) -> Iterator[tuple[str, Path]]:
    """Yield the files behind a module: of the harness that module, else the whole package."""
    top, _, rest = name.partition(".")
    if top == "oodd_eval":
        path = _HOME / f"{rest.replace('.', '/')}.py"
        if path.is_file():
            yield str(Path(top) / path.relative_to(_HOME)), path
        return
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None:
        return
    if not spec.submodule_search_locations:
        yield Path(spec.origin).name, Path(spec.origin)
        return
    root = Path(spec.origin).parent
    for path in root.rglob("*"):
        if path.is_file() and path.suffix != ".pyc":
            yield str(Path(top) / path.relative_to(root)), path


def _imports(path: Path) -> Iterator[str]:
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, UnicodeDecodeError):
        return  # Its bytes count; where it leads cannot be read.
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            # `from oodd_eval import prediction` names a module only in what it imports.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _commit() -> dict[str, Any]:
    """Return commit and dirty flag when the harness runs from a checkout of its own."""
    try:
        _git("ls-files", "--error-unmatch", "__init__.py")
        return {"git_commit": _git("rev-parse", "HEAD"), "git_dirty": bool(_git("status", "-s"))}
    except (OSError, subprocess.SubprocessError):
        return {"git_commit": None, "git_dirty": None}


def _git(*arguments: str) -> str:
    done = subprocess.run(  # noqa: S603  fixed arguments
        ["git", *arguments],  # noqa: S607  whichever git is on the path
        cwd=_HOME,
        capture_output=True,
        text=True,
        check=True,
        timeout=10,
    )
    return done.stdout.strip()


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()
