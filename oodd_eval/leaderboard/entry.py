"""An entry of the leaderboard: one directory of plain data.

::

    entry.json       what it is, who submits it, and the digest of every other file
    records.jsonl    one record a line, as in a results directory
    curves.json      illustrations computed from the scores (optional)
    scores/*.h5      every score, as in a results directory (optional)

Records or curves of more than a megabyte are packed: ``records.jsonl.gz``, ``curves.json.gz``.

Reading here is for entries that were verified (`oodd_eval.leaderboard.verify.verify`): the shape of
``entry.json`` and of each record is checked, their truth is not.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from oodd_eval.data import files as stored_files
from oodd_eval.errors import ResultsError
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record

SCHEMA: Final = 1
"""Version of the layout of an entry; a reader refuses others."""

ENTRY: Final = "entry.json"
CURVES: Final = "curves.json"
SCORES: Final = "scores"

TRUST: Final = ("reported", "re-scored", "re-run")
"""Levels of trust, the lowest first."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What ``entry.json`` says.

    Attributes
    ----------
    id
        Name of the entry and of its directory.
    title, submitter, citation, url, caption
        Plain text for people; the caption is a note above the tables. All but the title may be
        empty.
    detectors
        Names of the detectors in the records, sorted.
    trust
        ``"reported"``, ``"re-scored"`` or ``"re-run"``.
    rerun
        For ``"re-run"``, ``{"by": who, "how": on what}``; else None.
    split, split_digest, protocol
        What all records are of.
    plugins
        ``{"distribution", "plugin", "version", "source_digest"}`` of every plug-in.
    environment
        ``{"python", "platform", "packages": {name: version}}`` of the run.
    created
        Date, as ``"2026-11-21"``.
    command
        How the entry was made.
    files
        ``{relative name: {"sha256", "bytes"}}`` of every other file.
    schema
        Version of this layout.
    """

    id: str
    title: str
    detectors: list[str]
    submitter: str
    citation: str
    url: str
    trust: str
    split: str
    split_digest: str
    protocol: int
    plugins: list[dict[str, str]]
    environment: dict[str, Any]
    created: str
    command: str
    caption: str
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    rerun: dict[str, str] | None = None
    schema: int = SCHEMA

    def to_json(self) -> str:
        """Return the text of ``entry.json``, keys sorted."""
        return json.dumps(asdict(self), indent=1, sort_keys=True, ensure_ascii=False) + "\n"

    @classmethod
    def from_plain(cls, plain: Any, where: str) -> Entry:
        """Make an entry of a JSON value.

        Raises
        ------
        ResultsError
            When it has another schema or other fields.
        """
        if not isinstance(plain, dict):
            raise ResultsError(f"{where} is {type(plain).__name__}, expected a JSON object")
        if plain.get("schema") != SCHEMA:
            raise ResultsError(
                f"{where}: schema is {plain.get('schema')!r:.60}, expected {SCHEMA}: it was "
                "written by another version of oodd-eval"
            )
        names = {f.name for f in fields(cls)}
        if plain.keys() != names:
            raise ResultsError(
                f"{where} has other fields than an entry: missing {sorted(names - plain.keys())}, "
                f"unknown {sorted(plain.keys() - names)!s:.200}"
            )
        return cls(**plain)


@dataclass(frozen=True, slots=True)
class SubmittedEntry:
    """An entry that was read: `meta` is ``entry.json``, `path` its directory."""

    path: Path
    meta: Entry
    records: list[Record]

    @property
    def curves(self) -> Path | None:
        """The file of curves; None when the entry has none."""
        return stored_files.find_file(self.path / CURVES)

    @property
    def results(self) -> ResultsDirectory:
        """Access to the entry as a results directory, to its scores above all."""
        return ResultsDirectory(self.path)


def read_entry(path: Path | str) -> SubmittedEntry:
    """Read the entry in a directory.

    Raises
    ------
    ResultsError
        When it cannot be read.
    """
    path = Path(path)
    file = path / ENTRY
    try:
        plain = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ResultsError(f"{str(file)!r} cannot be read: {error}") from None
    meta = Entry.from_plain(plain, str(file))
    return SubmittedEntry(path, meta, ResultsDirectory(path).records())


def entry_paths(root: Path | str) -> list[Path]:
    """Return the directories below `root`, or `root` itself, that hold an entry, sorted."""
    root = Path(root)
    if (root / ENTRY).exists():
        return [root]
    found = (path.parent for path in root.glob(f"*/{ENTRY}"))
    # A name with a leading dot is an entry that is being written.
    return sorted(path for path in found if not path.name.startswith("."))


def read_entries(root: Path | str) -> list[SubmittedEntry]:
    """Read every entry below a directory, in the order of their names.

    Raises
    ------
    ResultsError
        When the directory does not exist or an entry cannot be read.
    """
    root = Path(root)
    if not root.is_dir():
        raise ResultsError(f"no directory of entries at {str(root)!r}")
    return [read_entry(path) for path in entry_paths(root)]


__all__ = ["CURVES", "ENTRY", "RECORDS", "SCHEMA", "SCORES", "TRUST", "Entry", "SubmittedEntry",
           "entry_paths", "read_entries", "read_entry"]  # fmt: skip
