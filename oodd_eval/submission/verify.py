"""Verify entries strictly as data: nothing of them is imported, executed or followed.

An entry is checked in an order in which every step only meets what the steps before have found
sound: files, ``entry.json``, digests, the fields of each record, the metrics of each record, the
records among each other, scores, and last the trajectories of the split, where it is at hand.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from oodd_eval.curves_format import check_curves
from oodd_eval.errors import ResultsError
from oodd_eval.records import Record
from oodd_eval.results import RECORDS
from oodd_eval.submission.cells import Records, check_cells
from oodd_eval.submission.entry_check import check_entry
from oodd_eval.submission.files import MOST_BYTES, check_digests, list_files, parse_json, read_bytes
from oodd_eval.submission.findings import Findings, shown
from oodd_eval.submission.format import CURVES, ENTRY, SCORES, TRUST, Entry
from oodd_eval.submission.identities import check_identities
from oodd_eval.submission.record_check import read_records
from oodd_eval.submission.rescoring import check_recomputed_curves, check_rescored
from oodd_eval.submission.score_check import check_scores
from oodd_eval.submission.trajectories import check_against_split, find_split, read_facts

ROOT_FILES: Final = frozenset({"README.md", ".gitkeep"})
"""Files that may lie beside the entries."""


Seen = dict[str, tuple[str, str]]
"""By cell or detector: the entry that has it, and the distribution that a detector is from."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What verification came to for one entry.

    Attributes
    ----------
    name
        Of the entry: the name of its directory.
    findings
        Problems and notes.
    entry
        ``entry.json``; None when it is not sound.
    records
        Sound records by where they stand.
    rescored
        Whether every metric was recomputed from the scores and agrees.
    """

    name: str
    findings: Findings
    entry: Entry | None = None
    records: Records | None = None
    rescored: bool = False

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against the entry."""
        return not self.findings.count


def verify_entry(directory: Path, *, name: str = "", split: str | Path | None = None) -> Verdict:
    """Check one entry.

    Parameters
    ----------
    directory
        Of the entry.
    name
        What the directory is going to be called; default: as it is called now.
    split
        Name or path of the split; default: where splits usually are.

    Raises
    ------
    OoddError
        When `split` is given and holds no split.
    """
    name = name or Path(os.path.abspath(directory)).name  # noqa: PTH100  a link is not followed
    findings = Findings()
    if not stat.S_ISDIR(directory.lstat().st_mode):
        findings.refuse("entry", "", "is a link or a file, expected a directory")
        return Verdict(name, findings)
    files = list_files(directory, findings)
    entry = check_entry(directory, name, findings) if ENTRY in files else None
    if entry is not None:
        check_digests(directory, files, entry.files, findings)
    records = read_records(directory, findings) if RECORDS in files else {}
    for where, record in records.items():
        check_identities(record, findings, where)
    if entry is None or not records:
        return Verdict(name, findings, entry, records)
    check_cells(entry, records, findings)
    scored = check_scores(directory, files, records, findings)
    curves = _read_curves(directory, records, findings) if CURVES in files else None
    opened = find_split(entry, split, findings)
    rescored = False
    if opened is not None:
        own = {w: r for w, r in records.items() if r.split_digest == opened.digest}
        scored = {w: r for w, r in scored.items() if w in own}
        sound = not findings.count
        facts = read_facts(opened, (record.environment for record in own.values()))
        check_against_split(own, facts, findings)
        if scored:
            rescored = check_rescored(scored, directory, opened, facts, findings)
        if scored and curves is not None and sound:
            check_recomputed_curves(curves, list(scored.values()), directory, opened, findings)
    complete = all(w in scored for w, r in records.items() if r.ok)
    rescored = rescored and complete and not findings.count
    _judge_trust(entry, findings, complete=complete and bool(scored), rescored=rescored)
    return Verdict(name, findings, entry, records, rescored)


def _judge_trust(entry: Entry, findings: Findings, *, complete: bool, rescored: bool) -> None:
    """Compare the trust level that an entry claims with what could be established."""
    if entry.trust == "re-scored" and not complete:
        findings.refuse(
            ENTRY, "trust",
            f"is 're-scored', but scores are not there, or not sound, for every record: expected "
            f"{SCORES}/*.h5 or trust {TRUST[0]!r}",
        )  # fmt: skip
    elif entry.trust == "re-scored" and not rescored and not findings.count:
        findings.note("trust 're-scored' could not be confirmed here")
    elif entry.trust == "reported" and rescored:
        findings.note("every metric was recomputed from the scores: qualifies for 're-scored'")


def _read_curves(directory: Path, records: Records, findings: Findings) -> dict[str, Any] | None:
    """Read and check ``curves.json``; None when it is not sound."""
    before = findings.count
    try:
        plain = parse_json(read_bytes(directory / CURVES, MOST_BYTES[CURVES]).decode())
    except UnicodeDecodeError as error:
        findings.refuse(CURVES, "", f"is not UTF-8: {error.reason} at byte {error.start}")
        return None
    except ResultsError as error:
        findings.refuse(CURVES, "", str(error))
        return None
    try:
        curves = check_curves(plain, CURVES)
    except ResultsError as error:
        # Its messages begin with the place: "curves.json: units[0].seed is False, ...".
        place, _, message = str(error).removeprefix(f"{CURVES}: ").partition(" ")
        findings.refuse(CURVES, place.removeprefix(CURVES).rstrip(":"), message)
        return None
    known = {record.cell: record for record in records.values() if record.ok}
    for i, unit in enumerate(curves["units"]):
        record = known.pop(unit["cell"], None)
        if record is None:
            findings.refuse(
                CURVES, f"units[{i}].cell", f"is {shown(unit['cell'])}, which no record is of"
            )
            continue
        for field, value in _identity(record).items():
            if unit[field] != value:
                findings.refuse(
                    CURVES, f"units[{i}].{field}",
                    f"is {shown(unit[field])}, but {shown(value)} in the record of its cell",
                )  # fmt: skip
        if unit["example"]["index"] >= record.counts["test"]:
            findings.refuse(CURVES, f"units[{i}].example.index", "is no test trajectory")
    for cell in known:
        findings.refuse(CURVES, "units", f"lack {cell}: curves are of all evaluated cells")
    return curves if findings.count == before else None


def _identity(record: Record) -> dict[str, Any]:
    names = ("detector", "horizon", "seed", "environment", "anomaly")
    return {
        **{name: getattr(record, name) for name in names},
        "overrides": record.provenance["overrides"],
    }


def verify(
    path: Path | str,
    *,
    split: str | Path | None = None,
    progress: Callable[[Verdict], None] | None = None,
) -> list[Verdict]:
    """Check an entry, or all entries of a directory and that no two of them clash.

    Parameters
    ----------
    path
        An entry, or a directory with entries.
    split
        Name or path of the split; default: where splits usually are.
    progress
        Called with each verdict as soon as it is known.

    Returns
    -------
    One verdict an entry, in the order of their names, and one more for the directory itself when
    something else lies in it. Empty for an empty directory.

    Raises
    ------
    ResultsError
        When there is no directory at `path`.
    OoddError
        When `split` is given and holds no split.
    """
    path = Path(path)
    if not path.is_dir():
        raise ResultsError(f"{str(path)!r} is no directory: expected an entry, or one of entries")
    verdicts: list[Verdict] = []

    def add(verdict: Verdict) -> None:
        verdicts.append(verdict)
        if progress is not None:
            progress(verdict)

    if any(os.path.lexists(path / name) for name in (ENTRY, RECORDS)):
        add(verify_entry(path, split=split))
        return verdicts
    stray = Findings()
    seen: Seen = {}
    for child in sorted(path.iterdir()):
        if child.is_symlink() or child.is_dir():
            verdict = verify_entry(child, split=split)
            check_clashes(verdict.name, verdict.records or {}, seen, verdict.findings)
            add(verdict)
        elif child.name not in ROOT_FILES:
            stray.refuse(shown(child.name)[1:-1], "", "is no entry: expected directories alone")
    if stray.count:
        add(Verdict(str(path), stray))
    return verdicts


def check_clashes(name: str, records: Records, seen: Seen, findings: Findings) -> None:
    """Refuse what another entry has too: a cell, or a detector's name from another place.

    Parameters
    ----------
    name, records
        Of one entry.
    seen
        What earlier entries have; this one's is added.
    findings
        Of this entry.
    """
    for where, record in records.items():
        key = f"{record.cell} {record.split_digest} {record.protocol}"
        other, _ = seen.setdefault(key, (name, ""))
        if other != name:
            findings.refuse(
                where, "cell", f"is in entry {other} too: replace that one, or leave it out"
            )
        distribution = record.plugin.partition(":")[0]
        owner, known = seen.setdefault(record.detector, (name, distribution))
        if known != distribution:
            findings.refuse(
                where, "detector",
                f"is {record.detector!r} from {distribution}, but in entry {owner} it is from "
                f"{known}: a name stands for one detector",
            )  # fmt: skip
