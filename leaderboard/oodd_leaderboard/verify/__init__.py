"""Verify entries strictly as data: nothing of them is imported, executed or followed.

An entry is checked in an order in which every step only meets what the steps before have found
sound: files, ``entry.json``, digests, the fields of each record, the metrics of each record, the
records among each other, curves and scores, and last the scores against the split, where it is at
hand. Whether numbers that agree are those of the detector is not asked here: re-runs do (`rerun`).
"""

import os
import stat
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from oodd_eval.data.facts import SPLITS
from oodd_eval.data.files import UNFINISHED, forms
from oodd_eval.data.split import Split, load_split, published_digests
from oodd_eval.errors import ResultsError, SplitError, UnknownNameError, UsageError
from oodd_eval.results.board import defined_cells
from oodd_eval.results.directory import RECORDS
from oodd_leaderboard.curve_file import check_curves
from oodd_leaderboard.entry import (
    CURVES,
    ENTRY,
    GRANTS,
    TRUST,
    EntryInfo,
    Grant,
    SubmittedEntry,
    Trust,
    digest_of,
    read_entry,
    read_grants,
    recorded_plugins,
    recorded_versions,
    row_of,
    write_grants,
)
from oodd_leaderboard.verify.files import (
    Findings,
    check_digests,
    find_text,
    parse_json,
    plain,
    read_files,
    short,
)
from oodd_leaderboard.verify.formats import GRANTED_BY, complaint, read_info, read_records
from oodd_leaderboard.verify.recompute import (
    Records,
    check_against_split,
    check_record,
    check_rescored,
    check_scores,
    check_together,
)
from oodd_leaderboard.verify.rerun import Rerun

ROOT_FILES: Final = frozenset({"README.md", ".gitkeep"})  # files that may lie beside the entries


@dataclass(frozen=True, slots=True)
class EntryVerdict:
    """The result of verifying one entry.

    `entry` is None when ``entry.json`` is not sound, `digest` is that of its bytes; `records` are
    the sound ones, by where they stand; `rescored` says that every metric was recomputed from the
    scores and agrees; `grant` is what maintainers have granted to just this entry, `rerun` how it
    compares with a run of its rows on fresh seeds.
    """

    name: str
    findings: Findings
    records: Records
    entry: EntryInfo | None = None
    rescored: bool = False
    digest: str = ""
    grant: Grant | None = None
    rerun: Rerun | None = None

    @property
    def ok(self) -> bool:
        """True if no problem was found."""
        return not self.findings.count

    @property
    def trust(self) -> Trust:
        """The level of trust that was granted."""
        return self.grant.trust if self.grant else "reported"

    @property
    def reached(self) -> Trust | None:
        """The level of trust that was established here; None for an entry that is refused."""
        if not self.ok:
            return None
        if self.rerun is not None and self.rerun.complete:
            return "re-run"
        return "re-scored" if self.rescored else "reported"

    @property
    def gains(self) -> bool:
        """True where a higher level was established, or a re-run in more environments."""
        if self.reached is None:
            return False
        places = self.rerun.environments if self.rerun and self.reached == "re-run" else ()
        held = self.grant.environments if self.grant else ()
        reached = TRUST.index(self.reached), len(places)
        return reached > (TRUST.index(self.trust), len(held))


def verify_entry(
    directory: Path, *, name: str = "", split: str | Path | None = None
) -> EntryVerdict:
    """Check one entry, which is going to have another name if one is given.

    `split` names its split where that is not at its usual place.
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
    for where, record in records.items():
        check_record(where, record, findings)
    if entry is None or not records:
        return EntryVerdict(name, findings, records, entry)
    _check_statements(entry, records, findings)
    opened, note = find_split(entry.split, entry.split_digest, split)
    cells = (
        {(e, str(c)) for e in opened.environments for c in opened.conditions(e)} if opened else ()
    )
    cells = defined_cells(entry.split) if entry.split in SPLITS else cells
    check_together(entry, records, cells, findings)
    name_of_curves, text = find_text(contents, CURVES, findings)
    with findings.reading(name_of_curves):
        _ = text and check_curves(parse_json(text), name_of_curves)
    scored = check_scores(directory, contents, records, findings)
    rescored = False
    if opened is None:
        findings.notes.append(f"{note}: compared with no trajectory, nothing recomputed")
    else:
        of_split = {w: r for w, r in records.items() if r.split_digest == opened.digest}
        check_against_split(of_split, opened, findings)
        complete = all(where in scored for where, r in records.items() if r.ok)
        if scored := {w: r for w, r in scored.items() if w in of_split}:
            rescored = check_rescored(scored, directory, opened, findings) and complete
    digest = digest_of(contents[ENTRY])
    grant = read_grants(directory.absolute().parent).get(name)
    held = grant if grant and grant.entry == digest else None
    rescored = rescored and not findings.count
    verdict = EntryVerdict(name, findings, records, entry, rescored, digest, held)
    findings.notes.extend(_notes_on_trust(verdict))
    return verdict


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
    """Check ``entry.json`` by itself: its name, and the split it names.

    A split's name that is the benchmark's own stands for one digest only; any other split of that
    name carries the start of its digest.
    """
    findings.expect(ENTRY, "id", name, entry.id, "the name of its directory")
    published, split, digest = published_digests(), entry.split, entry.split_digest
    names = [known for known, other in published.items() if other == digest]
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


def _notes_on_trust(verdict: EntryVerdict) -> Iterator[str]:
    """Say who granted the level of trust that an entry has, and which one was established here."""
    if (held := verdict.grant) is not None:
        yield f"{held.trust} was granted by {held.by} on {held.day}: {held.how}"
    if verdict.gains:
        yield f"qualifies for {verdict.reached!r} (--grant)"


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
    stray, neighbours, digests = Findings(), Neighbours(), {}
    for child in sorted(path.iterdir()):
        if UNFINISHED.fullmatch(child.name):  # by a submission that goes on, or was killed
            continue
        if child.is_symlink() or child.is_dir():
            verdict = _guarded(child, split)
            neighbours.check(verdict)
            digests[child.name] = verdict.digest
            yield verdict
        elif child.name not in ROOT_FILES:
            stray.refuse(plain(child.name), "", "is no entry: expected directories alone")
    for name, grant in read_grants(path).items():
        if digests.get(name) != grant.entry:
            message = "is of an entry.json that is not here: verify the entry and grant it again"
            stray.refuse(GRANTS, name, message)
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
        for where, record in verdict.records.items():
            if (other := self._rows.setdefault(row_of(record), verdict.name)) != verdict.name:
                message = f"is of a row of entry {other} too: replace that one, or leave it out"
                verdict.findings.refuse(where, "cell", message)
            origin = record.plugin.partition(":")[0]
            owner, first = self._origins.setdefault(record.detector, (verdict.name, origin))
            why = f"as in entry {owner}: a name stands for one detector"
            verdict.findings.expect(where, "detector", f"from {first}", f"from {origin}", why)


def grant(directory: Path, verdict: EntryVerdict, by: str) -> Grant:
    """Grant an entry the level of trust that its verification by somebody established."""
    if message := complaint(GRANTED_BY, by):
        raise UsageError(f"--grant {message}")
    level = verdict.reached
    if level is None:
        raise UsageError(f"--grant: {verdict.name} is refused, so nothing is granted")
    if level == "reported" or not verdict.gains:
        raise UsageError(
            f"--grant: {verdict.name} has trust {verdict.trust!r}, and what was established here "
            f"is {level!r}: more needs its scores (re-scored) or leaderboard rerun of all its rows "
            "(in more environments than before)"
        )
    day = datetime.now(UTC).date().isoformat()
    if (again := verdict.rerun) and level == "re-run":
        new = Grant(verdict.digest, level, by, day, again.how, again.means, again.environments)
    else:
        new = Grant(verdict.digest, level, by, day, "every metric recomputed from its scores")
    results = directory.absolute().parent
    write_grants(results, read_grants(results) | {verdict.name: new})
    return new
