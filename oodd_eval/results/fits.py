"""Fitted detectors on disk, by content key, so that scoring again never fits again.

::

    fitted/<key>/           what the detector's own ``save`` wrote
    fitted/<key>/fitted.json   digests of those files, and what the fit cost

A directory is filled elsewhere and then moved to its place, so that it is whole or absent. What is
there is compared with its digests before a detector is asked to load it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

INDEX: Final = "fitted.json"

MOST_BYTES: Final = 512 * 10**6
"""A fitted detector larger than this is not kept."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fitted detector that can be loaded: where it is, and the seconds that its fit took."""

    path: Path
    seconds_fit: float


class FittedStore:
    """Fitted detectors below one directory.

    Parameters
    ----------
    path
        The directory; made when something is kept.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made: set[str] = set()
        self._locks: dict[str, threading.Lock] = {}
        self._guard = threading.Lock()

    @contextlib.contextmanager
    def alone(self, key: str) -> Iterator[None]:
        """Let one thread at a time fit what belongs to a key; the others find it done."""
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            yield

    def has(self, key: str, *, fresh: bool) -> bool:
        """Whether something is kept under a key; when `fresh`, by this very object.

        Its files are not looked at: that is for `find`.
        """
        return (key in self._made or not fresh) and (self.path / key / INDEX).is_file()

    def find(self, key: str, *, fresh: bool = False) -> Fitted | None:
        """Return what is kept under a key; None when nothing is, or its files were damaged.

        When `fresh`, what another object has kept, as an earlier run did, does not count.
        """
        if not self.has(key, fresh=fresh):
            return None
        place = self.path / key
        try:
            index = json.loads((place / INDEX).read_text(encoding="utf-8"))
            if _digests(place) != index["files"]:
                return None
            return Fitted(place, float(index["seconds_fit"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    @contextlib.contextmanager
    def room(self) -> Iterator[Path]:
        """Give an empty directory for a detector to save itself in; afterwards it is gone."""
        self.path.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{os.getpid()}-", dir=self.path))
        try:
            yield made
        finally:
            shutil.rmtree(made, ignore_errors=True)

    def keep(self, key: str, room: Path, seconds_fit: float) -> None:
        """Move what a detector saved to its key; nothing happens when it saved nothing."""
        files = _digests(room)
        size = sum((room / name).stat().st_size for name in files)
        if not files or size > MOST_BYTES:
            return
        index = {"files": files, "seconds_fit": seconds_fit}
        (room / INDEX).write_text(json.dumps(index, indent=1), encoding="utf-8")
        self.drop(key)
        # Another process may have been quicker; then its result, the same, stays.
        with contextlib.suppress(OSError):
            room.rename(self.path / key)
            self._made.add(key)

    def distrust(self, key: str) -> None:
        """Take what is kept under a key for an earlier run's: it could not be loaded."""
        self._made.discard(key)

    def drop(self, key: str) -> None:
        """Forget what is kept under a key."""
        shutil.rmtree(self.path / key, ignore_errors=True)


def _digests(place: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a directory, by relative name."""
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.name != INDEX
    }
