"""Write an entry of the leaderboard from a results directory."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data import files as stored_files
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import OutputError, SplitError, UnknownNameError, UsageError
from oodd_eval.leaderboard.entry import CURVES, ENTRY, SCORES, Entry, read_entries
from oodd_eval.leaderboard.selecting import made_with, selected
from oodd_eval.leaderboard.verify import rules
from oodd_eval.leaderboard.verify.cells import joined
from oodd_eval.leaderboard.verify.curves_check import Extent, with_curves
from oodd_eval.leaderboard.verify.findings import Findings
from oodd_eval.leaderboard.verify.verify import Seen, Verdict, check_clashes, verify_entry
from oodd_eval.results.curves import make_curves, write_curves
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record

LARGE: Final = 10 * 10**6
"""Bytes beyond which an entry is said to be large: a repository keeps every version of it."""


@dataclass(frozen=True, slots=True)
class Statement:
    """What a submitter says about an entry, beyond what its records say.

    Attributes
    ----------
    id
        Name of the entry; empty for one made of detectors and split.
    title
        Empty for one made of detectors and split.
    submitter, citation, url, caption
        See `oodd_eval.leaderboard.entry.Entry`.
    trust
        Level of trust that is claimed: ``"reported"``, or ``"re-scored"`` with the scores.
    """

    id: str = ""
    title: str = ""
    submitter: str = ""
    citation: str = ""
    url: str = ""
    caption: str = ""
    trust: str = "reported"


@dataclass(frozen=True, slots=True)
class Submission:
    """What became of a submission.

    Attributes
    ----------
    place
        Of the entry.
    verdict
        What verification found; when it found a problem, nothing is left at `place`.
    left_out
        A line for each seed of a row that was left out as incomplete.
    size
        Bytes of the entry.
    """

    place: Path
    verdict: Verdict
    left_out: list[str]
    size: int


def submit(
    results: Path | str,
    root: Path | str,
    statement: Statement,
    *,
    detectors: str = "all",
    cells: str = "",
    complete: bool = False,
    scores: bool = False,
    curves: Extent = "rows",
    split: str | Path | None = None,
) -> Submission:
    """Write an entry, verify what was written, and move it to its place.

    Parameters
    ----------
    results
        Results directory.
    root
        Directory of the entries.
    statement
        What its submitter says.
    detectors
        Names of the detectors to submit: comma lists, globs or ``"all"``.
    cells, complete
        See `oodd_eval.leaderboard.selecting.selected`.
    scores
        Whether to include every score.
    curves
        Of which rows, see `oodd_eval.leaderboard.verify.curves_check.with_curves`.
    split
        Name or path of the split; default: where splits usually are. Without the split the entry
        has no curves.

    Raises
    ------
    UsageError
        For unknown detectors, records that cannot make one entry, or a name that is taken.
    ResultsError
        When the results cannot be read.
    OutputError
        When the entry cannot be written.
    """
    source, root = ResultsDirectory(results), Path(root)
    records, left_out = selected(source.records(), detectors, cells, complete=complete)
    _require_one_split(records)
    entry = _entry(records, statement, made_with(source.path, records))
    place = root / entry.id
    if os.path.lexists(place):
        raise UsageError(
            f"entry {entry.id!r} is there already, in {str(root)!r}: name another with --id, or "
            "remove it first if this one replaces it"
        )
    with _written(place) as directory:
        text = "".join(record.to_json() + "\n" for record in records)
        (directory / RECORDS).write_text(text, encoding="utf-8")
        stored_files.compress_large(directory / RECORDS)
        opened = _split(records[0], split)
        drawn = with_curves(records, curves)
        if opened is not None and drawn:
            _require_scores(drawn, source, "submit with --curves none, or")
            write_curves(make_curves(drawn, source, opened), directory / CURVES)
            stored_files.compress_large(directory / CURVES)
        if scores:
            _copy_scores([record for record in records if record.ok], source, directory)
        entry = replace(entry, files=_facts(directory))
        (directory / ENTRY).write_text(entry.to_json(), encoding="utf-8")
        verdict = verify_entry(directory, name=entry.id, split=split)
        if root.is_dir():
            _check_clashes(verdict, root)
        size = sum(path.stat().st_size for path in directory.rglob("*") if path.is_file())
        if verdict.ok:
            directory.rename(place)
    return Submission(place, verdict, left_out, size)


def _require_one_split(records: Sequence[Record]) -> None:
    splits = sorted({(r.split, r.split_digest[:12]) for r in records})
    if len(splits) > 1:
        listed = ", ".join(f"{name} ({digest})" for name, digest in splits)
        raise UsageError(
            f"these results are of {len(splits)} splits: {listed}; an entry is of one, so run "
            "each into a results directory of its own"
        )
    if limited := [r for r in records if r.limit is not None]:
        raise UsageError(
            f"{len(limited)} records, such as {limited[0].cell}, used --limit "
            f"{limited[0].limit}: an entry uses all trajectories, so run without "
            "it, into another results directory"
        )
    if local := [r for r in records if rules.plugin_name(r.plugin)]:
        raise UsageError(
            f"detector {local[0].detector!r} is of no installed plug-in (plugin is "
            f"{local[0].plugin!r}): others could not run it again; see oodd-eval new"
        )


def _split(record: Record, place: str | Path | None) -> Split | None:
    """Open the split of the records; None when it is not here and was not asked for by place."""
    try:
        split = load_split(place or record.split.partition("@")[0])
    except (SplitError, UnknownNameError):
        if place:
            raise
        return None
    return split if split.digest == record.split_digest else None


def _entry(records: Sequence[Record], statement: Statement, command: str) -> Entry:
    """Return ``entry.json`` without its files."""
    first = records[0]
    detectors = sorted({r.detector for r in records})
    split = first.split.replace("@", "-").lower()
    # Detectors made of classes have capitals and a colon in their names.
    name = statement.id or f"{'-'.join(detectors)}-{split}".lower().replace(":", "-")
    if not statement.id and (len(detectors) > 3 or rules.entry_id(name)):
        raise UsageError(
            f"the names of {len(detectors)} detectors make no short id: choose one with --id"
        )
    if complaint := rules.entry_id(name):
        raise UsageError(f"--id {complaint}")
    shown = ", ".join(detectors[:3]) + (f" and {len(detectors) - 3} more" * (len(detectors) > 3))
    return Entry(
        id=name,
        title=statement.title or f"{shown} on {first.split}",
        detectors=detectors,
        submitter=statement.submitter,
        citation=statement.citation,
        url=statement.url,
        trust=statement.trust,
        split=first.split,
        split_digest=first.split_digest,
        protocol=first.protocol,
        plugins=_plugins(records),
        environment=_environment(records),
        created=datetime.now(UTC).date().isoformat(),
        command=command,
        caption=statement.caption,
    )


def _plugins(records: Iterable[Record]) -> list[dict[str, str]]:
    sources = {(r.plugin, r.detector_version, r.plugin_source) for r in records}
    return [
        {
            "distribution": plugin.partition(":")[0],
            "plugin": plugin.partition(":")[2],
            "version": version,
            "source_digest": source,
        }
        for plugin, version, source in sorted(sources)
    ]


def _environment(records: Sequence[Record]) -> dict[str, Any]:
    """Return what the records were made with, as far as it can be known.

    Versions of the libraries that a plug-in depends on are added where the records were made by
    the Python and numpy that run now.
    """
    python = joined(str(r.provenance.get("python", "")) for r in records)
    numpy = joined(str(r.provenance.get("numpy", "")) for r in records)
    packages: dict[str, str] = {}
    if (python, numpy) == (platform.python_version(), np.__version__):
        for distribution in {r.plugin.partition(":")[0] for r in records}:
            packages |= _dependencies(distribution)
    packages |= {r.plugin.partition(":")[0]: r.detector_version for r in records}
    packages["oodd-eval"] = joined(str(r.provenance.get("oodd_eval", "")) for r in records)
    packages["numpy"] = numpy
    return {
        "python": python,
        "platform": joined(str(r.provenance.get("platform", "")) for r in records)[:200],
        "packages": dict(sorted(packages.items())),
    }


def _dependencies(distribution: str) -> dict[str, str]:
    """Return installed versions of what a distribution, or its extra ``reference``, requires."""
    found: dict[str, str] = {}
    try:
        required = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return found
    for requirement in required:
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)", requirement)
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        if name is None or (extra is not None and extra[1] != "reference"):
            continue
        try:
            found[name[0]] = importlib.metadata.version(name[0])
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _copy_scores(records: Iterable[Record], source: ResultsDirectory, directory: Path) -> None:
    (directory / SCORES).mkdir()
    for file in _require_scores(records, source, "leave out --scores, or"):
        shutil.copyfile(file, directory / SCORES / file.name)


def _require_scores(
    records: Iterable[Record], source: ResultsDirectory, instead: str
) -> list[Path]:
    """Return the score files of records, each once; refuse when one is not there."""
    files = []
    for key in sorted({r.scores for r in records}):
        file = source.path / SCORES / f"{key}.h5"
        if rules.score_key(key) or not file.is_file():
            raise UsageError(
                f"scores are not there in {str(file)!r}: {instead} run again into this directory"
            )
        files.append(file)
    return files


def _facts(directory: Path) -> dict[str, dict[str, Any]]:
    """Return digest and size of every file."""
    found = {}
    for path in sorted(p for p in directory.rglob("*") if p.is_file()):
        content = path.read_bytes()
        found[path.relative_to(directory).as_posix()] = {
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
        }
    return found


def _check_clashes(verdict: Verdict, root: Path) -> None:
    """Compare a new entry with those that are there."""
    seen: Seen = {}
    for other in read_entries(root):
        numbered = {str(i): record for i, record in enumerate(other.records, start=1)}
        check_clashes(other.meta.id, numbered, seen, Findings())
    check_clashes(verdict.name, verdict.records or {}, seen, verdict.findings)


@contextmanager
def _written(place: Path) -> Iterator[Path]:
    """Give a directory to write, beside the place; it is gone afterwards unless it was moved."""
    directory = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        directory.mkdir(parents=True)
        yield directory
    except OSError as error:
        raise OutputError(f"{str(place)!r} cannot be written: {error}") from error
    finally:
        shutil.rmtree(directory, ignore_errors=True)
