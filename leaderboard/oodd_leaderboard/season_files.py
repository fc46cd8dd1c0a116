"""The files of a season: what was run, and the records of each row.

::

    season.json          the season, see `Season`
    rows/NAME.jsonl.xz   the records of one row, one a line
    split/               the split, which the bits give again; never committed, as what follows
    packages/NAME/       what was installed for an entry
    work/NAME/           results of a row with scores and fits, from which a season resumes
"""

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.bounded import MANIFEST_BYTES, read_bytes
from oodd_eval.data.files import packed, write_bytes, write_text
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.ranking import Position
from oodd_eval.names import counted
from oodd_eval.results.directory import read_records
from oodd_eval.results.record import Record
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.formats import explained

SCHEMA: Final = 1
SEASON: Final = "season.json"
ROWS: Final = "rows"
SPLIT: Final = "split"
PACKAGES: Final = "packages"
WORK: Final = "work"


@dataclass(frozen=True, slots=True)
class SeasonSplit:
    """The split of a season: name, digest and the definition of its manifest."""

    name: str
    digest: str
    definition: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Installed:
    """One wheel that was installed for an entry."""

    distribution: str
    version: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Season:
    """One season: the fresh split that its bits give, and the entries that were run on it.

    Attributes
    ----------
    name
        Name of the season.
    bits
        The 128 random bits, as 32 hexadecimal digits.
    protocol, oodd_eval
        Version of the benchmark's protocol, and of the program.
    split
        What the bits gave.
    seeds
        Seeds of the detectors; of rows without randomness the first one alone.
    environments
        All environments of the season.
    conditions
        Anomalies with their strengths by environment, such as ``"iid@kept90"``.
    trial
        Whether sizes or environments are not those that a season has.
    entries
        What was run, by name.
    installed
        Wheels of strangers' entries, by the entry's name.
    date
        Day of its end, as in ISO 8601; empty until it is whole.
    """

    name: str
    bits: str
    protocol: int
    oodd_eval: str
    split: SeasonSplit
    seeds: list[int]
    environments: list[str]
    conditions: dict[str, list[str]]
    trial: bool = False
    entries: dict[str, Entry] = field(default_factory=dict)
    installed: dict[str, list[Installed]] = field(default_factory=dict)
    date: str = ""
    schema: Literal[1] = SCHEMA

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    @property
    def expected(self) -> frozenset[Position]:
        """Environments and conditions that every row has."""
        return frozenset(
            (e, condition) for e in self.environments for condition in self.conditions[e]
        )

    def records(self, directory: Path) -> list[Record]:
        """Read the records of the rows that are finished, in the order of the entries.

        `ResultsError`: a file cannot be read, or holds records of another row or split.
        """
        records: list[Record] = []
        for name in self.entries:
            path = row_path(directory, name)
            for record in read_records(path) if path.is_file() else ():
                held = record.detector, record.split_digest, record.protocol
                if held != (expected := (name, self.split.digest, self.protocol)):
                    raise ResultsError(f"{path}: a record is of {held}, expected {expected}")
                records.append(record)
        return records

    def missing(self, records: Iterable[Record]) -> list[str]:
        """Return a line for each row that lacks environments; empty when the season is whole."""
        cells: dict[str, set[tuple[str, str, int]]] = {name: set() for name in self.entries}
        deterministic: set[str] = set()
        for record in records:
            cells[record.detector].add((*record.position, record.seed))
            if record.deterministic:
                deterministic.add(record.detector)
        lines = []
        for name, held in cells.items():
            seeds = self.seeds[:1] if name in deterministic else self.seeds
            lacking = [
                environment
                for environment in self.environments
                if any(
                    (environment, condition, seed) not in held
                    for condition in self.conditions[environment]
                    for seed in seeds
                )
            ]
            if lacking == self.environments:
                lines.append(f"{name}: not run")
            elif lacking:
                lines.append(
                    f"{name}: no or not all results in {counted(len(lacking), 'environment(s)')} "
                    f"({', '.join(lacking)})"
                )
        return lines


def row_path(directory: Path, name: str) -> Path:
    """Return the path of the records of a row."""
    return directory / ROWS / f"{name}.jsonl.xz"


def write_row(directory: Path, name: str, records: Sequence[Record]) -> None:
    """Write the records of a row, all or nothing."""
    path = row_path(directory, name)
    text = "".join(f"{record.to_json()}\n" for record in records)
    write_bytes(path, packed(path, text.encode()))


def read_season(directory: Path) -> Season:
    """Read ``season.json``; `ResultsError` without one, and for what is no season."""
    path = directory / SEASON
    if not path.is_file():
        raise ResultsError(f"no season in {str(directory)!r}: it has no {SEASON}")
    try:
        return _READER.validate_json(read_bytes(path, MANIFEST_BYTES, ResultsError))
    except ValidationError as error:
        raise ResultsError(f"{path}: {explained(error)}") from None


def write_season(season: Season, directory: Path) -> None:
    """Write ``season.json``."""
    values = dataclasses.asdict(season)
    first = ("schema", "name", "date")
    ordered: Mapping[str, Any] = {name: values[name] for name in first} | values
    write_text(directory / SEASON, json.dumps(ordered, indent=1) + "\n")


_READER: Final = TypeAdapter(Season)
