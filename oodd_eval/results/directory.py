"""A results directory: records, every score sequence, logs of failures, and the report.

::

    records.jsonl      one record a line
    scores/<key>.h5    all scores of one unit; also the cache from which a later run resumes
    scores/<key>.sha256  SHA-256 and size of that file, and of the one before it
    fitted/<key>.npz   the state of a fitted detector that can hand it over, see `FitStore`
    logs/<key>.txt     the end of the output of a failing detector, with its traceback
    splits.json        the paths of splits that are not found by their names, by digest
    report.md

Every file is whole or absent, see `oodd_eval.data.files`. A score file that is not the one that was
written is not read; one of an earlier version, without a digest beside it, is.
"""

import contextlib
import hashlib
import io
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from oodd_eval.data import files
from oodd_eval.data.bounded import SCORES, open_plain, read_json
from oodd_eval.data.layout import MANIFEST
from oodd_eval.data.split import Split, load_split, split_directories
from oodd_eval.data.stored import child
from oodd_eval.errors import (
    FittedStateError,
    OutputError,
    ResultsError,
    SplitNotFoundError,
    UnknownNameError,
)
from oodd_eval.plugins.state import PackedState, read_state, write_state
from oodd_eval.results.record import Record

RECORDS: Final = "records.jsonl"
REPORT: Final = "report.md"
SPLITS: Final = "splits.json"

MOST_PATHS: Final = 2**20  # bytes of the file of splits

WRITING_SHARE: Final = 0.05  # of the time since the last writing that the next one may take


EXPLAINED: Final = ("sensors", "onsets")
"""Datasets of explanations beside ``scores``: by row, the sensor named first, and the onset."""

NAMINGS: Final = "namings"
"""Dataset of the parts that explanations name beside ``scores``, by episode."""

STREAM: Final = "stream"
"""Dataset of the surprise of the stream by row beside ``scores``."""


_TOO_LARGE: Final = (OverflowError, RecursionError)  # numbers and texts of damaged files

VOICES: Final = "voices"
"""Attribute of a score file: what voices cost, as JSON."""


@dataclass(frozen=True, slots=True)
class ScoreFile:
    """Scores of one unit by part (``calibration``, ``test/nominal``, ``test/iid`` and so on).

    `cost` holds ``seconds_fit``, ``seconds_score`` and ``peak_rss_mb`` of the fit, and
    ``steps_scored``, the number of observations that ``seconds_score`` is for. `explained` are
    explanations by part, int32 arrays of shape (2, rows) with the sensors named first and the
    onsets, of anomalous parts and detectors that explain only: -1 but at first guaranteed alarms.
    `namings` are the parts that are named there, see `alarms.naming_contributions` of the metrics.
    `stream` is the surprise of the stream by part, of episodes without twins only, see
    `oodd_eval.metrics.faults`. `voices` is what `oodd_eval.plugins.voices.VoiceCosts` is made of,
    of detectors that have any.
    """

    parts: dict[str, list[NDArray[np.float64]]]
    cost: dict[str, float]
    explained: dict[str, list[NDArray[np.int32]]] = field(default_factory=dict)
    stream: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    voices: dict[str, Any] = field(default_factory=dict)
    namings: dict[str, NDArray[np.int8]] = field(default_factory=dict)


class _StoredPart(NamedTuple):
    """One part of a score file: scores, explanations, stream and namings, or None for these."""

    sequences: list[NDArray[np.float64]]
    explained: list[NDArray[np.int32]] | None
    stream: list[NDArray[np.float64]] | None
    namings: NDArray[np.int8] | None


class ResultsDirectory:
    """Access to one results directory, which need not exist yet.

    `notes` are sentences for the user on what was damaged and left out.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.fits = FitStore(self.path / "fitted")
        self.notes: list[str] = []

    def prepare(self) -> None:
        """Make the directory, and find out before any work is done whether it can be used.

        What a killed run left half written is removed. `OutputError`: it cannot be written to.
        `ResultsError`: it has records that cannot be read, and so not be added to.
        """
        try:
            for part in ("scores", "logs"):
                (self.path / part).mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=self.path / part):
                    pass
        except OSError as error:
            raise OutputError(
                f"results directory {str(self.path)!r} cannot be written to: {error.strerror}; "
                "name another with --output"
            ) from None
        if (self.path / RECORDS).exists():
            self.records()
        for name in (RECORDS, REPORT):  # users may choose a directory that holds files of theirs
            files.remove_abandoned(self.path, name)
        for directory in (self.path / "scores", self.path / "logs", self.fits.path):
            files.remove_abandoned(directory)
        if old := self.fits.leftovers():
            self.notes.append(
                f"{len(old)} directories in {str(self.fits.path)!r}, such as {old[0].name}, hold "
                "fits of an earlier version and are not read: they can be deleted"
            )

    def note_split(self, split: Split) -> None:
        """Keep the path of a split that is not found by its name."""
        path = str(split.path.absolute())
        by_name = split_directories().get(str(split.manifest["name"]))
        if by_name is not None and by_name.absolute() == split.path.absolute():
            return
        with files.lock(self.path):
            paths = self._split_paths() | {split.digest: path}
            files.write_text(self.path / SPLITS, json.dumps(paths, indent=1) + "\n")

    def _split_paths(self) -> dict[str, str]:
        """Return the paths of splits by digest, as far as they can be read."""
        content = None
        with contextlib.suppress(ResultsError):
            content = read_json(self.path / SPLITS, MOST_PATHS, ResultsError)
        entries = content.items() if isinstance(content, dict) else ()
        return {digest: path for digest, path in entries if isinstance(path, str)}

    def split_of(self, record: Record) -> Split:
        """Open the split of a record: where it was when it was evaluated, or by its name.

        `SplitNotFoundError`, `UnknownNameError`: it is not there.
        """
        path = self._split_paths().get(record.split_digest)
        if path is not None and (Path(path) / MANIFEST).is_file():
            split = Split(Path(path))
            if split.digest == record.split_digest:
                return split
        # A split that is not the published one carries its digest behind its name.
        name = record.split.partition("@")[0]
        try:
            return load_split(name)
        except (SplitNotFoundError, UnknownNameError) as error:
            if path is None and isinstance(error, SplitNotFoundError):
                raise
            cause = str(error) if path is None else f"it was in {path!r}, and is not there any more"
            raise SplitNotFoundError(
                f"the split {name!r} of these results is not found: {cause}; pass --split PATH "
                "with the directory where it is"
            ) from None

    def records(self) -> list[Record]:
        """Read all records, also compressed ones; `ResultsError` without any, or a damaged one.

        A last line that was cut short is left out: kept scores can give its record again.
        """
        file = files.find_file(self.path / RECORDS) or self.path / RECORDS
        if not file.exists():
            raise ResultsError(
                f"no results in {str(self.path)!r}: expected a file {RECORDS}, written by "
                "oodd-eval run"
            )
        return read_records(file, self.notes)

    def merge_records(self, records: Iterable[Record]) -> list[Record]:
        """Write records into the directory, and return all that it has then.

        Newer records replace those of the same cell. A failed one is also replaced by one of the
        same cell with other parameters. Earlier records keep their places and new cells follow.
        Places of replaced cells are filled in the order of `records`, so that the end is the same
        whether records come at once or one by one. `OutputError`: they cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{str(self.path)!r} cannot be written to: {error}") from None
        with files.lock(self.path):
            earlier = self.records() if (self.path / RECORDS).exists() else []
            merged = _merged(earlier, records)
            self._write(merged)
        return merged

    def forget(self, records: Iterable[Record]) -> None:
        """Remove records, and the scores and logs that no other record names."""
        gone = {record.identity: record for record in records}
        with files.lock(self.path):
            kept = [r for r in self.records() if r.identity not in gone]
            self._write(kept)
            for key in {r.scores for r in gone.values()} - {r.scores for r in kept} - {""}:
                for file in (*self._score_paths(key), self.log_path(key)):
                    file.unlink(missing_ok=True)

    def _write(self, records: Iterable[Record]) -> None:
        text = "".join(record.to_json() + "\n" for record in records)
        files.write_text(self.path / RECORDS, text)

    def log_path(self, key: str) -> Path:
        """Return the place of the log of a failed unit."""
        return self.path / "logs" / f"{key}.txt"

    def write_scores(self, key: str, scores: ScoreFile) -> None:
        """Keep the scores of a unit, beside parts of it that an earlier run has scored."""
        parts = self._all_parts(key)
        for part, sequences in scores.parts.items():
            further = scores.explained.get(part), scores.stream.get(part), scores.namings.get(part)
            parts[part] = _StoredPart(sequences, *further)
        path, digests = self._score_paths(key)
        # In memory: HDF5 crashes where it cannot write, as on a full disk.
        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            file.attrs.update(scores.cost)
            if voices := scores.voices or self.voices(key):
                file.attrs[VOICES] = json.dumps(voices)
            for part in sorted(parts):
                group = file.create_group(part)
                sequences, explained, stream, namings = parts[part]
                group["offsets"] = np.cumsum([0, *map(len, sequences)], dtype=np.int64)
                columns = {"scores": np.concatenate([np.zeros(0), *sequences])}
                if stream is not None:
                    columns[STREAM] = np.concatenate([np.zeros(0), *stream])
                if explained is not None:
                    columns |= zip(EXPLAINED, np.concatenate(explained, axis=1), strict=True)
                if namings is not None:
                    columns[NAMINGS] = namings
                for name, data in columns.items():
                    group.create_dataset(name, data=data, compression="gzip", shuffle=True)
        content = image.getvalue()
        # First the digest, beside that of the file before: a kill between the two loses neither.
        sealed = f"{hashlib.sha256(content).hexdigest()} {len(content)}"
        files.write_text(digests, "\n".join([sealed, *_lines(digests)[:1]]) + "\n")
        files.write_bytes(path, content)

    def _score_paths(self, key: str) -> tuple[Path, Path]:
        """Return the paths of a score file and of its digests."""
        return self.path / "scores" / f"{key}.h5", self.path / "scores" / f"{key}.sha256"

    def _opened(self, key: str) -> h5py.File:
        """Open a score file; `ValueError` when it is not the one that was written."""
        path, digests = self._score_paths(key)
        if digests.exists():
            sealed, size = _lines(digests), f" {path.stat().st_size}"
            with open_plain(path) as file:
                same = any(line.endswith(size) for line in sealed) and (
                    hashlib.file_digest(file, "sha256").hexdigest() + size in sealed
                )
            if not same:
                note = f"{str(path)!r} was changed since it was written and is not used"
                self.notes += [] if note in self.notes else [note]
                raise ValueError(note)
        return h5py.File(path, "r", locking=False)

    def scores(self, key: str, lengths: Mapping[str, Sequence[int]]) -> ScoreFile | None:
        """Read a unit's scores; None when the file is absent, damaged, lacks a part or misfits.

        `lengths` names the parts to read, with the observations of each of their trajectories.
        """
        try:
            with self._opened(key) as file:
                parts, explained, stream, namings = {}, {}, {}, {}
                for part, expected in lengths.items():
                    if file[part]["offsets"].shape != (len(expected) + 1,):
                        return None
                    stored = _stored_part(file[part])
                    if list(map(len, stored.sequences)) != list(expected):
                        return None
                    parts[part] = stored.sequences
                    if stored.explained:
                        explained[part] = stored.explained
                    if stored.stream is not None:
                        stream[part] = stored.stream
                    if stored.namings is not None:
                        namings[part] = stored.namings
                attributes = dict(file.attrs)
                voices = dict(json.loads(attributes.pop(VOICES, "{}")))
                cost = {name: float(value) for name, value in attributes.items()}
        except Exception:  # noqa: BLE001  h5py raises many kinds for damaged bytes
            return None
        cost = {name: value for name, value in cost.items() if 0 <= value < np.inf}
        return ScoreFile(parts, cost, explained, stream, voices, namings)

    def voices(self, key: str) -> dict[str, Any]:
        """Return what a score file says of a detector's voices; empty where it says nothing."""
        try:
            with self._opened(key) as file:
                return dict(json.loads(file.attrs[VOICES]))
        except Exception:  # noqa: BLE001  as above
            return {}

    def _all_parts(self, key: str) -> dict[str, _StoredPart]:
        """Return all parts."""
        parts: dict[str, _StoredPart] = {}

        def collect(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Group) and "scores" in item:
                parts[name] = _stored_part(item)

        try:
            with self._opened(key) as file:
                file.visititems(collect)
        except Exception:  # noqa: BLE001  as above
            return {}
        return parts


def _stored_part(part: h5py.Group) -> _StoredPart:
    """Read a part of a score file; `ResultsError` when there can be no such number of scores."""
    sequences = _column(part, "scores")
    stream = _column(part, STREAM) if STREAM in part else None
    if stream is not None and [*map(len, stream)] != [*map(len, sequences)]:
        raise SCORES.error("the stream has another number of rows than the scores")
    return _StoredPart(sequences, _explained(part), stream, _namings(part))


def _column(part: h5py.Group, name: str) -> list[NDArray[np.float64]]:
    """Read a number a row, by episode."""
    stored = child(part, name, SCORES.error)
    SCORES.check(name, stored.dtype, stored.nbytes)
    if stored.ndim != 1:
        raise SCORES.error(f"{name} have shape {stored.shape}, expected one column")
    offsets = part["offsets"][:]
    # A part may have no trajectories.
    return np.split(np.asarray(stored[:], np.float64), offsets[1:-1])[: len(offsets) - 1]


def _lines(digests: Path) -> list[str]:
    """Return the lines of a file of digests, none where there is none."""
    if not digests.is_file():
        return []
    with open_plain(digests) as file:
        return file.read(1000).decode(errors="replace").splitlines()


def _explained(part: h5py.Group) -> list[NDArray[np.int32]] | None:
    """Return the explanations of a part, which detectors without ``explain`` do not have."""
    if not all(name in part for name in EXPLAINED):
        return None
    if any(part[name].shape != part["scores"].shape for name in EXPLAINED):
        raise ValueError("explanations of another number of rows than scores")
    columns = np.array([part[name][:] for name in EXPLAINED], dtype=np.int32)
    return np.split(columns, part["offsets"][1:-1], axis=1)


def _namings(part: h5py.Group) -> NDArray[np.int8] | None:
    """Return the named parts of the episodes of a part, which earlier versions did not keep."""
    if NAMINGS not in part:
        return None
    if part[NAMINGS].dtype != np.int8 or part[NAMINGS].shape[:2] != (len(part["offsets"]) - 1, 3):
        raise ValueError("namings of another form, or of another number of episodes than scores")
    return np.asarray(part[NAMINGS][:])


class RecordWriter:
    """Collects the records of one run and writes them from time to time.

    Scores are kept the moment a unit is finished, and records can be made from them again. Writing
    records is of the whole file, so that it waits until it costs little of the run's time. Without
    `results`, records are in memory only.
    """

    def __init__(self, results: ResultsDirectory | None) -> None:
        self._results = results
        self._finished: dict[int, list[Record]] = {}
        self._unwritten = False
        self._due = 0.0

    def add(self, index: int, records: list[Record]) -> None:
        """Take the records of the unit that is `index`-th in the plan; write all if it is time."""
        self._finished[index] = records
        self._unwritten = True
        if time.monotonic() >= self._due:
            self.write()

    def write(self) -> None:
        """Write all records so far, unless none is new."""
        if not (self._results and self._unwritten):
            return
        start = time.monotonic()
        self._results.merge_records(self.records)
        self._unwritten = False
        now = time.monotonic()
        self._due = now + (now - start) / WRITING_SHARE

    @property
    def records(self) -> list[Record]:
        """All records so far, in the order of the plan."""
        return [record for index in sorted(self._finished) for record in self._finished[index]]


def read_records(
    file: Path, notes: list[str] | None = None, *, matches: Callable[[str], bool] = bool
) -> list[Record]:
    """Read a file of records.

    Parameters
    ----------
    file
        Lines of JSON, compressed or not.
    notes
        With a list, a last line that was cut short is left out, and a note on it is added.
    matches
        Predicate of the lines to read.

    Returns
    -------
    list of Record
        In the order of the file.

    Raises
    ------
    ResultsError
        When it cannot be read, naming the line.
    """
    # Of the ends of lines that Python knows, JSON has this one alone.
    lines = (text := files.read_text(file)).removesuffix("\n").split("\n")
    if notes is not None and len(lines) > 1 and not text.endswith("\n"):
        try:
            Record.from_json(lines[-1])
        except ResultsError:
            del lines[-1]
            notes.append(f"{str(file)!r} was cut short: its last line is left out")
    records: list[Record] = []
    for number, line in enumerate(lines, start=1):
        if line.strip() and matches(line):
            records.append(Record.from_json(line, f"{file}:{number}"))
    return records


def _merged(earlier: Sequence[Record], records: Iterable[Record]) -> list[Record]:
    newer = {record.identity: record for record in records}
    tried = {_attempt(record) for record in newer.values()}
    rest = iter(newer.values())
    merged = {
        r.identity: next(rest) if r.identity in newer else r
        for r in {r.identity: r for r in earlier}.values()  # somebody may have copied lines
        if r.ok or r.identity in newer or _attempt(r) not in tried
    }
    return [*merged.values(), *rest]


def _attempt(record: Record) -> tuple[object, ...]:
    """Return the identity of a cell without parameters: a later attempt replaces a failed one."""
    cell = replace(record.cell, setting=replace(record.cell.setting, parameters=()))
    return cell, record.split_digest, record.limit


class KeptFit(NamedTuple):
    """A fit as data, and the seconds that it took."""

    packed: PackedState
    seconds_fit: float


class FitStore:
    """Fits of detectors in one directory, each a file that is whole or absent.

    Another run may fit again, and does where a file is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kept: set[str] = set()

    def has(self, key: str, *, fresh: bool = False) -> bool:
        """Tell whether a fit is kept under a key; when `fresh`, only one that this object kept."""
        return (key in self._kept or not fresh) and self._file(key).is_file()

    def find(self, key: str, *, fresh: bool = False) -> KeptFit | None:
        """Return the fit kept under a key; None when there is none, or its file is damaged."""
        if not self.has(key, fresh=fresh):
            return None
        try:
            packed = read_state(self._file(key))
            content = json.loads(packed.text)
            text, seconds = json.dumps(content["state"]), float(content["seconds_fit"])
        except (FittedStateError, LookupError, TypeError, ValueError, *_TOO_LARGE):
            return None
        if not 0 <= seconds < math.inf:
            return None
        return KeptFit(PackedState(packed.arrays, text), seconds)

    def keep(self, key: str, packed: PackedState, seconds_fit: float) -> None:
        """Keep a fit under a key, where it can be written."""
        text = f'{{"seconds_fit": {json.dumps(seconds_fit)}, "state": {packed.text}}}'
        with contextlib.suppress(OutputError):
            write_state(self._file(key), PackedState(packed.arrays, text))
            self._kept.add(key)

    def distrust(self, key: str) -> None:
        """Treat the fit under a key as an earlier run's: it could not be restored."""
        self._kept.discard(key)

    def leftovers(self) -> list[Path]:
        """Return directories in which earlier versions kept fits, and which nothing reads."""
        return sorted(p.parent for p in self.path.glob("*/fitted.json"))

    def _file(self, key: str) -> Path:
        return self.path / f"{key}.npz"
