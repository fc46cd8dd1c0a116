"""Content keys: equal keys mean equal scores, or an equal fit.

A key covers the plug-in's code and version, the contract's version, the detector's parameters, the
data and the protocol. Moving a file of the harness changes no key.
"""

import functools
import hashlib
import importlib.util
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from oodd_eval.plugins.contract import CONTRACT

_IMPORT = re.compile(rb"^\s*(?:from|import)\s+(oodd_\w+)", re.MULTILINE)


@functools.cache
def source_digest(module: str) -> str:
    """Return the SHA-256 of a plug-in's own packages and of the contract's version.

    These are the package that the entry point names and all packages ``oodd_*`` that it imports.
    The harness is covered by `CONTRACT`, third-party libraries by the versions in a record's
    provenance.
    """
    content = hashlib.sha256(f"contract {CONTRACT}\0".encode())
    pending, seen = [module], {"oodd_eval"}
    files: dict[str, bytes] = {}
    while pending:
        top = pending.pop().partition(".")[0]
        if top in seen:
            continue
        seen.add(top)
        for name, path in _files(top):
            files[name] = path.read_bytes()
            if path.suffix == ".py":
                pending += [package.decode() for package in _IMPORT.findall(files[name])]
    for name, code in sorted(files.items()):
        content.update(f"{name}\0{hashlib.sha256(code).hexdigest()}\0".encode())
    return content.hexdigest()


def _files(top: str) -> Iterator[tuple[str, Path]]:
    """Yield the files of a package, or of a single module, by names free of installation paths."""
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None:
        return
    origin = Path(spec.origin)
    if not spec.submodule_search_locations:
        yield origin.name, origin
        return
    for path in origin.parent.rglob("*"):
        if path.is_file() and path.suffix != ".pyc":
            yield str(Path(top) / path.relative_to(origin.parent)), path


def scores_key(detector: str, environment: str, identity: Mapping[str, Any]) -> str:
    """Return the key of a unit's scores as a short file name."""
    # Some file systems take no colons, and some do not tell capitals.
    file_name = detector.lower().replace(":", "-")
    return f"{file_name}-{environment}-{_digest(identity)[:20]}"


def fit_key(identity: Mapping[str, Any]) -> str:
    """Return the key of a fit. It tells nothing of the environment, since the worker sees it."""
    return _digest(identity)[:32]


def _digest(identity: Mapping[str, Any]) -> str:
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()
