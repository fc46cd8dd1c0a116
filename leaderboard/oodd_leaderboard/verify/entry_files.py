"""The files of an entry, read without trust, and the problems that are found in them.

Nothing is followed, opened or decoded before it is known to be a plain file of bounded size.
"""

import hashlib
import json
import os
import re
import reprlib
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import read_bytes
from oodd_eval.data.files import MAX_BYTES, PACKED, decompress, forms
from oodd_eval.errors import ResultsError
from oodd_eval.results.directory import RECORDS
from oodd_leaderboard.reported import CURVES, ENTRY

MB: Final = 10**6
MOST_PLAIN: Final = {RECORDS: MAX_BYTES, CURVES: 16 * MB}  # decompressed sizes

MOST_BYTES: Final = (
    {ENTRY: MB // 4} | MOST_PLAIN | {name + end: 8 * MB for end in PACKED for name in MOST_PLAIN}
)
"""Largest sizes by name."""

MOST_FILES: Final = 2000

MOST_PROBLEMS: Final = 200  # problems of one entry that are kept; more are counted

_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxlevel = 2


def short(value: Any) -> str:
    """Return a value of a submission, shortened and safe to print on a terminal."""
    return _SHORT.repr(value).encode("ascii", "backslashreplace").decode()


def plain(text: str) -> str:
    """Return a name of a submission like `short`, without its quotes."""
    return short(text)[1:-1]


@dataclass(frozen=True, slots=True)
class Problem:
    """One reason to refuse an entry.

    `where` is a file, with line and cell where there are any: ``records.jsonl:3 (<cell>)``.
    `field`, such as ``metrics.auc.value``, is empty for the file as a whole.
    """

    where: str
    field: str
    message: str

    @property
    def text(self) -> str:
        """The problem as one line."""
        return ": ".join(part for part in (self.where, self.field, self.message) if part)


@dataclass(slots=True)
class Findings:
    """Problems and notes of one entry, in the order in which they were found."""

    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    count: int = 0

    def refuse(self, where: str, field: str, message: str) -> None:
        """Add a problem; beyond `MOST_PROBLEMS` it is counted only."""
        self.count += 1
        if len(self.problems) < MOST_PROBLEMS:
            self.problems.append(Problem(where, field, message))

    def expect(self, where: str, field: str, expected: Any, actual: Any, why: str = "") -> None:
        """Refuse a value that is not the expected one."""
        if actual != expected:
            reason = f": {why}" if why else ""
            self.refuse(where, field, f"is {short(actual)}, expected {short(expected)}{reason}")

    @contextmanager
    def reading(self, where: str) -> Iterator[None]:
        """Make a problem of a file out of the error that ends this block."""
        try:
            yield
        except ResultsError as error:
            message = str(error).removeprefix(f"{where}: ")[:500]
            self.refuse(where, "", re.sub("[^ -~]", lambda c: ascii(c[0])[1:-1], message))
        except OSError as error:
            self.refuse(where, "", f"cannot be read: {error.strerror}")
        except UnicodeDecodeError as error:
            line = error.object[: error.start].count(b"\n") + 1
            self.refuse(where, "", f"is not UTF-8: {error.reason} in line {line}")


def read_files(entry: Path, findings: Findings) -> dict[str, bytes]:
    """Return the content of an entry's files by name; all else in the directory is refused."""
    listed = _scan(entry, findings)
    sound = []
    for name, status in sorted(listed.items()):
        if complaint := _complaint(name, status):
            findings.refuse(plain(name), "", complaint)
        else:
            sound.append(name)
    for name in MOST_PLAIN:
        first, *other_forms = [form for form in forms(name) if form in listed] or [name]
        for other in other_forms:
            findings.refuse(other, "", f"is there beside {first}: expected one of the two")
    for name in (ENTRY, RECORDS):
        if listed.keys().isdisjoint(forms(name)):
            findings.refuse(name, "", "is missing")
    contents = {}
    for name in sound:
        with findings.reading(name):
            contents[name] = read_bytes(entry / name, MOST_BYTES[name], ResultsError)
    return contents


def _scan(directory: Path, findings: Findings) -> dict[str, os.stat_result]:
    with findings.reading("entry"), os.scandir(directory) as items:
        first = list(islice(items, MOST_FILES + 1))
        if len(first) > MOST_FILES:
            raise ResultsError(f"holds more than {MOST_FILES} files")
        return {item.name: item.stat(follow_symlinks=False) for item in first}
    return {}


def _complaint(name: str, status: os.stat_result) -> str:
    """Return what is wrong with a file before it is opened; empty if nothing is."""
    if stat.S_ISLNK(status.st_mode):
        return "is a symbolic link, expected plain files"
    if name not in MOST_BYTES:
        return f"is no file of an entry: expected {', '.join(MOST_BYTES)}"
    if not stat.S_ISREG(status.st_mode):
        return "is no plain file"
    if status.st_size > (most := MOST_BYTES[name]):
        return f"has {status.st_size} bytes, expected at most {most}"
    return ""


def find_text(contents: Mapping[str, bytes], name: str, findings: Findings) -> tuple[str, str]:
    """Return a text file's name, compressed or not, and its text; both empty without it."""
    for stored in forms(name):
        if stored in contents:
            content = contents[stored]
            with findings.reading(stored):
                if stored != name:
                    content = decompress(content, MOST_PLAIN[name])
                return stored, content.decode()
    return "", ""


def check_digests(
    contents: Mapping[str, bytes], claimed: Mapping[str, Any], findings: Findings
) -> None:
    """Compare the files with what ``entry.json`` says of them."""
    present = contents.keys() - {ENTRY}
    for name in sorted(claimed.keys() - present):
        findings.refuse(ENTRY, f"files.{plain(name)}", "names a file that is not there")
    for name in sorted(present - claimed.keys()):
        findings.refuse(ENTRY, f"files.{name}", "is missing, but the file is there")
    why = "it was changed after the entry was written"
    for name in sorted(present & claimed.keys()):
        facts = {"bytes": len(contents[name]), "sha256": hashlib.sha256(contents[name]).hexdigest()}
        for fact, value in facts.items():
            findings.expect(ENTRY, f"files.{name}.{fact}", value, claimed[name][fact], why)


def parse_json(text: str) -> Any:
    """Parse JSON without its ambiguities: no NaN, no infinity, no name twice in an object."""
    try:
        return json.loads(text, object_pairs_hook=_once, parse_constant=_refuse_constant)
    except RecursionError:
        raise ResultsError("is nested too deep") from None
    except ValueError as error:
        raise ResultsError(f"is not JSON: {error}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError(f"a name stands twice among {short([name for name, _ in pairs])}")
    return members


def _refuse_constant(constant: str) -> Any:
    raise ValueError(f"{constant} is no JSON number; undefined values are null")
