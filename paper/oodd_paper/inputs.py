"""The files that a reproduction is rendered from: its header, the policies' returns, its records.

``returns.json`` is kept so that Table 2 can be made again without the split.
"""

import contextlib
import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from pydantic import TypeAdapter

from oodd_eval.data.bounded import MANIFEST_BYTES, read_json
from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import TABLE1
from oodd_eval.data.files import forms, write_bytes
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import Record
from oodd_paper.experiments import EXPERIMENTS, PAPER, Tier, of_paper, settings_of

HEADER: Final = "reproduction.json"
RETURNS: Final = "returns.json"
SCHEMA: Final = 1
KINDS: Final = ("nominal", *TABLE1)

Returns = Mapping[str, Mapping[str, Sequence[float]]]  # by environment and kind


@dataclass(frozen=True, slots=True)
class Reproduction:
    """The tier, data and sizes of a reproduction, and the number of units of all experiments.

    Records of version 0.1.0 have no time: the header has the `date` of the last one, ISO 8601.
    """

    tier: Tier
    split: str
    split_digest: str
    protocol: int
    train: int
    calibration: int
    test: int
    units: int
    date: str = ""

    def select(self, records: Iterable[Record]) -> list[Record]:
        """Return the records that belong to it: its whole data, its settings, its seeds.

        They tell what differs from the paper's parameters, see `of_paper`.
        """
        seeds = {setting: self.tier.seeds(setting) for setting in settings_of(EXPERIMENTS)}
        data = self.split_digest, self.protocol, None
        whole = (r for r in records if (r.split_digest, r.protocol, r.limit) == data)
        named = [
            replace(r, overrides=of_paper(r.setting, r.parameters).overrides)
            if r.detector in PAPER else r
            for r in whole
        ]  # fmt: skip
        return [r for r in named if r.seed in seeds.get(r.setting, ())]

    @classmethod
    def load(cls, directory: Path) -> "Reproduction":
        """Read the header of a directory, fields of other versions left out."""
        path = directory / HEADER
        if not path.exists():
            what = f"expected a file {HEADER}, written by oodd-eval reproduce"
            raise ResultsError(f"no reproduction in {str(directory)!r}: {what}")
        try:
            plain = read_json(path, MANIFEST_BYTES, ResultsError)
            if plain.get("schema") != SCHEMA:
                raise ValueError("it was written by another version of oodd-eval")  # noqa: TRY301
            return TypeAdapter(cls).validate_python(plain)
        except (ValueError, AttributeError) as error:
            raise ResultsError(f"{str(path)!r} cannot be read: {error}") from None

    def check_same_data(self, directory: Path) -> None:
        """Refuse a directory that holds a reproduction on other data or under other rules."""
        if not (directory / HEADER).exists():
            return
        other = self.load(directory)
        if (other.split_digest, other.protocol) != (self.split_digest, self.protocol):
            both = f"{str(directory)!r} holds a reproduction {other}, and this is {self}"
            raise UsageError(f"{both}: name another directory with --output")

    def __str__(self) -> str:
        data = f"digest {self.split_digest[:12]}, protocol {self.protocol}"
        return f"of tier {self.tier.name} on split {self.split} ({data})"


class Other(NamedTuple):
    """Tables that another reproduction has written, to be shown beside one.

    Lines of CSV by their first columns: of tables by experiment, environment, series, anomalies and
    metric; of claims by claim and kind. Returns are those of the policies.
    """

    name: str
    numbers: Mapping[tuple[str, ...], Mapping[str, str]]
    claims: Mapping[tuple[str, str], Mapping[str, str]]
    returns: Returns | None

    @classmethod
    def load(cls, directory: Path) -> "Other":
        """Read a directory in which ``oodd-eval reproduce`` has written."""
        header = Reproduction.load(directory)
        named = ("environment", "series", "anomalies", "metric")
        numbers = {
            (e.id, *(line[column] for column in named)): line
            for e in EXPERIMENTS
            for line in _lines(directory / "tables" / f"{e.id}.csv")
        }
        claims = {(line["claim"], line["kind"]): line for line in _lines(directory / "claims.csv")}
        return cls(header.split, numbers, claims, load_returns(directory, header.split_digest))


def _lines(path: Path) -> list[dict[str, str]]:
    """Read a CSV file; nothing where there is none."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def keep_inputs(directory: Path, reproduction: Reproduction, split: Split) -> None:
    """Write both files, the returns only where they are missing: that reads the whole test part."""
    header = json.dumps({"schema": SCHEMA, **asdict(reproduction)}, indent=1)
    write_changed(directory / HEADER, header + "\n")
    if load_returns(directory, split.digest) is not None:
        return
    returns = {}
    for name in split.environments:
        with contextlib.closing(split.environment(name)) as data:
            sets = {"nominal": data.twins} | {c: data.anomalous(c) for c in data.anomalies}
            by_part = {Condition.parse(c).anomaly: s.returns.tolist() for c, s in sets.items()}
            returns[name] = by_part
    write_changed(directory / RETURNS, dump_returns(returns, split.digest))


def write_changed(path: Path, content: str | bytes) -> None:
    """Write a file in one step, unless it has this content already."""
    data = content.encode() if isinstance(content, str) else content
    if not path.is_file() or path.read_bytes() != data:
        write_bytes(path, data)


def dump_returns(returns: Returns, digest: str) -> str:
    """Return the content of ``returns.json``."""
    whole = {"schema": SCHEMA, "split_digest": digest, "returns": returns}
    return json.dumps(whole, sort_keys=True) + "\n"


def load_returns(directory: Path, digest: str) -> Returns | None:
    """Read ``returns.json``; None where it is absent or of other data."""
    path = directory / RETURNS
    if not path.exists():
        return None
    try:
        whole = read_json(path, MANIFEST_BYTES, ResultsError)
        returns: Returns = whole["returns"]
        return returns if whole["split_digest"] == digest else None
    except (ValueError, KeyError, TypeError) as error:
        todo = "delete it, and it will be made again"
        raise ResultsError(f"{str(path)!r} cannot be read: {error!r}; {todo}") from None


def load_records(reproduction: Reproduction, paths: Iterable[Path]) -> list[Record]:
    """Read a reproduction's records below some directories; no two may hold the same cell."""
    origin: dict[Cell, Path] = {}
    records: list[Record] = []
    directories: set[Path] = set()
    for path in paths:
        # Large entries of the leaderboard keep their records compressed.
        below = [file.parent for name in forms(RECORDS) for file in path.rglob(name)]
        if not below:
            raise ResultsError(f"no results in {str(path)!r}, expected {RECORDS} in or below it")
        directories.update([path] if path in below else below)
    for directory in sorted(directories):
        for record in reproduction.select(ResultsDirectory(directory).records()):
            if (first := origin.setdefault(record.cell, directory)) != directory:
                twice = f"{record.cell} is in {str(first)!r} and in {str(directory)!r}"
                todo = "name those that belong to the reproduction with --records"
                raise ResultsError(f"{twice}: {todo}")
            records.append(record)
    return records
