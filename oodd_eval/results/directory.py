"""A results directory: records, every score sequence, logs of failures, and the report.

::

    records.jsonl      one record a line
    scores/<key>.h5    all scores of one unit; also the cache from which a later run resumes
    fitted/<key>/      a fitted detector that could save itself, see `oodd_eval.results.fits`
    logs/<key>.txt     what a failing detector printed, with its traceback
    report.md

Every file is written beside its place and then moved there, so that it is whole or absent.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from oodd_eval.data import files as stored_files
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.errors import OutputError, ResultsError
from oodd_eval.plugins.contract import Scores
from oodd_eval.plugins.discovery import Offer
from oodd_eval.results.fits import FittedStore
from oodd_eval.results.provenance import source_digest
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan, Unit

RECORDS = "records.jsonl"
REPORT = "report.md"


@dataclass(frozen=True, slots=True)
class UnitKey:
    """Everything that decides the scores of a unit; equal keys mean equal scores.

    Attributes
    ----------
    distribution, version, source
        Of the plug-in; `source` is the digest of its code.
    detector, parameters, seed, horizon, environment, split_digest, limit
        Of the unit.
    protocol
        Version of the benchmark's rules.
    """

    distribution: str
    version: str
    source: str
    detector: str
    parameters: dict[str, Any]
    seed: int
    horizon: int
    environment: str
    split_digest: str
    limit: int | None
    protocol: int = PROTOCOL

    @property
    def text(self) -> str:
        """Return the key as a short file name: detector, environment and a digest of it all."""
        canonical = json.dumps(asdict(self), sort_keys=True, separators=(",", ":"), default=str)
        digest = hashlib.sha256(canonical.encode()).hexdigest()
        # Some file systems take no colons, and some do not tell capitals.
        detector = self.detector.lower().replace(":", "-")
        return f"{detector}-{self.environment}-{digest[:20]}"


def fit_key(plan: Plan, unit: Unit, offer: Offer) -> str:
    """Return the key of a unit's fit: of all that decides the fitted detector, and nothing else.

    It tells nothing of the environment, since the worker sees it.
    """
    spec = offer.spec
    whole = asdict(unit_key(plan, unit, offer)) | {"detector": spec.fit_name or spec.name}
    del whole["protocol"]
    for name in spec.fit_ignores:
        whole.pop(name, None)
        whole["parameters"].pop(name, None)
    canonical = json.dumps(whole, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(canonical.encode()).hexdigest()[:32]


def unit_key(plan: Plan, unit: Unit, offer: Offer) -> UnitKey:
    """Return the key of a unit of a plan."""
    return UnitKey(
        distribution=offer.distribution,
        version=offer.version,
        source=source_digest(offer.module),
        detector=unit.detector,
        parameters=dict(unit.parameters),
        seed=unit.seed,
        horizon=unit.horizon,
        environment=unit.environment,
        split_digest=plan.split_digest,
        limit=plan.limit,
    )


@dataclass(frozen=True, slots=True)
class ScoreFile:
    """Scores of one unit by part (``calibration``, ``test/nominal``, ``test/iid`` and so on).

    `cost` holds ``seconds_fit``, ``seconds_score`` and ``peak_rss_mb`` of the fit, and
    ``steps_scored``, the number of observations that ``seconds_score`` is for.
    """

    parts: dict[str, list[Scores]]
    cost: dict[str, float]


class ResultsDirectory:
    """Access to one results directory.

    Parameters
    ----------
    path
        The directory; it need not exist for reading to be attempted or writing to begin.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.fitted = FittedStore(self.path / "fitted")

    def prepare(self) -> None:
        """Make the directory and find out, before any work is done, whether it can be used.

        Raises
        ------
        OutputError
            When it cannot be written to.
        ResultsError
            When it has records already that cannot be read, and so not be added to.
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

    def records(self) -> list[Record]:
        """Read all records; those of a large entry of the leaderboard are packed, in ``.gz``.

        Raises
        ------
        ResultsError
            When there are none, or one cannot be read.
        """
        file = stored_files.find_file(self.path / RECORDS) or self.path / RECORDS
        try:
            lines = stored_files.read_text(file).splitlines()
        except FileNotFoundError:
            raise ResultsError(
                f"no results in {str(self.path)!r}: expected a file {RECORDS}, written by "
                "oodd-eval run"
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise ResultsError(f"{str(file)!r} cannot be read: {error}") from None
        return [
            Record.from_json(line, f"{file}:{number}")
            for number, line in enumerate(lines, start=1)
            if line.strip()
        ]

    def merge_records(self, records: Iterable[Record]) -> list[Record]:
        """Write records into the directory; newer ones replace those of the same cell.

        Returns
        -------
        All records of the directory: earlier ones in their places, new cells behind them. Places
        of cells that are replaced are filled in the order of `records`, so that the end is the same
        whether records come at once or one by one.
        """
        with _alone(self.path):
            earlier = self.records() if (self.path / RECORDS).exists() else []
            merged = _merged(earlier, records)
            text = "".join(record.to_json() + "\n" for record in merged)
            self._write_text(self.path / RECORDS, text)
        return merged

    def write_report(self, text: str) -> Path:
        """Write ``report.md`` and return its path."""
        self._write_text(self.path / REPORT, text)
        return self.path / REPORT

    def write_log(self, key: str, text: str) -> None:
        """Keep what a failing detector printed."""
        self._write_text(self.path / "logs" / f"{key}.txt", text)

    def write_scores(self, key: str, scores: ScoreFile) -> None:
        """Keep the scores of a unit, beside parts of it that an earlier run has scored."""
        parts = {**self._all_parts(key), **scores.parts}
        with _replacing(self.path / "scores" / f"{key}.h5") as path, h5py.File(path, "w") as file:
            file.attrs.update(scores.cost)
            for part, sequences in sorted(parts.items()):
                group = file.create_group(part)
                group["offsets"] = np.cumsum([0, *map(len, sequences)], dtype=np.int64)
                group.create_dataset(
                    "scores", data=np.concatenate(sequences), compression="gzip", shuffle=True
                )

    def scores(self, key: str, lengths: Mapping[str, Sequence[int]]) -> ScoreFile | None:
        """Read the scores of a unit.

        Parameters
        ----------
        key
            Of the unit.
        lengths
            For each part that is needed, the number of observations of its trajectories.

        Returns
        -------
        The parts asked for; None when the file is absent, damaged, lacks a part, or does not fit.
        """
        try:
            with h5py.File(self.path / "scores" / f"{key}.h5", "r") as file:
                parts = {}
                for part, expected in lengths.items():
                    flat, offsets = file[part]["scores"][:], file[part]["offsets"][:]
                    if np.diff(offsets).tolist() != list(expected) or len(flat) != offsets[-1]:
                        return None
                    parts[part] = np.split(flat.astype(np.float64, copy=False), offsets[1:-1])
                cost = {name: float(value) for name, value in file.attrs.items()}
        except (OSError, KeyError, ValueError):
            return None
        return ScoreFile(parts, cost)

    def _all_parts(self, key: str) -> dict[str, list[Scores]]:
        parts: dict[str, list[Scores]] = {}

        def collect(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Group) and "scores" in item:
                parts[name] = np.split(item["scores"][:], item["offsets"][1:-1])

        try:
            with h5py.File(self.path / "scores" / f"{key}.h5", "r") as file:
                file.visititems(collect)
        except (OSError, KeyError, ValueError):
            return {}
        return parts

    @staticmethod
    def _write_text(path: Path, text: str) -> None:
        with _replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def _merged(earlier: Sequence[Record], records: Iterable[Record]) -> list[Record]:
    newer = {record.identity: record for record in records}
    rest = iter(newer.values())
    merged = {r.identity: next(rest) if r.identity in newer else r for r in earlier}
    return [*merged.values(), *rest]


@contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Keep other runs that write to the same directory waiting."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        # Not every file system has locks; without them two runs at a time are not supported.
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a file to write, which then takes the place of `path` in one step."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)
