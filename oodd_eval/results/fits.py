"""Fitted detectors on disk, by content key, so that scoring again never fits again.

::

    fitted/<key>/              files that the detector's own ``save`` wrote
    fitted/<key>/fitted.json   digests of those files, and the seconds that the fit took

A directory is filled elsewhere and then moved to its place, so that it is whole or absent. Its
files are compared with their digests before a detector is asked to load them.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from oodd_eval.data.files import digests

INDEX: Final = "fitted.json"

MAX_BYTES: Final = 512 * 10**6  # A fitted detector larger than this is not kept


class KeptFit(NamedTuple):
    """A fitted detector that can be loaded: its directory, and the seconds that its fit took."""

    path: Path
    seconds_fit: float


class FitStore:
    """Fitted detectors below one directory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made: set[str] = set()

    def has(self, key: str, *, fresh: bool = False) -> bool:
        """Tell whether a fit is kept under a key; when `fresh`, only one that this object kept."""
        return (key in self._made or not fresh) and (self.path / key / INDEX).is_file()

    def find(self, key: str, *, fresh: bool = False) -> KeptFit | None:
        """Return the fit kept under a key; None when there is none, or its files were damaged."""
        if not self.has(key, fresh=fresh):
            return None
        place = self.path / key
        try:
            index = json.loads((place / INDEX).read_text(encoding="utf-8"))
            if digests(place, without=INDEX) != index["files"]:
                return None
            return KeptFit(place, float(index["seconds_fit"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    @contextlib.contextmanager
    def filling(self) -> Iterator[Path]:
        """Give an empty directory for a detector to save itself in; remove it afterwards."""
        self.path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=".", suffix=f".{os.getpid()}", dir=self.path, ignore_cleanup_errors=True
        ) as made:
            yield Path(made)

    def keep(self, key: str, directory: Path, seconds_fit: float) -> None:
        """Move a filled directory to its key; do nothing when it is empty or too large."""
        files = digests(directory, without=INDEX)
        size = sum((directory / name).stat().st_size for name in files)
        if not files or size > MAX_BYTES:
            return
        index = {"files": files, "seconds_fit": seconds_fit}
        (directory / INDEX).write_text(json.dumps(index, indent=1), encoding="utf-8")
        shutil.rmtree(self.path / key, ignore_errors=True)
        # Another process may have been quicker; then its result, the same, stays.
        with contextlib.suppress(OSError):
            directory.rename(self.path / key)
            self._made.add(key)

    def distrust(self, key: str) -> None:
        """Treat the fit under a key as an earlier run's: it could not be loaded."""
        self._made.discard(key)
