"""Records to compare and to compare with, read from results or from a reference, and written.

A reference is a file of records, such as ``records.jsonl``, without what no comparison needs:
intervals, values of single trajectories and costs. So it is small, and a change of it can be read.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.files import write_text
from oodd_eval.errors import ResultsError
from oodd_eval.names import Predicate
from oodd_eval.results.directory import ResultsDirectory, read_records
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, Metric, Record


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which records can be compared; of the split, the digest decides."""

    split: str = field(compare=False)
    split_digest: str
    protocol: int
    limit: int | None

    def __str__(self) -> str:
        limited = f", limited to {self.limit}" if self.limit is not None else ""
        return f"split {self.split} {self.split_digest[:12]}, protocol {self.protocol}{limited}"


@dataclass(frozen=True, slots=True)
class RecordSet:
    """Records by conditions and cell, and the name of the place that they are from."""

    where: str
    boards: dict[Conditions, dict[Cell, Record]]

    @classmethod
    def of(cls, records: Iterable[Record], where: str = "records") -> "RecordSet":
        """Arrange records for comparison; of several of one cell, the last one counts."""
        boards: dict[Conditions, dict[Cell, Record]] = {}
        for r in records:
            conditions = Conditions(r.split, r.split_digest, r.protocol, r.limit)
            boards.setdefault(conditions, {})[r.cell] = r
        return cls(where, boards)

    @property
    def records(self) -> list[Record]:
        """All records."""
        return [record for cells in self.boards.values() for record in cells.values()]

    def selected(self, wanted: Predicate | None) -> "RecordSet":
        """Return the records of those cells only whose text passes."""
        chosen = (r for r in self.records if wanted is None or wanted(str(r.cell)))
        return RecordSet.of(chosen, self.where)

    def metrics(self) -> list[str]:
        """Return the names of all metrics that occur, in their order."""
        return list(dict.fromkeys(name for r in self.records for name in r.metrics))


def read_record_set(path: Path | str) -> RecordSet:
    """Read the records of a results directory or of a file, such as a reference."""
    path = Path(path)
    if not path.exists():
        raise ResultsError(
            f"no results or reference at {str(path)!r}: expected a results directory, or a file of "
            "records (*.jsonl) such as oodd-eval compare --write-reference writes"
        )
    records = ResultsDirectory(path).records() if path.is_dir() else read_records(path)
    return RecordSet.of(records, str(path))


def write_reference(records: Iterable[Record], path: Path | str) -> None:
    """Write a file of records to compare with later: values, without intervals and costs.

    Records stand in the order of the benchmark, whatever the order in which cells ran.
    """
    environments, anomalies = list(ENVIRONMENTS), list(ANOMALIES)

    def order(r: Record) -> tuple[str, str, int, int, str]:
        place = environments.index(r.environment), anomalies.index(r.anomaly)
        return r.split, r.split_digest, *place, str(r.cell)

    lines = [_referenced(record).to_json() + "\n" for record in sorted(records, key=order)]
    write_text(Path(path), "".join(lines))


def _referenced(record: Record) -> Record:
    known = ("oodd_eval", "python", "numpy")
    return replace(
        record,
        metrics={name: Metric(metric.value, n=metric.n) for name, metric in record.metrics.items()},
        per_trajectory={}, scores="", seconds_fit=NAN, seconds_score=NAN, steps_scored=None,
        peak_rss_mb=NAN, provenance={k: v for k, v in record.provenance.items() if k in known},
    )  # fmt: skip
