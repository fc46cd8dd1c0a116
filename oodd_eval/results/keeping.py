"""Keep what a run comes to as it goes, so that a killed run loses nothing that was finished.

Scores are kept the moment a unit is finished: they are what a later run resumes from. Records can
be made from them again and are written from time to time, since each writing is of the whole file.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from pathlib import Path
from typing import Final

from oodd_eval.results.directory import ResultsDirectory, UnitKey
from oodd_eval.results.record import Record
from oodd_eval.scoring.unit import Scored

SHARE_OF_WRITING: Final = 0.05
"""Records are written again once the last writing took less than this share of the time since."""

# Files and directories that are being written are named by `oodd_eval.results.directory` and
# `oodd_eval.results.fits` with the id of the writing process.
_TEMPORARY_FILE: Final = re.compile(r"\..+\.(\d+)")
_TEMPORARY_ROOM: Final = re.compile(r"\.(\d+)-")


class Keeper:
    """Writes scores, logs and records of one run.

    Parameters
    ----------
    results
        Where to; None keeps nothing.
    """

    def __init__(self, results: ResultsDirectory | None) -> None:
        self._results = results
        self._finished: dict[int, list[Record]] = {}
        self._unwritten = False
        self._due = 0.0

    def prepare(self) -> None:
        """Make the results directory ready and remove what a killed run left half written.

        Raises
        ------
        OutputError, ResultsError
            See `ResultsDirectory.prepare`.
        """
        if self._results:
            self._results.prepare()
            _clean(self._results.path)

    def keep(self, key: UnitKey, scored: Scored) -> None:
        """Keep a unit's scores, or what its failing detector printed."""
        if not self._results:
            return
        if scored.status == "ok" and not scored.resumed:
            self._results.write_scores(key.text, scored.file)
        if scored.log:
            self._results.write_log(key.text, scored.log)

    def add(self, index: int, records: list[Record]) -> None:
        """Take the records of the unit that is `index`-th in the plan; write all if it is time."""
        self._finished[index] = records
        self._unwritten = True
        if time.monotonic() >= self._due:
            self.write()

    def write(self) -> None:
        """Write all records so far, unless none is new."""
        if not (self._results and self._unwritten):
            return
        start = time.monotonic()
        self._results.merge_records(self.records)
        self._unwritten = False
        now = time.monotonic()
        self._due = now + (now - start) / SHARE_OF_WRITING

    @property
    def records(self) -> list[Record]:
        """All records so far, in the order of the plan."""
        return [record for index in sorted(self._finished) for record in self._finished[index]]


def _clean(directory: Path) -> None:
    """Remove what was being written by processes that are no more."""
    for folder in (directory, directory / "scores", directory / "logs"):
        for file in folder.glob(".*"):
            found = _TEMPORARY_FILE.fullmatch(file.name)
            if found and not _alive(int(found[1])):
                file.unlink(missing_ok=True)
    for room in (directory / "fitted").glob(".*"):
        found = _TEMPORARY_ROOM.match(room.name)
        if found and not _alive(int(found[1])):
            shutil.rmtree(room, ignore_errors=True)


def _alive(pid: int) -> bool:
    with contextlib.suppress(PermissionError):
        try:
            os.kill(pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
    return True
