"""The files of an entry: which there may be, how large, and how they are read without trust.

Nothing is followed, opened or decoded before it is known to be a plain file of bounded size.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from oodd_eval.data import files as stored_files
from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.entry import CURVES, ENTRY, SCORES
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.results.directory import RECORDS

MB: Final = 10**6
MOST_PLAIN: Final = {RECORDS: stored_files.MAX_BYTES, CURVES: 16 * MB}
"""Largest sizes of files that may be packed, unpacked."""

MOST_BYTES: Final = {
    ENTRY: MB // 4,
    **MOST_PLAIN,
    **{name + stored_files.GZIP: 8 * MB for name in MOST_PLAIN},
}
"""Largest sizes by name; those of score files are `MOST_SCORE_BYTES`."""

MOST_SCORE_BYTES: Final = 64 * MB
MOST_TOTAL_BYTES: Final = 128 * MB
MOST_FILES: Final = 2000

_SCORE_FILE: Final = re.compile(rf"{SCORES}/[a-z0-9][a-z0-9._-]{{0,159}}\.h5")


def list_files(entry: Path, findings: Findings) -> dict[str, int]:
    """Return the sizes of an entry's files by relative name: of those alone that may be read.

    Everything else in the directory is refused: other files, directories, links, devices.
    """
    found: dict[str, int] = {}
    listed = _scan(entry, "", findings)
    if SCORES in listed and stat.S_ISDIR(listed[SCORES].st_mode):
        del listed[SCORES]
        listed |= _scan(entry / SCORES, f"{SCORES}/", findings)
    for name, status in sorted(listed.items()):
        if _is_fine(name, status, findings):
            found[name] = status.st_size
    total = sum(found.values())
    if total > MOST_TOTAL_BYTES:
        findings.refuse(
            "files", "total size", f"is {total} bytes, expected at most {MOST_TOTAL_BYTES}"
        )
        return {}
    for name in MOST_PLAIN:
        if name in listed and name + stored_files.GZIP in listed:
            findings.refuse(
                name + stored_files.GZIP, "", f"is there beside {name}: expected one of the two"
            )
    for name in (ENTRY, RECORDS):
        if not {name, name + stored_files.GZIP} & listed.keys():
            findings.refuse(name, "", "is missing")
    return found


def name_in(files: Mapping[str, int], name: str) -> str:
    """Return the name under which a file is there, plain or packed; empty if it is not."""
    return next((n for n in (name, name + stored_files.GZIP) if n in files), "")


def read_whole(entry: Path, name: str) -> str:
    """Read a text file of an entry, unpacked if its name says that it is packed.

    Raises
    ------
    ResultsError
        When it is too large, no plain file, not packed as it should be, or not UTF-8.
    """
    content = read_bytes(entry / name, MOST_BYTES[name])
    if name.endswith(stored_files.GZIP):
        content = stored_files.decompress(content, MOST_PLAIN[name.removesuffix(stored_files.GZIP)])
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ResultsError(f"is not UTF-8: {error.reason} in line {line}") from None


def _scan(directory: Path, prefix: str, findings: Findings) -> dict[str, os.stat_result]:
    listed: dict[str, os.stat_result] = {}
    try:
        with os.scandir(directory) as items:
            for item in items:
                if len(listed) == MOST_FILES:
                    findings.refuse(prefix or "entry", "", f"holds more than {MOST_FILES} files")
                    return {}
                listed[prefix + item.name] = item.stat(follow_symlinks=False)
    except OSError as error:
        findings.refuse(prefix or "entry", "", f"cannot be listed: {error.strerror}")
    return listed


def _is_fine(name: str, status: os.stat_result, findings: Findings) -> bool:
    where = shown(name)[1:-1]
    if stat.S_ISLNK(status.st_mode):
        findings.refuse(where, "", "is a symbolic link, expected plain files")
    elif name not in MOST_BYTES and not _SCORE_FILE.fullmatch(name):
        findings.refuse(
            where, "", f"is no file of an entry: expected {', '.join(MOST_BYTES)}, {SCORES}/*.h5"
        )
    elif not stat.S_ISREG(status.st_mode):
        findings.refuse(where, "", "is no plain file")
    elif status.st_size > (most := MOST_BYTES.get(name, MOST_SCORE_BYTES)):
        findings.refuse(where, "", f"has {status.st_size} bytes, expected at most {most}")
    else:
        return True
    return False


def read_bytes(path: Path, most: int) -> bytes:
    """Read a plain file of at most `most` bytes, following no link and waiting for no pipe.

    Raises
    ------
    ResultsError
        When it is something else.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | getattr(os, "O_NOFOLLOW", 0))
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ResultsError("is no plain file")
            content = file.read(most + 1)
    except OSError as error:
        raise ResultsError(f"cannot be read: {error.strerror}") from None
    if len(content) > most:
        raise ResultsError(f"has more than {most} bytes")
    return content


def check_digests(
    entry: Path, found: Mapping[str, int], claimed: Mapping[str, Any], findings: Findings
) -> None:
    """Compare the files with what ``entry.json`` says of them."""
    for name in sorted(claimed.keys() - found.keys()):
        findings.refuse(ENTRY, f"files.{shown(name)[1:-1]}", "names a file that is not there")
    for name, size in found.items():
        if name == ENTRY:
            continue
        field = f"files.{name}"
        if name not in claimed:
            findings.refuse(ENTRY, field, "is missing, but the file is there")
            continue
        if claimed[name]["bytes"] != size:
            findings.refuse(
                ENTRY, f"{field}.bytes", f"is {claimed[name]['bytes']}, but the file has {size}"
            )
        try:
            content = read_bytes(entry / name, MOST_BYTES.get(name, MOST_SCORE_BYTES))
        except ResultsError as error:
            findings.refuse(name, "", str(error))
            continue
        digest = hashlib.sha256(content).hexdigest()
        if claimed[name]["sha256"] != digest:
            findings.refuse(
                ENTRY,
                f"{field}.sha256",
                f"is {claimed[name]['sha256'][:12]}, but the file has {digest[:12]}: it was "
                "changed after the entry was written",
            )


def parse_json(text: str) -> Any:
    """Parse JSON without its ambiguities: no NaN, no infinity, no name twice in an object.

    Raises
    ------
    ResultsError
        When it cannot be parsed so.
    """
    try:
        return json.loads(text, object_pairs_hook=_once, parse_constant=_refuse_constant)
    except RecursionError:
        raise ResultsError("is nested too deep") from None
    except ValueError as error:
        raise ResultsError(f"is not JSON: {error}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {shown(name)} stands twice in one object")
        found[name] = value
    return found


def _refuse_constant(constant: str) -> Any:
    raise ValueError(f"{constant} is no JSON number; undefined values are null")
