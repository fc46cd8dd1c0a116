"""Check ``entry.json``: its fields, its own consistency, and the split it names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import PROTOCOL, SPLITS
from oodd_eval.data.split import published_digests
from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.entry import ENTRY, SCHEMA, TRUST, Entry
from oodd_eval.leaderboard.verify import rules
from oodd_eval.leaderboard.verify.files import parse_json, read_whole
from oodd_eval.leaderboard.verify.findings import Findings, shown

FIELDS: Final[Mapping[str, rules.Rule]] = {
    "schema": rules.one_of([SCHEMA]),
    "id": rules.entry_id,
    "title": rules.text(120, least=1),
    "detectors": lambda value: "" if isinstance(value, list) else f"is {shown(value)}, not a list",
    "submitter": rules.text(120),
    "citation": rules.text(2000),
    "url": rules.url,
    "trust": rules.one_of(TRUST),
    "rerun": rules.nullable(rules.mapping),
    "split": rules.split_name,
    "split_digest": rules.digest,
    "protocol": rules.one_of([PROTOCOL]),
    "plugins": lambda value: "" if isinstance(value, list) else f"is {shown(value)}, not a list",
    "environment": rules.mapping,
    "created": rules.day,
    "command": rules.command,
    "caption": rules.text(500),
    "files": rules.mapping,
}
_PLUGIN: Final = {
    "distribution": rules.name,
    "plugin": rules.name,
    "version": rules.version,
    "source_digest": rules.digest,
}
_ENVIRONMENT: Final = {
    "python": rules.text(100, least=1),
    "platform": rules.text(200),
    "packages": rules.mapping,
}
_RERUN: Final = {"by": rules.text(200, least=1), "how": rules.text(1000, least=1)}
_FILE: Final = {"sha256": rules.digest, "bytes": rules.whole(0)}
_FILE_NAME: Final = re.compile(r"(scores/)?[a-z0-9][a-z0-9._-]{0,170}")


def check_entry(directory: Path, name: str, findings: Findings) -> Entry | None:
    """Read and check ``entry.json``.

    Parameters
    ----------
    directory
        Of the entry.
    name
        The name that the directory has or is going to have.

    Returns
    -------
    The entry; None when a field is wrong, so that nothing else can be compared with it.
    """
    before = findings.count
    try:
        plain = parse_json(read_whole(directory, ENTRY))
    except ResultsError as error:
        findings.refuse(ENTRY, "", str(error))
        return None
    rules.check_fields(plain, FIELDS, findings, ENTRY)
    if isinstance(plain, dict):
        _check_parts(plain, findings)
    if findings.count > before:
        return None
    entry = Entry.from_plain(plain, ENTRY)
    if entry.id != name:
        findings.refuse(ENTRY, "id", f"is {entry.id!r}, but the directory is {shown(name)}")
    _check_trust(entry, findings)
    check_split(entry, findings)
    return entry


def _check_parts(plain: Mapping[str, Any], findings: Findings) -> None:
    detectors = plain.get("detectors")
    if isinstance(detectors, list):
        _check_detectors(detectors, findings)
    plugins = plain.get("plugins")
    for i, plugin in enumerate(plugins[:100] if isinstance(plugins, list) else []):
        rules.check_fields(plugin, _PLUGIN, findings, ENTRY, f"plugins[{i}].")
    if plain.get("rerun") is not None:
        rules.check_fields(plain["rerun"], _RERUN, findings, ENTRY, "rerun.")
    if isinstance(plain.get("files"), dict):
        _check_files(plain["files"], findings)
    environment = plain.get("environment")
    if isinstance(environment, dict):
        rules.check_fields(environment, _ENVIRONMENT, findings, ENTRY, "environment.")
        packages = environment.get("packages")
        for package, version in packages.items() if isinstance(packages, dict) else ():
            if complaint := rules.name(package) or rules.version(version):
                findings.refuse(
                    ENTRY, f"environment.packages.{shown(package)[1:-1]}", complaint
                )  # fmt: skip


def _check_detectors(detectors: list[Any], findings: Findings) -> None:
    for i, detector in enumerate(detectors):
        if complaint := rules.detector_name(detector):
            findings.refuse(ENTRY, f"detectors[{i}]", complaint)
            return
    if not detectors or detectors != sorted(set(detectors)):
        findings.refuse(
            ENTRY, "detectors", f"is {shown(detectors)}, expected names in order, each once"
        )


def _check_files(files: Mapping[str, Any], findings: Findings) -> None:
    for name, facts in files.items():
        field = f"files.{shown(name)[1:-1]}"
        if not _FILE_NAME.fullmatch(name) or ".." in name:
            findings.refuse(
                ENTRY, field, "is no name of a file of an entry: expected a plain name, in scores/"
                " or in the entry itself",
            )  # fmt: skip
        else:
            rules.check_fields(facts, _FILE, findings, ENTRY, f"{field}.")


def _check_trust(entry: Entry, findings: Findings) -> None:
    if entry.trust == "re-run" and entry.rerun is None:
        findings.refuse(
            ENTRY, "rerun", "is null, but trust is 're-run': say by whom and how it was run again"
        )
    if entry.trust != "re-run" and entry.rerun is not None:
        findings.refuse(ENTRY, "rerun", f"must be null where trust is {entry.trust!r}")


def check_split(entry: Entry, findings: Findings) -> None:
    """Check that name and digest of the split are those of a published one, or say that it is none.

    A name that is the benchmark's own stands for one digest only; any other split of that name
    carries the start of its digest.
    """
    published = published_digests()
    short = entry.split.partition("@")[2]
    if short and not entry.split_digest.startswith(short):
        findings.refuse(
            ENTRY, "split", f"is {entry.split!r}, but split_digest is {entry.split_digest[:8]}…"
        )
    names = [name for name, digest in published.items() if digest == entry.split_digest]
    if names and entry.split not in names:
        findings.refuse(
            ENTRY, "split", f"is {entry.split!r}, but this digest is that of {names[0]!r}"
        )
    elif entry.split in SPLITS and entry.split not in published:
        findings.refuse(
            ENTRY, "split_digest", f"is not known: no digest of {entry.split!r} is published yet, "
            f"the name would be {entry.split}@{entry.split_digest[:8]}",
        )  # fmt: skip
    elif entry.split in published and not names:
        findings.refuse(
            ENTRY, "split_digest",
            f"is {entry.split_digest[:12]}, but the published digest of {entry.split!r} is "
            f"{published[entry.split][:12]}",
        )  # fmt: skip
    elif not names:
        findings.note(
            f"unpublished split {entry.split} (digest {entry.split_digest[:12]}): shown in tables "
            "of its own, not ranked with others"
        )
