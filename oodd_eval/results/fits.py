"""Fitted detectors on disk, by content key, so that scoring again never fits again.

::

    fitted/<key>/              files that the detector's own ``save`` wrote
    fitted/<key>/fitted.json   digests of those files, and the seconds that the fit took

A directory is filled elsewhere and then moved to its place, so that it is whole or absent. Its
files are compared with their digests before a detector is asked to load them.
"""

import contextlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from oodd_eval.data.files import digests
from oodd_eval.errors import OutputError

INDEX: Final = "fitted.json"

MAX_BYTES: Final = 512 * 10**6  # A fitted detector larger than this is not kept
_MAX_INDEX: Final = 10**7


class KeptFit(NamedTuple):
    """A fitted detector that can be loaded: its directory, and the seconds that its fit took."""

    path: Path
    seconds_fit: float


class FitStore:
    """Fitted detectors below one directory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kept: set[str] = set()

    def has(self, key: str, *, fresh: bool = False) -> bool:
        """Tell whether a fit is kept under a key; when `fresh`, only one that this object kept."""
        return (key in self._kept or not fresh) and (self.path / key / INDEX).is_file()

    def find(self, key: str, *, fresh: bool = False) -> KeptFit | None:
        """Return the fit kept under a key; None when there is none, or its files were damaged."""
        if not self.has(key, fresh=fresh):
            return None
        path = self.path / key
        try:
            if _size(path) > MAX_BYTES or (path / INDEX).stat().st_size > _MAX_INDEX:
                return None
            index = json.loads((path / INDEX).read_text(encoding="utf-8"))
            seconds = float(index["seconds_fit"])
            if digests(path, without=INDEX) != index["files"] or not 0 <= seconds < math.inf:
                return None
            return KeptFit(path, seconds)
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None

    @contextlib.contextmanager
    def filling(self) -> Iterator[Path]:
        """Yield an empty directory for a detector to save itself in; remove it afterwards.

        `OutputError`: it cannot be made.
        """
        try:
            try:
                temporary = self._temporary()
            except FileNotFoundError:  # Somebody has just removed the directory.
                temporary = self._temporary()
        except OSError as error:
            raise OutputError(f"{str(self.path)!r} cannot be written to: {error}") from None
        with temporary as path:
            yield Path(path)

    def _temporary(self) -> "tempfile.TemporaryDirectory[str]":
        self.path.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(
            prefix=".", suffix=f".{os.getpid()}", dir=self.path, ignore_cleanup_errors=True
        )

    def keep(self, key: str, directory: Path, seconds_fit: float) -> None:
        """Move a filled directory to its key; do nothing when it is empty or too large.

        Nor where it cannot be written: without it, another run fits again.
        """
        # Another process may have been quicker; then its result, the same, stays.
        with contextlib.suppress(OSError):
            # Sizes first: a file may be said to hold more than there is room for.
            if _size(directory) > MAX_BYTES or not (files := digests(directory, without=INDEX)):
                return
            index = {"files": files, "seconds_fit": seconds_fit}
            (directory / INDEX).write_text(json.dumps(index, indent=1), encoding="utf-8")
            shutil.rmtree(self.path / key, ignore_errors=True)
            directory.rename(self.path / key)
            self._kept.add(key)

    def distrust(self, key: str) -> None:
        """Treat the fit under a key as an earlier run's: it could not be loaded."""
        self._kept.discard(key)


def _size(directory: Path) -> int:
    """Return the bytes of all files below a directory."""
    return sum(path.stat().st_size for path in directory.rglob("*") if path.is_file())
