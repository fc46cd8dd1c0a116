"""Write an entry of the leaderboard from a run: what a season is to install, and what was run."""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import read_bytes
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, in_order
from oodd_eval.data.files import compress_large, remove_abandoned, temporary_directory
from oodd_eval.errors import OoddError, OutputError, ResultsError, UsageError
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.results.standings import row_named
from oodd_leaderboard import formats
from oodd_leaderboard.curve_file import check_curves, make_curves, write_curves
from oodd_leaderboard.entry import ENTRY, Entry, read_entry
from oodd_leaderboard.reported import CURVES, read_strange_records

MOST_WHEEL: Final = 10**8  # bytes
SHIPPED: Final = "oodd-eval"


def submit(results: Path, row: str, root: Path, stated: Entry, wheel: Path | None = None) -> Path:
    """Write the entry of a row of a run, read it back, and return its directory.

    Parameters
    ----------
    results
        Directory of the run.
    row
        Name of its detector, or a setting such as ``rf[trees=9]``.
    root
        Directory of the entries.
    stated
        What the records do not say: name, requirement and digest, who made it.
    wheel
        What pip installs, if no requirement; it is copied.

    Raises
    ------
    UsageError
        When these make no entry; nothing is written then.
    """
    source = ResultsDirectory(results)
    records = _publishable(source.records(), row)
    entry = _entry(records, stated, wheel)
    path = root / entry.name
    if os.path.lexists(path):
        raise UsageError(f"{str(path)!r} is there already: remove it first, or choose --name")
    try:
        remove_abandoned(root)
        with temporary_directory(root, entry.name) as directory:
            target = directory / entry.name
            target.mkdir()
            (target / ENTRY).write_text(to_toml(entry), encoding="utf-8")
            if wheel:
                shutil.copyfile(wheel, target / entry.wheel)
            text = "".join(record.to_json() + "\n" for record in records)
            (target / RECORDS).write_text(text, encoding="utf-8")
            compress_large(target / RECORDS)
            _add_curves(records, source, target)
            _read_back(entry, target)
            target.rename(path)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
    return path


def _read_back(entry: Entry, directory: Path) -> None:
    """Raise `UsageError` where what was written is not what a build would read."""
    try:
        read_strange_records(directory)
        same = read_entry(directory / ENTRY) == entry
    except ResultsError as error:
        raise UsageError(f"this makes no entry: {error}") from None
    if not same:
        raise UsageError("this makes no entry: its parameters are not those that TOML gives back")


def _publishable(records: Sequence[Record], row: str) -> list[Record]:
    """Return the records of a row, in the order of a board, as others may read them."""
    if not records:
        raise UsageError("these results have no records: expected those of a finished run")
    setting = row_named(records, row)
    kept = [r for r in records if r.setting == setting]
    if len(splits := {f"{r.split} ({r.split_digest[:12]})" for r in kept}) > 1:
        raise UsageError(f"{setting} was run on {', '.join(sorted(splits))}, expected one split")
    if any(r.limit is not None for r in kept):
        raise UsageError(f"{setting} was run with --limit: run without it into another directory")
    if ":" not in kept[0].plugin:
        raise UsageError(f"{setting} is of no installed plug-in; see oodd-eval new")
    environments = in_order((r.environment for r in kept), ENVIRONMENTS)
    anomalies = in_order((r.anomaly for r in kept), ANOMALIES)
    kept.sort(
        key=lambda r: (environments.index(r.environment), anomalies.index(r.anomaly), r.strength)
    )
    kept.sort(key=lambda r: r.seed)
    return list(map(_plain, kept))


def _plain(record: Record) -> Record:
    """Return a record whose texts are plain; a command that is not is left out."""
    # Exceptions may say anything, and parameters on the command line may have any value.
    reason = "".join(c if c.isprintable() else " " for c in record.reason)
    reason = reason.replace("<", "(").replace(">", ")").replace("](", "] (")[:1000]
    origin = dict(record.provenance)
    if any(formats.unsafe(origin.get("command", ""))):
        del origin["command"]
    return replace(record, reason=reason, provenance=origin)


def _entry(records: Sequence[Record], stated: Entry, wheel: Path | None) -> Entry:
    """Return the entry of a row, its wheel's digest computed."""
    first = records[0]
    distribution = first.plugin.partition(":")[0]
    entry = replace(
        stated,
        name=stated.name or first.detector.lower().replace(":", "-"),
        detector=first.detector,
        parameters=first.setting.overrides,
        horizon=first.horizon,
        training=first.training,
    )
    if wheel:
        digest = hashlib.sha256(read_bytes(wheel, MOST_WHEEL, ResultsError)).hexdigest()
        entry = replace(entry, wheel=wheel.name, sha256=digest)
    elif distribution != SHIPPED:
        version = first.detector_version.partition("+")[0]
        entry = replace(entry, requirement=stated.requirement or f"{distribution}=={version}")
        if not stated.sha256:
            raise UsageError(
                f"{distribution} is not shipped: name its wheel with --wheel, which `pip wheel "
                "--no-deps` makes, or with --sha256 the digest of the file that pip installs"
            )
    if problem := formats.ENTRY_NAME.complaint(entry.name):
        raise UsageError(f"--name {problem}")
    if not entry.shipped and entry.distribution != distribution:
        raise UsageError(f"{entry.wheel or entry.requirement} is not of {distribution}, as the run")
    return entry


def to_toml(entry: Entry) -> str:
    """Return the text of ``entry.toml``, fields at their default left out."""
    defaults = Entry(entry.name, detector=entry.name)
    names = [f.name for f in fields(Entry) if f.name not in {"name", "parameters"}]
    stated = [name for name in names if getattr(entry, name) != getattr(defaults, name)]
    lines = [f"{name} = {_toml(name, getattr(entry, name))}" for name in stated]
    if entry.parameters:
        lines += ["", "[parameters]"]
        lines += [f"{json.dumps(k)} = {_toml(k, v)}" for k, v in entry.parameters.items()]
    return "\n".join(lines) + "\n"


def _toml(name: str, value: Any) -> str:
    """Return a value in TOML, which has JSON's texts, numbers, truth values and lists."""
    if value is None or isinstance(value, dict):
        raise UsageError(f"parameter {name!r} is {value!r}, which an entry cannot hold")
    return json.dumps(value, ensure_ascii=False)


def _add_curves(records: Sequence[Record], source: ResultsDirectory, target: Path) -> None:
    """Add the curves of the row's first seed, where split and scores are at hand."""
    seed = min(r.seed for r in records)
    drawn = [r for r in records if r.ok and r.seed == seed]
    if not drawn:
        return
    try:
        split = source.split_of(drawn[0])
        curves = check_curves(make_curves(drawn, source, split), CURVES)
    except OoddError:
        return
    write_curves(curves, target / CURVES)
    compress_large(target / CURVES)
