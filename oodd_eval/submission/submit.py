"""Write an entry of the leaderboard from a results directory."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.benchmark import ANOMALIES, ENVIRONMENTS
from oodd_eval.curves import make_curves, write_curves
from oodd_eval.errors import OutputError, SplitError, UnknownNameError, UsageError
from oodd_eval.records import Record
from oodd_eval.results import RECORDS, ResultsDirectory
from oodd_eval.selection import select
from oodd_eval.splits import Split, load_split
from oodd_eval.submission import rules
from oodd_eval.submission.cells import joined, setting_of
from oodd_eval.submission.findings import Findings
from oodd_eval.submission.format import CURVES, ENTRY, SCORES, Entry, read_entries
from oodd_eval.submission.verify import Seen, Verdict, check_clashes, verify_entry

LONGEST_COMMAND: Final = 4000


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
        See `oodd_eval.submission.format.Entry`.
    trust, rerun
        Level of trust that is claimed, and for ``"re-run"`` by whom and how.
    """

    id: str = ""
    title: str = ""
    submitter: str = ""
    citation: str = ""
    url: str = ""
    caption: str = ""
    trust: str = "reported"
    rerun: dict[str, str] | None = None


def submit(
    results: Path | str,
    root: Path | str,
    statement: Statement,
    *,
    detectors: str = "all",
    scores: bool = False,
    split: str | Path | None = None,
) -> tuple[Path, Verdict]:
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
    scores
        Whether to include every score.
    split
        Name or path of the split; default: where splits usually are. Without the split the entry
        has no curves.

    Returns
    -------
    The place of the entry, and what verification found. When it found a problem, nothing is left
    there.

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
    records = _selected(source.records(), detectors)
    _require_one_split(records)
    entry = _entry(records, statement)
    place = root / entry.id
    if os.path.lexists(place):
        raise UsageError(
            f"entry {entry.id!r} is there already, in {str(root)!r}: name another with --id, or "
            "remove it first if this one replaces it"
        )
    with _written(place) as directory:
        text = "".join(record.to_json() + "\n" for record in records)
        (directory / RECORDS).write_text(text, encoding="utf-8")
        opened = _split(records[0], split)
        ok = [record for record in records if record.ok]
        if opened is not None and ok:
            write_curves(make_curves(ok, source, opened), directory / CURVES)
        if scores:
            _copy_scores(ok, source, directory)
        entry = replace(entry, files=_facts(directory))
        (directory / ENTRY).write_text(entry.to_json(), encoding="utf-8")
        verdict = verify_entry(directory, name=entry.id, split=split)
        if root.is_dir():
            _check_clashes(verdict, root)
        if verdict.ok:
            directory.rename(place)
    return place, verdict


def _selected(records: Sequence[Record], detectors: str) -> list[Record]:
    """Return the records of some detectors, fit to be published, in the order of the board."""
    if not records:
        raise UsageError("these results have no records: expected those of a finished run")
    names = select("detector of these results", detectors, sorted({r.detector for r in records}))
    environments, anomalies = list(ENVIRONMENTS), list(ANOMALIES)
    chosen = [replace(r, reason=_plain(r.reason)) for r in records if r.detector in names]
    return sorted(
        chosen,
        key=lambda r: (
            setting_of(r), environments.index(r.environment), anomalies.index(r.anomaly)
        ),
    )  # fmt: skip


def _plain(reason: str) -> str:
    """Return a reason without markup and control characters: exceptions may say anything."""
    printable = "".join(c if c.isprintable() else " " for c in reason)
    return printable.replace("<", "(").replace(">", ")").replace("](", "] (")[:1000]


def _require_one_split(records: Sequence[Record]) -> None:
    splits = sorted({(r.split, r.split_digest[:12]) for r in records})
    if len(splits) > 1:
        listed = ", ".join(f"{name} ({digest})" for name, digest in splits)
        raise UsageError(
            f"these results are of {len(splits)} splits: {listed}; an entry is of one, so run "
            "each into a results directory of its own"
        )
    if limited := [r for r in records if r.provenance.get("limit") is not None]:
        raise UsageError(
            f"{len(limited)} records, such as {limited[0].cell}, used --limit "
            f"{limited[0].provenance['limit']}: an entry uses all trajectories, so run without "
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


def _entry(records: Sequence[Record], statement: Statement) -> Entry:
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
        command=run_command(records),
        caption=statement.caption,
        rerun=statement.rerun,
    )


def _plugins(records: Iterable[Record]) -> list[dict[str, str]]:
    sources = {
        (r.plugin, r.detector_version, str(r.provenance.get("plugin_source", ""))) for r in records
    }
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


def run_command(records: Sequence[Record]) -> str:
    """Return the commands that make such records, joined by ``&&``.

    Examples
    --------
    >>> run_command([])
    ''
    """
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        overrides = record.provenance.get("overrides", {})
        key = (record.detector, tuple(sorted((k, repr(v)) for k, v in overrides.items())))
        groups.setdefault(key, []).append(record)
    # Detectors that are run alike share a command.
    alike: dict[tuple[str, ...], list[str]] = {}
    for (detector, _), own in groups.items():
        alike.setdefault(_options(own), []).append(detector)
    commands = [
        shlex.join(["oodd-eval", "run", "--detector", ",".join(detectors), *options])
        for options, detectors in alike.items()
    ]
    return " && ".join(commands)[:LONGEST_COMMAND]


def _options(records: Sequence[Record]) -> tuple[str, ...]:
    environments = [e for e in ENVIRONMENTS if any(r.environment == e for r in records)]
    overrides = records[0].provenance.get("overrides", {})
    texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in overrides.items()}
    return (
        "--env", "all" if len(environments) == len(ENVIRONMENTS) else ",".join(environments),
        "--split", records[0].split.partition("@")[0],
        "--horizon", ",".join(str(h) for h in sorted({r.horizon for r in records})),
        "--seed", ",".join(str(s) for s in sorted({r.seed for r in records})),
        *(word for k, v in texts.items() for word in ("--param", f"{k}={v}")),
    )  # fmt: skip


def _copy_scores(records: Iterable[Record], source: ResultsDirectory, directory: Path) -> None:
    (directory / SCORES).mkdir()
    for key in sorted({str(r.provenance.get("scores", "")) for r in records}):
        file = source.path / SCORES / f"{key}.h5"
        if rules.score_key(key) or not file.is_file():
            raise UsageError(
                f"--scores: {str(file)!r} is not there: run again, or submit without --scores"
            )
        shutil.copyfile(file, directory / SCORES / file.name)


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
