"""Verify entries strictly as data: nothing of them is imported, executed or followed.

An entry is checked in an order in which every step only meets what the steps before have found
sound: files, ``entry.json``, digests, the fields of each record, the records among each other,
curves. Whether the numbers are those of the detector is not asked: its author reports them.
"""

import os
import stat
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from oodd_eval.data.facts import SPLITS
from oodd_eval.data.files import UNFINISHED, forms
from oodd_eval.data.split import Split, load_split, published_digests
from oodd_eval.errors import ResultsError, SplitError, UnknownNameError
from oodd_eval.metrics.ranking import Position
from oodd_eval.results.board import defined_cells
from oodd_eval.results.directory import RECORDS
from oodd_leaderboard.curve_file import check_curves
from oodd_leaderboard.reported import (
    CURVES,
    ENTRY,
    EntryInfo,
    SubmittedEntry,
    read_entry,
    recorded_plugins,
    recorded_versions,
    row_of,
)
from oodd_leaderboard.verify.entry_files import (
    Findings,
    check_digests,
    find_text,
    parse_json,
    plain,
    read_files,
    short,
)
from oodd_leaderboard.verify.formats import read_info, read_records
from oodd_leaderboard.verify.records import Records, check_record, check_together

ROOT_FILES: Final = frozenset({"README.md", ".gitkeep"})  # files that may lie beside the entries


@dataclass(frozen=True, slots=True)
class EntryVerdict:
    """The result of verifying one entry.

    `entry` is None when ``entry.json`` is not sound; `records` are the sound ones, by where they
    stand.
    """

    name: str
    findings: Findings
    records: Records
    entry: EntryInfo | None = None

    @property
    def ok(self) -> bool:
        """True if no problem was found."""
        return not self.findings.count


def verify_entry(
    directory: Path, *, name: str = "", split: str | Path | None = None
) -> EntryVerdict:
    """Check one entry, which is going to have another name if one is given.

    `split` names its split where that is not at its usual place. Only a split that is not published
    needs to be there: it says which cells a whole row has.
    """
    name = name or Path(os.path.abspath(directory)).name  # noqa: PTH100  a link is not followed
    findings = Findings()
    if not stat.S_ISDIR(directory.lstat().st_mode):
        findings.refuse("entry", "", "is a link or a file, expected a directory")
        return EntryVerdict(name, findings, {})
    contents = read_files(directory, findings)
    entry = read_info(contents, findings)
    if entry is not None:
        _check_info(entry, name, findings)
        check_digests(contents, entry.files, findings)
    records = read_records(contents, findings)
    for location, record in records.items():
        check_record(location, record, findings)
    if entry is None or not records:
        return EntryVerdict(name, findings, records, entry)
    _check_statements(entry, records, findings)
    cells, note = _cells(entry, split)
    findings.notes += [f"{note}: its cells are taken to be those of these records"] if note else []
    check_together(entry, records, cells, findings)
    name_of_curves, text = find_text(contents, CURVES, findings)
    with findings.reading(name_of_curves):
        _ = text and check_curves(parse_json(text), name_of_curves)
    return EntryVerdict(name, findings, records, entry)


def _guarded(directory: Path, split: str | Path | None) -> EntryVerdict:
    """Check an entry among others, which are to be checked whatever this one does."""
    try:
        return verify_entry(directory, split=split)
    except Exception as error:  # noqa: BLE001  it holds what nobody has thought of
        findings = Findings()
        reason = plain(f"{type(error).__name__}: {error}")
        findings.refuse("entry", "", f"could not be checked ({reason}): please report it")
        return EntryVerdict(directory.name, findings, {})


def _check_info(entry: EntryInfo, name: str, findings: Findings) -> None:
    """Check ``entry.json`` by itself: its name, and the split it names."""
    # A split's name that is the benchmark's own stands for one digest only; any other split of that
    # name carries the start of its digest.
    findings.expect(ENTRY, "id", name, entry.id, "the name of its directory")
    published, split, digest = published_digests(), entry.split, entry.split_digest
    names = [split_name for split_name, other in published.items() if other == digest]
    if not digest.startswith(split.partition("@")[2]):
        findings.refuse(ENTRY, "split", f"is {split!r}, but split_digest is {digest[:8]}…")
    if names and split not in names:
        findings.expect(ENTRY, "split", names[0], split, "the split of this digest")
    elif split in SPLITS and not names:
        expected = published.get(split, "not published yet")
        why = f"that of {split!r}; another split would be {split}@{digest[:8]}"
        findings.expect(ENTRY, "split_digest", expected, digest, why)
    elif not names:
        note = f"unpublished split {split} (digest {digest[:12]})"
        findings.notes.append(f"{note}: shown in tables of its own, not ranked with others")


def _check_statements(entry: EntryInfo, records: Records, findings: Findings) -> None:
    """Check what ``entry.json`` says of its records: detectors, plug-ins, versions."""
    why = "as the records have it"
    detectors = sorted({record.detector for record in records.values()})
    findings.expect(ENTRY, "detectors", detectors, entry.detectors, why)
    used = recorded_plugins(records.values())
    findings.expect(ENTRY, "plugins", used, entry.plugins, why)
    rows = {str(record.setting): record.detector for record in records.values()}
    named = [rows.get(row, "") for row in entry.primary]
    for row, detector in zip(entry.primary, named, strict=True):
        if not detector or named.count(detector) > 1:
            message = f"names {short(row)}, expected rows of these records, one a detector"
            findings.refuse(ENTRY, "primary", message)
    stated = entry.environment["packages"] | {"python": entry.environment["python"]}
    for package, version in recorded_versions(records.values()).items():
        field = f"environment.{'' if package == 'python' else 'packages.'}{package}"
        findings.expect(ENTRY, field, version, stated.get(package), why)


def _cells(entry: EntryInfo, path: str | Path | None) -> tuple[Collection[Position], str]:
    """Return the cells of an entry's split, or why they are not known."""
    if entry.split in SPLITS:
        return defined_cells(entry.split), ""
    split, note = find_split(entry.split, entry.split_digest, path)
    if split is None:
        return (), note
    return {(e, str(c)) for e in split.environments for c in split.conditions(e)}, ""


def find_split(name: str, digest: str, path: str | Path | None) -> tuple[Split | None, str]:
    """Open a split, or say why it is not at hand; one that a `path` names has to be there."""
    try:
        split = load_split(path or name.partition("@")[0])
    except (SplitError, UnknownNameError):
        if path:
            raise
        return None, f"split {name} is not on this machine (name its place with --split)"
    if split.digest == digest:
        return split, ""
    digests = f"digest {split.digest[:12]}, the entry's is {digest[:12]}"
    return None, f"split {split.name} here has {digests}"


def verify(path: Path | str, *, split: str | Path | None = None) -> Iterator[EntryVerdict]:
    """Check an entry, or all entries of a directory and that no two of them clash.

    Yields one verdict an entry, in the order of their names, and one more for the directory itself
    when something else lies in it; for the split see `verify_entry`.
    """
    path = Path(path)
    if not path.is_dir():
        raise ResultsError(f"{str(path)!r} is no directory: expected an entry, or one of entries")
    if any(os.path.lexists(path / name) for name in (ENTRY, *forms(RECORDS))):
        yield verify_entry(path, split=split)
        return
    stray, neighbours = Findings(), Neighbours()
    for child in sorted(path.iterdir()):
        if UNFINISHED.fullmatch(child.name):  # by a submission that goes on, or was killed
            continue
        if child.is_symlink() or child.is_dir():
            verdict = _guarded(child, split)
            neighbours.check(verdict)
            yield verdict
        elif child.name not in ROOT_FILES:
            stray.refuse(plain(child.name), "", "is no entry: expected directories alone")
    if stray.count:
        yield EntryVerdict(str(path), stray, {})


def verify_changed(root: Path, names: Collection[str]) -> Iterator[EntryVerdict]:
    """Check some entries of a directory, and that none of them clashes with another one.

    The others are taken as they are. Names without a directory are entries that were removed.
    """
    directories = sorted(path.parent for path in root.glob(f"*/{ENTRY}"))
    neighbours = Neighbours(read_entry(path) for path in directories if path.name not in names)
    for name in sorted(names):
        if os.path.lexists(root / name):
            verdict = _guarded(root / name, None)
            neighbours.check(verdict)
            yield verdict


class Neighbours:
    """The rows and detectors of entries, which no further entry may have too.

    Parameters
    ----------
    entries
        Those that are taken as they are.
    """

    def __init__(self, entries: Iterable[SubmittedEntry] = ()) -> None:
        self._rows: dict[object, str] = {}  # the entry of a row
        self._origins: dict[str, tuple[str, str]] = {}  # a detector's entry and distribution
        for entry in entries:
            records = {str(i): record for i, record in enumerate(entry.records)}
            self.check(EntryVerdict(entry.meta.id, Findings(), records))

    def check(self, verdict: EntryVerdict) -> None:
        """Refuse rows of other entries, and detectors' names from other distributions."""
        for location, record in verdict.records.items():
            if (other := self._rows.setdefault(row_of(record), verdict.name)) != verdict.name:
                message = f"is of a row of entry {other} too: replace that one, or leave it out"
                verdict.findings.refuse(location, "cell", message)
            origin = record.plugin.partition(":")[0]
            owner, first = self._origins.setdefault(record.detector, (verdict.name, origin))
            why = f"as in entry {owner}: a name stands for one detector"
            verdict.findings.expect(location, "detector", f"from {first}", f"from {origin}", why)
