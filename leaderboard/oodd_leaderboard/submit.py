"""Write an entry of the leaderboard from a results directory."""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Literal, NamedTuple

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, in_order
from oodd_eval.data.files import compress_large, digests, remove_abandoned, temporary_directory
from oodd_eval.errors import OutputError, UsageError
from oodd_eval.names import counted, expression, select
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_leaderboard import reported as stored
from oodd_leaderboard.curve_file import make_curves, write_curves
from oodd_leaderboard.reported import CURVES, ENTRY, EntryInfo
from oodd_leaderboard.standings import primary_settings
from oodd_leaderboard.verify import EntryVerdict, Neighbours, find_split, formats, verify_entry

LARGE: Final = 10 * 10**6  # bytes of a large entry: a repository keeps every version of it

Extent = Literal["rows", "detectors", "none"]


@dataclass(frozen=True, slots=True)
class Statement:
    """A submitter's statements about an entry, beyond its records; empty ones are made up."""

    id: str = ""
    title: str = ""
    submitter: str = ""
    citation: str = ""
    url: str = ""
    caption: str = ""
    primary: tuple[str, ...] = ()


class Submission(NamedTuple):
    """The directory of an entry and its verdict; nothing is left there with a problem.

    `left_out` has a line for each seed of a row that was left out as incomplete.
    """

    path: Path
    verdict: EntryVerdict
    left_out: list[str]


def submit(
    results: Path | str,
    root: Path | str,
    statement: Statement,
    *,
    detectors: str = "all",
    cells: str = "",
    complete: bool = False,
    curves: Extent = "rows",
    split: str | Path | None = None,
) -> Submission:
    """Write an entry from a results directory, verify it, and move it into `root`."""
    source, root = ResultsDirectory(results), Path(root)
    records, left_out = selected(source.records(), detectors, cells, complete=complete)
    _check_publishable(records)
    entry = _info(records, statement)
    path = root / entry.id
    if os.path.lexists(path):
        advice = "name another with --id, or remove it first if this one replaces it"
        raise UsageError(f"entry {entry.id!r} is there already, in {str(root)!r}: {advice}")
    with _written(path) as directory:
        text = "".join(record.to_json() + "\n" for record in records)
        (directory / RECORDS).write_text(text, encoding="utf-8")
        compress_large(directory / RECORDS)
        opened, _ = find_split(records[0].split, records[0].split_digest, split)
        drawn = with_curves(records, curves)
        if opened is not None and drawn:
            _require_scores(drawn, source)
            write_curves(make_curves(drawn, source, opened), directory / CURVES)
            compress_large(directory / CURVES)
        entry = replace(
            entry,
            files={
                name: {"sha256": digest, "bytes": (directory / name).stat().st_size}
                for name, digest in digests(directory).items()
            },
        )
        (directory / ENTRY).write_text(entry.to_json(), encoding="utf-8")
        verdict = verify_entry(directory, name=entry.id, split=split)
        if root.is_dir():
            Neighbours(stored.read_entries(root)).check(verdict)
        if verdict.ok:
            directory.rename(path)
    return Submission(path, verdict, left_out)


def selected(
    records: Sequence[Record], detectors: str, cells: str = "", *, complete: bool = False
) -> tuple[list[Record], list[str]]:
    """Return the records to publish, in the order of the board, and what is left out."""
    if not records:
        raise UsageError("these results have no records: expected those of a finished run")
    names = select("detector of these results", detectors, sorted({r.detector for r in records}))
    matches = expression(cells) if cells else lambda _: True
    kept = [r for r in records if r.detector in names and matches(str(r.cell))]
    if not kept:
        raise UsageError(f"-k {cells!r} selects none of the {len(records)} records")
    left_out: list[str] = []
    if complete:
        kept, left_out = _complete(kept)
    environments = in_order((r.environment for r in kept), ENVIRONMENTS)
    anomalies = in_order((r.anomaly for r in kept), ANOMALIES)
    kept.sort(
        key=lambda r: (environments.index(r.environment), anomalies.index(r.anomaly), r.strength)
    )
    kept.sort(key=lambda r: (r.detector, r.horizon, r.seed, r.setting.overrides_json))
    return [_publishable(r) for r in kept], left_out


def _complete(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Leave out the seeds of rows that lack cells which any row here has."""
    cells: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for r in records:
        cells[r.cell.label].add(r.position)
    every = set().union(*cells.values())
    partial = {label: len(has) for label, has in sorted(cells.items()) if has != every}
    if len(partial) == len(cells):
        raise UsageError(
            f"--complete: no row of these results has all {len(every)} cells that occur in them; "
            "run the rest, or choose cells that all rows have with -k"
        )
    left_out = [
        f"{label}, which has {n} of {counted(len(every), 'cell(s)')}"
        for label, n in partial.items()
    ]
    return [r for r in records if r.cell.label not in partial], left_out


def _publishable(record: Record) -> Record:
    """Return a record whose texts are plain; a command that is not is left out."""
    # Exceptions may say anything, and parameters on the command line may have any value.
    reason = "".join(c if c.isprintable() else " " for c in record.reason)
    reason = reason.replace("<", "(").replace(">", ")").replace("](", "] (")[:1000]
    origin = dict(record.provenance)
    if any(formats.unsafe(origin.get("command", ""))):
        del origin["command"]
    return replace(record, reason=reason, provenance=origin)


def with_curves(records: Sequence[Record], extent: Extent) -> list[Record]:
    """Return the records that curves are made of: those of the lowest evaluated seed of each row.

    With ``"detectors"`` they are of rows that are primary by default.
    """
    evaluated = [r for r in records if r.ok and extent != "none"]
    seeds: dict[Setting, int] = {}
    for r in evaluated:
        seeds[r.setting] = min(seeds.get(r.setting, r.seed), r.seed)
    rows = primary_settings(evaluated) if extent == "detectors" else seeds
    return [r for r in evaluated if r.setting in rows and r.seed == seeds[r.setting]]


def _check_publishable(records: Sequence[Record]) -> None:
    splits = sorted({(r.split, r.split_digest[:12]) for r in records})
    if len(splits) > 1:
        listed = ", ".join(f"{name} ({digest})" for name, digest in splits)
        advice = "an entry is of one, so run each into a results directory of its own"
        raise UsageError(f"these results are of {len(splits)} splits: {listed}; {advice}")
    for record in records:
        if record.limit is not None:
            raise UsageError(
                f"{record.cell} used --limit {record.limit}: an entry uses all trajectories, so "
                "run without it, into another results directory"
            )
        if formats.complaint(formats.PLUGIN_NAME, record.plugin):
            raise UsageError(
                f"detector {record.detector!r} is of no installed plug-in (plugin is "
                f"{record.plugin!r}): others could not run it again; see oodd-eval new"
            )


def _info(records: Sequence[Record], statement: Statement) -> EntryInfo:
    """Return ``entry.json`` without its files."""
    first = records[0]
    detectors = sorted({r.detector for r in records})
    # Detectors made of classes have capitals and a colon in their names.
    split = first.split.replace("@", "-")
    name = statement.id or f"{'-'.join(detectors)}-{split}".lower().replace(":", "-")
    complaint = formats.complaint(formats.ENTRY_ID, name)
    if not statement.id and (len(detectors) > 3 or complaint):
        raise UsageError("the names of these detectors make no short id: choose one with --id")
    if complaint:
        raise UsageError(f"--id {complaint}")
    title = ", ".join(detectors[:3]) + (f" and {len(detectors) - 3} more" * (len(detectors) > 3))
    packages = {r.plugin.partition(":")[0]: r.detector_version for r in records}
    packages |= stored.recorded_versions(records)
    platforms = sorted({r.provenance.get("platform", "") for r in records})
    environment = {
        "python": packages.pop("python"),
        "platform": "+".join(platforms)[:200],
        "packages": dict(sorted(packages.items())),
    }
    stated = asdict(statement) | {
        "id": name,
        "title": statement.title or f"{title} on {first.split}",
        "primary": [str(Setting.parse(row)) for row in statement.primary],
    }
    return EntryInfo(
        **stated,
        detectors=detectors,
        split=first.split,
        split_digest=first.split_digest,
        protocol=first.protocol,
        plugins=stored.recorded_plugins(records),
        environment=environment,
        created=datetime.now(UTC).date().isoformat(),
    )


def _require_scores(records: Iterable[Record], source: ResultsDirectory) -> None:
    """Raise `UsageError` when a score file of the records is not there."""
    for key in {r.scores for r in records}:
        file = source.path / "scores" / f"{key}.h5"
        if formats.complaint(formats.SCORE_KEY, key) or not file.is_file():
            advice = "submit with --curves none, or run again into this directory"
            raise UsageError(f"scores are not there in {str(file)!r}: {advice}")


@contextmanager
def _written(path: Path) -> Iterator[Path]:
    """Yield a directory beside the path, which is removed afterwards unless it was moved."""
    try:
        remove_abandoned(path.parent)
        with temporary_directory(path.parent, path.name) as directory:
            yield directory
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
