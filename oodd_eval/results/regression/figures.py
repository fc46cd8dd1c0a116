"""What is compared: figures per cell, read from results or from a reference file, and written.

A reference file holds the metrics of every cell without intervals, one cell a line, so that it is
small and a change of it can be read. Cells stand in the order of the benchmark, whatever the order
in which they ran::

    {"kind": "oodd-eval reference", "schema": 1, "versions": {...}, "detectors": {...},
     "boards": [{"split": ..., "split_digest": ..., "protocol": ..., "limit": ...,
                 "cells": {"mini/hopper/iid::rf[h=1,seed=0]": {"auc": 0.97, "delay": null, ...},
                           "mini/ant/iid::rf[h=1,seed=0]": "timeout"}}]}

A cell that failed has its state in place of metrics. Numbers have six decimals.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.errors import OutputError, ResultsError
from oodd_eval.names import Predicate
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import NAN, STATUSES, Record

KIND: Final = "oodd-eval reference"
SCHEMA: Final = 1
"""Version of the layout of a reference file; a reader refuses others."""

DECIMALS: Final = 6


@dataclass(frozen=True, slots=True)
class Conditions:
    """What figures must have in common to be compared.

    Attributes
    ----------
    split, split_digest
        Name and content of the split; the digest decides.
    protocol
        Version of the benchmark's rules.
    limit
        First so many trajectories that were used; None means all.
    """

    split: str
    split_digest: str
    protocol: int
    limit: int | None

    @property
    def key(self) -> tuple[str, int, int | None]:
        """What has to be equal: everything but the split's name."""
        return self.split_digest, self.protocol, self.limit

    @property
    def text(self) -> str:
        """As printed."""
        limited = f", limited to {self.limit}" if self.limit is not None else ""
        return f"split {self.split} {self.split_digest[:12]}, protocol {self.protocol}{limited}"


@dataclass(frozen=True, slots=True)
class Figures:
    """Metrics of one cell by name, NaN where undefined; or the state in which it failed."""

    status: str = "ok"
    reason: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether the cell has metrics."""
        return self.status == "ok"


@dataclass(frozen=True, slots=True)
class FigureSet:
    """All figures of one file or directory, by conditions and by cell id."""

    where: str
    boards: dict[Conditions, dict[str, Figures]]

    def selected(self, wanted: Predicate | None) -> FigureSet:
        """Return the figures of those cells only whose ids pass."""
        if wanted is None:
            return self
        kept = {
            conditions: {cell: f for cell, f in cells.items() if wanted(cell)}
            for conditions, cells in self.boards.items()
        }
        return FigureSet(self.where, {c: cells for c, cells in kept.items() if cells})

    def metrics(self) -> list[str]:
        """Return the names of all metrics that occur, in their order."""
        cells = (figures for board in self.boards.values() for figures in board.values())
        return list(dict.fromkeys(name for figures in cells for name in figures.metrics))


def figures_of(records: Iterable[Record], where: str = "records") -> FigureSet:
    """Arrange records for comparison; of several of one cell, the last one counts."""
    boards: dict[Conditions, dict[str, Figures]] = {}
    for r in records:
        conditions = Conditions(r.split, r.split_digest, r.protocol, r.limit)
        metrics = {name: metric.value for name, metric in r.metrics.items()}
        boards.setdefault(conditions, {})[str(r.cell)] = Figures(r.status, r.reason, metrics)
    return FigureSet(where, boards)


def read_records(path: Path | str) -> list[Record]:
    """Read the records of a results directory, or of a file of records.

    Raises
    ------
    ResultsError
        When there are none, or one cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return ResultsDirectory(path).records()
    if path.suffix != ".jsonl" and path.exists():
        raise ResultsError(
            f"{str(path)!r} has no records: expected a results directory or a file *.jsonl"
        )
    return [
        Record.from_json(line, f"{path}:{number}")
        for number, line in enumerate(_text(path).splitlines(), start=1)
        if line.strip()
    ]


def read_figures(path: Path | str) -> FigureSet:
    """Read a results directory, a file of records (``*.jsonl``) or a reference file.

    Raises
    ------
    ResultsError
        When it does not exist or is none of them.
    """
    path = Path(path)
    if path.is_dir() or path.suffix == ".jsonl":
        return figures_of(read_records(path), str(path))
    return _parse(_text(path), str(path))


def write_reference(records: Sequence[Record], path: Path | str) -> None:
    """Write a reference file of records.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(reference_text(records), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"reference {str(path)!r} cannot be written: {error.strerror}") from None


def reference_text(records: Sequence[Record]) -> str:
    """Return the content of a reference file, the same for the same records in any order."""
    records = sorted(records, key=_order)
    versions: dict[str, Any] = {}
    detectors: dict[str, Any] = {}
    for r in records:
        versions |= {k: r.provenance[k] for k in ("oodd_eval", "python", "numpy")
                     if k in r.provenance}  # fmt: skip
        detectors[r.detector] = {
            "plugin": r.plugin,
            "version": r.detector_version,
            "source": r.plugin_source,
        }
    head = {"kind": KIND, "schema": SCHEMA, "versions": versions}
    lines = [f" {json.dumps(k)}: {json.dumps(v)}," for k, v in head.items()]
    origins = [f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in detectors.items()]
    boards = [_board_text(c, cells) for c, cells in figures_of(records).boards.items()]
    return "\n".join(
        ["{", *lines, ' "detectors": {', ",\n".join(origins), " },",
         ' "boards": [', ",\n".join(boards), " ]", "}\n"]
    )  # fmt: skip


def _order(record: Record) -> tuple[str, str, int, int, str]:
    return (
        record.split,
        record.split_digest,
        _position(record.environment, tuple(ENVIRONMENTS)),
        _position(record.anomaly, tuple(ANOMALIES)),
        str(record.cell),
    )


def _position(name: str, names: Sequence[str]) -> int:
    return names.index(name) if name in names else len(names)


def _board_text(conditions: Conditions, cells: Mapping[str, Figures]) -> str:
    facts = [
        f"   {json.dumps(name)}: {json.dumps(getattr(conditions, name))},"
        for name in ("split", "split_digest", "protocol", "limit")
    ]
    rows = [f"    {json.dumps(cell)}: {json.dumps(_plain(f))}" for cell, f in cells.items()]
    return "\n".join(["  {", *facts, '   "cells": {', ",\n".join(rows), "   }", "  }"])


def _plain(figures: Figures) -> dict[str, float | None] | str:
    if not figures.ok:
        return figures.status
    return {
        name: round(value, DECIMALS) if math.isfinite(value) else None
        for name, value in figures.metrics.items()
    }


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ResultsError(
            f"no results or reference at {str(path)!r}: expected a results directory, a file of "
            "records (*.jsonl) or a reference written by oodd-eval compare --write-reference"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ResultsError(f"{str(path)!r} cannot be read: {error}") from None


def _parse(text: str, where: str) -> FigureSet:
    try:
        plain = json.loads(text)
    except json.JSONDecodeError as error:
        raise ResultsError(f"{where} is not JSON: {error}") from None
    if not isinstance(plain, dict) or plain.get("kind") != KIND:
        raise ResultsError(f"{where} is no reference file: expected an object of kind {KIND!r}")
    if plain.get("schema") != SCHEMA:
        raise ResultsError(
            f"{where} has schema {plain.get('schema')!r}, expected {SCHEMA}: it was written by "
            "another version of oodd-eval"
        )
    boards: dict[Conditions, dict[str, Figures]] = {}
    for number, board in enumerate(_of(plain, "boards", list, where)):
        place = f"{where}: boards[{number}]"
        if not isinstance(board, dict):
            raise ResultsError(f"{place} is {type(board).__name__}, expected an object")
        conditions = Conditions(
            _of(board, "split", str, place),
            _of(board, "split_digest", str, place),
            _of(board, "protocol", int, place),
            _of(board, "limit", int | None, place),
        )
        boards[conditions] = {
            cell: _figures(value, f"{place}: cell {cell!r}")
            for cell, value in _of(board, "cells", dict, place).items()
        }
    return FigureSet(where, boards)


def _of(plain: Mapping[str, Any], name: str, kind: Any, place: str) -> Any:
    value = plain.get(name)
    # bool is an int to isinstance, and never meant here.
    if name not in plain or not isinstance(value, kind) or isinstance(value, bool):
        expected = getattr(kind, "__name__", str(kind))
        raise ResultsError(f"{place}: {name} is {value!r:.60}, expected {expected}")
    return value


def _figures(value: Any, place: str) -> Figures:
    if isinstance(value, str) and value in STATUSES[1:]:
        return Figures(value)
    if not isinstance(value, dict):
        raise ResultsError(
            f"{place} is {value!r:.60}, expected metrics or one of {', '.join(STATUSES[1:])}"
        )
    for name, number in value.items():
        if number is not None and (not isinstance(number, int | float) or isinstance(number, bool)):
            raise ResultsError(f"{place}: {name} is {number!r:.60}, expected a number or null")
    return Figures(metrics={k: NAN if v is None else float(v) for k, v in value.items()})
