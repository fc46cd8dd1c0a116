"""Verify entries strictly as data: nothing of them is imported, executed or followed.

An entry is checked in an order in which every step only meets what the steps before have found
sound: files, ``entry.json``, digests, the fields of each record, the metrics of each record, the
records among each other, scores, and last the trajectories of the split, where it is at hand.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from oodd_eval.data import files as stored_files
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.leaderboard.entry import CURVES, ENTRY, SCORES, TRUST, Entry
from oodd_eval.leaderboard.verify.cells import PLACE, Records, check_cells
from oodd_eval.leaderboard.verify.curves_check import read_curves
from oodd_eval.leaderboard.verify.entry_check import check_entry
from oodd_eval.leaderboard.verify.files import check_digests, list_files, name_in
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.leaderboard.verify.identities import check_identities
from oodd_eval.leaderboard.verify.record_check import read_records
from oodd_eval.leaderboard.verify.rerun import Rerun, compare_rerun
from oodd_eval.leaderboard.verify.rescoring import check_recomputed_curves, check_rescored
from oodd_eval.leaderboard.verify.score_check import check_scores
from oodd_eval.leaderboard.verify.trajectories import check_against_split, find_split, read_facts
from oodd_eval.results.directory import RECORDS
from oodd_eval.results.record import Record

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
    rerun
        What the comparison with a run again came to; None without one.
    """

    name: str
    findings: Findings
    entry: Entry | None = None
    records: Records | None = None
    rescored: bool = False
    rerun: Rerun | None = None

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against the entry."""
        return not self.findings.count

    @property
    def reached(self) -> str:
        """The level of trust that was established here; empty for an entry that is refused."""
        if not self.ok:
            return ""
        if self.rerun is not None and self.rerun.confirmed:
            return "re-run"
        return "re-scored" if self.rescored else "reported"


def verify_entry(
    directory: Path,
    *,
    name: str = "",
    split: str | Path | None = None,
    rerun: Sequence[Record] = (),
) -> Verdict:
    """Check one entry.

    Parameters
    ----------
    directory
        Of the entry.
    name
        What the directory is going to be called; default: as it is called now.
    split
        Name or path of the split; default: where splits usually are.
    rerun
        Records of a run that the verifier made, to compare the entry's with.

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
    recorded, drawn = name_in(files, RECORDS), name_in(files, CURVES)
    records = read_records(directory, recorded, findings) if recorded else {}
    for where, record in records.items():
        check_identities(record, findings, where)
    if entry is None or not records:
        return Verdict(name, findings, entry, records)
    check_cells(entry, records, findings)
    scored = check_scores(directory, files, records, findings)
    curves = read_curves(directory, drawn, records, findings) if drawn else None
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
    again = compare_rerun(records, rerun, findings) if rerun else None
    _judge_trust(
        entry, findings, complete=complete and bool(scored), rescored=rescored, rerun=again
    )  # fmt: skip
    return Verdict(name, findings, entry, records, rescored, again)


def _judge_trust(
    entry: Entry, findings: Findings, *, complete: bool, rescored: bool, rerun: Rerun | None
) -> None:
    """Compare the trust level that an entry claims with what could be established."""
    if entry.trust == "re-scored" and not complete:
        findings.refuse(
            ENTRY, "trust",
            f"is 're-scored', but scores are not there, or not sound, for every record: expected "
            f"{SCORES}/*.h5 or trust {TRUST[0]!r}",
        )  # fmt: skip
    elif entry.trust == "re-scored" and not rescored and not findings.count:
        findings.note("trust 're-scored' could not be confirmed here")
    elif entry.trust == "re-run" and entry.rerun is not None and rerun is None:
        findings.note(
            f"trust 're-run' is what the entry says (by {entry.rerun['by']}: "
            f"{entry.rerun['how']}); nothing here confirms it without a run of yours (--rerun)"
        )
    if entry.trust == "reported" and rescored:
        findings.note("every metric was recomputed from the scores: qualifies for 're-scored'")
    if entry.trust != "re-run" and rerun is not None and rerun.confirmed and not findings.count:
        findings.note("the run again agrees: qualifies for 're-run'")


def verify(
    path: Path | str,
    *,
    split: str | Path | None = None,
    rerun: Sequence[Record] = (),
    progress: Callable[[Verdict], None] | None = None,
) -> list[Verdict]:
    """Check an entry, or all entries of a directory and that no two of them clash.

    Parameters
    ----------
    path
        An entry, or a directory with entries.
    split
        Name or path of the split; default: where splits usually are.
    rerun
        Records of a run that the verifier made; for a single entry only.
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
    UsageError
        When `rerun` is given and `path` holds no single entry.
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

    if any(os.path.lexists(path / name) for name in (ENTRY, RECORDS, RECORDS + stored_files.GZIP)):
        add(verify_entry(path, split=split, rerun=rerun))
        return verdicts
    if rerun:
        raise UsageError(f"--rerun is for one entry, but {str(path)!r} is a directory of entries")
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


def _cell_key(record: Record) -> str:
    """Return what only one entry may have: a cell of a split, wherever it was computed."""
    overrides = {k: v for k, v in record.overrides.items() if k != PLACE}
    parts = [
        record.detector, record.horizon, record.seed, overrides, record.environment,
        record.anomaly, record.split_digest, record.protocol,
    ]  # fmt: skip
    return json.dumps(parts, sort_keys=True)


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
        key = _cell_key(record)
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
